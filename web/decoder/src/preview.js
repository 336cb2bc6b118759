import { FgsError } from './errors.js';
import { openRanged } from './ranged.js';
import { PREAMBLE_BYTES } from './limits.js';
import { MemorySource } from './memory.js';

/**
 * Open the preview of an opened file: the same scene in far fewer Gaussians. It may have one of its own. Null if there is none.
 *
 * @param {FgsFile} file
 * @param {string} [name] of the file, for errors
 * @returns {Promise<FgsFile | null>}
 */
export async function openPreview(file, name = '') {
  const bytes = await file.previewBytes();
  if (!bytes.length) return null;
  return openInside(new MemorySource(bytes), `${name} (preview)`, file);
}

/** Open the preview of a file from a source of its bytes. */
export async function openInside(source, name, file) {
  const small = await openRanged(source, name);
  const fault = faultOf(small.header, file);
  if (fault) throw new FgsError(name, PREAMBLE_BYTES, `header: ${fault}`);
  small.inside = true;
  return small;
}

function faultOf({ previewBytes, origin, shDegree }, whole) {
  if (previewBytes && whole.inside) return "preview_bytes: wanted none here";
  if (whole.origin.some((place, axis) => place !== origin[axis])) return `origin: wanted ${whole.origin}, got ${origin}`;
  if (shDegree === 0 || shDegree === whole.shDegree) return '';
  return `sh_degree: wanted 0 or ${whole.shDegree} in a preview, got ${shDegree}`;
}
