import { openLevels } from '../../decoder/src/levels.js';
import { openSource } from '../../decoder/src/open.js';
import { webSource } from '../../decoder/src/web-sources.js';
import { headerOf, sendAll, sendChunk, sendError, sendPreview } from './load.js';

/**
 * As load-worker.js, for a scene with levels. In also: { level, start, shStart } for the rows of the level that take the place of a
 * chunk.
 */
let file = null;
let level = null;
let preview = null;

async function act(data) {
  if (data.all) {
    await sendPreview(preview, file.shDegree, file.count, headerOf(file).shRows);
    return sendAll(file);
  }
  if (data.get !== undefined) {
    return sendChunk(await file.chunk(data.get), file.shDegree, data.start, data.shStart, data.shEnd);
  }
  if (data.level !== undefined) {
    // A layer without rows has no chunk.
    const index = level.layers.slice(0, data.level).filter((rows) => rows).length;
    return sendChunk(await level.chunk(index), file.shDegree, data.start, data.shStart, data.shStart);
  }
  if (data.preview) return sendPreview(preview, file.shDegree, data.start, data.shStart);
  file = await openSource(await webSource(data.source), data.name);
  [level, preview] = await openLevels(file, data.name);
  const levels = { level: headerOf(level), preview: headerOf(preview) };
  return self.postMessage({ header: { ...headerOf(file), ...levels, anyChunk: Boolean(file.chunk) } });
}

self.onmessage = ({ data }) => act(data).catch(sendError);
