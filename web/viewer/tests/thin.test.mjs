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

test('the rows that show most stay, with their SH', () => {
  const chunk = packed(70, 1, 100);
  const words = 4 * shTexels(1);
  const thin = thinChunk(chunk, 2 / 7, { start: 30, shStart: 12 }, words);
  const rows = [...Array(70).keys()].filter((row) => row % 7 >= 5);
  assert.deepEqual([thin.rows, thin.start, thin.shStart, thin.index, thin.shRows], [20, 30, 12, 5, 10]);
  assert.deepEqual([...thin.means], [0, 1, 2].flatMap((axis) => rows.map((row) => 10 * row + axis)));
  assert.deepEqual([...thin.importance], rows.map((row) => chunk.importance[row]));
  let sh = 0;
  rows.forEach((row, i) => {
    const [from, to] = [16 * row, 16 * i];
    const place = row % 2 ? 12 + sh : chunk.data[from + 3];
    assert.deepEqual([...thin.data.slice(to, to + 16)], [...chunk.data.slice(from, from + 3), place, ...chunk.data.slice(from + 4, from + 16)]);
    if (!(row % 2)) return;
    const own = (chunk.data[from + 3] - 100) * words;
    assert.deepEqual(thin.sh.slice(sh * words, ++sh * words), chunk.sh.slice(own, own + words));
  });
  assert.equal(thin.sh.length, sh * words);
  assert.equal(thin.data.length, 20 * 4 * TEXELS);
});

test('a share fits all of both textures', () => {
  assert.equal(shareOf({ count: 100, shRows: 10 }, { count: 100, shRows: 10 }), 1);
  assert.equal(shareOf({ count: 100, shRows: 10 }, { count: 50, shRows: 9 }), 0.5);
  assert.equal(shareOf({ count: 100, shRows: 10 }, { count: 500, shRows: 2 }), 0.2);
});
