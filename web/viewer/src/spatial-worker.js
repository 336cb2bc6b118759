import { open } from '../../decoder/src/index.js';
import { headerOf, sendAll, sendChunk, sendError } from './load.js';

/**
 * Decode the chunks that the page asks for, and pack them for the textures. In: { source, name }; then { all: true } for chunk after
 * chunk, or { get, start, shStart, shEnd } for one. Out: { header }, { chunk }, { done } or { error }.
 */
let file = null;

async function act(data) {
  if (data.all) return sendAll(file);
  if (data.get !== undefined) {
    return sendChunk(await file.chunk(data.get), file.shDegree, data.start, data.shStart, data.shEnd);
  }
  file = await open(data.source, { name: data.name });
  return self.postMessage({ header: { ...headerOf(file), anyChunk: Boolean(file.chunk) } });
}

self.onmessage = ({ data }) => act(data).catch(sendError);
