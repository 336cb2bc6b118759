// What stands before the chunks of a file.
import { crc32, u32 } from './bytes.js';
import { FgsError, HeaderError } from './errors.js';
import { FORMATS } from './formats.js';
import { PREAMBLE_BYTES } from './limits.js';
import { compareCrc, truncated } from './preamble.js';

/** Read and check the header. */
export function readHeader(name, block, { version, size, headerBytes, headerCrc }) {
  if (block.length !== headerBytes) throw truncated(name, PREAMBLE_BYTES, 'header', headerBytes, block.length);
  compareCrc(name, 'header', PREAMBLE_BYTES, headerCrc, crc32(block));
  const { decodeHeader, wrongSize } = FORMATS[version];
  try {
    const header = decodeHeader(block);
    const fault = wrongSize(header, size);
    if (fault) throw new HeaderError(`${fault} bytes, got ${size}`);
    return header;
  } catch (error) {
    if (error instanceof HeaderError) throw new FgsError(name, PREAMBLE_BYTES, `header: ${error.message}`);
    throw error;
  }
}

/** Where that lies which all chunks need: the model, in version 1 the ranges. */
export function sharedPart(header) {
  return FORMATS[header.version].shared(header);
}

/**
 * Read and check that part.
 * @returns {{header: object, size: number, format: object, shared: object}} all that decoding a chunk takes
 */
export function readFrame(name, header, size, data) {
  const format = FORMATS[header.version];
  const { part, offset, length } = format.shared(header);
  if (data.length !== length) throw truncated(name, offset, part, length, data.length);
  const body = data.subarray(0, length - 4);
  compareCrc(name, part, offset, u32(data, length - 4), crc32(body));
  return { header, size, format, shared: format.readShared(name, body, header) };
}
