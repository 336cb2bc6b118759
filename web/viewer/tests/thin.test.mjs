import assert from 'node:assert/strict';
import test from 'node:test';
import { packChunk, shTexels, TEXELS } from '../src/pack.js';
import { shareOf, thinChunk } from '../src/thin.js';

function packed(rows, degree, shBefore) {
  const plane = (width, value) => Float32Array.from({ length: width * rows }, (_, i) => value(i % rows, Math.floor(i / rows)));
  const values = {
    means: plane(3, (row, axis) => 10 * row + axis),
    logScales: plane(3, (row) => row % 7),
    opacityLogits: plane(1, () => 2),
    quats: plane(4, () => 1),
    shDc: plane(3, (row) => row),
    shRest: plane(9, (row, k) => (row % 2 ? row + k / 16 : 0)),
  };
  return { ...packChunk(values, rows, degree, shBefore, Uint8Array.from({ length: rows }, (_, row) => row % 2)), rows, index: 5, start: 0, shStart: shBefore };
}

test('some rows stay, with their SH, and grow', () => {
  const chunk = packed(70, 1, 100);
  const words = 4 * shTexels(1);
  const thin = thinChunk(chunk, 2 / 7, { start: 30, shStart: 12 }, 42, words);
  assert.ok(thin.rows > 15 && thin.rows <= 20);
  assert.deepEqual([thin.start, thin.shStart, thin.index], [30, 12, 5]);
  assert.deepEqual([thin.data.length, thin.means.length, thin.importance.length], [4 * TEXELS, 3, 1].map((each) => each * thin.rows));
  const [was, is] = [chunk.data, thin.data].map((data) => new Float32Array(data.buffer));
  const rows = [...thin.means.subarray(0, thin.rows)].map((x) => x / 10);
  let sh = 0;
  rows.forEach((row, i) => {
    const [from, to] = [16 * row, 16 * i];
    assert.deepEqual([...thin.means].filter((_, at) => at % thin.rows === i), [0, 1, 2].map((axis) => 10 * row + axis));
    for (const word of [0, 1, 2, 7, 8, 9, 10, 11, 12, 13, 14, 15]) assert.equal(thin.data[to + word], chunk.data[from + word]);
    const grown = [4, 5, 6].map((word) => is[to + word] - was[from + word]);
    assert.ok(grown[0] >= 0 && Math.max(...grown) - Math.min(...grown) < 1e-5);
    assert.ok(Math.abs(thin.importance[i] - chunk.importance[row] - 2 * grown[0]) < 1e-5);
    if (!(row % 2)) return;
    assert.equal(thin.data[to + 3], 12 + sh);
    const own = (chunk.data[from + 3] - 100) * words;
    assert.deepEqual(thin.sh.slice(sh * words, ++sh * words), chunk.sh.slice(own, own + words));
  });
  assert.equal(thin.sh.length, sh * words);
  assert.equal(thin.shRows, sh);
});

test('never more rows than there is room for, whatever they show', () => {
  for (const share of [0, 0.01, 0.1, 0.5, 0.9, 0.99]) {
    const thin = thinChunk(packed(997, 1, 0), share, { start: 0, shStart: 0 }, 997, 4 * shTexels(1));
    assert.ok(thin.rows <= share * 997 && thin.rows > 0.9 * share * 997 - 2, `${thin.rows} of ${share}`);
  }
});

test('rows for whose SH there is no room lose them', () => {
  const thin = thinChunk(packed(8, 1, 0), 1, { start: 0, shStart: 5 }, 7, 4 * shTexels(1));
  assert.deepEqual([thin.shRows, thin.sh.length], [2, 8 * shTexels(1)]);
  const words = [...Array(8).keys()].map((row) => [thin.data[16 * row + 3], thin.data[16 * row + 15]]);
  assert.deepEqual(words.map(([, degree]) => degree), [0, 1, 0, 1, 0, 0, 0, 0]);
  assert.deepEqual([1, 3, 5].map((row) => words[row][0]), [5, 6, 0xffffffff]);
});

test('a share fits all of both textures', () => {
  assert.equal(shareOf({ count: 100, shRows: 10 }, { count: 100, shRows: 10 }), 1);
  assert.equal(shareOf({ count: 100, shRows: 10 }, { count: 50, shRows: 9 }), 0.5);
  assert.equal(shareOf({ count: 100, shRows: 10 }, { count: 500, shRows: 2 }), 0.2);
});
