import { Room, readChannel } from './channels.js';
import { ShortStream, StreamError } from './errors.js';
import { CODE_LIMIT, VALUE_LIMIT } from './limits.js';
import { BASE } from './model.js';
import { readCells } from './octree.js';
import { planPasses } from './passes.js';
import { leastBytes } from './plan2.js';
import { Decoder, laneCount } from './rans.js';
import { addFeature, addSizes, addTriple, addWithSize, fillSums, startSums } from './sums.js';

/** Channels that predict SH. */
const SH_SOURCES = ['opacity', 'scale x', 'scale y', 'scale z'];

/**
 * Decode the codes of a chunk of a version 2 file; throws `StreamError` for bytes that no encoder writes.
 *
 * @param {object} model from `readModel`
 * @param {number[]} low position code of the first cell
 * @param {number} rows
 * @param {Uint8Array} bytes the chunk
 * @param {{sh?: boolean, open?: boolean}} options `open`: more may follow the chunk
 * @returns {{codes: object, used: number}} and the bytes of the chunk
 */
export function decodeChunk(model, low, rows, bytes, { sh = true, open = false } = {}) {
  const lanes = laneCount(rows);
  if (open && bytes.length < 4 * lanes) throw new ShortStream();
  const stream = new Decoder(open ? bytes.subarray(0, bytes.length & ~1) : bytes, lanes);
  const cells = readCells(stream, model, rows);
  const room = new Room(rows);
  const { base, triples } = readBase(stream, model, cells, rows, room);
  const codes = {
    position: cells.map((axis, i) => shifted(axis, low[i])),
    scale: [base.get('scale x'), base.get('scale y'), base.get('scale z')],
    rotation: [base.get('rotation x'), base.get('rotation y'), base.get('rotation z')],
    opacity: base.get('opacity'),
    dc: [base.get('dc Y'), base.get('dc Co'), base.get('dc Cg')],
    degrees: Uint8Array.from(base.get('sh degree')),
    sh: [],
  };
  if (!sh && !open) return { codes, used: bytes.length };
  codes.sh = readSh(stream, model, cells, codes.degrees, triples, room);
  stream.finish();
  const used = Math.max(stream.used, leastBytes(rows));
  if (!open) checkEnd(bytes, rows, stream.used);
  else if (used > bytes.length) throw new ShortStream();
  if (!sh) codes.sh = [];
  return { codes, used };
}

function checkEnd(bytes, rows, used) {
  const rest = bytes.subarray(used);
  if (rest.some((byte) => byte) || (rest.length && bytes.length !== leastBytes(rows))) {
    throw new StreamError(`stream: wanted ${used} bytes, got ${bytes.length}`);
  }
}

/** Cells count from the lowest one of the scene. */
function shifted(cells, low) {
  const codes = new Int32Array(cells.length);
  for (let i = 0; i < codes.length; i++) codes[i] = Math.min(cells[i] + low, CODE_LIMIT);
  return codes;
}

function readBase(stream, model, cells, rows, room) {
  const plan = planPasses(cells, rows, 4);
  const base = new Map();
  const triples = new Map();
  BASE.forEach(([name, earlier], i) => {
    const codes = new Int32Array(rows);
    base.set(name, codes);
    if (name === 'sh degree' && model.shDegree === 0) return;
    const group = model.groups[i];
    const { valueWeights: v, errorWeights: w } = group;
    fillSums(room.p, room.e, rows, v[v.length - 1], w[w.length - 1]);
    addFeature(room.p, room.e, rows, plan.near, v[2], w[2]);
    earlier.forEach((other, k) => addTriple(room.p, room.e, rows, triples.get(other), group, 3 + 3 * k));
    const predicts = !name.startsWith('rotation') && name !== 'sh degree';
    const triple = predicts ? [new Int32Array(rows), new Int32Array(rows), new Int32Array(rows)] : null;
    readChannel(stream, group, plan, room, codes, triple && triple[1]);
    if (name === 'sh degree') checkDegrees(codes, model.shDegree);
    if (triple) {
      fillTriple(room.values, rows, triple[0], triple[1], triple[2]);
      triples.set(name, triple);
    }
  });
  return { base, triples };
}

function fillTriple(values, rows, scaled, means, away) {
  for (let i = 0; i < rows; i++) {
    scaled[i] = 256 * values[i];
    away[i] = Math.abs(scaled[i] - means[i]);
  }
}

function checkDegrees(codes, most) {
  const [lowest, highest] = [Math.min, Math.max].map((better) => codes.reduce((a, b) => better(a, b), codes[0]));
  if (lowest < 0 || highest > most) throw new StreamError(`sh degree: wanted 0 to ${most}, got ${lowest} to ${highest}`);
}

/** For each degree: the rows that have it, and the planes of all Y, all Co, all Cg of its coefficients. */
function readSh(stream, model, cells, degrees, triples, room) {
  let rows = Int32Array.from(degrees.keys());
  let below = [0, 1, 2].map(() => new Int32Array(rows.length));
  let plan = null;
  const bands = [];
  for (let degree = 1; degree <= model.shDegree; degree++) {
    const kept = [...places(rows, degrees, degree)];
    if (plan === null || kept.length < rows.length) {
      below = below.map((sum) => taken(sum, kept));
      rows = taken(rows, kept);
      const there = cells.map((axis) => taken(axis, rows));
      plan = planPasses(there, rows.length, 2);
    }
    const groups = model.groups.slice(BASE.length + 3 * (degree - 1), BASE.length + 3 * degree);
    const sources = SH_SOURCES.map((name) => taken(triples.get(name)[0], rows));
    const { planes, sums } = readBand(stream, groups, plan, rows.length, degree, below, sources, room);
    bands.push({ rows, planes });
    below = sums.map((sum) => sum.map((size) => Math.min(size, 256 * VALUE_LIMIT)));
  }
  return bands;
}

function places(rows, degrees, degree) {
  const kept = [];
  for (let i = 0; i < rows.length; i++) if (degrees[rows[i]] >= degree) kept.push(i);
  return kept;
}

function taken(values, chosen) {
  const some = new Int32Array(chosen.length);
  for (let i = 0; i < some.length; i++) some[i] = values[chosen[i]];
  return some;
}

function readBand(stream, groups, plan, rows, degree, below, sources, room) {
  const fixed = groups.map((group, plane) => {
    const [p, e] = [new Float64Array(rows), new Float64Array(rows)];
    const { valueWeights: v, errorWeights: w } = group;
    fillSums(p, e, rows, v[v.length - 1], w[w.length - 1]);
    [[plan.near, 2], [below[plane], 4], ...sources.map((source, i) => [source, 5 + i])].forEach(([feature, at]) =>
      addFeature(p, e, rows, feature, v[at], w[at]),
    );
    return { p, e };
  });
  const width = 2 * degree + 1;
  const planes = Array.from({ length: 3 * width }, () => new Int32Array(rows));
  // Sums of |Y|, |Co|, |Cg| of the coefficients before. They are not limited.
  const sums = [0, 1, 2].map(() => new Int32Array(rows));
  const own = [0, 1, 2].map(() => new Int32Array(rows));
  for (let k = 0; k < width; k++) {
    groups.forEach((group, plane) => {
      const { valueWeights: v, errorWeights: w } = group;
      const { p, e } = room;
      startSums(p, e, rows, fixed[plane].p, fixed[plane].e, sums[plane], v[3], w[3]);
      for (let earlier = 0; earlier < plane; earlier++) {
        addWithSize(p, e, rows, own[earlier], group, 9 + 2 * earlier);
        const at = 9 + 2 * plane + earlier;
        addFeature(p, e, rows, sums[earlier], v[at], w[at]);
      }
      readChannel(stream, group, plan, room, planes[plane * width + k], null);
      scale256(room.values, rows, own[plane]);
    });
    for (let plane = 0; plane < 3; plane++) addSizes(sums[plane], rows, own[plane]);
  }
  return { planes, sums };
}

function scale256(values, rows, out) {
  for (let i = 0; i < rows; i++) out[i] = 256 * values[i];
}
