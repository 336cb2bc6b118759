import { StreamError } from './errors.js';
import { Decoder, Tables } from './rans.js';

const LEVELS = 65;
const CLASSES = 5;
const OFTEN = 20;
const TOTAL = 1 << 14;
/** What a level stands for; above 2^31 from level 60 on, so doubles. */
const WEIGHTS = Array.from({ length: LEVELS }, (_, v) => (v ? (4 + ((v - 1) % 4)) * 2 ** Math.floor((v - 1) / 4) : 0));

/** Frequencies that add up to 2^14, from the levels of a table. */
export function frequencies(levels) {
  const weights = Array.from(levels, (level) => WEIGHTS[level]);
  const sum = weights.reduce((a, b) => a + b, 0);
  const freqs = new Uint16Array(weights.length);
  if (sum === 0) {
    freqs[0] = TOTAL;
    return freqs;
  }
  let missing = TOTAL;
  for (let i = 0; i < freqs.length; i++) {
    if (weights[i]) freqs[i] = Math.max(1, Math.floor((TOTAL * weights[i]) / sum));
    missing -= freqs[i];
  }
  const order = [...freqs.keys()].filter((i) => freqs[i]).sort((a, b) => freqs[b] - freqs[a] || a - b);
  // This ends: at most 256 symbols, so some frequency is above 1.
  while (missing) {
    const able = missing > 0 ? order : order.filter((i) => freqs[i] > 1);
    const unit = Math.sign(missing);
    for (const i of able.slice(0, Math.abs(missing))) {
      freqs[i] += unit;
      missing -= unit;
    }
  }
  return freqs;
}

/**
 * Read the tables of all alphabets.
 *
 * @param {Uint8Array} bytes nothing may follow them
 * @param {{contexts: number, symbols: number}[]} shapes of each alphabet
 * @returns {Tables[]}
 */
export function decodeTables(bytes, shapes) {
  const { classes, at } = readClasses(bytes);
  const decoder = new Decoder(bytes.subarray(at), 16);
  const symbols = new Uint8Array(256);
  const which = new Uint8Array(256);
  const tables = shapes.map((shape) => {
    const mapping = which.fill(CLASSES - 1, 0, shape.contexts) && new Uint8Array(shape.contexts);
    decoder.get(classes, which, shape.contexts, mapping);
    const count = Math.max(...mapping) + 1;
    if (count > shape.contexts) throw new StreamError(`tables: wanted at most ${shape.contexts}, got ${count}`);
    const rows = [];
    for (let t = 0; t < count; t++) rows.push(readLevels(decoder, classes, which, symbols, shape.symbols, rows[t - 1]));
    return new Tables(rows.map(frequencies), mapping);
  });
  decoder.finish();
  if (decoder.used !== bytes.length - at) throw new StreamError('tables: wanted their end, got more bytes');
  return tables;
}

function readClasses(bytes) {
  const rows = [];
  let at = 0;
  for (let i = 0; i < CLASSES; i++) {
    const length = at < bytes.length ? bytes[at] : LEVELS + 1;
    const part = bytes.subarray(at + 1, at + 1 + length);
    if (length > LEVELS || part.length < length || part.some((level) => level >= LEVELS)) {
      throw new StreamError(`tables: byte ${at}: wanted at most ${LEVELS} levels below ${LEVELS}`);
    }
    const levels = new Uint8Array(LEVELS);
    levels.set(part);
    rows.push(frequencies(levels.some((level) => level) ? levels : levels.fill(1)));
    at += 1 + length;
  }
  return { classes: new Tables(rows, rows.keys()), at };
}

/** The levels of a table: differences from symbol to symbol, or from the table before. */
function readLevels(decoder, classes, which, symbols, size, before) {
  for (let i = 0; i < size; i++) which[i] = before ? 1 + (before[i] > 0) + (before[i] > OFTEN) : 0;
  decoder.get(classes, which, size, symbols);
  const levels = new Uint8Array(size);
  for (let i = 0; i < size; i++) levels[i] = (symbols[i] + (before ? before[i] : i ? levels[i - 1] : 0)) % LEVELS;
  return levels;
}
