import { FgsError } from '../../decoder/src/errors.js';
import { StreamSource } from '../../decoder/src/incoming.js';
import { openStreamed } from '../../decoder/src/streamed.js';
import { packChunk } from './pack.js';

/** Decode a scene as it comes, and pack it for the textures. In: { source, name }. Out: { header }, { chunk }, { done } or { error }. */
async function load(source, name) {
  const response = typeof source === 'string' ? await fetch(source) : new Response(source);
  if (!response.ok) throw new Error(`${source}: the server says ${response.status}`);
  const file = await openStreamed(new StreamSource(response.body), name, sizeOf(source, response));
  const { count, shDegree, origin, settings, layers, size, version, header } = file;
  const shRows = header.channels ? (header.channels.rows[0] ?? 0) : (header.shCount ?? (shDegree ? count : 0));
  const { cutFrom } = header;
  self.postMessage({ header: { count, shDegree, origin, settings, layers, size, version, shRows, cutFrom } });
  let shBefore = 0;
  for await (const chunk of file.chunks()) {
    const packed = packChunk(chunk.values(), chunk.rows, shDegree, shBefore, chunk.codes.degrees);
    shBefore += packed.shRows;
    // The header's count of them is not checked by a decoder, and our room was made for it.
    if (shBefore > shRows) throw new Error(`The header says that ${shRows} splats have SH, but more have.`);
    const { data, sh, means, importance } = packed;
    const place = { start: chunk.start, rows: chunk.rows, layer: chunk.layer, shStart: shBefore - packed.shRows };
    self.postMessage({ chunk: { ...packed, ...place } }, [data.buffer, sh.buffer, means.buffer, importance.buffer]);
  }
  self.postMessage({ done: true });
}

/** Bytes of a source, or null. A server may pack what it sends, and other servers need not tell that they do. */
function sizeOf(source, { type, headers }) {
  if (typeof source !== 'string') return source.size ?? source.length;
  const told = type === 'basic' && !headers.get('Content-Encoding') && headers.get('Content-Length');
  return told ? Number(told) : null;
}

self.onmessage = ({ data }) => {
  load(data.source, data.name).catch((error) => {
    const advice = error instanceof FgsError ? '' : 'Cannot load the scene: ';
    self.postMessage({ error: advice + error.message });
  });
};
