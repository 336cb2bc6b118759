import { crc32 } from './bytes.js';
import { ShortStream, StreamError } from './errors.js';
import { FgsFile } from './file.js';
import { readFrame, readHeader, sharedPart } from './frame.js';
import { PREAMBLE_BYTES } from './limits.js';
import { checkedChunk, chunkError, decodePlace, readTable } from './parts.js';
import { leastBytes } from './plan2.js';
import { compareCrc, readPreamble, truncated, wrongSize } from './preamble.js';

/** Bytes that a first try waits for, as a share of those that a chunk will likely have. */
const LIKELY = 1.1;

/**
 * Open a file that comes in once.
 *
 * @param {StreamSource} source
 * @param {string} name of the file, for errors
 * @param {number | null} size its bytes, if they are known before its end
 */
export async function openStreamed(source, name, size = null) {
  try {
    const frame = await streamedFrame(source, name, size);
    const preview = await nextPreview(source, name, frame.header);
    let used = false;
    const chunks = (options) => {
      if (used) throw new Error('a stream can be read once: open the file again');
      used = true;
      return streamedChunks(source, name, frame, options);
    };
    return new FgsFile(
      frame,
      chunks,
      async () => preview,
      () => source.cancel(),
    );
  } catch (error) {
    await source.cancel();
    throw error;
  }
}

/** As long as the file's true size is not known, we trust no more than has arrived. */
async function streamedFrame(source, name, size) {
  const preamble = readPreamble(name, await next(source, PREAMBLE_BYTES), size);
  const header = readHeader(name, await next(source, preamble.headerBytes), preamble);
  return readFrame(name, header, preamble.size, await next(source, sharedPart(header).length));
}

/** The bytes of the preview, which lie before the chunks. */
async function nextPreview(source, name, { previewBytes = 0 }) {
  const offset = source.position;
  const bytes = await next(source, previewBytes);
  if (bytes.length < previewBytes) throw truncated(name, offset, 'preview', previewBytes, bytes.length);
  return bytes;
}

async function next(source, count) {
  const bytes = (await source.peek(count)).slice();
  source.drop(bytes.length);
  return bytes;
}

/**
 * The chunks of a file that comes in once, from its first to its last byte. The table of lengths and checksums comes last, so a
 * chunk's end is found by decoding it, and its checksum is compared at the end of the stream. The last chunk ends where the table
 * begins: it is checked before it is decoded.
 *
 * Memory holds the bytes of one chunk, or of all that follow a chunk that does not decode: what is wrong with it, only the table
 * can say.
 */
async function* streamedChunks(source, name, frame, { sh, layers, first }) {
  const { header, size, format } = frame;
  const end = size - header.tableBytes;
  const seen = [];
  for (const place of format.planChunks(header)) {
    if (place.layer >= layers) {
      await source.cancel();
      return;
    }
    const offset = source.position;
    const isLast = place.index === header.chunkCount - 1;
    const found = isLast ? null : await decodeNext(source, frame, place, end, sh);
    if (found === null) break;
    seen.push({ offset, used: found.used, sum: crc32(await source.peek(found.used)) });
    source.drop(found.used);
    if (place.index >= first) yield found.chunk;
  }
  yield* rest(source, name, frame, seen, { sh, first });
}

/** Decode the chunk that comes next; null if it does not decode, whatever comes. */
async function decodeNext(source, frame, place, end, sh) {
  const left = end - source.position;
  let wanted = Math.min(place.bytes ?? likelyBytes(frame, place, end), left);
  for (;;) {
    const bytes = await source.peek(wanted);
    if (bytes.length < wanted) return null;
    try {
      return decodePlace(frame, place, bytes, { sh, open: true });
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
  const { header, size, format } = frame;
  const start = source.position;
  // One byte more than there may be: a file that goes on is refused.
  const bytes = await source.peek(size - start + 1);
  if (start + bytes.length !== size) throw wrongSize(name, size, await wholeLength(source, start));
  const table = readTable(name, frame, bytes.subarray(bytes.length - header.tableBytes));
  let offset = header.chunksOffset;
  for (const place of format.planChunks(header)) {
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
