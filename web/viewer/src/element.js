// <flexgs-scene src="scene.fgs">: a scene in any page. Attributes: src, view (of a link), turn (degrees a second), poster (a picture to
// show until the scene is there), notes (address of their JSON), controls="none". Events: first, loaded, failed. `viewer` is its Viewer.
import { viewOfWord } from './camera.js';
import { notesOf, showNotes } from './notes.js';
import { SceneViewer } from './scene-viewer.js';

class SceneElement extends HTMLElement {
  static observedAttributes = ['src', 'view'];

  connectedCallback() {
    const root = this.shadowRoot ?? this.attachShadow({ mode: 'open' });
    const canvas = document.createElement('canvas');
    Object.assign(canvas.style, { display: 'block', width: '100%', height: '100%' });
    canvas.tabIndex = 0;
    canvas.setAttribute('role', 'application');
    canvas.setAttribute('aria-label', this.getAttribute('label') ?? 'A scene: arrow keys turn it, W A S D Q E move');
    if (getComputedStyle(this).display === 'inline') this.style.display = 'block';
    if (!this.clientHeight) this.style.aspectRatio = '16 / 9';
    if (this.getAttribute('controls') === 'none') Object.assign(canvas, { tabIndex: -1 }).style.pointerEvents = 'none';
    this.style.position ||= 'relative';
    root.replaceChildren(canvas, ...this.#poster());
    try {
      this.viewer = new SceneViewer(canvas, { guest: true });
    } catch (error) {
      this.#tell('failed', error.message);
      return;
    }
    for (const name of ['first', 'loaded']) this.viewer.addEventListener(name, () => this.#tell(name));
    this.viewer.addEventListener('first', () => root.querySelector('img')?.remove());
    this.viewer.addEventListener('failed', (event) => this.#tell('failed', event.detail));
    const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.viewer.turning = calm ? 0 : Number(this.getAttribute('turn')) || 0;
    this.#load();
    const { viewer } = this;
    notesOf(this.getAttribute('notes')).then((list) => showNotes(viewer, list)).catch((error) => this.#tell('failed', error.message));
  }

  disconnectedCallback() {
    this.viewer?.dispose();
    this.viewer = null;
    this.shadowRoot.replaceChildren();
  }

  attributeChangedCallback() {
    if (this.viewer) this.#load();
  }

  #load() {
    const source = this.getAttribute('src');
    const start = viewOfWord(this.getAttribute('view'));
    if (source) this.viewer.load(new URL(source, document.baseURI).href, { name: source, start }).catch(() => {});
  }

  #poster() {
    if (!this.hasAttribute('poster')) return [];
    const picture = new Image();
    picture.src = this.getAttribute('poster');
    picture.alt = '';
    Object.assign(picture.style, { position: 'absolute', inset: '0', width: '100%', height: '100%', objectFit: 'contain' });
    picture.style.pointerEvents = 'none';
    return [picture];
  }

  #tell(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}

customElements.define('flexgs-scene', SceneElement);
