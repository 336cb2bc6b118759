// What follows from a header of version 2.

/** The fault of a header's claims in a file of `size` bytes; "" if there is none. A chunk has at least a bit a row. */
export function wrongSize2(header, size) {
  const least = header.chunksOffset + header.tableBytes + Math.floor(header.count / 8);
  return least <= size ? '' : `its counts make a file of at least ${least}`;
}

/** Chunk after chunk: its number, its layer, and its rows. A file may claim billions, so no list is made of them. */
export function* planChunks2(header) {
  let index = 0;
  let at = 0;
  for (let layer = 0; layer < header.layers.length; layer++) {
    const end = at + header.layers[layer];
    for (let start = at; start < end; start += header.chunkRows) {
      yield { index: index++, layer, start, rows: Math.min(header.chunkRows, end - start) };
    }
    at = end;
  }
}

/** Least bytes of a chunk of so many rows. */
export function leastBytes(rows) {
  return 2 * Math.ceil(rows / 16);
}
