import { StreamSource } from '../../decoder/src/incoming.js';
import { openStreamed } from '../../decoder/src/streamed.js';
import { headerOf, sendAll, sendError } from './load.js';

/** Decode a scene as it comes, and pack it for the textures. In: { source, name }. Out: { header }, { chunk }, { done } or { error }. */
async function load(source, name) {
  const response = typeof source === 'string' ? await fetch(source) : new Response(source);
  if (!response.ok) throw new Error(`${source}: the server says ${response.status}`);
  const file = await openStreamed(new StreamSource(response.body), name, sizeOf(source, response));
  self.postMessage({ header: headerOf(file) });
  await sendAll(file);
}

/** Bytes of a source, or null. A server may pack what it sends, and other servers need not tell that they do. */
function sizeOf(source, { type, headers }) {
  if (typeof source !== 'string') return source.size ?? source.length;
  const told = type === 'basic' && !headers.get('Content-Encoding') && headers.get('Content-Length');
  return told ? Number(told) : null;
}

self.onmessage = ({ data }) => load(data.source, data.name).catch(sendError);
