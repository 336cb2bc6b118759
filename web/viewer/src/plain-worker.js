import { openArriving } from './arriving.js';
import { headerOf, sendAll, sendError } from './load.js';

/** Decode a scene as it comes, and pack it for the textures. In: { source, name }. Out: { header }, { chunk }, { done } or { error }. */
async function load(source, name) {
  const file = await openArriving(source, name);
  self.postMessage({ header: headerOf(file) });
  await sendAll(file);
}

self.onmessage = ({ data }) => load(data.source, data.name).catch(sendError);
