import { SpacePreview } from './preview-space.js';
import { PreviewViewer } from './preview-viewer.js';
import { Space } from './space.js';
import { GROWTH_POWER } from './viewer.js';

/** Chunks that are asked for at once: one comes while another is decoded. */
const AT_ONCE = 2;

/**
 * A viewer of all scenes. Of large ones, chunks in sight come first, and a budget bounds how many splats are held: beside a preview
 * the chunks in sight, else of all chunks those splats that cover most.
 */
export class SpatialViewer extends PreviewViewer {
  constructor(canvas, options) {
    super(canvas, options);
    this.addEventListener('frame', () => this.#ask());
  }

  /** Most splats to hold: as the page's address says, or as many as there is graphics memory for. */
  #budget(degree) {
    const { count, shRows } = this.renderer.most(degree);
    return Math.min(this.roomFor({ count: 1, shRows: 1, shDegree: degree }), count, degree ? shRows : Infinity);
  }

  roomOf(header) {
    this.asking = 0;
    this.rested = false;
    this.spacePreview = null;
    this.space = Space.tells(header) ? new Space(header, this.#budget(header.shDegree)) : null;
    if (!this.space) {
      this.loader.postMessage({ all: true });
      return super.roomOf(header);
    }
    const { room, share } = this.space;
    this.share = share;
    if (!header.preview) return room;
    this.spacePreview = new SpacePreview(this, this.space, header.preview);
    this.loader.postMessage({ preview: true, start: room.count, shStart: room.shRows });
    return this.spacePreview.room;
  }

  thinned(whole) {
    if (!this.space) return super.thinned(whole);
    return super.thinned(whole, this.isPreview(whole) ? 1 : this.share, whole.start, whole.shStart);
  }

  get growth() {
    if (!this.space) return super.growth;
    if (this.spacePreview && !this.space.sightIsHere) return 1;
    const { layers, cutFrom, count } = this.header;
    const missing = layers.length > 1 ? this.space.missing : 1;
    return ((missing * (cutFrom ?? { count }).count) / count) ** GROWTH_POWER;
  }

  /** Whether a chunk lies behind the room of the scene. */
  isPreview({ start }) {
    return start >= this.space.room.count;
  }

  async loaded(data) {
    const { chunk } = data;
    if (chunk && this.space && !this.isPreview(chunk)) {
      this.asking--;
      this.space.arrived(chunk.index);
    } else if (chunk) this.spacePreview?.add(chunk);
    const done = await super.loaded(data);
    if (!this.space) return done;
    if (data.header) this.placeBox(this.space.box);
    this.spacePreview?.update();
    this.#ask();
    return this.rested;
  }

  /** Ask for what the camera sees and is not there. */
  #ask() {
    if (!this.space || !this.header) return;
    this.space.look(this.view);
    while (this.asking < AT_ONCE) {
      const part = this.space.next();
      if (!part) break;
      this.asking++;
      this.loader.postMessage({ get: part.index, ...part.place });
    }
    if (this.asking || this.rested) return;
    this.rested = true;
    if (this.space.complete) this.loader.terminate();
    this.finish();
  }
}
