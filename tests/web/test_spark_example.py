"""three.js and Spark draw our files, `.fgs` by the example page and other formats by their own readers, as we do."""

from __future__ import annotations

import base64
import io
import json
import math
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import viewer_tab
from browser import Browser
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.commands.render import render_views
from viewer_tab import decibels, faults, pose_of, until

POSES = (0, 27, 53)
LEAST = 41
SPARK = "web/examples/spark"


@pytest.fixture(scope="module")
def site(repository: Path, node_modules: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`web/` with the packages and a scene where the page looks for them."""
    for package in ("three", "@sparkjsdev/spark"):
        if not (node_modules / package / "package.json").is_file():
            pytest.skip(f"no {package} in {node_modules}: npm install three@0.187 @sparkjsdev/spark@2.2")
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(repository / "web", folder / "web")
    (folder / "web" / "examples" / "spark" / "node_modules").symlink_to(node_modules)
    shutil.copy(scene, folder / "web" / "examples" / "spark" / "scene.fgs")
    return folder


@pytest.fixture(scope="module")
def address(site: Path) -> Iterator[str]:
    """Where the site is served."""
    with viewer_tab.site(site) as address:
        yield address


def fidelity(
    tab: Browser, url: str, cameras: Path, poses: Sequence[int], files: Sequence[str], turn: float = 0.0
) -> list[float]:
    """Decibels between pictures of a page and those of `render` in `files`; `turn`: radians about x."""
    all_cameras = sorted(read_cameras(cameras), key=lambda camera: camera.name)
    tab.events.clear()
    tab.send("Page.navigate", url=url)
    tab.wait("Page.loadEventFired")
    until(tab, "globalThis.example || document.getElementById('status').textContent !== 'Loading …'")
    assert tab.run("document.getElementById('status').textContent") == ""
    found = []
    for pose, file in zip(poses, files, strict=True):
        text = tab.run(f"({SHOT})({json.dumps({**pose_of(all_cameras[pose]), 'turn': turn})})")
        image = Image.open(io.BytesIO(base64.b64decode(text.partition(",")[2]))).convert("RGB")
        found.append(decibels(np.asarray(image, np.float64), np.asarray(Image.open(file), np.float64)))
    assert faults(tab) == []
    return found


def test_the_pictures_are_nearly_those_of_render(
    tab: Browser, site: Path, address: str, sample_dir: Path, tmp_path: Path
) -> None:
    cameras = sample_dir / "cameras.json"
    files = render_views(site / SPARK / "scene.fgs", tmp_path, views=POSES, cameras=str(cameras)).files
    assert min(fidelity(tab, f"{address}/{SPARK}/index.html", cameras, POSES, files)) >= LEAST


@pytest.mark.parametrize(
    ("suffix", "least", "turn"),
    [
        (".ply", LEAST, 0.0),
        (".compressed.ply", 36, 0.0),  # Spark reads codes of SH as shares of 255, not as intervals
        (".sog", LEAST, 0.0),
        (".splat", LEAST, 0.0),
        (".spz", LEAST, math.pi),  # y is up in these files
    ],
)
def test_files_of_other_formats_look_alike(
    tab: Browser, site: Path, address: str, sample_dir: Path, tmp_path: Path, suffix: str, least: float, turn: float
) -> None:
    file, cameras = site / SPARK / f"scene{suffix}", sample_dir / "cameras.json"
    (site / SPARK / "formats.html").write_text(PAGE)
    decompress(site / SPARK / "scene.fgs", file)
    poses = POSES[1:2]
    files = render_views(file, tmp_path, views=poses, cameras=str(cameras)).files
    assert min(fidelity(tab, f"{address}/{SPARK}/formats.html?file={file.name}", cameras, poses, files, turn)) >= least


PAGE = """<!doctype html>
<meta charset="utf-8">
<link rel="icon" href="data:,">
<script type="importmap">{ "imports": {
    "three": "./node_modules/three/build/three.module.js",
    "three/addons/": "./node_modules/three/examples/jsm/",
    "@sparkjsdev/spark": "./node_modules/@sparkjsdev/spark/dist/spark.module.js",
    "@flexgs/decoder": "../../decoder/src/index.js",
    "@flexgs/decoder/spark": "../../decoder/src/spark.js" } }</script>
<p id="status">Loading …</p>
<script type="module">
import * as THREE from 'three';
import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';
import { limitSides, sparkOptions } from '@flexgs/decoder/spark';
const status = document.getElementById('status');
try {
    const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
    document.body.append(renderer.domElement);
    const scene = new THREE.Scene();
    scene.background = new THREE.Color(0);
    const spark = new SparkRenderer({ renderer, ...sparkOptions(false) });
    limitSides(spark);
    scene.add(spark);
    const mesh = new SplatMesh({ url: new URL(location.href).searchParams.get('file') });
    await mesh.initialized;
    const turned = new THREE.Group();
    turned.add(mesh);
    scene.add(turned);
    const camera = new THREE.PerspectiveCamera(50, 1, 0.05, 10_000);
    status.textContent = '';
    globalThis.example = { THREE, file: { origin: [0, 0, 0] }, renderer, scene, spark, turned, camera };
} catch (error) {
    status.textContent = error.message;
}
</script>
"""


SHOT = """async (pose) => {
    const { THREE, renderer, scene, camera, turned, file, spark } = globalThis.example;
    renderer.setAnimationLoop(null);
    renderer.setPixelRatio(1);
    renderer.setSize(pose.width, pose.height);
    // The scene as it is in its file, and a camera of three.js: y up, looking along -z.
    turned.rotation.x = pose.turn;
    const [right, down, forward] = pose.rotation;
    const eye = pose.position.map((value, axis) => value - file.origin[axis]);
    const column = (of, sign) => new THREE.Vector3(...of).multiplyScalar(sign);
    camera.quaternion.setFromRotationMatrix(
        new THREE.Matrix4().makeBasis(column(right, 1), column(down, -1), column(forward, -1)));
    camera.position.set(...eye);
    const [near, far] = [0.2, 1000];
    const left = (-0.5 - pose.cx) / pose.fx, top = (0.5 + pose.cy) / pose.fy;
    camera.projectionMatrix.makePerspective(
        left * near, (left + pose.width / pose.fx) * near, top * near, (top - pose.height / pose.fy) * near, near, far);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    // The order comes from a worker: draw until the picture stays as it is.
    let [picture, same] = ['', 0];
    for (let frame = 0; same < 3 && frame < 40; frame++) {
        renderer.render(scene, camera);
        const now = renderer.domElement.toDataURL();
        same = now === picture ? same + 1 : 0;
        picture = now;
        await new Promise((done) => setTimeout(done, 400));
    }
    return picture;
}"""
