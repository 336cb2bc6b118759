import { openPreview } from '../../decoder/src/preview.js';
import { openArriving } from './arriving.js';
import { headerOf, sendAll, sendError, sendPreview } from './load.js';

/**
 * Decode a scene as it comes, its preview first, and pack it for the textures. In: { source, name }. Out: { header }, { chunk },
 * { done } or { error }. Rows of the preview lie behind those of the scene.
 */
async function load(source, name) {
  const file = await openArriving(source, name);
  const preview = await openPreview(file, name);
  const header = headerOf(file);
  self.postMessage({ header: { ...header, preview: headerOf(preview) } });
  await sendPreview(preview, header.shDegree, header.count, header.shRows);
  await sendAll(file);
}

self.onmessage = ({ data }) => load(data.source, data.name).catch(sendError);
