"""PlayCanvas draws our files as we do, by the example page."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from browser import Browser
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.commands.render import render_views
from flexgs_edge.scene.fields import FIELDS
from grid_scenes import make_grid
from viewer_tab import decibels, faults, pose_of, site, until

POSES = (0, 27, 53)
LEAST = 44
EXAMPLE = "web/examples/playcanvas"


@pytest.fixture(scope="module")
def folder(repository: Path, node_modules: Path, scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`web/` with the package and a scene where the page looks for them."""
    if not (node_modules / "playcanvas" / "package.json").is_file():
        pytest.skip(f"no playcanvas in {node_modules}: npm install playcanvas@2.23")
    place = tmp_path_factory.mktemp("site")
    shutil.copytree(repository / "web", place / "web")
    (place / EXAMPLE / "node_modules").symlink_to(node_modules)
    shutil.copy(scene, place / EXAMPLE / "scene.fgs")
    return place


def opened(tab: Browser, address: str) -> None:
    tab.events.clear()
    tab.send("Page.navigate", url=address)
    tab.wait("Page.loadEventFired")
    until(tab, "globalThis.example || document.getElementById('status').textContent !== 'Loading …'")
    assert tab.run("document.getElementById('status').textContent") == ""


def test_the_pictures_are_nearly_those_of_render(tab: Browser, folder: Path, sample_dir: Path, tmp_path: Path) -> None:
    cameras = sorted(read_cameras(sample_dir / "cameras.json"), key=lambda camera: camera.name)
    files = render_views(
        folder / EXAMPLE / "scene.fgs", tmp_path, views=POSES, cameras=str(sample_dir / "cameras.json")
    ).files
    found = []
    with site(folder) as address:
        opened(tab, f"{address}/{EXAMPLE}/index.html")
        for pose, file in zip(POSES, files, strict=True):
            text = tab.run(f"({SHOT})({json.dumps(pose_of(cameras[pose]))})")
            image = Image.open(io.BytesIO(base64.b64decode(text.partition(",")[2]))).convert("RGB")
            found.append(decibels(np.asarray(image, np.float64), np.asarray(Image.open(file), np.float64)))
    assert faults(tab) == []
    assert min(found) >= LEAST, found


@pytest.fixture(scope="module")
def packages(repository: Path, node_modules: Path, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which npm has installed the decoder beside the engine."""
    place = tmp_path_factory.mktemp("packages")
    shutil.copytree(node_modules / "playcanvas", place / "node_modules" / "playcanvas", copy_function=os.link)
    for types in ("@types", "@webgpu"):
        (place / "node_modules" / types).symlink_to(node_modules / types)
    shutil.copytree(repository / "web" / "decoder", place / "node_modules" / "@flexgs" / "decoder")
    return place


@pytest.mark.parametrize(("degree", "bands"), [(0, 0), (1, 1), (3, 3), (4, 3)])
def test_the_engine_has_the_values_of_the_file(packages: Path, degree: int, bands: int) -> None:
    write_grid(packages / f"{degree}.fgs", make_grid(300, degree, layers=2), {}, chunk_rows=128)
    run = subprocess.run(
        ["node", "--input-type=module", "-e", VALUES, f"{degree}.fgs"],
        cwd=packages, capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    found = json.loads(run.stdout)
    assert found.pop("bands") == bands
    source = open_fgs(packages / f"{degree}.fgs")
    planes = source.read(np.arange(source.count), [field.name for field in FIELDS])
    each, kept = (degree + 1) ** 2 - 1, (bands + 1) ** 2 - 1
    rows = [k for k in range(3 * each) if k % each < kept]
    wanted = {**planes, "sh_rest": planes["sh_rest"][rows]}
    names = {"means": "xyz", "sh_dc": "f_dc_", "sh_rest": "f_rest_", "log_scales": "scale_", "quats": "rot_"}
    names["opacity_logits"] = ["opacity"]
    for field, name in names.items():
        count = len(wanted[field])
        keys = [f"{name}{k}" for k in range(count)] if isinstance(name, str) and name.endswith("_") else list(name)
        for key, plane in zip(keys, wanted[field], strict=True):
            assert np.array_equal(np.array(found.pop(key), np.float32), plane), key
    assert not found


def test_its_types(node_modules: Path, packages: Path) -> None:
    compiler = node_modules / "typescript" / "bin" / "tsc"
    if not compiler.is_file():
        pytest.skip(f"no typescript in {node_modules}: npm install typescript@5")
    options = ["--noEmit", "--strict", "--skipLibCheck", "--target", "es2022", "--module", "nodenext"]
    for faulty, text in enumerate((TYPED, TYPED.replace("shBands", "bands"))):
        (packages / "use.mts").write_text(text)
        command = ["node", str(compiler), *options, "--lib", "es2022,dom,dom.iterable", "use.mts"]
        run = subprocess.run(command, cwd=packages, capture_output=True, text=True, check=False, timeout=250)
        assert ("TS2551" in run.stdout or "TS2339" in run.stdout) == bool(faulty) == bool(run.returncode), run.stdout


VALUES = """
import { open } from '@flexgs/decoder';
import { splatDataOf } from '@flexgs/decoder/playcanvas';
const data = await splatDataOf(await open(process.argv[1]));
const values = data.getElement('vertex').properties.map(({ name, storage }) => [name, [...storage]]);
console.log(JSON.stringify({ bands: data.shBands, ...Object.fromEntries(values) }));
"""

TYPED = """
import { Application, Entity } from 'playcanvas';
import { open } from '@flexgs/decoder';
import { drawLikeRender, splatDataOf, splatsOf } from '@flexgs/decoder/playcanvas';
export async function show(app: Application, entity: Entity): Promise<number> {
  drawLikeRender(app, true);
  const file = await open('scene.fgs');
  entity.addComponent('gsplat', { resource: await splatsOf(file, app.graphicsDevice) });
  return (await splatDataOf(file)).shBands;
}
"""


SHOT = """async (pose) => {
    const { pc, app, camera, splats, file } = globalThis.example;
    // The order comes from a worker: draw until the picture stays as it is, before the camera moves too.
    const settled = async () => {
        let [picture, same] = ['', 0];
        for (let frame = 0; same < 3 && frame < 40; frame++) {
            await new Promise((done) => setTimeout(done, 200));
            await new Promise((done) => app.once('frameend', done));
            const now = app.graphicsDevice.canvas.toDataURL();
            same = now === picture ? same + 1 : 0;
            picture = now;
        }
        return picture;
    };
    camera.removeComponent('script');
    await settled();
    app.setCanvasFillMode(pc.FILLMODE_NONE, pose.width, pose.height);
    app.setCanvasResolution(pc.RESOLUTION_FIXED, pose.width, pose.height);
    // The scene as it is in its file, and a camera of PlayCanvas: y up, looking along -z.
    splats.setEulerAngles(0, 0, 0);
    const [right, down, forward] = pose.rotation;
    const eye = pose.position.map((value, axis) => value - file.origin[axis]);
    const matrix = new pc.Mat4();
    matrix.data.set([...right, 0, ...down.map((v) => -v), 0, ...forward.map((v) => -v), 0, ...eye, 1]);
    camera.setPosition(...eye);
    camera.setRotation(new pc.Quat().setFromMat4(matrix));
    const [near, far] = [0.2, 1000];
    const left = (-0.5 - pose.cx) / pose.fx, top = (0.5 + pose.cy) / pose.fy;
    camera.camera.nearClip = near;
    camera.camera.calculateProjection = (made) => made.setFrustum(
        left * near, (left + pose.width / pose.fx) * near, (top - pose.height / pose.fy) * near, top * near, near, far);
    return settled();
}"""
