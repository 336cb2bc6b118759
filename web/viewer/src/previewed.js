/** A preview in a viewer. Its rows lie behind those of the scene, whose chunks wait until it is taken away. */
export class Previewed {
  /**
   * @param {Viewer} viewer
   * @param {{count: number, shRows: number}} room of the scene
   * @param {{count: number, shRows: number}} preview its header
   */
  constructor(viewer, room, { count, shRows }) {
    this.viewer = viewer;
    this.start = room.count;
    this.room = { ...room, count: room.count + count, shRows: room.shRows + shRows };
    this.parts = [];
    this.waiting = [];
  }

  /** Whether a chunk has to wait: all but those of the preview have to. */
  holds(chunk) {
    const own = chunk.start >= this.start;
    (own ? this.parts : this.waiting).push(chunk);
    return !own;
  }

  /** Take the preview away. Returns the chunks that have waited. */
  end() {
    for (const { start, rows } of this.parts) {
      this.viewer.sorter.postMessage({ add: { means: new Float32Array(), importance: new Float32Array(), start } });
      this.viewer.rows -= rows;
    }
    return this.waiting;
  }
}
