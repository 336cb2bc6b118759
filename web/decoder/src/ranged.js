import { crc32 } from './bytes.js';
import { chunkError, decodePlace, readTable } from './parts.js';
import { compareCrc, truncated } from './preamble.js';

/** The chunks of a file of which any part can be had: each is checked before it is decoded. */
export async function* rangedChunks(source, name, frame, { sh, layers, first }) {
  const { header, size } = frame;
  const table = await source.read(size - header.tableBytes, header.tableBytes);
  const { lengths, sums } = readTable(name, frame, table);
  let offset = header.chunksOffset;
  const [from, to] = wantedBytes(frame, lengths, first, layers);
  source.ahead?.(from, to);
  try {
    for (const place of frame.plan()) {
      const length = lengths[place.index];
      if (place.layer >= layers) return;
      if (place.index >= first) {
        const bytes = await source.read(offset, length);
        yield checkedChunk(name, frame, place, offset, length, sums[place.index], bytes, sh);
      }
      offset += length;
    }
  } finally {
    await source.cancel?.();
  }
}

/** Where the chunks that are asked for begin and end. */
function wantedBytes(frame, lengths, first, layers) {
  let from = frame.header.chunksOffset;
  let to = from;
  for (const place of frame.plan()) {
    if (place.index < first) from += lengths[place.index];
    if (place.layer < layers) to += lengths[place.index];
  }
  return [from, to];
}

/** Check a chunk and decode it. */
export function checkedChunk(name, frame, place, offset, length, sum, bytes, sh) {
  const part = `chunk ${place.index}`;
  if (bytes.length !== length) throw truncated(name, offset, part, length, bytes.length);
  compareCrc(name, part, offset, sum, crc32(bytes));
  try {
    return decodePlace(frame, place, bytes, { sh }).chunk;
  } catch (error) {
    throw chunkError(name, place.index, offset, error);
  }
}
