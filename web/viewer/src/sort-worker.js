import { Sorter } from './sort.js';

const sorter = new Sorter();

/** In: { add }, { view, near, most, sight, buffer }, { pick }. Out, for each view: { order, count, ms }, and { picked }. */
self.onmessage = ({ data }) => {
  if (data.add) sorter.add(data.add.means, data.add.importance, data.add.start);
  if (data.pick) self.postMessage({ picked: sorter.pick(data.pick.eye, data.pick.way, data.pick.near) });
  if (!data.view) return;
  const start = performance.now();
  const room = data.buffer && data.buffer.byteLength >= 4 * sorter.rows ? data.buffer : new ArrayBuffer(4 * sorter.rows);
  const order = new Uint32Array(room);
  const count = sorter.sort(data.view, data.near, order, data.most, data.sight);
  self.postMessage({ order, count, ms: performance.now() - start }, [room]);
};
