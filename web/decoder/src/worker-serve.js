import { FgsError, open } from './index.js';

/**
 * Serve one file over a port: `self` in a worker, or one end of a `MessageChannel`.
 *
 * Messages in: { open, options }, { start, values }, { next }, { preview }, { close }. Out: { opened }, { chunk },
 * { done }, { preview }, { error }.
 */
export function serve(port) {
  let file = null;
  let chunks = null;
  let ahead = null;
  let withValues = false;

  async function answer(message) {
    if (message.open !== undefined) {
      file = await open(message.open, message.options);
      const { version, size, count, shDegree, origin, settings, layers, chunkCount, header } = file;
      port.postMessage({ opened: { version, size, count, shDegree, origin, settings, layers, chunkCount, header } });
    } else if (message.start) {
      chunks = file.chunks(message.start);
      withValues = Boolean(message.values);
      ahead = null;
    } else if (message.next) {
      const { value, done } = await (ahead ?? chunks.next());
      ahead = null;
      if (done) {
        port.postMessage({ done: true });
        return;
      }
      send(value);
      // The next one is decoded while this one is drawn. Its fault is reported when it is asked for.
      ahead = chunks.next();
      ahead.catch(() => {});
    } else if (message.preview) {
      port.postMessage({ preview: await file.previewBytes() });
    } else if (message.close) {
      await chunks?.return();
      await file?.close();
      port.postMessage({ done: true });
    }
  }

  function send(chunk) {
    const { index, layer, start, rows, verified, codes } = chunk;
    const values = withValues ? chunk.values() : undefined;
    const plain = { index, layer, start, rows, verified, codes: withValues ? undefined : codes, values };
    port.postMessage({ chunk: plain }, [...buffersOf(withValues ? values : codes)]);
  }

  port.onmessage = ({ data }) => {
    answer(data).catch((error) => {
      const { message, offset, name } = error;
      port.postMessage({ error: { message, offset, name, isFormat: error instanceof FgsError } });
    });
  };
}

/** The buffers of all arrays in a record, each once. */
function buffersOf(record, found = new Set()) {
  for (const value of Object.values(record)) {
    if (ArrayBuffer.isView(value)) found.add(value.buffer);
    else if (value && typeof value === 'object') buffersOf(value, found);
  }
  return found;
}
