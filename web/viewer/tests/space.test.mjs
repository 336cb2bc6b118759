import assert from 'node:assert/strict';
import { test } from 'node:test';
import { Camera } from '../src/camera.js';
import { Space } from '../src/space.js';

const ROWS = 10;

/** Two layers of eight chunks each, in a row along x: chunk k of a layer lies around x = 4 k - 14. */
function header(changes = {}) {
  const boxes = [];
  for (let k = 0; k < 16; k++) {
    const x = 40 * (k % 8) - 140;
    boxes.push([x - 10, -10, -10, x + 10, 10, 10, k % 3]);
  }
  const layers = [8 * ROWS, 8 * ROWS - 3];
  return {
    count: 157,
    shDegree: 1,
    layers,
    chunkRows: ROWS,
    steps: { position: 0.1 },
    settings: { boxes },
    anyChunk: true,
    ...changes,
  };
}

/** A view from x = `at` along z, so narrow that it shows two or three chunks. */
function view(at, forward = [0, 0, 1]) {
  const camera = new Camera([0, -1, 0]);
  const position = [at, 0, forward[2] ? -10 : 0];
  const rotation = forward[2] ? [[1, 0, 0], [0, 1, 0], forward] : [[0, 0, -1], [0, 1, 0], forward]; // prettier-ignore
  camera.setPose({ position, rotation, width: 100, height: 100, fx: 300, fy: 300, cx: 49.5, cy: 49.5 }, [0, 0, 0], 10);
  return camera.view(100, 100);
}

function order(space) {
  const asked = [];
  for (let part = space.next(); part; part = space.next()) asked.push(part.index);
  return asked;
}

test('chunks in sight come first, layer by layer; a layer out of sight comes before the third one in sight', () => {
  const space = new Space(header(), 1000);
  space.look(view(-14));
  const asked = order(space);
  assert.deepEqual(asked.slice(0, 2), [0, 8]);
  assert.deepEqual(asked.slice(2, 9), [1, 2, 3, 4, 5, 6, 7], 'the nearest first');
  assert.equal(asked.length, 16);
  assert.equal(new Set(asked).size, 16);
});

test('each chunk has its place in the order of the file, and the room is that of the file', () => {
  const space = new Space(header(), 157);
  assert.deepEqual(space.room, { count: 157, shRows: 15, shDegree: 1 });
  space.look(view(14));
  const places = [];
  for (let part = space.next(); part; part = space.next()) places[part.index] = part.place;
  assert.deepEqual(places.map(({ start }) => start), places.map((_, k) => ROWS * k)); // prettier-ignore
  assert.equal(places[15].rows, 7);
  assert.deepEqual([places[2].shStart, places[2].shEnd, places[3].shStart], [1, 3, 3]);
});

test('over the budget, all chunks lose the same share of their rows; with layers beside a preview, too', () => {
  const space = new Space(header({ preview: {} }), 45);
  assert.equal(space.share, 45 / 157);
  assert.deepEqual(space.room, { count: 15 * 2 + 2, shRows: 15, shDegree: 1 });
  space.look(view(14));
  assert.equal(order(space).length, 16);
  assert.deepEqual(
    space.parts.sort((a, b) => a.index - b.index).map(({ place }) => place.start),
    [...Array(16).keys()].map((k) => 2 * k),
  );
  assert.equal(space.parts[2].place.shEnd - space.parts[2].place.shStart, 2);
});

test('over the budget and beside a preview, chunks out of sight give way to better ones, and no others', () => {
  const space = new Space(header({ preview: {}, layers: [157] }), 45);
  assert.equal(space.share, 1);
  assert.deepEqual(space.room, { count: 40, shRows: 8, shDegree: 1 });
  space.look(view(-14));
  const first = order(space);
  assert.deepEqual(first, [0, 8, 1, 9]);
  assert.equal(space.complete, false);
  first.forEach((index) => space.arrived(index));
  assert.equal(space.next(), null, 'nothing that is missing is better');
  assert.equal(space.missing, 1);
  space.look(view(14));
  assert.equal(space.missing, 1, 'nothing of what is in sight is there');
  const part = space.next();
  assert.equal(part.index, 7);
  assert.equal(part.place.start, 10, 'the place of the farthest one');
  space.arrived(7);
  assert.equal(space.missing, 17 / 10);
  assert.deepEqual(order(space), [15]);
});

test('a chunk that was asked for and is not here yet keeps its place', () => {
  const space = new Space(header({ preview: {}, layers: [157] }), 20);
  space.look(view(-14));
  assert.deepEqual(order(space), [0, 8]);
  space.look(view(14));
  assert.equal(space.next(), null);
});

test('a view sees what lies ahead, to its sides and no farther', () => {
  const space = new Space(header(), 1000);
  space.look(view(0, [1, 0, 0]));
  const seen = space.parts.filter((part) => part.inSight).map(({ index }) => index % 8);
  assert.ok(seen.length > 0 && seen.every((k) => 4 * k - 14 > -1), seen.join());
  space.look(view(0));
  const ahead = space.parts.filter((part) => part.inSight).map(({ index }) => index % 8);
  assert.deepEqual([...new Set(ahead)].sort(), [3, 4]);
});

test('the box leaves chunks far outside out', () => {
  const far = header();
  far.settings.boxes[0] = [-1e6, -1e6, -1e6, -1e5, 0, 0, 0];
  const { low, high } = new Space(far, 1000).box;
  assert.ok(low[0] > -15 && high[0] < 15 && low[1] === -1 && high[2] === 1);
});

test('without boxes that can be used, chunks come as they are', () => {
  assert.equal(Space.tells(header()), true);
  const { boxes } = header().settings;
  for (const wrong of [undefined, 'boxes', boxes.slice(1), boxes.with(3, [1, 2, 3]), boxes.with(3, [0, 0, 0, 0, 0, 0, 0.5])]) {
    assert.equal(Space.tells(header({ settings: { boxes: wrong } })), false);
  }
  assert.equal(Space.tells(header({ anyChunk: false })), false);
  assert.equal(Space.tells(header({ layers: [0], count: 0 })), false);
  assert.equal(Space.tells(header({ chunkRows: undefined, steps: undefined })), false, 'version 1');
});

test('boxes of contracted positions lie around what is in them', () => {
  const steps = { position: 0.1, contraction: { centre: [1, 0, 0], radius: 2 } };
  const contracted = new Space(header({ steps }), 1e9);
  const plain = new Space(header(), 1e9);
  contracted.parts.forEach((part, i) => {
    const { low, high } = plain.parts[i];
    // At 7.5 radii and more, the farthest places are more than 2^6 radii away.
    const far = Math.max(Math.abs(low[0] - 1), Math.abs(high[0] - 1)) / 2;
    assert.ok(low.every((value, axis) => part.low[axis] <= value) && high.every((value, axis) => part.high[axis] >= value));
    if (far <= 1) assert.deepEqual([part.low, part.high], [low, high]);
    if (far >= 7) assert.ok(Math.max(Math.abs(part.low[0] - 1), Math.abs(part.high[0] - 1)) >= 2 * 2 ** 6);
  });
});
