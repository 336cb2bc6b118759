import { FgsError } from './errors.js';
import { openRanged } from './ranged.js';
import { PREAMBLE_BYTES } from './limits.js';
import { MemorySource } from './memory.js';

/**
 * Open the preview of an opened file: the same scene in far fewer Gaussians. Null if there is none.
 *
 * @param {FgsFile} file
 * @param {string} [name] of the file, for errors
 * @returns {Promise<FgsFile | null>}
 */
export async function openPreview(file, name = '') {
  const bytes = await file.previewBytes();
  if (!bytes.length) return null;
  const inner = `${name} (preview)`;
  const small = await openRanged(new MemorySource(bytes), inner);
  const fault = faultOf(small.header, file);
  if (fault) throw new FgsError(inner, PREAMBLE_BYTES, `header: ${fault}`);
  return small;
}

function faultOf({ previewBytes, origin, shDegree }, whole) {
  if (previewBytes) return 'preview_bytes: wanted none in a preview';
  if (whole.origin.some((place, axis) => place !== origin[axis])) return `origin: wanted ${whole.origin}, got ${origin}`;
  if (shDegree === 0 || shDegree === whole.shDegree) return '';
  return `sh_degree: wanted 0 or ${whole.shDegree} in a preview, got ${shDegree}`;
}
