/** What is drawn stays, unless something else is so many times worse. */
const HOLD = 1.5;
/** What is out of sight becomes finer last. */
const UNSEEN_SHARE = 1e-9;

/**
 * Versions of each chunk of a scene: the preview's and the level's rows, and those of the chunk. One of them is drawn. Where a budget
 * does not hold all of the finest, those parts are finer whose splats are larger in the picture.
 */
export class Levels {
  /**
   * @param {Viewer} viewer
   * @param {Space} space of the scene, whose rows come before those of the levels
   * @param {object[]} headers of the levels, from coarse to fine; layer k of each takes the place of chunk k
   */
  constructor(viewer, space, headers) {
    Object.assign(this, { viewer, space, asked: new Set(), shown: '' });
    this.chunks = space.parts.map((part) => ({ part, versions: [], now: 0 }));
    this.places = new Map();
    let { count: start } = space.room;
    for (const header of headers) {
      header.layers.forEach((rows, k) => {
        // The preview comes as a whole.
        const version = { k, rows, start, here: false, comes: header === headers[0] };
        if (rows) this.chunks[k]?.versions.push(version);
        if (rows) this.places.set(start, version);
        start += rows;
      });
    }
    const shRows = headers.reduce((sum, header) => sum + header.shRows, space.room.shRows);
    this.room = { ...space.room, count: start, shRows };
  }

  /** A chunk of a level came. */
  add({ start, importance, rows }) {
    const version = this.places.get(start);
    version.here = true;
    version.area = Math.exp(importance.reduce((sum, value) => sum + value, 0) / rows);
    if (this.asked.delete(version)) this.viewer.asking--;
  }

  update() {}

  /** The rows of the level to have next, in sight or of all; null if none is missing. */
  next(all) {
    for (const { index, inSight } of this.space.parts) {
      const version = this.chunks[index].versions.find(({ here, comes }) => !here && !comes);
      if (!(inSight || all) || !version || this.asked.has(version)) continue;
      this.asked.add(version);
      return { level: version.k, start: version.start, shStart: this.room.shRows };
    }
    return null;
  }

  /** Choose a version of each chunk for the camera's view. */
  choose() {
    const { viewer, space } = this;
    space.look(viewer.view);
    const steps = [];
    let rows = 0;
    for (const chunk of this.chunks) {
      const { part, now } = chunk;
      chunk.there = chunk.versions.filter(({ here }) => here);
      if (part.here) chunk.there.push({ rows: part.rows, start: part.place.start });
      chunk.now = 0;
      rows += chunk.there[0]?.rows ?? 0;
      for (let to = 1, worst = Infinity; to < chunk.there.length; to++) {
        const { area } = chunk.there[to - 1];
        worst = Math.min(worst, (area * (part.inSight ? 1 : UNSEEN_SHARE)) / Math.max(part.distance ** 2, area));
        steps.push({ chunk, to, error: to <= now ? HOLD * worst : worst });
      }
    }
    const most = viewer.taking ? Infinity : viewer.pace[viewer.resting ? 'moving' : 'still'];
    for (const { chunk, to } of steps.sort((a, b) => b.error - a.error)) {
      const more = chunk.there[to].rows - chunk.there[chunk.now].rows;
      if (chunk.now !== to - 1 || rows + more > most) continue;
      chunk.now = to;
      rows += more;
    }
    const shown = this.chunks.map(({ there, now }) => there[now]?.start).filter((start) => start !== undefined);
    viewer.rows = rows;
    if (this.shown === (this.shown = shown.join())) return;
    viewer.sorter.postMessage({ shown });
    viewer.sortedFor = null;
  }
}
