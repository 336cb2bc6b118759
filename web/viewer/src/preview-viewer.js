import { Previewed } from './previewed.js';
import { Viewer } from './viewer.js';

/** A viewer that shows a scene's preview until the first layer is there. */
export class PreviewViewer extends Viewer {
  roomOf(header) {
    this.previewed = null;
    if (!header.preview) return super.roomOf(header);
    this.previewed = new Previewed(this, header, header.preview);
    return this.previewed.room;
  }

  async loaded(data, agree) {
    const { chunk } = data;
    if (!chunk || !this.previewed) return super.loaded(data, agree);
    await this.ready;
    if (!this.previewed.holds(chunk)) return super.loaded(data, agree);
    if (chunk.start + chunk.rows < this.header.layers.find((rows) => rows)) return false;
    const waiting = this.previewed.end();
    this.previewed = null;
    for (const each of waiting) await super.loaded({ chunk: each }, agree);
    return false;
  }

  get growth() {
    return this.previewed ? 1 : super.growth;
  }
}
