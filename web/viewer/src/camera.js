import { add, cross, dot, subtract, times, turned, unit } from './vectors.js';

/**
 * A camera: right, down and forward in the world, the eye relative to the scene's origin, and how wide it sees. A pose of a
 * file fits into the canvas whole, and the canvas shows what lies around it.
 */
export class Camera {
  constructor(up) {
    this.up = up;
    this.eye = [0, 0, 0];
    this.target = [0, 0, 1];
    this.axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]; // prettier-ignore
    this.lens = { width: 1, height: 1, fx: 1, fy: 1, cx: 0, cy: 0 };
  }

  /** Take the place of a pose, and turn around what lies in its middle at this distance. */
  setPose(pose, origin, distance) {
    this.eye = subtract(pose.position, origin);
    this.axes = pose.rotation.map((row) => [...row]);
    const { width, height, fx, fy, cx, cy } = pose;
    this.lens = { width, height, fx, fy, cx, cy };
    this.target = add(this.eye, times(this.axes[2], distance));
  }

  get distance() {
    return Math.max(dot(subtract(this.target, this.eye), this.axes[2]), 1e-6);
  }

  /** Look from the eye to the target, upright. */
  #level(forward) {
    const right = unit(cross(forward, this.up), this.axes[0]);
    this.axes = [right, cross(forward, right), forward];
  }

  /** Look at a point, upright, and turn around it. */
  lookAt(point) {
    this.target = point;
    this.#level(unit(subtract(point, this.eye), this.axes[2]));
  }

  /** Turn around the target, by angles to the side and up. */
  orbit(side, upwards) {
    const away = subtract(this.eye, this.target);
    const forward = this.#steered(side, upwards);
    const distance = Math.hypot(...away);
    this.eye = subtract(this.target, times(forward, distance));
    this.#level(forward);
  }

  /** Turn the head. */
  look(side, upwards) {
    const distance = this.distance;
    this.#level(this.#steered(side, upwards));
    this.target = add(this.eye, times(this.axes[2], distance));
  }

  /** The direction of view, turned; never quite along `up`, where left and right would swap. */
  #steered(side, upwards) {
    const sideways = turned(this.axes[2], this.up, side);
    const right = unit(cross(sideways, this.up), this.axes[0]);
    const forward = unit(turned(sideways, right, upwards));
    return Math.abs(dot(forward, this.up)) > 0.999 ? sideways : forward;
  }

  /** Move the eye and the target, in units of right, down and forward. */
  move(right, down, forward) {
    const by = add(add(times(this.axes[0], right), times(this.axes[1], down)), times(this.axes[2], forward));
    this.eye = add(this.eye, by);
    this.target = add(this.target, by);
  }

  /** Come closer to the target, or go away from it, by a factor of the distance. */
  zoom(factor) {
    this.eye = add(this.target, times(subtract(this.eye, this.target), factor));
  }

  /** What the shaders take, for a picture of this size in pixels. */
  view(width, height) {
    const { lens } = this;
    const scale = Math.min(width / lens.width, height / lens.height);
    return {
      width,
      height,
      rotation: this.axes.flat(),
      eye: this.eye,
      fx: lens.fx * scale,
      fy: lens.fy * scale,
      // The middle of the pose's picture lies in the middle of the canvas; pixel centres are integers.
      cx: (width - 1) / 2 + (lens.cx - (lens.width - 1) / 2) * scale,
      cy: (height - 1) / 2 + (lens.cy - (lens.height - 1) / 2) * scale,
    };
  }

  /** The depth of a point p is p . (x, y, z) + w. */
  get depth() {
    return [...this.axes[2], -dot(this.axes[2], this.eye)];
  }
}

/** Up, as most poses have it. */
export function upOf(poses) {
  const sum = poses.reduce((total, pose) => subtract(total, pose.rotation[1]), [0, 0, 0]);
  return unit(sum, poses.length ? times(poses[0].rotation[1], -1) : [0, -1, 0]);
}

/** A pose that sees the whole scene from outside, for a scene without poses. */
export function outsidePose(box, origin) {
  const middle = times(add(box.low, box.high), 0.5);
  const radius = Math.max(0.5 * Math.hypot(...subtract(box.high, box.low)), 1e-3);
  const forward = unit([-0.5, 0.35, 0.8]);
  const right = unit(cross(forward, [0, -1, 0]));
  const position = add(add(origin, middle), times(forward, -1.6 * radius));
  const [width, height, focal] = [960, 720, 900];
  const [cx, cy] = [(width - 1) / 2, (height - 1) / 2];
  return { name: 'outside', position, rotation: [right, cross(forward, right), forward], width, height, fx: focal, fy: focal, cx, cy };
}

/** The pose of a start view (docs/format.md); null for anything else. */
export function startPose(start) {
  const { eye, target, up, fov } = start ?? {};
  const three = (list) => Array.isArray(list) && list.length === 3 && list.every((value) => Number.isFinite(value) && Math.abs(value) < 1e15);
  const angles = Array.isArray(fov) && fov.length === 2 && fov.every((angle) => angle > 0 && angle < 180);
  if (!angles || ![eye, target, up].every(three)) return null;
  const away = subtract(target, eye);
  const forward = unit(away);
  const right = unit(cross(forward, up), unit(cross(forward, Math.abs(forward[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0])));
  const [width, height] = fov.map((angle) => 2 * Math.tan((angle * Math.PI) / 360));
  const lens = { width, height, fx: 1, fy: 1, cx: (width - 1) / 2, cy: (height - 1) / 2 };
  const depth = Math.hypot(...away);
  return { name: 'start', position: eye, rotation: [right, cross(forward, right), forward], up: unit(up), depth, ...lens };
}

/** What `startPose` reads, of a camera. */
export function startOf({ eye, target, up, lens }, origin) {
  const fov = [lens.width / lens.fx, lens.height / lens.fy].map((size) => (Math.atan(size / 2) * 360) / Math.PI);
  return { eye: add(eye, origin), target: add(target, origin), up, fov };
}

/** A start view as one word of an address. */
export function viewWord({ eye, target, up, fov }) {
  return [...eye, ...target, ...up, ...fov].map((value) => Number(value.toPrecision(7))).join();
}

/** The start view of such a word; undefined for none. */
export function viewOfWord(word) {
  const numbers = word?.split(',').map(Number);
  if (numbers?.length !== 11) return undefined;
  const [eye, target, up] = [0, 3, 6].map((at) => numbers.slice(at, at + 3));
  return { eye, target, up, fov: numbers.slice(9) };
}

/** The box around most positions: all but a twentieth at each end, on each axis. */
export function boxOf(means, rows) {
  const ends = [0, 1, 2].map((axis) => {
    const step = Math.max(1, Math.floor(rows / 5000));
    const some = [];
    for (let i = 0; i < rows; i += step) some.push(means[axis * rows + i]);
    some.sort((a, b) => a - b);
    const at = (share) => some[Math.floor(share * (some.length - 1))] ?? 0;
    return [at(0.05), at(0.95)];
  });
  return { low: ends.map((end) => end[0]), high: ends.map((end) => end[1]) };
}
