import { StreamSource } from './incoming.js';
import { openRanged } from './ranged.js';
import { openStreamed } from './streamed.js';

/** Open the file that a source gives. `name`: of the file, for errors. */
export function openSource(source, name) {
  return (source instanceof StreamSource ? openStreamed : openRanged)(source, name);
}
