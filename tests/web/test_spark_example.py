"""The example page for three.js and Spark: its picture is ours, as near as Spark's numbers go."""

from __future__ import annotations

import base64
import io
import json
import shutil
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from browser import Browser
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.commands.render import render_views
from viewer_tab import decibels, faults, until

POSES = (0, 27, 53)
LEAST = 41


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        pass


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


def test_the_pictures_are_nearly_those_of_render(tab: Browser, site: Path, sample_dir: Path, tmp_path: Path) -> None:
    scene = site / "web" / "examples" / "spark" / "scene.fgs"
    cameras = sample_dir / "cameras.json"
    files = render_views(scene, tmp_path, views=POSES, cameras=str(cameras)).files
    all_cameras = sorted(read_cameras(cameras), key=lambda camera: camera.name)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(site)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        tab.events.clear()
        tab.send("Page.navigate", url=f"http://127.0.0.1:{server.server_port}/web/examples/spark/index.html")
        tab.wait("Page.loadEventFired")
        until(tab, "globalThis.example || document.getElementById('status').textContent !== 'Loading …'")
        assert tab.run("document.getElementById('status').textContent") == ""
        for pose, file in zip(POSES, files, strict=True):
            text = tab.run(f"({SHOT})({json.dumps(pose_of(all_cameras[pose]))})")
            image = Image.open(io.BytesIO(base64.b64decode(text.partition(",")[2]))).convert("RGB")
            found = decibels(np.asarray(image, np.float64), np.asarray(Image.open(file), np.float64))
            assert found >= LEAST, pose
    finally:
        server.shutdown()
        server.server_close()
    assert faults(tab) == []


def pose_of(camera: Camera) -> dict[str, Any]:
    names = ("width", "height", "fx", "fy", "cx", "cy")
    numbers = {name: getattr(camera, name) for name in names}
    return {"rotation": camera.rotation.tolist(), "position": camera.center.tolist(), **numbers}


SHOT = """async (pose) => {
    const { THREE, renderer, scene, camera, turned, file, spark } = globalThis.example;
    renderer.setAnimationLoop(null);
    renderer.setPixelRatio(1);
    renderer.setSize(pose.width, pose.height);
    // The scene as it is in its file, and a camera of three.js: y up, looking along -z.
    turned.rotation.x = 0;
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
