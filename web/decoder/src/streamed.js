import { crc32 } from './bytes.js';
import { ShortStream, StreamError } from './errors.js';
import { leastBytes } from './header2.js';
import { chunkError, decodePlace, readTable } from './parts.js';
import { compareCrc, wrongSize } from './preamble.js';
import { checkedChunk } from './ranged.js';

/** Bytes that a first try waits for, as a share of those that a chunk will likely have. */
const LIKELY = 1.1;

/**
 * The chunks of a file that comes in once, from its first to its last byte. The table of lengths and checksums comes last, so a
 * chunk's end is found by decoding it, and its checksum is compared at the end of the stream.
 *
 * Memory holds the bytes of one chunk, or of all that follow a chunk that does not decode: what is wrong with it, only the table
 * can say.
 */
export async function* streamedChunks(source, name, frame, { sh, layers, first }) {
  const { header, size } = frame;
  const end = size - header.tableBytes;
  const seen = [];
  for (const place of frame.plan()) {
    if (place.layer >= layers) {
      await source.cancel();
      return;
    }
    const offset = source.position;
    const found = await decodeNext(source, frame, place, end, sh);
    if (found === null) {
      yield* rest(source, name, frame, seen, { sh, first });
      return;
    }
    seen.push({ offset, used: found.used, sum: crc32(await source.peek(found.used)) });
    source.drop(found.used);
    if (place.index >= first) yield found.chunk;
  }
  yield* rest(source, name, frame, seen, { sh, first });
}

/** Decode the chunk that comes next; null if it does not decode, whatever comes. */
async function decodeNext(source, frame, place, end, sh) {
  const left = end - source.position;
  const exact = place.bytes ?? (place.index === frame.header.chunkCount - 1 ? left : 0);
  let wanted = Math.min(exact || likelyBytes(frame, place, end), left);
  for (;;) {
    const bytes = await source.peek(wanted);
    if (bytes.length < wanted) return null;
    try {
      const found = decodePlace(frame, place, bytes, { sh, open: true });
      return exact && found.used !== exact ? null : found;
    } catch (error) {
      if (!(error instanceof StreamError)) throw error;
      if (!(error instanceof ShortStream) || wanted >= left) return null;
      wanted = Math.min(2 * wanted, left);
    }
  }
}

function likelyBytes({ header, size }, place, end) {
  const share = (place.rows / header.count) * (end - header.chunksOffset);
  return Math.max(2 * Math.ceil((LIKELY * share) / 2), leastBytes(place.rows)) + Math.min(64, size);
}

/** Compare all that was decoded with the table at the end, then decode what is left, from bytes that are all here. */
async function* rest(source, name, frame, seen, { sh, first }) {
  const { header, size } = frame;
  const start = source.position;
  // One byte more than there may be: a file that goes on is refused.
  const bytes = await source.peek(size - start + 1);
  if (start + bytes.length !== size) throw wrongSize(name, size, await wholeLength(source, start));
  const table = readTable(name, frame, bytes.subarray(bytes.length - header.tableBytes));
  let offset = header.chunksOffset;
  for (const place of frame.plan()) {
    const length = table.lengths[place.index];
    const sum = table.sums[place.index];
    const before = seen[place.index];
    if (before) compareSeen(name, place.index, offset, length, sum, before);
    else {
      const part = bytes.subarray(offset - start, offset - start + length);
      const chunk = checkedChunk(name, frame, place, offset, length, sum, part, sh);
      if (place.index >= first) yield chunk;
    }
    offset += length;
  }
}

/** A damaged chunk may decode, even to another length: then its sum is that of the bytes that were taken. */
function compareSeen(name, index, offset, length, sum, before) {
  compareCrc(name, `chunk ${index}`, offset, sum, before.sum);
  if (before.used !== length || before.offset !== offset) {
    throw chunkError(name, index, offset, new StreamError(`stream: wanted ${before.used} bytes, got ${length}`));
  }
}

async function wholeLength(source, start) {
  let length = source.here;
  while (!source.ended) {
    source.drop(source.here);
    await source.peek(1);
    length += source.here;
  }
  return start + length;
}

