import assert from 'node:assert/strict';
import { test } from 'node:test';
import { boxOf, Camera, outsidePose, startOf, startPose, upOf, viewOfWord, viewWord } from '../src/camera.js';
import { toHalf } from '../src/half.js';
import { NO_SH, packChunk, shPerLine, shTexels } from '../src/pack.js';
import { growthOf, ROW_BITS } from '../src/some.js';
import { Sorter } from '../src/sort.js';
import { cross, dot } from '../src/vectors.js';

function fromHalf(bits) {
  const [sign, exponent, fraction] = [bits & 0x8000 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  return exponent ? sign * 2 ** (exponent - 15) * (1 + fraction / 1024) : sign * 2 ** -14 * (fraction / 1024);
}

test('half floats are the nearest ones', () => {
  for (let bits = 0; bits < 0x7c00; bits++) assert.equal(toHalf(fromHalf(bits)), bits);
  assert.equal(toHalf(-1.5), 0xbe00);
  assert.equal(toHalf(1 + 2 ** -11), 0x3c00, 'a tie goes to the even one');
  assert.equal(toHalf(1 + 3 * 2 ** -11), 0x3c02);
  assert.equal(toHalf(1e9), 0x7bff);
  assert.equal(toHalf(2 ** -24), 1);
  assert.equal(toHalf(1e-12), 0);
});

test('rows are sorted back to front, ties by the row, and hidden ones are left out', () => {
  const sorter = new Sorter();
  const z = [3, 1, 2, -1, 2, 0.1];
  sorter.add(Float32Array.from([...z.map(() => 0), ...z.map(() => 0), ...z]), Float32Array.from(z, () => 1));
  const out = new Uint32Array(6);
  assert.equal(sorter.sort([0, 0, 1, 0], 0.2, out), 4);
  assert.deepEqual([...out.subarray(0, 4)], [0, 4, 2, 1]);
  assert.equal(sorter.sort([0, 0, 1, 10], 0.2, out), 6);
  assert.deepEqual([...out], [0, 4, 2, 1, 5, 3]);
});

/** A sorter of two chunks of 5000 rows at depth 1, of which the second half shows so much more. */
function twoChunks(more) {
  const sorter = new Sorter();
  for (const add of [0, more]) sorter.add(new Float32Array(15_000).fill(1), new Float32Array(5000).fill(add));
  return sorter;
}

/** Rows, and steps below the level from which on all are drawn. */
function some(sorter, most, sight) {
  const out = new Uint32Array(10_000);
  const words = [...out.subarray(0, sorter.sort([0, 0, 1, 0], 0.2, out, most, sight))];
  return { rows: words.map((word) => word % 2 ** ROW_BITS), below: words.map((word) => word >>> ROW_BITS) };
}

test('of too many splats some are drawn, everywhere, and they grow', () => {
  const { rows, below } = some(twoChunks(0), 2500);
  assert.ok(Math.abs(rows.length - 2500) < 100, rows.length);
  for (let at = 0; at < 10_000; at += 100) {
    const near = rows.filter((row) => row >= at && row < at + 100).length;
    assert.ok(near >= 22 && near <= 28, `${near} of 100`);
  }
  assert.deepEqual([...new Set(below)], [64]);
  assert.ok(Math.abs(Math.exp(growthOf(64)) - 4 ** 0.4) < 1e-9, 'a quarter of them, larger');
});

test('splats that show more, are nearer or in sight have a larger chance, and all have one', () => {
  const shares = (sorter, sight) => [0, 1].map((half) => some(sorter, 5000, sight).rows.filter((row) => row < 5000 === !half).length);
  const [small, large] = shares(twoChunks(Math.log(16)));
  assert.ok(Math.abs(large / small - 16 ** 0.375) < 0.1, large / small);
  const moved = twoChunks(0);
  moved.parts[1].means.fill(4, 10_000);
  assert.ok(Math.abs(shares(moved)[0] / shares(moved)[1] - 16 ** 0.375) < 0.1, 'four times as far');
  moved.parts[1].means.fill(1, 10_000).fill(9, 0, 5000);
  const [seen, unseen] = shares(moved, { eye: [0, 0, 0], wide: 4 });
  assert.ok(seen / unseen > 7 && unseen > 500, [seen, unseen]);
});

test('a chunk takes the place of one that began at the same row', () => {
  const sorter = new Sorter();
  const at = (...z) => Float32Array.from([...z.map(() => 0), ...z.map(() => 0), ...z]);
  sorter.add(at(4, 2), Float32Array.of(1, 1), 10);
  sorter.add(at(3, 1), Float32Array.of(1, 1), 0);
  const out = new Uint32Array(4);
  assert.equal(sorter.sort([0, 0, 1, 0], 0.2, out), 4);
  assert.deepEqual([...out], [10, 0, 11, 1]);
  sorter.add(at(9), Float32Array.of(1), 10);
  assert.equal(sorter.sort([0, 0, 1, 0], 0.2, out), 3);
  assert.deepEqual([...out.subarray(0, 3)], [10, 0, 1]);
});

test('chunks are packed: rows with SH lie apart', () => {
  const rows = 3;
  const each = 3;
  const shRest = new Float32Array(3 * each * rows);
  shRest[1] = 0.5; // red, coefficient 0, row 1
  shRest[(2 * each + 2) * rows + 2] = -2; // blue, coefficient 2, row 2
  const values = {
    means: Float32Array.from({ length: 9 }, (_, i) => i),
    shDc: new Float32Array(9),
    shRest,
    opacityLogits: new Float32Array(3),
    logScales: new Float32Array(9),
    quats: new Float32Array(12),
  };
  const { data, sh, shRows } = packChunk(values, rows, 1, 10);
  assert.equal(shRows, 2);
  assert.deepEqual([data[3], data[19], data[35]], [NO_SH, 10, 11]);
  assert.deepEqual([data[15], data[31], data[47]], [0, 1, 1]);
  const halves = new Uint16Array(sh.buffer);
  const width = 8 * shTexels(1);
  assert.equal(fromHalf(halves[0]), 0.5);
  assert.equal(fromHalf(halves[width + 8]), -2);
  assert.deepEqual([new Float32Array(data.buffer)[16], new Float32Array(data.buffer)[18]], [1, 7]);
  assert.equal(shPerLine(3) * shTexels(3) <= 2048, true);
  assert.deepEqual(packChunk(values, rows, 1, 10, Uint8Array.of(0, 1, 1)), { ...packChunk(values, rows, 1, 10) });
});

function axesAreRight(camera) {
  const [right, down, forward] = camera.axes;
  for (const axis of camera.axes) assert.ok(Math.abs(dot(axis, axis) - 1) < 1e-9);
  cross(right, down).forEach((value, i) => assert.ok(Math.abs(value - forward[i]) < 1e-9));
}

test('a pose fills the canvas of its own size exactly, and fits into others', () => {
  const pose = { position: [1, 2, 3], rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], width: 40, height: 30, fx: 35, fy: 36, cx: 18, cy: 15 }; // prettier-ignore
  const camera = new Camera([0, -1, 0]);
  camera.setPose(pose, [1, 1, 1], 5);
  const view = camera.view(40, 30);
  assert.deepEqual([view.fx, view.fy, view.cx, view.cy], [35, 36, 18, 15]);
  assert.deepEqual(view.eye, [0, 1, 2]);
  const wide = camera.view(120, 60);
  assert.deepEqual([wide.fx, wide.cx], [70, 59.5 + 2 * (18 - 19.5)]);
});

test('turning keeps the axes square and the distance', () => {
  const camera = new Camera([0, -1, 0]);
  const pose = outsidePose({ low: [-1, -1, -1], high: [1, 1, 1] }, [5, 5, 5]);
  camera.setPose(pose, [5, 5, 5], 4);
  axesAreRight(camera);
  const distance = camera.distance;
  for (let i = 0; i < 400; i++) {
    camera.orbit(0.1, 0.07);
    axesAreRight(camera);
  }
  assert.ok(Math.abs(camera.distance - distance) < 1e-6);
  for (let i = 0; i < 100; i++) camera.look(0.2, -0.3);
  axesAreRight(camera);
  camera.zoom(0.5);
  assert.ok(Math.abs(camera.distance - distance / 2) < 1e-6);
  const up = upOf([pose]);
  assert.ok(up[1] < 0);
  const box = boxOf(Float32Array.from({ length: 300 }, (_, i) => i % 100), 100);
  assert.ok(box.low[0] > 0 && box.high[0] < 99);
});

test('a start view stands upright, and survives an address', () => {
  const start = { eye: [500001, 2, 3], target: [500004, 4, 9], up: [0, -0.6, 0.8], fov: [60, 40] };
  const pose = startPose(start);
  const camera = new Camera(pose.up);
  const origin = [500000, 0, 0];
  camera.setPose(pose, origin, pose.depth);
  axesAreRight(camera);
  assert.ok(Math.abs(dot(camera.axes[0], start.up)) < 1e-9 && dot(camera.axes[1], start.up) < 0);
  assert.ok(Math.abs(camera.distance - 7) < 1e-9);
  const { fx, fy } = camera.view(1200, 100);
  assert.ok(Math.abs(100 / 2 / fy - Math.tan((20 * Math.PI) / 180)) < 1e-9 && Math.abs(fx - fy) < 1e-9);
  const again = viewOfWord(viewWord(startOf(camera, origin)));
  for (const name of Object.keys(start)) {
    again[name].forEach((value, i) => assert.ok(Math.abs(value - start[name][i]) < 0.05, name));
  }
});

test('what is no start view gives no pose', () => {
  const start = { eye: [0, 0, 0], target: [0, 0, 1], up: [0, -1, 0], fov: [60, 40] };
  for (const [name, value] of [['eye', [0, 0]], ['target', 'abc'], ['up', [0, null, 0]], ['eye', [1e300, 0, 0]], ['fov', [0, 40]], ['fov', [60, 180]]]) {
    assert.equal(startPose({ ...start, [name]: value }), null);
  }
  for (const none of [undefined, null, 3, 'abc', []]) assert.equal(startPose(none), null);
  for (const target of [[0, 0, 1], [1, 1, 1], [0, 0, 0]]) {
    for (const up of [[0, 0, 1], [1, 1, 1], [0, 0, 0]]) axesAreRight({ axes: startPose({ ...start, target, up }).rotation });
  }
  for (const word of [null, undefined, '', '1,2,3']) assert.equal(viewOfWord(word), undefined);
  assert.equal(startPose(viewOfWord('a,b,c,d,e,f,g,h,i,j,k')), null);
});

test('a double click finds what a ray meets first', () => {
  const sorter = new Sorter();
  const logs = (radii) => Float32Array.from(radii, (radius) => 2 * Math.log(radius));
  sorter.add(Float32Array.of(0, 0, 0.1, 0, 0, 0, 0, 0, 5, 9, 4, -2), logs([1, 1, 0.05, 1]));
  assert.deepEqual(sorter.pick([0, 0, 0], [0, 0, 1], 0.2), [0, 0, 5]);
  assert.deepEqual(sorter.pick([0, 0, 0], [0, 0, 1], 6), [0, 0, 9]);
  assert.deepEqual(sorter.pick([0.1, 0, 0], [0, 0, 1], 0.2).map((v) => Math.round(10 * v) / 10), [0.1, 0, 4]);
  assert.equal(sorter.pick([0, 0, 0], [0, 1, 0], 0.2), null);
  const camera = new Camera([0, -1, 0]);
  camera.eye = [1, 1, 1];
  camera.lookAt([4, 5, 1]);
  axesAreRight(camera);
  assert.ok(Math.abs(camera.distance - 5) < 1e-9 && Math.abs(camera.axes[0][1]) < 1e-9);
});
