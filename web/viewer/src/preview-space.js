import { distanceTo } from './space.js';

/** A preview beside chunks that come in any order. A row of it goes when that chunk of the first layer comes in whose box it lies. */
export class SpacePreview {
  /**
   * @param {Viewer} viewer
   * @param {Space} space of the scene, whose rows come before those of the preview
   * @param {{count: number, shRows: number}} preview its header
   */
  constructor(viewer, space, { count, shRows }) {
    this.viewer = viewer;
    this.room = { ...space.room, count: space.room.count + count, shRows: space.room.shRows + shRows };
    this.cells = space.firstLayer.map((part) => ({ part, volume: volumeOf(part), rows: [] }));
    this.chunks = [];
  }

  /** Note where the rows of a chunk of the preview lie. */
  add({ start, rows, means, importance }) {
    const chunk = { start, means: means.slice(), importance: importance.slice() };
    this.chunks.push(chunk);
    for (let row = 0; row < rows; row++) {
      const at = [0, 1, 2].map((axis) => means[axis * rows + row]);
      this.#cellAt(at).rows.push({ chunk, row });
    }
  }

  /** The cell whose box is nearest; of several around a place, the smallest. */
  #cellAt(at) {
    let [best, least] = [null, Infinity];
    for (const cell of this.cells) {
      const cost = distanceTo(cell.part, at) || -1 / cell.volume;
      if (cost < least) [best, least] = [cell, cost];
    }
    return best;
  }

  /** Take away what lies where a chunk is. The sorter leaves out rows that are nowhere. */
  update() {
    const changed = new Set();
    for (const cell of this.cells) {
      if (!cell.part.here) continue;
      for (const { chunk, row } of cell.rows) {
        chunk.means[row] = NaN;
        changed.add(chunk);
      }
      this.viewer.rows -= cell.rows.length;
      cell.rows = [];
    }
    for (const add of changed) this.viewer.sorter.postMessage({ add });
    if (!changed.size) return;
    this.viewer.sortedFor = null;
    this.viewer.refresh();
  }
}

function volumeOf({ low, high }) {
  return high.reduce((product, end, axis) => product * Math.max(end - low[axis], Number.EPSILON), 1);
}
