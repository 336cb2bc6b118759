// Mouse, touch and keys, as moves of the camera. `moved` is called after each.

const TURN = 0.005;
const KEY_SPEED = 0.8;
const MOVES = {
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyQ: [0, 1, 0],
  KeyE: [0, -1, 0],
};
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

/** Whether a key belongs to the field that it is typed in. */
export function isTyping({ target }) {
  return Boolean(target.matches?.('select, textarea, input:not([type="checkbox"])'));
}

export class Controls {
  /**
   * @param {HTMLElement} element
   * @param {() => import('./camera.js').Camera} camera
   * @param {() => void} moved
   * @param {{keys?: EventTarget, guest?: boolean, signal?: AbortSignal}} [options] `keys`: where keys are heard, such as the document
   *   of a page that is about one scene. `guest`: on a page of something else, which scrolls until the element is clicked.
   */
  constructor(element, camera, moved, { keys = element, guest = false, signal } = {}) {
    this.element = element;
    this.camera = camera;
    this.moved = moved;
    this.fly = false;
    this.touched = false; // whether anybody has moved the camera
    this.pointers = new Map();
    this.held = new Set();
    this.guest = guest;
    const hear = (target, names, act) => names.forEach((name) => target.addEventListener(name, act, { signal, passive: false }));
    hear(element, ['pointerdown'], (event) => this.#down(event));
    hear(element, ['pointermove'], (event) => this.#move(event));
    hear(element, ['pointerup', 'pointercancel'], (event) => this.#up(event));
    hear(element, ['wheel'], (event) => this.#wheel(event));
    hear(element, ['contextmenu'], (event) => event.preventDefault());
    hear(keys, ['keydown', 'keyup'], (event) => isTyping(event) || this.#key(event, event.type === 'keydown'));
    hear(element, ['blur'], () => this.held.clear());
    hear(globalThis, ['blur'], () => this.held.clear());
    if (!guest) return;
    element.style.touchAction = 'pan-y';
    hear(element, ['focus'], () => (element.style.touchAction = 'none'));
    hear(element, ['blur'], () => (element.style.touchAction = 'pan-y'));
  }

  /** Whether a key is held, so that frames must follow each other. */
  get active() {
    return this.held.size > 0;
  }

  /** Move by the keys that are held, for so many seconds. */
  step(seconds) {
    const speed = KEY_SPEED * seconds;
    const camera = this.camera();
    for (const code of this.held) {
      if (MOVES[code]) camera.move(...MOVES[code].map((way) => way * speed * camera.distance));
      else this.#turn(...TURNS[code].map((way) => way * speed));
    }
  }

  #turn(side, upwards) {
    // Dragging turns the scene when orbiting, and the head when flying: the other way round.
    if (this.fly) this.camera().look(-side, upwards);
    else this.camera().orbit(-side, upwards);
  }

  #down(event) {
    this.touched = true;
    this.element.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  #up(event) {
    this.pointers.delete(event.pointerId);
  }

  #move(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const others = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
    const [dx, dy] = [event.clientX - before[0], event.clientY - before[1]];
    if (others.length) this.#pinch(before, [event.clientX, event.clientY], others[0]);
    else if (event.buttons & 6 || event.shiftKey) this.#pan(dx, dy);
    else this.#turn(dx * TURN, -dy * TURN);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    this.moved();
  }

  /** Two fingers: their distance zooms, their middle moves. */
  #pinch(before, now, other) {
    const wide = (place) => Math.max(Math.hypot(place[0] - other[0], place[1] - other[1]), 10);
    this.#closer(wide(before) / wide(now));
    this.#pan((now[0] - before[0]) / 2, (now[1] - before[1]) / 2);
  }

  /** Move what lies at the target's depth with the pointer. */
  #pan(dx, dy) {
    const camera = this.camera();
    const box = this.element.getBoundingClientRect();
    const { fx, fy } = camera.view(box.width, box.height);
    camera.move((-dx * camera.distance) / fx, (-dy * camera.distance) / fy, 0);
  }

  #wheel(event) {
    if (this.guest && !this.element.matches(':focus')) return;
    event.preventDefault();
    const factor = Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * 0.001)));
    this.#closer(factor);
    this.moved();
  }

  /** Come closer by a factor of the distance: to the target, or with it when flying. */
  #closer(factor) {
    const camera = this.camera();
    if (this.fly) camera.move(0, 0, (1 - factor) * camera.distance);
    else camera.zoom(factor);
  }

  #key(event, down) {
    if (!(event.code in MOVES || event.code in TURNS)) return;
    if (down && (event.ctrlKey || event.metaKey || event.altKey)) return;
    event.preventDefault();
    this.touched = true;
    if (down) this.held.add(event.code);
    else this.held.delete(event.code);
    this.moved();
  }
}
