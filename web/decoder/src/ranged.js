import { FgsFile } from './file.js';
import { readFrame, readHeader, sharedPart } from './frame.js';
import { PREAMBLE_BYTES } from './limits.js';
import { checkedChunk, readTable } from './parts.js';
import { readPreamble } from './preamble.js';

/** Open a file of which any part can be had. */
export async function openRanged(source, name) {
  const preamble = readPreamble(name, await source.read(0, PREAMBLE_BYTES), source.size);
  const header = readHeader(name, await source.read(PREAMBLE_BYTES, preamble.headerBytes), preamble);
  const { offset, length } = sharedPart(header);
  const frame = readFrame(name, header, preamble.size, await source.read(offset, length));
  return new FgsFile(frame, (options) => rangedChunks(source, name, frame, options));
}

/** The chunks: each is checked before it is decoded. */
async function* rangedChunks(source, name, frame, { sh, layers, first }) {
  const { header, size, format } = frame;
  const table = await source.read(size - header.tableBytes, header.tableBytes);
  const { lengths, sums } = readTable(name, frame, table);
  let offset = header.chunksOffset;
  const [from, to] = wantedBytes(frame, lengths, first, layers);
  source.ahead?.(from, to);
  try {
    for (const place of format.planChunks(header)) {
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
function wantedBytes({ header, format }, lengths, first, layers) {
  let from = header.chunksOffset;
  let to = from;
  for (const place of format.planChunks(header)) {
    if (place.index < first) from += lengths[place.index];
    if (place.layer < layers) to += lengths[place.index];
  }
  return [from, to];
}
