/**
 * Start a worker. A page of one file holds its workers' code as text, since such a page may load nothing.
 * @param {'load' | 'sort'} name
 */
export function startWorker(name) {
  const inline = document.getElementById(`${name}-worker`);
  if (!inline) return new Worker(new URL(`./${name}-worker.js`, import.meta.url), { type: 'module' });
  const address = URL.createObjectURL(new Blob([inline.textContent], { type: 'text/javascript' }));
  const worker = new Worker(address);
  URL.revokeObjectURL(address);
  return worker;
}
