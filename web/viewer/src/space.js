// Which chunks of a large scene to have, and in which order: what is in sight comes first.
import { expandBox } from '../../decoder/src/contraction.js';
import { dot, subtract } from './vectors.js';

/** A layer that is out of sight comes after so many further layers that are in sight. */
const OUT_OF_SIGHT = 1.5;
/** Splats reach beyond their centres: we take a view for so much wider. */
const WIDER = 1.2;

/**
 * The chunks of a scene whose file tells where they lie (`boxes` in docs/format.md), and places for those that fit a budget.
 *
 * Each chunk has a state: `place` is where it lies or will lie, or undefined.
 */
export class Space {
  /**
   * @param {object} header of the worker
   * @param {number} budget most rows to hold; beside a preview and without layers, whole chunks, and one at least
   */
  constructor(header, budget) {
    this.parts = partsOf(header);
    const [rows, shRows] = ['rows', 'shRows'].map((name) => Math.max(...this.parts.map((part) => part[name])));
    const fits = header.count <= budget;
    /** The share of each chunk's rows that there is room for. */
    this.share = fits || (header.preview && header.layers.length < 2) ? 1 : budget / header.count;
    const most = Math.min(this.parts.length, Math.max(1, Math.floor(budget / rows)));
    this.free = fits || this.share < 1 ? ownPlaces(this.parts, this.share) : equalPlaces(most, rows, shRows);
    const end = this.free.at(-1);
    // A chunk of which nothing is kept has its place inside, too.
    this.room = { count: end.start + Math.max(end.rows, 1), shRows: end.shStart + end.shRows, shDegree: header.shDegree };
  }

  /** Whether a header tells where each chunk lies. */
  static tells({ anyChunk, settings: { boxes }, layers, chunkRows }) {
    const count = layers.reduce((sum, rows) => sum + Math.ceil(rows / chunkRows), 0);
    if (!anyChunk || !Array.isArray(boxes) || !(count > 0 && boxes.length >= count)) return false;
    return boxes.every((box) => Array.isArray(box) && box.length === 7 && box.every(Number.isSafeInteger) && box[6] >= 0);
  }

  /** The box of the scene: all but a quarter of the chunks at each end, since a few lie far outside. */
  get box() {
    const at = (name, axis, share) => {
      const ends = this.parts.map((part) => part[name][axis]).sort((a, b) => a - b);
      return ends[Math.floor(share * (ends.length - 1))];
    };
    return { low: [0, 1, 2].map((axis) => at('low', axis, 0.25)), high: [0, 1, 2].map((axis) => at('high', axis, 0.75)) };
  }

  /** Rank all chunks for a view, from `Camera.view`. */
  look(view) {
    const planes = planesOf(view);
    for (const part of this.parts) {
      part.inSight = planes.every((plane) => farthest(part, plane, view.eye) > 0);
      part.rank = part.layer + (part.inSight ? 0 : OUT_OF_SIGHT);
      part.distance = distanceTo(part, view.eye);
    }
    this.parts.sort((a, b) => a.rank - b.rank || a.distance - b.distance || a.index - b.index);
  }

  /**
   * The chunk to have next, with its place; it may be that of another chunk, which is given up for it.
   * @returns {{index: number, place: object} | null} null if nothing that is missing would be better than what is there
   */
  next() {
    const part = this.parts.find(({ place }) => !place);
    if (!part) return null;
    if (!this.free.length) {
      const worst = this.parts.findLast(({ place, here }) => place && here);
      if (!worst || worst.rank <= part.rank) return null;
      this.free.push(worst.place);
      worst.place = undefined;
      worst.here = false;
    }
    const own = this.free.findIndex(({ index }) => index === part.index);
    [part.place] = this.free.splice(Math.max(own, 0), 1);
    return part;
  }

  /** A chunk came. */
  arrived(index) {
    this.parts.find((part) => part.index === index).here = true;
  }

  /** The chunks of the first layer. */
  get firstLayer() {
    const first = Math.min(...this.parts.map(({ layer }) => layer));
    return this.parts.filter(({ layer }) => layer === first);
  }

  /** Whether all chunks are there. */
  get complete() {
    return this.parts.every(({ here }) => here);
  }

  /** Whether of the first layer all that is in sight is there; also if nothing is. */
  get sightIsHere() {
    return this.firstLayer.every(({ inSight, here }) => here || !inSight);
  }

  /** Rows of the chunks in sight over those of them that are there; 1 if none is. */
  get missing() {
    const sum = (parts) => parts.reduce((total, { rows }) => total + rows, 0);
    const inSight = this.parts.filter((part) => part.inSight);
    const here = sum(inSight.filter((part) => part.here));
    return here ? sum(inSight) / here : 1;
  }
}

function partsOf({ settings: { boxes }, layers, chunkRows, steps }) {
  const parts = [];
  const scaled = (codes) => codes.map((code) => code * steps.position);
  layers.forEach((count, layer) => {
    for (let at = 0; at < count; at += chunkRows) {
      const index = parts.length;
      const box = boxes[index];
      const rows = Math.min(chunkRows, count - at);
      const shRows = Math.min(box[6], rows);
      const codes = { low: scaled(box.slice(0, 3)), high: scaled(box.slice(3, 6)) };
      const ends = steps.contraction ? expandBox(codes, steps.contraction) : codes;
      parts.push({ index, layer, rows, shRows, ...ends, here: false });
    }
  });
  return parts;
}

/** A place for each chunk, in the order of the file. */
function ownPlaces(parts, share) {
  let [start, shStart] = [0, 0];
  return parts.map((part) => {
    const rows = Math.floor(share * part.rows);
    const shRows = Math.min(rows, part.shRows);
    const place = { index: part.index, start, rows, shStart, shRows, shEnd: shStart + part.shRows };
    start += rows;
    shStart += shRows;
    return place;
  });
}

function equalPlaces(count, rows, shRows) {
  return Array.from({ length: count }, (_, i) => ({ start: i * rows, rows, shStart: i * shRows, shRows, shEnd: (i + 1) * shRows }));
}

/** Normals of the planes around a view, which point inwards: the sides, and forward. */
function planesOf({ rotation, fx, fy, width, height }) {
  const [right, down, forward] = [0, 3, 6].map((at) => rotation.slice(at, at + 3));
  const side = (axis, slope, sign) => axis.map((value, i) => sign * value + WIDER * slope * forward[i]);
  const [wide, high] = [width / (2 * fx), height / (2 * fy)];
  return [side(right, wide, 1), side(right, wide, -1), side(down, high, 1), side(down, high, -1), forward];
}

/** How far the box reaches to the inner side of a plane through the eye. */
function farthest({ low, high }, plane, eye) {
  const corner = plane.map((value, axis) => (value > 0 ? high : low)[axis]);
  return dot(plane, subtract(corner, eye));
}

/** How far a place is from a box; 0 inside. */
export function distanceTo({ low, high }, eye) {
  return Math.hypot(...eye.map((value, axis) => Math.max(low[axis] - value, 0, value - high[axis])));
}
