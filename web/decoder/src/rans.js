import { ShortStream, StreamError } from './errors.js';

const BUCKET_SHIFT = 5;
const BUCKETS = 1 << (14 - BUCKET_SHIFT);

/** Lanes of a chunk's stream. */
export function laneCount(rows) {
  let lanes = 1;
  while (lanes < 512 && 256 * lanes <= rows) lanes *= 2;
  return lanes;
}

/**
 * Frequency tables of one alphabet. A symbol is found by the bucket of its slot, then by a short walk: 1.5 kB a table, where a
 * list of all slots would take 80 kB, and a small hostile file can ask for 3776 tables.
 */
export class Tables {
  /**
   * @param {Uint16Array[]} frequencies each adds up to 2^14
   * @param {ArrayLike<number>} mapping the table of each context
   */
  constructor(frequencies, mapping) {
    this.size = frequencies[0].length;
    this.starts = new Uint16Array(frequencies.length * (this.size + 1));
    this.buckets = new Uint8Array(frequencies.length * BUCKETS);
    this.mapping = Uint8Array.from(mapping);
    frequencies.forEach((row, t) => this.#fill(row, t));
  }

  #fill(row, t) {
    const starts = this.starts.subarray(t * (this.size + 1), (t + 1) * (this.size + 1));
    let sum = 0;
    for (let symbol = 0; symbol < this.size; symbol++) {
      starts[symbol] = sum;
      sum += row[symbol];
    }
    starts[this.size] = sum;
    let symbol = 0;
    for (let bucket = 0; bucket < BUCKETS; bucket++) {
      while (starts[symbol + 1] <= bucket << BUCKET_SHIFT) symbol++;
      this.buckets[t * BUCKETS + bucket] = symbol;
    }
  }
}

/** Decodes batch after batch of one rANS stream. */
export class Decoder {
  /**
   * @param {Uint8Array} bytes the stream, and what may follow it
   * @param {number} lanes a power of two
   */
  constructor(bytes, lanes) {
    if (bytes.length < 4 * lanes || bytes.length % 2) {
      throw new StreamError(`stream: wanted an even number of at least ${4 * lanes} bytes, got ${bytes.length}`);
    }
    // A copy: parts of a file begin at any byte, and a view of 16-bit words must not.
    const copy = bytes.slice().buffer;
    this.states = new Int32Array(copy, 0, lanes);
    this.words = new Uint16Array(copy, 4 * lanes);
    this.at = 0;
    if (this.states.some((state) => state >>> 16 === 0)) {
      throw new StreamError('stream: wanted states of at least 65536');
    }
  }

  /** Bytes that were read. */
  get used() {
    return 4 * this.states.length + 2 * this.at;
  }

  /**
   * Decode a batch of `count` symbols into `out`; `contexts` chooses the table of each.
   * @param {Tables} tables
   */
  get(tables, contexts, count, out) {
    const { starts, buckets, mapping, size } = tables;
    this.#moved(decodeRows(this.states, this.words, this.at, starts, buckets, mapping, size + 1, contexts, count, out));
  }

  /** Add raw numbers of `bits` bits to `out`, each times 2^at. */
  raw(bits, count, out) {
    out.fill(0, 0, count);
    if (count === 0) return;
    for (let at = 0; at < bits; at += 8) {
      this.#moved(decodeRaw(this.states, this.words, this.at, Math.min(bits - at, 8), 2 ** at, count, out));
    }
  }

  #moved(at) {
    // Words beyond the end count as 0 inside a batch.
    if (at > this.words.length) throw new ShortStream();
    this.at = at;
  }

  /** Throw an error unless every lane is back in its first state. */
  finish() {
    if (this.states.some((state) => state !== 65536)) {
      throw new StreamError('stream: wanted every lane to end in its first state');
    }
  }
}

// The loops below take typed arrays and numbers only: engines compile them once and keep them.

function decodeRows(states, words, at, starts, buckets, mapping, width, contexts, count, out) {
  const last = states.length - 1;
  for (let i = 0; i < count; i++) {
    const lane = i & last;
    const x = states[lane];
    const slot = x & 16383;
    const table = mapping[contexts[i]];
    const first = table * width;
    let symbol = buckets[(table << 9) + (slot >> 5)];
    let next = starts[first + symbol + 1];
    while (next <= slot) next = starts[first + ++symbol + 1];
    const start = starts[first + symbol];
    let y = (Math.imul(next - start, x >>> 14) + slot - start) | 0;
    if (y >>> 16 === 0) y = (y << 16) | words[at++];
    states[lane] = y;
    out[i] = symbol;
  }
  return at;
}

function decodeRaw(states, words, at, bits, factor, count, out) {
  const last = states.length - 1;
  const shift = 14 - bits;
  const mask = (1 << shift) - 1;
  for (let i = 0; i < count; i++) {
    const lane = i & last;
    const x = states[lane];
    const slot = x & 16383;
    out[i] += (slot >> shift) * factor;
    let y = ((x >>> 14 << shift) + (slot & mask)) | 0;
    if (y >>> 16 === 0) y = (y << 16) | words[at++];
    states[lane] = y;
  }
  return at;
}
