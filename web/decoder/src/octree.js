import { StreamError } from './errors.js';

const CHILDREN = Uint8Array.from({ length: 256 }, (_, byte) => {
  let count = 0;
  for (let bit = byte; bit; bit &= bit - 1) count++;
  return count;
});
const ESCAPE = 15;

/**
 * The cells of a chunk's rows, [x, y, z]. Morton indices have 63 bits, so the three coordinates go down the tree side by side.
 *
 * @param {import('./rans.js').Decoder} stream
 * @param {object} model
 * @param {number} rows
 */
export function readCells(stream, model, rows) {
  let nodes = { x: new Int32Array(1), y: new Int32Array(1), z: new Int32Array(1), siblings: new Uint8Array(1) };
  const contexts = new Uint8Array(Math.max(rows, 1));
  const bytes = new Uint8Array(Math.max(rows, 1));
  let count = 1;
  for (let level = model.depth - 1; level >= 0; level--) {
    nodeContexts(nodes.siblings, count, Math.min(level, 5) * 5, contexts);
    stream.get(model.octree, contexts, count, bytes);
    const children = countChildren(bytes, count);
    if (children < 0) throw new StreamError('octree: wanted nodes with children, got one without');
    if (children > rows) {
      throw new StreamError(`octree: wanted at most ${rows} nodes at level ${level}, got ${children}`);
    }
    nodes = descend(nodes, bytes, count, children);
    count = children;
  }
  const repeats = new Float64Array(count);
  readRepeats(stream, model.repeats, count, contexts.fill(0), bytes, repeats);
  let sum = 0;
  for (let i = 0; i < count; i++) sum += repeats[i];
  if (sum + count !== rows) throw new StreamError(`repeats: wanted ${rows - count} in all, got ${sum}`);
  return [nodes.x, nodes.y, nodes.z].map((axis) => repeated(axis, repeats, count, rows));
}

function nodeContexts(siblings, count, base, contexts) {
  for (let i = 0; i < count; i++) contexts[i] = base + Math.min(siblings[i], 4);
}

/** Children of all nodes, or -1 if one has none. */
function countChildren(bytes, count) {
  let sum = 0;
  for (let i = 0; i < count; i++) {
    if (bytes[i] === 0) return -1;
    sum += CHILDREN[bytes[i]];
  }
  return sum;
}

function descend(nodes, bytes, count, children) {
  const next = {
    x: new Int32Array(children),
    y: new Int32Array(children),
    z: new Int32Array(children),
    siblings: new Uint8Array(children),
  };
  fillChildren(nodes.x, nodes.y, nodes.z, bytes, count, next.x, next.y, next.z, next.siblings);
  return next;
}

function fillChildren(x, y, z, bytes, count, toX, toY, toZ, siblings) {
  let at = 0;
  for (let i = 0; i < count; i++) {
    const byte = bytes[i];
    for (let c = 0; c < 8; c++) {
      if ((byte >> c) & 1) {
        toX[at] = 2 * x[i] + (c >> 2);
        toY[at] = 2 * y[i] + ((c >> 1) & 1);
        toZ[at] = 2 * z[i] + (c & 1);
        siblings[at++] = CHILDREN[byte];
      }
    }
  }
}

/** Rows beyond the first of each cell; an escape's number is 32 bits, not what is beyond the escape. */
function readRepeats(stream, tables, count, contexts, symbols, repeats) {
  stream.get(tables, contexts, count, symbols);
  let escapes = 0;
  for (let i = 0; i < count; i++) {
    if (symbols[i] === ESCAPE) escapes++;
    else repeats[i] = symbols[i];
  }
  const raw = new Float64Array(escapes);
  stream.raw(32, escapes, raw);
  for (let i = 0, next = 0; i < count && next < escapes; i++) if (symbols[i] === ESCAPE) repeats[i] = raw[next++];
}

function repeated(axis, repeats, count, rows) {
  const all = new Int32Array(rows);
  for (let i = 0, at = 0; i < count; i++) {
    const end = at + repeats[i] + 1;
    while (at < end) all[at++] = axis[i];
  }
  return all;
}
