let own = null;

/**
 * Start a worker from a joined script (`join_modules`), which stands in the place of `workers.js` there: it runs itself as `ownScript`,
 * and a worker's name says what it does.
 * @param {'load' | 'sort'} name
 */
export function startWorker(name) {
  own ??= URL.createObjectURL(new Blob([ownScript()], { type: 'text/javascript' }));
  return new Worker(own, { name });
}
