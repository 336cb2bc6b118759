// The page: its buttons and texts. All text of files reaches it as text, never as HTML.
import { bytesInside } from './inside.js';
import { SceneViewer } from './scene-viewer.js';

const find = (id) => document.getElementById(id);
const config = JSON.parse(find('scene')?.textContent || '{}');
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
    const half = new URLSearchParams(location.search).get('bits') !== '8';
    viewer = new SceneViewer(canvas, { half, first });
  } catch (error) {
    say(error.message, true);
    return;
  }
  globalThis.viewer = viewer;
  wire(viewer);
  wireFiles(viewer);
  if (first) show(viewer, first.source, first.name, config.poses, config.look);
  else say('Drop a .fgs file here, or choose one in the panel.');
}

/** The scene of the page: bytes that lie in it, or an address. */
function firstScene() {
  const bytes = bytesInside('scene-bytes');
  if (bytes) return { source: bytes, name: config.name };
  const address = config.scene ?? new URLSearchParams(location.search).get('scene');
  return address ? { source: new URL(address, location.href).href, name: config.name ?? address } : null;
}

async function show(viewer, source, name, poses = [], look = {}) {
  say('Loading …');
  document.title = name ? `${name} – flexgs-edge` : 'flexgs-edge';
  find('name').textContent = name ?? '';
  await viewer.load(source, { name, poses, look, agree }).catch(() => {});
}

async function agree(bytes) {
  return confirm(`The scene takes ${Math.round(bytes / 2 ** 20)} MB of graphics memory. Load it?`);
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
  viewer.addEventListener('first', () => viewer.stats.wholeMs || say('Loading the rest …'));
  viewer.addEventListener('loaded', () => say(viewer.header.count ? '' : 'The scene is empty.'));
  viewer.addEventListener('failed', (event) => say(event.detail, true));
  viewer.addEventListener('frame', () => showNumbers(viewer));
  const change = (id, act) => find(id).addEventListener('input', (event) => (act(event.target), viewer.refresh()));
  change('pose', (field) => viewer.setPose(Number(field.value)));
  change('degree', (field) => (viewer.look.degree = Number(field.value)));
  change('antialiased', (field) => (viewer.look.antialiased = field.checked));
  change('background', (field) => (viewer.look.background = fromHex(field.value)));
  change('fly', (field) => (viewer.controls.fly = field.checked));
  change('share', (field) => viewer.setShare(Number(field.value) / 100));
  change('scale', (field) => (viewer.scale = Number(field.value)));
  change('theme', (field) => (document.documentElement.dataset.theme = field.value));
  find('reset').addEventListener('click', () => viewer.setPose(viewer.pose ?? 0));
  find('full').addEventListener('click', () => fullScreen());
  find('save').addEventListener('click', () => save(viewer));
  document.addEventListener('keydown', (event) => shortcut(viewer, event));
}

function shortcut(viewer, event) {
  const typing = /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName);
  if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
  const acts = {
    r: () => viewer.setPose(viewer.pose ?? 0),
    f: fullScreen,
    p: () => save(viewer),
    '[': () => turnPage(viewer, -1),
    ']': () => turnPage(viewer, 1),
    '?': () => (find('panel').open = !find('panel').open),
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
}

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => say('This browser does not allow a full screen.'));
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
