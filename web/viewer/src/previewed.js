/** A preview in a viewer. Its rows lie behind those that the scene has room for. The scene's chunks wait until it is taken away. */
export class Previewed {
  /**
   * @param {Viewer} viewer
   * @param {{count: number, shRows: number}} header of the scene
   * @param {{count: number, shRows: number}} room of the scene
   */
  constructor(viewer, header, room) {
    const { count, shRows } = header.preview;
    this.viewer = viewer;
    this.start = header.count;
    this.moves = [room.count - header.count, room.shRows - header.shRows];
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
    for (const { start, rows, shRows } of this.parts) {
      const add = { means: new Float32Array(), importance: new Float32Array(), start: start + this.moves[0] };
      this.viewer.sorter.postMessage({ add });
      this.viewer.rows -= rows;
      this.viewer.shRows -= shRows;
    }
    return this.waiting;
  }
}
