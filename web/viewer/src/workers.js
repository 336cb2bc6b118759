import { prefetch } from '../../decoder/src/http.js';

let own = null;

/**
 * Start a worker. In a page of one file, which may load nothing, it runs the page's own script: its name says as what.
 * @param {'load' | 'sort'} name
 */
export function startWorker(name) {
  const inline = document.getElementById('script');
  if (inline) own ??= URL.createObjectURL(new Blob([inline.textContent], { type: 'text/javascript' }));
  const address = own ?? new URL(`./${name}-worker.js`, import.meta.url);
  // Chromium starts no module from a text on a page from disk.
  return new Worker(address, { type: inline ? 'classic' : 'module', name });
}

/** Give a scene to the worker that loads. Its first bytes come while the worker starts. */
export async function sendScene(worker, source, name) {
  try {
    const given = typeof source === 'string' ? await prefetch(source) : source;
    worker.postMessage({ source: given, name }, given.stream ? [given.stream] : []);
  } catch (error) {
    worker.postMessage({ error: error.message });
  }
}
