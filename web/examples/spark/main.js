import * as THREE from 'three';
import { OrbitControls } from 'three/addons/controls/OrbitControls.js';
import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';
import { open } from '@flexgs/decoder';
import { limitSides, sparkOptions, splatsOf } from '@flexgs/decoder/spark';

const asked = new URLSearchParams(location.search);
const status = document.getElementById('status');

async function start() {
  const file = await open(new URL(asked.get('scene') ?? 'scene.fgs', location.href));
  const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  document.body.append(renderer.domElement);
  const scene = new THREE.Scene();
  scene.background = new THREE.Color().setRGB(...(file.settings.background ?? [0, 0, 0]), THREE.SRGBColorSpace);
  const spark = new SparkRenderer({ renderer, ...sparkOptions(file.settings.antialiased === true) });
  limitSides(spark);
  scene.add(spark);
  const mesh = new SplatMesh({ splats: await splatsOf(file) });
  // Scenes of INRIA's training look along z and have y down, and three.js has y up: turned, they stand upright.
  const turned = new THREE.Group();
  turned.rotation.x = Math.PI;
  turned.add(mesh);
  scene.add(turned);
  const camera = new THREE.PerspectiveCamera(50, 1, 0.05, 10_000);
  const controls = new OrbitControls(camera, renderer.domElement);
  const box = mesh.getBoundingBox(true).applyMatrix4(new THREE.Matrix4().makeRotationX(Math.PI));
  box.getCenter(controls.target);
  camera.position.copy(controls.target).add(new THREE.Vector3(0.3, 0.3, 1).multiplyScalar(box.getSize(new THREE.Vector3()).length() / 3));
  controls.update();
  const resize = () => {
    renderer.setSize(innerWidth, innerHeight);
    camera.aspect = innerWidth / innerHeight;
    camera.updateProjectionMatrix();
  };
  addEventListener('resize', resize);
  resize();
  renderer.setAnimationLoop(() => renderer.render(scene, camera));
  status.textContent = '';
  globalThis.example = { THREE, file, renderer, scene, spark, mesh, turned, camera, controls };
}

start().catch((error) => {
  status.textContent = error.message;
});
