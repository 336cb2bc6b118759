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
