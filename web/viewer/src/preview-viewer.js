import { Previewed } from './previewed.js';
import { Viewer } from './viewer.js';

/** A viewer that shows a scene's preview until the first layer is there. */
export class PreviewViewer extends Viewer {
  roomOf(header) {
    this.previewed = null;
    if (!header.preview) return super.roomOf(header);
    this.previewed = new Previewed(this, header, super.roomOf(header));
    return this.previewed.room;
  }

  async loaded(data) {
    const { chunk } = data;
    if (!chunk || !this.previewed) return super.loaded(data);
    if (!this.previewed.holds(chunk)) return super.loaded(data);
    if (chunk.start + chunk.rows < this.header.layers.find((rows) => rows)) return false;
    const waiting = this.previewed.end();
    this.previewed = null;
    for (const each of waiting) await super.loaded({ chunk: each });
    return false;
  }

  /** All of a preview. */
  thinned(whole, ...where) {
    if (!this.previewed) return super.thinned(whole, ...where);
    const [by, shBy] = this.previewed.moves;
    return super.thinned(whole, 1, whole.start + by, whole.shStart + shBy);
  }

  get growth() {
    return this.previewed ? 1 : super.growth;
  }
}
