/**
 * Start a worker. A module of another server is imported by a worker of this page, since browsers start none from elsewhere.
 * @param {'load' | 'sort'} name
 */
export function startWorker(name) {
  const { href, origin } = new URL(`./${name}-worker.js`, import.meta.url);
  const own = origin === location.origin ? href : URL.createObjectURL(new Blob([`import ${JSON.stringify(href)};`], { type: 'text/javascript' }));
  return new Worker(own, { type: 'module', name });
}
