// A box around a part of the scene, to drag, and the command line that keeps what is inside.
import { inPicture } from './in-picture.js';
import { styled } from './styled.js';
import { add, subtract, times } from './vectors.js';

/** Width and height of a handle, in CSS pixels: a finger needs so much. */
const GRIP = 44;
const KEY_STEP = 0.01; // of the box at first; with Shift ten times as much
const WAYS = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 };
const SVG = 'http://www.w3.org/2000/svg';
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((corner) => [1, 2, 4].filter((bit) => !(corner & bit)).map((bit) => [corner, corner | bit]));

/**
 * Offer a box in a panel.
 *
 * @param {Viewer} viewer
 * @param {HTMLElement} panel
 * @param {() => string[]} words of the command line that the box is added to
 */
export function offerCrop(viewer, panel, words) {
  const layer = styled('div', { position: 'absolute', inset: '0', overflow: 'hidden', pointerEvents: 'none' });
  const drawing = document.createElementNS(SVG, 'svg');
  Object.assign(drawing.style, { width: '100%', height: '100%' });
  const lines = ['#000', '#fff'].map((stroke, i) => {
    const line = document.createElementNS(SVG, 'path');
    Object.assign(line.style, { fill: 'none', stroke, strokeWidth: 4 - 2 * i });
    return line;
  });
  drawing.append(...lines);
  layer.append(drawing);
  const [label, on] = [document.createElement('label'), document.createElement('input')];
  Object.assign(on, { type: 'checkbox', id: 'crop' });
  label.append(on, ' Crop to a box');
  const command = styled('textarea', { width: '100%', font: 'inherit' });
  Object.assign(command, { readOnly: true, rows: 5, id: 'command', ariaLabel: 'The command line that keeps what is inside' });
  const copy = Object.assign(document.createElement('button'), { type: 'button', textContent: 'Copy the command', id: 'copy' });
  panel.append(label, command, copy);
  const handles = [0, 1, 2, 3, 4, 5].map((face) => handleOf(face >> 1, face & 1));
  let ends = null; // low and high corner, from the origin on
  let step = 0;

  function handleOf(axis, end) {
    const style = { position: 'absolute', width: `${GRIP}px`, height: `${GRIP}px`, padding: '0', borderRadius: '50%', touchAction: 'none' };
    const handle = styled('div', { ...style, pointerEvents: 'auto', cursor: 'move', background: '#fff6', border: '2px solid', color: ['#c00', '#080', '#04f'][axis] });
    Object.assign(handle, { tabIndex: 0, role: 'slider', ariaLabel: `${'xyz'[axis]} ${end ? 'to' : 'from'}` });
    const move = (by) => {
      const [low, high] = [end ? ends[0][axis] : -Infinity, end ? Infinity : ends[1][axis]];
      ends[end][axis] = Math.min(high, Math.max(low, ends[end][axis] + by));
      show();
    };
    let last = null;
    handle.addEventListener('pointerdown', ({ pointerId, clientX, clientY }) => {
      handle.setPointerCapture(pointerId);
      last = [clientX, clientY];
    });
    handle.addEventListener('pointermove', ({ clientX, clientY, buttons }) => {
      const way = buttons && last ? alongPicture(axis, end) : null;
      if (way) move((way[0] * (clientX - last[0]) + way[1] * (clientY - last[1])) / (way[0] ** 2 + way[1] ** 2));
      last = [clientX, clientY];
    });
    handle.addEventListener('keydown', (event) => {
      const way = WAYS[event.key];
      if (!way) return;
      event.preventDefault();
      event.stopPropagation(); // else the camera turns
      move(way * step * (event.shiftKey ? 10 : 1));
    });
    layer.append(handle);
    return handle;
  }

  /** The middle of a face. */
  function middleOf(axis, end) {
    const middle = times(add(...ends), 0.5);
    middle[axis] = ends[end][axis];
    return middle;
  }

  function place(at) {
    const view = viewer.camera.view(layer.clientWidth, layer.clientHeight);
    return inPicture(subtract(at, view.eye), view, 1e-6);
  }

  /** Pixels that a face moves with a unit along its axis; null if that can hardly be seen. */
  function alongPicture(axis, end) {
    const at = middleOf(axis, end);
    const [from, to] = [at, at.map((value, i) => value + (i === axis ? step : 0))].map(place);
    const way = [0, 1].map((i) => (to[i] - from[i]) / step);
    return Math.hypot(...way) * step > 0.1 ? way : null;
  }

  function show() {
    const { origin } = viewer.header;
    const digits = Math.min(12, Math.max(0, 2 - Math.floor(Math.log10(step))));
    const texts = ends.map((corner) => add(corner, origin).map((value) => String(Number(value.toFixed(digits)))));
    const quoted = words().map((word) => (/^[\w./-]+$/.test(word) ? word : `'${word.replace(/'/g, `'\\''`)}'`));
    command.value = [...quoted, '-o', 'cropped.fgs', `--crop=${texts.flat().join()}`].join(' ');
    handles.forEach((handle, face) => {
      const text = texts[face & 1][face >> 1];
      Object.assign(handle, { ariaValueNow: text, ariaValueText: text });
    });
    viewer.refresh();
  }

  function draw() {
    layer.hidden = !(ends && viewer.header && on.checked);
    viewer.look.crop = layer.hidden ? null : ends;
    if (layer.hidden) return;
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((corner) => place([0, 1, 2].map((axis) => ends[(corner >> axis) & 1][axis])));
    const seen = EDGES.filter((edge) => edge.every((corner) => corners[corner].length));
    for (const line of lines) line.setAttribute('d', seen.map(([a, b]) => `M${corners[a]}L${corners[b]}`).join(''));
    handles.forEach((handle, face) => {
      const [x, y] = place(middleOf(face >> 1, face & 1));
      handle.hidden = x === undefined;
      Object.assign(handle.style, { left: `${x - GRIP / 2}px`, top: `${y - GRIP / 2}px` });
    });
  }

  function toggle() {
    for (const element of [command, copy]) element.hidden = !on.checked;
    if (on.checked && viewer.box) {
      ends ??= [[...viewer.box.low], [...viewer.box.high]];
      step ||= KEY_STEP * Math.hypot(...subtract(ends[1], ends[0]));
      show();
    }
    draw();
    viewer.refresh();
  }

  on.addEventListener('input', toggle);
  copy.addEventListener('click', () => {
    command.select();
    navigator.clipboard?.writeText(command.value).catch(() => {}); // pages without a right to it leave the text selected
  });
  viewer.addEventListener('begun', () => {
    ends = null;
    step = 0;
    on.checked = false;
    toggle();
  });
  viewer.addEventListener('frame', draw);
  viewer.canvas.after(layer);
  toggle();
}
