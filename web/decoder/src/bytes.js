if (new Uint8Array(new Uint16Array([1]).buffer)[0] !== 1) throw new Error('wanted a little-endian machine');

const TABLES = makeTables();

function makeTables() {
  const tables = [new Int32Array(256), new Int32Array(256), new Int32Array(256), new Int32Array(256)];
  for (let i = 0; i < 256; i++) {
    let c = i;
    for (let k = 0; k < 8; k++) c = c & 1 ? (c >>> 1) ^ 0xedb88320 : c >>> 1;
    tables[0][i] = c;
  }
  for (let i = 0; i < 256; i++) {
    for (let k = 1; k < 4; k++) {
      const before = tables[k - 1][i];
      tables[k][i] = (before >>> 8) ^ tables[0][before & 255];
    }
  }
  return tables;
}

/**
 * CRC-32 as in zlib, four bytes a step.
 * @param {Uint8Array} bytes
 * @param {number} [before] the sum of the bytes that came before
 */
export function crc32(bytes, before = 0) {
  const [t0, t1, t2, t3] = TABLES;
  const fours = bytes.length & ~3;
  let c = ~before;
  let i = 0;
  for (; i < fours; i += 4) {
    c ^= bytes[i] | (bytes[i + 1] << 8) | (bytes[i + 2] << 16) | (bytes[i + 3] << 24);
    c = t3[c & 255] ^ t2[(c >>> 8) & 255] ^ t1[(c >>> 16) & 255] ^ t0[c >>> 24];
  }
  for (; i < bytes.length; i++) c = t0[(c ^ bytes[i]) & 255] ^ (c >>> 8);
  return ~c >>> 0;
}

export function u16(bytes, at) {
  return bytes[at] | (bytes[at + 1] << 8);
}

export function u32(bytes, at) {
  return (bytes[at] | (bytes[at + 1] << 8) | (bytes[at + 2] << 16) | (bytes[at + 3] << 24)) >>> 0;
}

export function i16(bytes, at) {
  return (u16(bytes, at) << 16) >> 16;
}

export function i32(bytes, at) {
  return u32(bytes, at) | 0;
}

/** A u64 as a BigInt: a damaged one may be beyond the integers that a number holds. */
export function u64(bytes, at) {
  return BigInt(u32(bytes, at)) | (BigInt(u32(bytes, at + 4)) << 32n);
}

/** Eight hexadecimal digits of a checksum. */
export function hex8(sum) {
  return sum.toString(16).padStart(8, '0');
}
