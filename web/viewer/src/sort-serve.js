/**
 * Let a sorter answer in this worker. In: { add }, { view, near, most, sight, buffer }, { pick }. Out, for each view: { order, count, ms },
 * and { picked }.
 */
export function answer(sorter, data) {
  const { add, pick } = data;
  if (add) sorter.add(add.means, add.importance, add.start);
  if (pick) self.postMessage({ picked: sorter.pick(pick.eye, pick.way, pick.near) });
  if (!data.view) return;
  const start = performance.now();
  const room = data.buffer && data.buffer.byteLength >= 4 * sorter.rows ? data.buffer : new ArrayBuffer(4 * sorter.rows);
  const order = new Uint32Array(room);
  const count = sorter.sort(data.view, data.near, order, data.most, data.sight);
  self.postMessage({ order, count, ms: performance.now() - start }, [room]);
}
