import { StreamSource } from '../../decoder/src/incoming.js';
import { openStreamed } from '../../decoder/src/streamed.js';

/** Open a file that comes in once: an address, or bytes. */
export async function openArriving(source, name) {
  const response = typeof source === 'string' ? await fetch(source) : new Response(source);
  if (!response.ok) throw new Error(`${source}: the server says ${response.status}`);
  return openStreamed(new StreamSource(response.body), name, lengthOf(source, response));
}

/** Bytes of a source, or null. A server may pack what it sends, and other servers need not tell that they do. */
function lengthOf(source, { type, headers }) {
  if (typeof source !== 'string') return source.size ?? source.length;
  const told = type === 'basic' && !headers.get('Content-Encoding') && headers.get('Content-Length');
  return told ? Number(told) : null;
}
