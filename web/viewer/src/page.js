// The page: its buttons and texts. All text of files reaches it as text, never as HTML.
import { startOf, viewOfWord, viewWord } from './camera.js';
import { isTyping } from './controls.js';
import { bytesInside } from './inside.js';
import { notesOf, showNotes } from './notes.js';
import { SceneViewer } from './scene-viewer.js';

const find = (id) => document.getElementById(id);
const config = JSON.parse(find('scene')?.textContent || '{}');
const asked = new URLSearchParams(location.search);
const status = find('status');

function say(text, isError = false) {
  status.textContent = text;
  status.classList.toggle('error', isError);
  status.hidden = !text;
}

function start() {
  const canvas = find('canvas');
  const first = firstScene();
  let viewer;
  try {
    const half = asked.get('bits') !== '8';
    viewer = new SceneViewer(canvas, { half, first, keys: document });
  } catch (error) {
    say(error.message, true);
    return;
  }
  globalThis.viewer = viewer;
  if (!matchMedia('(prefers-reduced-motion: reduce)').matches) viewer.turning = Number(asked.get('turn')) || 0;
  wire(viewer);
  wireFiles(viewer);
  if (config.command) find('more').addEventListener('toggle', () => offerBox(viewer), { once: true });
  const notes = config.notes ?? asked.get('notes');
  const begin = { poses: config.poses, look: config.look, start: viewOfWord(asked.get('view')), notes };
  if (first) show(viewer, first.source, first.name, begin);
  else say('Drop a .fgs file here, or choose one in the panel.');
}

/** Few want it, and a page is shorter without. */
async function offerBox(viewer) {
  const { offerCrop } = await import(new URL('src/crop.js', document.baseURI));
  offerCrop(viewer, find('more'), () => config.command);
}

/** The scene of the page: bytes that lie in it, or an address. */
function firstScene() {
  const bytes = bytesInside('scene-bytes');
  if (bytes) return { source: bytes, name: config.name };
  const address = config.scene ?? asked.get('scene');
  if (!address) return null;
  const source = new URL(address, location.href);
  return { source: source.href, name: config.name ?? decodeURIComponent(source.pathname.split('/').pop()) };
}

let takeNotesAway = () => {};
let shows = 0;

async function show(viewer, source, name, { notes, ...begin } = {}) {
  say('Loading …');
  takeNotesAway();
  const coming = notesOf(notes);
  const turn = ++shows;
  // Another scene may be shown when they are here.
  coming.then((list) => turn === shows && (takeNotesAway = showNotes(viewer, list))).catch(() => {});
  document.title = name ? `${name} – flexgs-edge` : 'flexgs-edge';
  find('name').textContent = name ?? '';
  await viewer.load(source, { name, ...begin }).catch(() => {});
  await coming.catch((error) => turn === shows && say(error.message, true));
}

function wire(viewer) {
  viewer.addEventListener('begun', () => {
    const { look, header } = viewer;
    const degree = find('degree');
    degree.replaceChildren(...Array.from({ length: header.shDegree + 1 }, (_, i) => new Option(String(i), String(i))));
    degree.value = String(header.shDegree);
    find('antialiased').checked = look.antialiased;
    find('background').value = `#${look.background.map((v) => hex(v)).join('')}`;
    listPoses(viewer);
  });
  viewer.addEventListener('poses', () => listPoses(viewer));
  viewer.addEventListener('first', () => {
    find('poster')?.remove();
    if (!viewer.stats.wholeMs) say('Loading the rest …');
  });
  viewer.addEventListener('chunk', () => {
    const part = Math.floor((100 * viewer.rows) / (viewer.share * viewer.header.count));
    if (viewer.stats.firstMs && part < 100) say(`Loading … ${part} %`);
  });
  viewer.addEventListener('loaded', () => say(viewer.header.count ? roomNote(viewer) : 'The scene is empty.'));
  viewer.addEventListener('failed', (event) => {
    say(event.detail, true);
    const again = Object.assign(document.createElement('button'), { textContent: 'Try again', type: 'button' });
    again.addEventListener('click', () => (say('Loading …'), viewer.retry()));
    status.append(' ', again);
  });
  for (const name of ['frame', 'timed']) viewer.addEventListener(name, () => showNumbers(viewer));
  const change = (id, act) => find(id).addEventListener('input', (event) => (act(event.target), viewer.refresh()));
  change('pose', (field) => viewer.setPose(Number(field.value)));
  change('degree', (field) => (viewer.look.degree = Number(field.value)));
  change('antialiased', (field) => (viewer.look.antialiased = field.checked));
  change('background', (field) => (viewer.look.background = fromHex(field.value)));
  change('fly', (field) => (viewer.controls.fly = field.checked));
  change('share', (field) => viewer.asks = Number(field.value) / 100);
  change('scale', (field) => (viewer.scale = Number(field.value)));
  change('theme', (field) => (document.documentElement.dataset.theme = field.value));
  find('reset').addEventListener('click', () => viewer.setPose(viewer.pose ?? 0));
  find('link').addEventListener('click', () => copyLink(viewer));
  find('full').addEventListener('click', () => fullScreen());
  find('save').addEventListener('click', () => save(viewer));
  document.addEventListener('keydown', (event) => shortcut(viewer, event));
}

/** What a device shows that has no room for all. */
function roomNote({ rows, header, share }) {
  return share < 1 ? `There is room for ${rows} of ${header.count} splats: some are shown, and larger.` : '';
}

function shortcut(viewer, event) {
  // Brackets need Alt on many keyboards.
  const plain = !event.metaKey && (/^[[\]]$/.test(event.key) || !(event.ctrlKey || event.altKey));
  if (isTyping(event) || !plain) return;
  const press = (id) => () => find(id).click();
  const acts = {
    r: press('reset'),
    f: press('full'),
    l: press('link'),
    p: press('save'),
    '[': () => turnPage(viewer, -1),
    ']': () => turnPage(viewer, 1),
    '?': () => (find('panel').open = !find('panel').open),
    Escape: () => (find('panel').open = false),
  };
  const act = acts[event.key];
  if (act) {
    event.preventDefault();
    act();
  }
}

function turnPage(viewer, by) {
  const count = viewer.poses.length;
  if (!count) return;
  viewer.setPose(((viewer.pose ?? 0) + by + count) % count);
  find('pose').value = String(viewer.pose);
}

function listPoses(viewer) {
  find('pose').replaceChildren(...viewer.poses.map((pose, i) => new Option(pose.name || String(i), String(i))));
  find('pose').value = String(viewer.pose ?? 0);
}

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => say('This browser does not allow a full screen.'));
}

/** Copy the address of this page with the camera's view. Pages without a right to the clipboard show it. */
async function copyLink(viewer) {
  if (!viewer.header) return;
  const link = new URL(location.href);
  link.searchParams.set('view', viewWord(startOf(viewer.camera, viewer.header.origin)));
  try {
    await navigator.clipboard.writeText(link.href);
    say('The link to this view is copied.');
    setTimeout(() => say(''), 3000);
  } catch {
    prompt('The link to this view:', link.href);
  }
}

async function save(viewer) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(await viewer.picture());
  link.download = `${(config.name ?? 'scene').replace(/\.[^.]*$/, '')}.png`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** Made when it is needed: it takes as long as a worker to start. */
let numbers = null;

function showNumbers({ stats, canvas, renderer }) {
  numbers ??= new Intl.NumberFormat('en');
  const rows = {
    splats: `${numbers.format(stats.drawn)} of ${numbers.format(stats.splats)}`,
    file: stats.bytes ? `${numbers.format(Math.round(stats.bytes / 1000))} kB` : '',
    'first picture': stats.firstMs ? `${Math.round(stats.firstMs)} ms` : '',
    'whole scene': stats.wholeMs ? `${Math.round(stats.wholeMs)} ms` : '',
    sort: `${stats.sortMs.toFixed(1)} ms`,
    frame: `${stats.frameMs.toFixed(1)} ms`,
    picture: `${canvas.width} x ${canvas.height}, ${renderer.half ? '16' : '8'} bit`,
  };
  find('numbers').replaceChildren(
    ...Object.entries(rows).flatMap(([name, text]) => {
      const [term, value] = [document.createElement('dt'), document.createElement('dd')];
      term.textContent = name;
      value.textContent = text;
      return [term, value];
    }),
  );
}

function wireFiles(viewer) {
  const open = (file) => {
    config.name = file.name;
    config.command?.splice(2, Infinity, file.name);
    show(viewer, file, file.name);
  };
  find('file').addEventListener('change', (event) => event.target.files[0] && open(event.target.files[0]));
  document.addEventListener('dragover', (event) => event.preventDefault());
  document.addEventListener('drop', (event) => {
    event.preventDefault();
    const file = event.dataTransfer?.files[0];
    if (file) open(file);
  });
}

function hex(value) {
  return Math.round(255 * Math.min(1, Math.max(0, value)))
    .toString(16)
    .padStart(2, '0');
}

function fromHex(text) {
  return [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);
}

start();
