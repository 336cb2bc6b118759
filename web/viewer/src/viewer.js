import { boxOf, Camera, outsidePose, startOf, startPose, upOf } from './camera.js';
import { Controls } from './controls.js';
import { Renderer } from './renderer.js';
import { add, dot, subtract, times, unit } from './vectors.js';
import { shTexels } from './pack.js';
import { shareOf, thinChunk } from './thin.js';
import { startWorker } from './workers.js';

/** Bytes of graphics memory to take on a device with a gigabyte of memory, and such gigabytes at most. */
const ROOM_BYTES = 64 * 2 ** 20;
const ROOM_MOST = 8;
const ROOM_USUAL = 4;
export const GROWTH_POWER = 1 / 8;
/** Most pixels of a picture, on phones and elsewhere. */
const PIXELS = { coarse: 2e6, fine: 9e6 };
/** While the camera moves, frames that take longer than this many milliseconds have fewer pixels, down to this scale. */
const SMOOTH_MS = 50;
const LEAST_SCALE = 0.25;
/**
 * Pictures that take longer even so, or longer than this where the camera stands still, have fewer splats, down to so many. The
 * first ones have so many, and faster ones so many times more.
 */
const PATIENT_MS = 1000;
const LEAST_DRAWN = 50_000;
const FIRST_DRAWN = 250_000;
const FASTER = 4;
const REST_MS = 200;
const SIGHT = 1.2; // splats reach beyond their centres
/** While chunks come, this share of the time goes into pictures, at most. */
const DRAWING_SHARE = 0.2;

/**
 * A scene on a canvas. It draws when something changed, and while a key is held.
 *
 * `look` may be changed by the page, followed by `refresh`; `stats` tells numbers.
 */
export class Viewer extends EventTarget {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{half?: boolean, first?: {source: string | Uint8Array, name: string}, keys?: EventTarget, guest?: boolean}} [options] `first` is decoded while the
   *   shaders are compiled; `load` must be called with it at once. `keys`, `guest`: as for
   *   `Controls`
   */
  constructor(canvas, { half, first, keys, guest } = {}) {
    super();
    this.canvas = canvas;
    this.half = half;
    this.turning = 0; // degrees a second, until somebody moves the camera
    this.ending = new AbortController();
    const { signal } = this.ending;
    this.fresh = { load: startWorker('load'), sort: startWorker('sort'), first, started: performance.now() };
    if (first) this.fresh.load.postMessage(first);
    this.renderer = new Renderer(canvas, { half });
    this.camera = new Camera([0, -1, 0]);
    this.controls = new Controls(
      canvas,
      () => this.camera,
      () => this.#moved(),
      { keys, guest, signal },
    );
    canvas.addEventListener('dblclick', ({ clientX, clientY }) => this.focus(clientX, clientY), { signal });
    this.look = { near: 0.2, degree: 4, antialiased: false, background: [0, 0, 0] };
    this.scale = 1;
    this.movingScale = 1;
    this.asks = 1; // share of the splats to draw
    this.poses = [];
    this.stats = {};
    this.#reset();
    this.sized = new ResizeObserver(() => this.refresh());
    this.sized.observe(canvas);
    canvas.addEventListener('webglcontextlost', (event) => this.#lost(event), { signal });
    canvas.addEventListener('webglcontextrestored', () => this.#restored(), { signal });
  }

  #lost(event) {
    event.preventDefault(); // else it never comes back
    this.loader?.terminate();
    this.#fail('The graphics device was lost. The scene comes back with it.');
  }

  #restored() {
    this.renderer = new Renderer(this.canvas, { half: this.half });
    this.retry();
  }

  /** Load the last scene again, at the camera's view. */
  retry() {
    if (!this.last) return;
    const [source, options] = this.last;
    const start = this.header ? startOf(this.camera, this.header.origin) : options.start;
    this.load(source, { ...options, start }).catch(() => {});
  }

  /** End its workers and let go of the device. The canvas cannot be drawn on again. */
  dispose() {
    this.ending.abort();
    this.sized.disconnect();
    clearTimeout(this.resting);
    clearTimeout(this.later);
    for (const worker of [this.loader, this.sorter, this.fresh?.load, this.fresh?.sort]) worker?.terminate();
    this.header = null;
    this.controls.held.clear();
    this.renderer.gl.getExtension('WEBGL_lose_context')?.loseContext();
  }

  #reset() {
    this.header = null;
    this.rows = 0;
    this.shRows = 0;
    this.share = 1;
    this.pace = { moving: FIRST_DRAWN, still: FIRST_DRAWN };
    this.order = null;
    this.box = null;
    this.wanted = false;
    this.sorting = null;
    this.sortedFor = null;
    this.stats = { splats: 0, drawn: 0, bytes: 0, layers: 0, sortMs: 0, frameMs: 0, firstMs: 0, wholeMs: 0 };
  }

  /**
   * Load a scene.
   *
   * @param {string | Uint8Array | Blob} source an absolute address, or bytes
   * @param {{name: string, poses: object[], pose?: number, start?: object, look?: object}} options `pose`: index of the first one,
   *   in place of the view that the scene starts from; `start`: that view, in place of the file's
   * @returns {Promise<void>} when all is there
   */
  async load(source, { name, poses = [], pose, start, look = {} }) {
    this.loader?.terminate();
    this.sorter?.terminate();
    this.last = [source, { name, poses, pose, start, look }];
    this.#reset();
    this.poses = poses;
    this.pose = pose;
    this.start = start;
    this.asked = look;
    const begun = this.fresh?.first?.source === source && this.fresh;
    const { load, sort } = this.fresh ?? { load: startWorker('load'), sort: startWorker('sort') };
    this.fresh = null;
    this.started = begun ? begun.started : performance.now();
    this.sorter = sort;
    this.sorter.onmessage = ({ data }) => this.#sorted(data);
    this.loader = load;
    await new Promise((resolve, reject) => {
      const failed = (error) => {
        load.terminate();
        this.#fail(error.message);
        reject(error);
      };
      load.onerror = (event) => failed(new Error(event.message || 'The worker that decodes did not start.'));
      load.onmessage = ({ data }) => this.loaded(data).then((done) => done && resolve(), failed);
      if (!begun) load.postMessage({ source, name });
    });
  }

  /** Act on what the worker sends. Returns whether all is there. */
  async loaded(data) {
    if (data.error) throw new Error(data.error);
    if (data.header) return this.#begin(data.header);
    if (data.chunk) this.#add(data.chunk);
    if (data.done) {
      this.loader.terminate();
      this.finish();
    }
    return Boolean(data.done);
  }

  finish() {
    this.stats.wholeMs = performance.now() - this.started;
    this.#tell('loaded');
    this.refresh();
  }

  /** Most splats to hold of a scene like this: as the page's address says, or as the device has memory for. */
  roomFor(header) {
    const asked = Number(new URLSearchParams(location.search).get('splats'));
    const bytes = ROOM_BYTES * Math.min(navigator.deviceMemory ?? ROOM_USUAL, ROOM_MOST);
    return asked > 0 ? asked : (header.count * bytes) / Math.max(1, Renderer.bytesOf(header));
  }

  /** How many rows get room, and how many of them have SH. */
  roomOf(header) {
    const { count: most, shRows: shMost } = this.renderer.most(header.shDegree);
    this.share = shareOf(header, { count: Math.min(most, this.roomFor(header)), shRows: shMost });
    const [count, shRows] = [header.count, header.shRows].map((rows) => Math.floor(this.share * rows));
    return { ...header, count, shRows };
  }

  #begin(header) {
    this.header = header;
    this.room = this.roomOf(header);
    this.renderer.begin(this.room);
    const { near, background, antialiased } = header.settings;
    if (typeof near === 'number') this.look.near = near;
    if (Array.isArray(background) && background.length === 3) this.look.background = background.map(Number);
    this.look.antialiased = antialiased === true;
    this.look.degree = header.shDegree;
    Object.assign(this.look, this.asked);
    Object.assign(this.stats, { splats: header.count, bytes: header.size, layers: header.layers.length });
    this.#placeStart(startPose(this.start) ?? startPose(header.settings.start));
    if (this.poses.length) this.setPose(this.pose);
    this.#tell('begun');
    return false;
  }

  /** The view to start from becomes the last of the poses. */
  #placeStart(start) {
    this.camera = new Camera(start?.up ?? upOf(this.poses));
    if (start) this.poses = [...this.poses, start];
    this.pose ??= start ? this.poses.length - 1 : 0;
  }

  #add(whole) {
    const chunk = this.share < 1 ? this.thinned(whole) : whole;
    if (!chunk.rows) return; // of a chunk of few rows, a small share is none
    this.shRows += chunk.shRows;
    this.renderer.add(chunk);
    this.rows += chunk.rows;
    if (!this.box) this.placeBox(boxOf(chunk.means, chunk.rows));
    const { means, importance, start } = chunk;
    this.sorter.postMessage({ add: { means, importance, start } }, [means.buffer, importance.buffer]);
    this.sortedFor = null;
    // Not with the next frame: a frame of what is there may take longer than the sort.
    this.#sortIfNeeded();
    this.#refreshSoon();
    this.#tell('chunk');
  }

  /** The rows of a chunk that there is room for. */
  thinned(whole, share = this.share, start = this.rows, shStart = this.shRows) {
    return thinChunk(whole, share, { start, shStart }, this.room.shRows, 4 * shTexels(this.header.shDegree));
  }

  /** The scene lies in this box: so far away the camera turns around it. */
  placeBox(box) {
    this.box = box;
    if (!this.poses.length) this.poses = [outsidePose(box, this.header.origin)];
    this.setPose(this.pose);
    this.#tell('poses');
  }

  /** Take the place of a pose. */
  setPose(index) {
    const pose = this.poses[index];
    if (!pose) return;
    this.camera.setPose(pose, this.header.origin, this.#depthOf(pose));
    this.pose = index;
    this.refresh();
  }

  /** How far a pose is from what it looks at: the middle of the scene, unless it says so. */
  #depthOf(pose) {
    if (pose.depth) return pose.depth;
    if (!this.box) return 1;
    const eye = subtract(pose.position, this.header.origin);
    const middle = times(add(this.box.low, this.box.high), 0.5);
    const across = Math.hypot(...subtract(this.box.high, this.box.low));
    return Math.max(dot(subtract(middle, eye), pose.rotation[2]), 0.1 * across, 1e-3);
  }

  /** Most splats to draw now. */
  get most() {
    const rows = this.asks * this.rows;
    return this.taking ? rows : Math.min(rows, this.pace[this.resting ? 'moving' : 'still']);
  }

  /** Factor on all scales while layers are missing (docs/drawing.md): what is there fills the gaps. */
  get growth() {
    const { layers, cutFrom, count } = this.header;
    const layered = cutFrom || layers.length > 1;
    return layered && this.rows ? ((cutFrom ?? { count }).count / this.rows) ** GROWTH_POWER : 1;
  }

  /** Draw soon. */
  refresh() {
    if (this.wanted) return;
    this.wanted = true;
    requestAnimationFrame((now) => this.#frame(now));
  }

  /** Draw when the pictures have had their share of the time. */
  #refreshSoon() {
    const wait = this.stats.firstMs ? this.stats.frameMs / DRAWING_SHARE - (performance.now() - this.lastDraw) : 0;
    if (wait <= 0) this.refresh();
    else this.later ??= setTimeout(() => ((this.later = null), this.refresh()), wait);
  }

  #moved() {
    clearTimeout(this.resting);
    this.resting = setTimeout(() => ((this.resting = null), this.refresh()), REST_MS);
    this.refresh();
  }

  #frame(now) {
    // The device still draws the last one: a frame behind it would show where the camera was.
    if (this.drawing) return requestAnimationFrame((next) => this.#frame(next));
    this.wanted = false;
    const seconds = Math.min((now - (this.lastFrame ?? now)) / 1000, 0.1);
    const turns = this.turning && !this.controls.touched;
    this.lastFrame = this.controls.active || turns ? now : undefined;
    if (!this.header) return;
    if (this.controls.active) {
      this.controls.step(seconds);
      this.#moved();
    } else if (turns && this.stats.wholeMs) {
      this.camera.orbit((this.turning * seconds * Math.PI) / 180, 0);
      this.#moved();
    }
    this.lastDraw = performance.now();
    this.#sortIfNeeded();
    this.renderer.draw(this.view, this.look, this.growth);
    this.drawing = true;
    this.renderer.whenDone(() => this.#drew());
    this.stats.drawn = this.renderer.drawn;
    if (this.renderer.drawn && !this.stats.firstMs) {
      this.stats.firstMs = performance.now() - this.started;
      this.#tell('first');
    }
    this.#tell('frame');
  }

  /** A frame is done. */
  #drew() {
    this.drawing = false;
    this.stats.frameMs = performance.now() - this.lastDraw;
    const [kind, wanted] = this.resting ? ['moving', SMOOTH_MS] : ['still', PATIENT_MS];
    const faster = wanted / Math.max(this.stats.frameMs, 1);
    if (this.resting) this.movingScale = Math.min(1, Math.max(LEAST_SCALE, this.movingScale * Math.sqrt(faster)));
    const most = Math.max(LEAST_DRAWN, Math.min(faster, FASTER) * this.stats.drawn);
    if (faster > 1 && most > this.pace[kind]) {
      if (this.most < this.rows) this.refresh();
      this.pace[kind] = most;
    } else if (faster < 1 && (!this.resting || this.movingScale === LEAST_SCALE)) this.pace[kind] = Math.min(this.pace[kind], most);
    this.#tell('timed');
  }

  /** The camera's view on the canvas as it is. */
  get view() {
    const { clientWidth, clientHeight } = this.canvas;
    const most = PIXELS[matchMedia('(pointer: coarse)').matches ? 'coarse' : 'fine'];
    const density = Math.min(globalThis.devicePixelRatio || 1, Math.sqrt(most / Math.max(1, clientWidth * clientHeight)));
    const ratio = density * this.scale * (this.resting ? this.movingScale : 1);
    const [width, height] = [clientWidth, clientHeight].map((size) =>
      Math.max(1, Math.floor(size * ratio + 1e-6)),
    );
    return this.camera.view(width, height);
  }

  #sortIfNeeded() {
    const { camera, look, most } = this;
    const some = most < this.rows;
    const key = [...camera.depth, look.near, this.rows, some && [most, camera.eye]].join();
    if (this.sorting || this.sortedFor === key || !this.rows) return;
    this.sortedFor = key;
    this.sorting = true;
    const buffer = this.order;
    this.order = null;
    const { width, height, fx, fy, eye } = this.view;
    const sight = { eye, wide: ((SIGHT * Math.hypot(width / fx, height / fy)) / 2) ** 2 };
    const message = { view: camera.depth, near: look.near, most: some ? most : undefined, sight, buffer };
    this.sorter.postMessage(message, buffer ? [buffer] : []);
  }

  /** Turn around what lies at a place of the canvas, in CSS pixels. */
  focus(x, y) {
    const box = this.canvas.getBoundingClientRect();
    const { fx, fy, cx, cy } = this.camera.view(box.width, box.height);
    const [right, down, forward] = this.camera.axes;
    const way = unit(add(forward, add(times(right, (x - box.left - cx) / fx), times(down, (y - box.top - cy) / fy))));
    this.sorter?.postMessage({ pick: { eye: this.camera.eye, way, near: this.look.near } });
  }

  #sorted({ order, count, ms, picked }) {
    if (picked !== undefined) {
      if (picked) this.camera.lookAt(picked);
      this.#moved();
      return;
    }
    this.sorting = null;
    this.renderer.setOrder(order, count);
    this.order = order.buffer;
    this.stats.sortMs = ms;
    this.#tell('sorted');
    this.refresh();
  }

  /** When the order belongs to the camera, as far as the camera stands still. */
  async settled() {
    for (;;) {
      this.#sortIfNeeded();
      if (!this.sorting) return;
      await new Promise((resolve) => this.addEventListener('sorted', resolve, { once: true }));
    }
  }

  /** A PNG of the view in this size. */
  async picture(width = this.canvas.width, height = this.canvas.height) {
    this.taking = true;
    await this.settled();
    this.taking = false;
    this.renderer.draw(this.camera.view(width, height), this.look, this.growth);
    const blob = await new Promise((resolve) => this.canvas.toBlob(resolve, 'image/png'));
    this.refresh();
    return blob;
  }

  /** What was drawn is taken back: a damaged file is no scene. */
  #fail(message) {
    // An order that is on its way would bring it back.
    if (this.sorter) this.sorter.onmessage = null;
    this.sorter?.terminate();
    this.sorting = null;
    this.renderer.drawn = 0;
    this.rows = 0;
    this.refresh();
    this.#tell('sorted');
    this.dispatchEvent(new CustomEvent('failed', { detail: message }));
  }

  #tell(name) {
    this.dispatchEvent(new Event(name));
  }
}
