import { shPerLine, TEXELS, TEXTURE_WIDTH } from './pack.js';
import { SpacePreview } from './preview-space.js';
import { PreviewViewer } from './preview-viewer.js';
import { Renderer } from './renderer.js';
import { Space } from './space.js';
import { GROWTH_POWER, UNASKED_BYTES } from './viewer.js';

/** Chunks that are asked for at once: one comes while another is decoded. */
const AT_ONCE = 2;

/** A viewer of all scenes. Of large ones, chunks in sight come first, and a budget bounds how many are held. */
export class SpatialViewer extends PreviewViewer {
  constructor(canvas, options) {
    super(canvas, options);
    this.addEventListener('frame', () => this.#ask());
  }

  /** Most splats to hold: as the page's address says, or as many as graphics memory is used for without asking. */
  #budget(degree) {
    const { gl } = this.renderer;
    const asked = Number(new URLSearchParams(location.search).get('splats'));
    const each = Renderer.bytesOf({ count: 1, shRows: 1, shDegree: degree });
    const perLine = Math.min(TEXTURE_WIDTH / TEXELS, degree ? shPerLine(degree) : Infinity);
    return Math.min(asked > 0 ? asked : UNASKED_BYTES / each, gl.getParameter(gl.MAX_TEXTURE_SIZE) * perLine);
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
    const { room } = this.space;
    if (!header.preview) return room;
    this.spacePreview = new SpacePreview(this, this.space, header.preview);
    this.loader.postMessage({ preview: true, start: room.count, shStart: room.shRows });
    return this.spacePreview.room;
  }

  get growth() {
    if (!this.space) return super.growth;
    if (this.spacePreview && !this.space.sightIsHere) return 1;
    const { layers, cutFrom, count } = this.header;
    const missing = layers.length > 1 ? this.space.missing : 1;
    return ((missing * (cutFrom ?? { count }).count) / count) ** GROWTH_POWER;
  }

  async loaded(data, agree) {
    const { chunk } = data;
    if (chunk) await this.ready;
    const own = chunk && chunk.start < this.space?.room.count;
    if (own) {
      this.asking--;
      this.space.arrived(chunk.index);
    } else if (chunk) this.spacePreview?.add(chunk);
    const done = await super.loaded(data, agree);
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
