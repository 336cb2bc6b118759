import { openSource } from '../../decoder/src/open.js';
import { openPreview } from '../../decoder/src/preview.js';
import { webSource } from '../../decoder/src/web-sources.js';
import { headerOf, sendAll, sendChunk, sendError, sendPreview } from './load.js';

/**
 * Decode the chunks that the page asks for, and pack them for the textures. In: { source, name }; then { all: true } for the preview and chunk
 * after chunk, { preview, start, shStart } for the preview, or { get, start, shStart, shEnd } for one. Out: { header }, { chunk }, { done }
 * or { error }.
 */
let file = null;
let preview = null;

async function act(data) {
  if (data.all) {
    if (preview) await sendPreview(preview, file.shDegree, file.count, headerOf(file).shRows);
    return sendAll(file);
  }
  if (data.get !== undefined) {
    return sendChunk(await file.chunk(data.get), file.shDegree, data.start, data.shStart, data.shEnd);
  }
  if (data.preview) return sendPreview(preview, file.shDegree, data.start, data.shStart);
  file = await openSource(await webSource(data.source), data.name);
  preview = await openPreview(file, data.name);
  const small = preview && headerOf(preview);
  return self.postMessage({ header: { ...headerOf(file), anyChunk: Boolean(file.chunk), preview: small } });
}

self.onmessage = ({ data }) => act(data).catch(sendError);
