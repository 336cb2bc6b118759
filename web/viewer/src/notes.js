// Notes at places of a scene: numbered buttons over its canvas, whose texts are shown while they have the focus.
import { inPicture } from './in-picture.js';
import { styled } from './styled.js';
import { subtract } from './vectors.js';

/** Width and height of a button, in CSS pixels: a finger needs so much. */
const BUTTON = 44;
const WIDEST = 280;
const LOOK = { position: 'absolute', margin: '0', background: 'Canvas', color: 'CanvasText', border: '1px solid GrayText' };

/**
 * The notes of a page.
 *
 * @param {string | object[] | null} source address of a JSON file, or notes
 * @returns {Promise<{at: number[], text: string}[]>}
 */
export async function notesOf(source) {
  if (typeof source !== 'string') return source ?? [];
  const response = await fetch(new URL(source, document.baseURI));
  if (!response.ok) throw new Error(`${source}: the server says ${response.status}`);
  const list = await response.json().catch((error) => {
    throw new Error(`${source}: not JSON: ${error.message}`);
  });
  if (!Array.isArray(list)) throw new Error(`${source}: expected a list of notes`);
  list.forEach((note, i) => {
    const fail = (field, expected) => {
      throw new Error(`${source}: note ${i + 1}: ${field}: expected ${expected}, found ${JSON.stringify(note?.[field])}`);
    };
    const { at, text } = note ?? {};
    if (!Array.isArray(at) || at.length !== 3 || !at.every(Number.isFinite)) fail('at', 'three numbers');
    if (typeof text !== 'string' || !text.trim()) fail('text', 'a text');
  });
  return list;
}

/**
 * Show notes over a viewer's canvas.
 *
 * @param {Viewer} viewer
 * @param {{at: number[], text: string}[]} notes places are those of the world
 * @returns {() => void} takes them away
 */
export function showNotes(viewer, notes) {
  const layer = styled('div', { position: 'absolute', inset: '0', overflow: 'hidden', pointerEvents: 'none' });
  const bubble = styled('p', { ...LOOK, padding: '8px 12px', borderRadius: '6px', width: 'max-content', whiteSpace: 'pre-wrap', overflowWrap: 'anywhere' });
  const buttons = notes.map(({ text }, i) => {
    const size = `${BUTTON}px`;
    const button = styled('button', { ...LOOK, width: size, height: size, padding: '0', borderRadius: '50%', pointerEvents: 'auto' });
    Object.assign(button, { type: 'button', textContent: i + 1, ariaLabel: `Note ${i + 1}: ${text}` });
    button.addEventListener('click', () => button.focus()); // not every browser does so
    for (const name of ['focus', 'blur']) button.addEventListener(name, place);
    button.addEventListener('keydown', ({ key }) => key === 'Escape' && button.blur());
    return button;
  });
  layer.append(...buttons, bubble);
  viewer.canvas.after(layer);

  function place() {
    const { clientWidth: width, clientHeight: height } = layer;
    const view = viewer.camera.view(width, height);
    bubble.hidden = true;
    buttons.forEach((button, i) => {
      const [x, y] = viewer.header ? inPicture(subtract(subtract(notes[i].at, viewer.header.origin), view.eye), view, viewer.look.near) : [];
      button.hidden = !(x >= 0 && y >= 0 && x <= width && y <= height);
      Object.assign(button.style, { left: `${x - BUTTON / 2}px`, top: `${y - BUTTON / 2}px` });
      if (button.hidden || !button.matches(':focus')) return;
      const below = y < height / 2;
      bubble.hidden = false;
      bubble.textContent = notes[i].text;
      Object.assign(bubble.style, {
        left: `${Math.max(0, Math.min(x - BUTTON / 2, width - WIDEST))}px`,
        maxWidth: `${Math.min(WIDEST, width)}px`,
        top: below ? `${y + BUTTON / 2}px` : 'auto',
        bottom: below ? 'auto' : `${height - y + BUTTON / 2}px`,
      });
    });
  }

  place();
  viewer.addEventListener('frame', place);
  return () => {
    viewer.removeEventListener('frame', place);
    layer.remove();
  };
}
