import { MemorySource } from './memory.js';
import { openInside, openPreview } from './preview.js';

/** Bytes of a level that are read at once: its header, its model and, of most, its preview. */
const AT_FIRST = 1 << 16;

/**
 * Open the levels of a file: its preview, of which chunks are read when they are asked for, and that one's preview.
 *
 * @param {FgsFile} file
 * @param {string} [name] of the file, for errors
 * @returns {Promise<FgsFile[]>} fine, coarse
 */
export async function openLevels(file, name = '') {
  const inner = `${name} (preview)`;
  const level = await openInside(await sourceOf(file), inner, file);
  return [level, await openPreview(level, inner)];
}

async function sourceOf({ source, previewBytes, header }) {
  if (!source) return new MemorySource(await previewBytes());
  const size = header.previewBytes;
  const start = header.chunksOffset - size;
  const first = await source.read(start, Math.min(AT_FIRST, size));
  return {
    size,
    async read(offset, length) {
      const end = offset + length;
      return end <= first.length ? first.subarray(offset, end) : source.read(start + offset, length);
    },
  };
}
