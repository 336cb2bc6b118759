let own = null;

/**
 * Start a worker. One script of all modules runs itself in it: `ownScript` stands in such a script, and a worker's name says what it
 * does. A module of another server is imported by a worker of this page, since browsers start none from elsewhere.
 * @param {'load' | 'sort'} name
 */
export function startWorker(name) {
  const text = (parts) => URL.createObjectURL(new Blob([parts], { type: 'text/javascript' }));
  if (typeof ownScript === 'function') return new Worker((own ??= text(ownScript())), { name });
  const { href, origin } = new URL(`./${name}-worker.js`, import.meta.url);
  return new Worker(origin === location.origin ? href : text(`import ${JSON.stringify(href)};`), { type: 'module', name });
}
