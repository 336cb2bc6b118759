import { FgsError } from './errors.js';

export { FgsError };

/**
 * Open a file in a worker. See `worker-client.d.ts`.
 */
export async function openInWorker(source, { worker, ...options } = {}) {
  const port = worker ?? startWorker();
  const remote = new Remote(port);
  // An address is relative to the page, not to the worker's script.
  const given = typeof source === 'string' || source instanceof URL ? new URL(source, globalThis.location?.href).href : source;
  const transfer = typeof source?.getReader === 'function' ? [source] : [];
  try {
    const { opened } = await remote.ask({ open: given, options }, transfer);
    return Object.assign(new WorkerFile(remote), opened);
  } catch (error) {
    remote.end();
    throw error;
  }
}

function startWorker() {
  try {
    return new Worker(new URL('./worker.js', import.meta.url), { type: 'module' });
  } catch {
    // Browsers start no worker of another server. One of this page may import it.
    const text = `import ${JSON.stringify(new URL('./worker.js', import.meta.url).href)};`;
    return new Worker(URL.createObjectURL(new Blob([text], { type: 'text/javascript' })), { type: 'module' });
  }
}

/** An opened file, decoded in a worker. */
class WorkerFile {
  #remote;

  constructor(remote) {
    this.#remote = remote;
  }

  /** Chunks with their codes, or with `values: true` with their values alone. */
  async *chunks({ values = false, ...options } = {}) {
    this.#remote.tell({ start: options, values });
    for (;;) {
      const { chunk } = await this.#remote.ask({ next: true });
      if (!chunk) return;
      yield chunk;
    }
  }

  /** See `FgsFile`. */
  async previewBytes() {
    return (await this.#remote.ask({ preview: true })).preview;
  }

  /** Stop decoding, and end the worker. */
  async close() {
    this.#remote.end();
  }
}

/** One question at a time, each with one answer. */
class Remote {
  constructor(port) {
    this.port = port;
    this.waiting = null;
    this.last = Promise.resolve();
    port.onmessage = ({ data }) => this.#settle(data.error ? null : data, data.error && rebuilt(data.error));
    port.onerror = (event) => this.#settle(null, new Error(event.message || 'the worker could not be started'));
  }

  tell(message, transfer = []) {
    this.port.postMessage(message, transfer);
  }

  ask(message, transfer) {
    const answer = this.last.then(
      () =>
        new Promise((resolve, reject) => {
          this.waiting = { resolve, reject };
          this.tell(message, transfer);
        }),
    );
    this.last = answer.catch(() => {});
    return answer;
  }

  end() {
    this.#settle(null, new Error('the file was closed'));
    if (this.port.terminate) this.port.terminate();
    else {
      this.tell({ close: true });
      this.port.close?.();
    }
  }

  #settle(data, error) {
    const waiting = this.waiting;
    this.waiting = null;
    if (error) waiting?.reject(error);
    else waiting?.resolve(data);
  }
}

function rebuilt({ message, offset, isFormat }) {
  if (!isFormat) return new Error(message);
  return Object.assign(new FgsError('', offset, ''), { message });
}
