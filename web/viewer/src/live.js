// The live scenes of a report, under one camera. Nothing is decoded or drawn before somebody asks for it.
import { bytesInside } from './inside.js';
import { add, subtract } from './vectors.js';
import { Viewer } from './viewer.js';

const byId = (id) => document.getElementById(id);

function say(text) {
  byId('live-status').textContent = text;
}

function start() {
  const { poses, look, first } = JSON.parse(byId('live-config').textContent);
  const canvases = [...document.querySelectorAll('#live canvas')];
  const viewers = [];
  byId('live-start').disabled = true;
  byId('live-stage').hidden = false;
  say('Loading …');
  try {
    for (const canvas of canvases) viewers.push(new Viewer(canvas));
  } catch (error) {
    byId('live-stage').hidden = true;
    say(error.message);
    return;
  }
  globalThis.liveViewers = viewers;
  const list = byId('live-pose');
  list.replaceChildren(...poses.map((pose, i) => new Option(pose.name || String(i), String(i))));
  list.value = String(first);
  list.addEventListener('input', () => viewers.forEach((viewer) => viewer.setPose(Number(list.value))));
  let failed = false;
  const loading = viewers.map((viewer, i) => {
    viewer.addEventListener('failed', (event) => say(event.detail));
    viewer.addEventListener('frame', () => viewers.forEach((other) => other !== viewer && follow(viewer, other)));
    const source = bytesInside(canvases[i].dataset.scene);
    return viewer.load(source, { name: canvases[i].dataset.scene, poses, pose: first, look }).catch(() => (failed = true));
  });
  Promise.all(loading).then(() => failed || say(''));
}

/** Give the camera of a scene that was moved to the other scene. Their origins may differ. */
function follow(leader, other) {
  if (!leader.header || !other.header) return;
  const state = stateOf(leader);
  if (state === leader.shared) return;
  leader.shared = state;
  const between = subtract(leader.header.origin, other.header.origin);
  const { eye, target, axes, lens } = leader.camera;
  Object.assign(other.camera, { eye: add(eye, between), target: add(target, between), axes, lens });
  other.shared = stateOf(other);
  other.refresh();
}

function stateOf({ camera: { eye, target, axes, lens } }) {
  return JSON.stringify([eye, target, axes, lens]);
}

byId('live-start').addEventListener('click', start, { once: true });
