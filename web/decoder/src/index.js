import { MAGIC } from './limits.js';
import { openSource } from './open.js';
import { toSource } from './sources.js';

export { FgsError } from './errors.js';
export { FgsFile } from './file.js';
export { prefetch } from './http.js';
export { openPreview } from './preview.js';

/**
 * Open a `.fgs` file of version 1 or 2: read and check its header and its model. See `index.d.ts`.
 */
export async function open(given, options = {}) {
  return openSource(await toSource(given, options.fetch), options.name ?? '');
}

/** Whether bytes begin like a `.fgs` file of any version. */
export function looksLikeFgs(bytes) {
  return MAGIC.every((byte, i) => byte === bytes[i]);
}
