import * as pc from 'playcanvas';
import { CameraControls } from 'playcanvas/scripts/esm/camera-controls.mjs';
import { open } from '@flexgs/decoder';
import { drawLikeRender, splatsOf } from '@flexgs/decoder/playcanvas';

const asked = new URLSearchParams(location.search);
const status = document.getElementById('status');

async function start() {
  const file = await open(new URL(asked.get('scene') ?? 'scene.fgs', location.href));
  const canvas = document.getElementById('canvas');
  const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false, preserveDrawingBuffer: true } });
  app.setCanvasFillMode(pc.FILLMODE_FILL_WINDOW);
  app.setCanvasResolution(pc.RESOLUTION_AUTO);
  addEventListener('resize', () => app.resizeCanvas());
  drawLikeRender(app, file.settings.antialiased === true);
  const resource = await splatsOf(file, app.graphicsDevice);
  const splats = new pc.Entity('splats');
  splats.addComponent('gsplat', { resource });
  // Scenes of INRIA's training look along z and have y down, and PlayCanvas has y up: turned, they stand upright.
  splats.setEulerAngles(180, 0, 0);
  app.root.addChild(splats);
  const camera = new pc.Entity('camera');
  camera.addComponent('camera', { clearColor: new pc.Color(...(file.settings.background ?? [0, 0, 0])), nearClip: 0.05 });
  app.root.addChild(camera);
  const { center, halfExtents } = resource.aabb;
  const middle = new pc.Vec3(center.x, -center.y, -center.z);
  const eye = new pc.Vec3(0.3, 0.3, 1).mulScalar((2 * halfExtents.length()) / 3).add(middle);
  camera.setPosition(eye);
  camera.addComponent('script').create(CameraControls).reset(middle, eye);
  app.start();
  status.textContent = '';
  globalThis.example = { pc, app, file, splats, camera };
}

start().catch((error) => {
  status.textContent = error.message;
});
