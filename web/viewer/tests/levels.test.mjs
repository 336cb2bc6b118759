import assert from 'node:assert/strict';
import { test } from 'node:test';
import { Camera } from '../src/camera.js';
import { LevelSorter } from '../src/level-sorter.js';
import { Levels } from '../src/levels.js';
import { Space } from '../src/space.js';

const [ROWS, CHUNKS] = [16, 8];

/** Chunk k of eight lies around x = 4 k - 14. */
function scene() {
  const boxes = Array.from({ length: CHUNKS }, (_, k) => [40 * k - 150, -10, -10, 40 * k - 130, 10, 10, 0]);
  const count = CHUNKS * ROWS;
  return { count, shDegree: 0, layers: [count], chunkRows: ROWS, steps: { position: 0.1 }, settings: { boxes }, anyChunk: true, preview: {} };
}

/** A view along z that shows all chunks, from x = `at`. */
function view(at) {
  const camera = new Camera([0, -1, 0]);
  const lens = { width: 100, height: 100, fx: 20, fy: 20, cx: 49.5, cy: 49.5 };
  camera.setPose({ position: [at, 0, -10], rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], ...lens }, [0, 0, 0], 10); // prettier-ignore
  return camera.view(100, 100);
}

/** Levels of two rows and of four rows a chunk, all of which are there, and all chunks. */
function all() {
  const space = new Space(scene(), 1000);
  const sent = [];
  const viewer = { view: view(-14), pace: { still: Infinity }, asking: 0, sorter: { postMessage: ({ shown }) => sent.push(shown) } };
  const headers = [2, 4].map((rows) => ({ layers: Array(CHUNKS).fill(rows), shRows: 0 }));
  const levels = new Levels(viewer, space, headers);
  levels.places.forEach(({ rows }, start) => levels.add({ start, rows, importance: new Float32Array(rows).fill(4 - rows) }));
  space.look(viewer.view);
  for (let part = space.next(); part; part = space.next()) space.arrived(part.index);
  return { viewer, levels, sent, shown: () => levels.chunks.map(({ now }) => now) };
}

test('with room for all, chunks are drawn; their levels lie behind them', () => {
  const { viewer, levels, sent, shown } = all();
  assert.equal(levels.room.count, CHUNKS * (ROWS + 4 + 2));
  levels.choose();
  assert.deepEqual(shown(), Array(CHUNKS).fill(2));
  assert.deepEqual(sent, [Array.from({ length: CHUNKS }, (_, k) => k * ROWS)]);
  levels.choose();
  assert.equal(sent.length, 1, 'nothing is said twice');
  assert.equal(viewer.rows, CHUNKS * ROWS);
});

test('a budget is kept, and what is near is finer', () => {
  const { viewer, levels, shown } = all();
  for (const most of [1, 20, 40, 60, 100]) {
    viewer.pace.still = most;
    levels.choose();
    const now = shown();
    assert.ok(viewer.rows <= Math.max(most, 2 * CHUNKS), `${viewer.rows} of ${most}`);
    assert.deepEqual(now, [...now].sort().reverse(), 'the camera stands before the first chunk');
  }
});

test('what is drawn stays while nothing else is much nearer', () => {
  const { viewer, levels, shown } = all();
  viewer.pace.still = 2 * CHUNKS + ROWS - 2 + 2 * (CHUNKS - 1);
  viewer.view = view(-1);
  levels.choose();
  const [before] = [shown()];
  assert.equal(before[3], 2, 'the nearest one');
  viewer.view = view(1);
  levels.choose();
  assert.deepEqual(shown(), before);
  viewer.view = view(6);
  levels.choose();
  assert.equal(shown()[5], 2);
});

test('rows of a level that are missing are asked for once, those in sight first', () => {
  const { levels } = all();
  for (const version of levels.places.values()) version.here = version.k > 2;
  levels.space.parts.forEach((part) => (part.inSight = part.index !== 1));
  assert.deepEqual([levels.next().level, levels.next().level, levels.next()], [0, 2, null]);
  assert.equal(levels.next(true).level, 1);
  assert.equal(levels.next(true), null);
});

test('the sorter sorts what is shown', () => {
  const sorter = new LevelSorter();
  for (const start of [0, 3, 6]) sorter.add(Float32Array.of(0, 0, 0, 0, 0, 0, 1 + start, 2 + start, 3 + start), new Float32Array(3), start);
  const sorted = () => {
    const out = new Uint32Array(9);
    return [...out.subarray(0, sorter.sort([0, 0, 1, 0], 0.2, out))];
  };
  assert.deepEqual(sorted(), []);
  sorter.show([6, 0]);
  assert.deepEqual(sorted(), [8, 7, 6, 2, 1, 0]);
  sorter.show([3]);
  assert.deepEqual(sorted(), [5, 4, 3]);
  sorter.add(Float32Array.of(0, 0, 0, 0, 9, 1), new Float32Array(2), 3);
  assert.deepEqual(sorted(), [3, 4]);
});
