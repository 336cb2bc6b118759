import { crc32, hex8, u16, u32, u64 } from './bytes.js';
import { FgsError } from './errors.js';
import { FORMATS } from './formats.js';
import { HEADER_MOST, MAGIC, PREAMBLE_BYTES } from './limits.js';
import { shownBytes } from './shown-bytes.js';

/**
 * Read and check the preamble.
 *
 * @param {string} name of the file, for errors
 * @param {Uint8Array} bytes the first 36 bytes, or all of a shorter file
 * @param {number | null} size bytes of the whole file; null while they are not known
 * @returns {{version: number, size: number, headerBytes: number, headerCrc: number}}
 */
export function readPreamble(name, bytes, size) {
  if (bytes.length < PREAMBLE_BYTES) throw truncated(name, 0, 'preamble', PREAMBLE_BYTES, bytes.length);
  const start = bytes.subarray(0, 8);
  if (!MAGIC.every((byte, i) => byte === start[i])) {
    const wanted = shownBytes(MAGIC);
    throw new FgsError(name, 0, `magic: wanted ${wanted}, got ${shownBytes(start)}: not a .fgs file, or damaged`);
  }
  const version = u16(bytes, 8);
  if (version !== 1 && version !== 2) {
    throw new FgsError(name, 8, `version: wanted 1, got ${version}: another program wrote it, or it is damaged`);
  }
  if (!FORMATS[version]) throw new FgsError(name, 8, 'version: wanted 2, got 1: flexgs-edge view makes a page for it');
  compareCrc(name, 'preamble', 0, u32(bytes, 32), crc32(bytes.subarray(0, 32)));
  const required = u16(bytes, 10);
  if (required) {
    const found = `0x${required.toString(16)}`;
    throw new FgsError(name, 10, `flags that must be understood: wanted 0, got ${found}: a newer program wrote it`);
  }
  const claimed = u64(bytes, 16);
  if (size !== null && claimed !== BigInt(size)) throw wrongSize(name, claimed, size);
  if (claimed > BigInt(Number.MAX_SAFE_INTEGER)) {
    throw new FgsError(name, 16, `file size: wanted at most 2^53 - 1 bytes, got ${claimed}`);
  }
  const headerBytes = u32(bytes, 24);
  const fault = wrongHeaderLength(version, headerBytes, Number(claimed) - PREAMBLE_BYTES);
  if (fault) throw new FgsError(name, 24, `header length: ${fault}, got ${headerBytes}`);
  return { version, size: Number(claimed), headerBytes, headerCrc: u32(bytes, 28) };
}

function wrongHeaderLength(version, length, room) {
  const most = Math.min(HEADER_MOST, room);
  if (version === 2) return length <= most ? '' : `wanted at most ${most}`;
  if (length % 1024 === 0 && length >= 2048 && length <= most) return '';
  return `wanted a multiple of 1024 from 2048 to ${most}`;
}

export function wrongSize(name, wanted, got) {
  return new FgsError(name, 16, `file size: wanted ${wanted}, got ${got}: truncated or extended`);
}

export function truncated(name, offset, part, wanted, got) {
  return new FgsError(name, offset, `${part}: wanted ${wanted} bytes, got ${got}: the file is truncated`);
}

/** Throw an error unless two checksums of a part are equal. */
export function compareCrc(name, part, offset, wanted, got) {
  if (wanted !== got) {
    const sums = `wanted ${hex8(wanted)}, got ${hex8(got)}`;
    throw new FgsError(name, offset, `${part}: checksum: ${sums}: the file is damaged`);
  }
}
