import { FgsError, open } from '../../decoder/src/index.js';
import { packChunk } from './pack.js';

/** Decode a scene and pack it for the textures. In: { source, name } or { error }. Out: { header }, { chunk }, { done } or { error }. */
async function load(source, name) {
  const file = await open(source, { name });
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

self.onmessage = ({ data }) => {
  const loaded = data.error ? Promise.reject(new Error(data.error)) : load(data.source, data.name);
  loaded.catch((error) => {
    const advice = error instanceof FgsError ? '' : 'Cannot load the scene: ';
    self.postMessage({ error: advice + error.message });
  });
};
