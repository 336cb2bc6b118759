"""`view`: the page of one file, the server as a process, and the scripts that both need."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flexgs_edge.cameras.start import START
from flexgs_edge.codec.open_fgs import read_header
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.commands.view import view
from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.io.ply import write_ply
from flexgs_edge.run import run as run_module
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.run import open_run
from flexgs_edge.viewer.assets import ELEMENT, PLAIN, PREVIEWED, SPATIAL, entries_of, web_files
from flexgs_edge.viewer.join import join_modules
from flexgs_edge.viewer.scene_page import page_config, viewer_page
from grid_scenes import make_grid
from quantized_scenes import make_scene

CAMERA = {
    "id": 0,
    "img_name": "</script><b>",
    "width": 40,
    "height": 30,
    "position": [1234.5, 0, -3],
    "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "fx": 40,
    "fy": 40,
}

MOST_SENT = {(1, PLAIN): 29_500, (2, PLAIN): 26_300, (2, PREVIEWED): 27_300, (2, SPATIAL): 30_000}
"""Bytes of viewer and decoder with gzip, by the version and the kind of the scene."""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    write_grid(tmp_path / "scene.fgs", make_grid(300, 1), {"near": 0.01})
    (tmp_path / "cameras.json").write_text(json.dumps([CAMERA]))
    return tmp_path / "scene.fgs"


def part(page: str, name: str) -> str:
    found = re.search(rf'<script type="[^"]*" id="{name}">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return found[1]


def check_digests(page: str, policy: str) -> None:
    """The policy lets in what stands in the page, and nothing else that is written into it."""
    for kind, element in (
        ("script", r'<script type="module" id="script">(.*?)</script>'),
        ("style", r"<style>(.*?)</style>"),
    ):
        (text,) = re.findall(element, page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind}-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'; ") and "unsafe" not in policy


def test_a_page_of_one_file(scene: Path) -> None:
    output = scene.with_suffix(".html")
    result = view(scene, output)
    page = output.read_text()
    assert base64.b64decode(part(page, "scene-bytes")) == scene.read_bytes()
    config = json.loads(part(page, "scene"))
    assert config["name"] == "scene.fgs" and "scene" not in config
    assert config["poses"][0]["name"] == CAMERA["img_name"] and config["poses"][0]["position"] == CAMERA["position"]
    assert config["look"]["near"] == 0.01
    assert "<b>" not in page
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert policy is not None and "connect-src" not in policy[1]
    check_digests(page, policy[1])
    # Nothing is fetched: no address but those of data.
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page) and "http://" not in page and "https://" not in page
    assert (result.size, result.views, result.page_size) == (scene.stat().st_size, 1, output.stat().st_size)
    assert "wrote" in result.summary() and result.to_json()["output"] == str(output)
    with pytest.raises(InputError, match="exists"):
        view(scene, output)


def test_other_scenes_are_coded_with_16_bits(tmp_path: Path) -> None:
    write_ply(tmp_path / "scene.ply", make_scene(200, 1))
    view(tmp_path / "scene.ply", tmp_path / "scene.html", cameras="none")
    data = base64.b64decode(part((tmp_path / "scene.html").read_text(), "scene-bytes"))
    (tmp_path / "coded.fgs").write_bytes(data)
    header = read_header(tmp_path / "coded.fgs")
    assert (header.count, header.sh_degree, header.version if hasattr(header, "version") else 1) == (200, 1, 1)


def test_views_to_look_through_are_placed_from_a_sample(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_ply(tmp_path / "scene.ply", make_scene(200, 1))
    counts: list[int] = []
    monkeypatch.setattr(run_module, "USUAL_COUNT", 50)
    monkeypatch.setattr(run_module.view_set, "find_views", lambda _, __, source, *rest: counts.append(source.count))
    for decodes in (True, False):
        open_run(tmp_path / "scene.ply", ViewOptions(), decodes=decodes)
    assert counts == [200, 50]


def start_at(eye: list[float]) -> dict[str, Any]:
    return {START: {"eye": eye, "target": [eye[0], 0, 5], "up": [0, -1, 0], "fov": [50, 40]}}


@pytest.mark.parametrize("own", [True, False])
def test_cameras_of_another_scene_beside_a_file(scene: Path, own: bool, caplog: pytest.LogCaptureFixture) -> None:
    scene.unlink()
    write_grid(scene, make_grid(300, 1), start_at([1234.5 if own else 0.0, 0, -3]))
    output = scene.with_suffix(".html")
    result = view(scene, output)
    assert (CAMERA["img_name"] in output.read_text().replace("\\u003c", "<")) is own
    assert ("was made with other cameras" in caplog.text) is not own
    if own:
        assert result.views == 1
    assert view(scene, output, cameras=str(scene.with_name("cameras.json")), force=True).views == 1


def test_a_file_that_says_where_to_start_needs_no_views(scene: Path) -> None:
    scene.unlink()
    write_grid(scene, make_grid(300, 1), start_at([0.0, 0, -3]))
    scene.with_name("cameras.json").unlink()
    assert view(scene, scene.with_suffix(".html")).views == 0
    assert view(scene, scene.with_name("auto.html"), cameras="auto").views > 0
    # What has to be coded anew keeps it.
    view(scene, scene.with_name("cropped.html"), crop="-9999,-9999,-9999,9999,9999,9999")
    data = base64.b64decode(part(scene.with_name("cropped.html").read_text(), "scene-bytes"))
    scene.write_bytes(data)
    assert read_header(scene).settings == start_at([0.0, 0, -3])


def test_a_page_that_browsers_may_not_open(
    scene: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flexgs_edge.commands.view.PAGE_MOST", 50_000)
    view(scene, scene.with_suffix(".html"))
    assert "may not open a page of" in caplog.text


def test_a_folder_for_a_web_site(scene: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    result = view(scene, site)
    # no start view, no poster
    assert {path.name for path in site.iterdir()} == {"index.html", "embed.txt", "flexgs-scene.js", "scene.fgs"}
    assert (site / "scene.fgs").read_bytes() == scene.read_bytes() and "<iframe" in (site / "embed.txt").read_text()
    page = (site / "index.html").read_text()
    assert json.loads(part(page, "scene"))["scene"] == "scene.fgs" and "poster" not in page.partition("<body>")[2][:200]
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert policy is not None and "connect-src 'self'" in policy[1]
    check_digests(page, policy[1])
    assert result.to_json()["output"] == str(site)
    with pytest.raises(InputError, match="not empty"):
        view(scene, site)
    scene.unlink()
    write_grid(scene, make_grid(300, 1), {"near": 0.01, **start_at([1234.5, 0, -3])})
    view(scene, site, force=True)
    with Image.open(site / "poster.jpg") as poster:
        assert poster.info["progressive"] and (site / "poster.jpg").stat().st_size < np.prod(poster.size) / 12
    assert '<img id="poster" src="poster.jpg"' in (site / "index.html").read_text()


def test_arguments_that_are_wrong(scene: Path) -> None:
    with pytest.raises(InputError, match=r"ends in \.html"):
        view(scene, scene.with_suffix(".fgs.out"))
    with pytest.raises(InputError, match="--port"):
        view(scene, port=70000)
    with pytest.raises(InputError, match="cannot listen"):
        view(scene, host="no.such.host.invalid", browser=False)


def test_too_small_a_memory_limit(scene: Path) -> None:
    with pytest.raises(BudgetError, match="the program already holds .* use --memory-limit"):
        view(scene, scene.with_suffix(".html"), memory_limit=1 << 20)
    assert not scene.with_suffix(".html").exists()


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_until_it_is_stopped(scene: Path, stop: signal.Signals) -> None:
    command = [sys.executable, "-m", "flexgs_edge", "view", str(scene), "--no-browser", "-q"]
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        # As in a job that a shell has put in the background: the server would take that over, and never stop.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    folder = Path(__file__).resolve().parents[2]
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(folder)},
    ) as process:
        assert process.stderr is not None
        address = process.stderr.readline().strip()
        try:
            assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]+/viewer/index\.html", address)
            with urllib.request.urlopen(address) as answer:
                page, policy = answer.read().decode(), answer.headers["Content-Security-Policy"]
            check_digests(page, policy)
            assert "connect-src 'self'; frame-ancestors 'none'" in policy
            assert json.loads(part(page, "scene"))["scene"] == "scene.fgs"
            with urllib.request.urlopen(urllib.parse.urljoin(address, "scene.fgs")) as answer:
                assert answer.read() == scene.read_bytes()
        finally:
            process.send_signal(stop)
        rest = process.communicate(timeout=60)[1]
    assert process.returncode == (0 if stop == signal.SIGINT else 128 + stop), rest
    assert "Traceback" not in rest


def test_modules_are_joined() -> None:
    files = {
        "a/main.js": "import { two, one } from './b.js';\nimport './c.js';\nexport const three = one + two();\n"
        "globalThis.found = three;\n",
        "a/b.js": "/** A comment. */\nexport { one } from '../d.js';\nconst own = 2;\n"
        "export function two() {\n  return own;\n}\n",
        "a/c.js": "export class C {}\n// alone\n`\nconst own = 3;\n`;\n",
        "d.js": "const mine = 1;\nexport const one = mine;\n",
        "a/other.js": "import { one } from '../d.js';\nglobalThis.found = -one;\n",
    }
    text = join_modules(files, {"page": "a/main.js", "other": "a/other.js"})
    assert "comment" not in text and "alone" not in text and "import" not in text
    node = shutil.which("node")
    if node is not None:
        for role, wanted in (("document = {}", "3"), ("name = 'other'", "-1")):
            script = f"globalThis.{role};\n{text}\nconsole.log(found)"
            run = subprocess.run([node, "-e", script], capture_output=True, text=True, check=True)
            assert run.stdout == f"{wanted}\n"


def test_numbers_of_joined_modules_stand_in_the_place_of_their_names() -> None:
    files = {
        "main.js": "import { MOST, Names } from './names.js';\nconst LEAST = 1 << 4; // so little\n"
        "globalThis.found = [2 ** -LEAST, Names.MOST, `${MOST}`];\n",
        "names.js": "export const MOST = 8;\nexport class Names {}\nNames.MOST = 'most';\n",
    }
    text = join_modules(files, {"page": "main.js"})
    assert "LEAST" not in text
    node = shutil.which("node")
    if node is not None:
        script = f"globalThis.document = {{}};\n{text}\nconsole.log(JSON.stringify(found))"
        run = subprocess.run([node, "-e", script], capture_output=True, text=True, check=True)
        assert json.loads(run.stdout) == [2**-16, "most", "8"]
    ours = "\n".join(web_files(notes=True).values())
    names = re.findall(r"^(?:export )?const ([A-Z][A-Z0-9_]*) = \d", ours, re.MULTILINE)
    strings = " ".join(re.findall(r"'([^'\n]*)'", ours))
    assert len(names) > 40 and not set(names) & set(re.findall(r"\w+", strings))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("export default 3;", "cannot join 'export default"),
        ("import { one as uno } from './d.js';", "cannot join .import { one as uno }"),
        ("import { two } from './e.js';", "e.js and d.js both have one"),
        ("const { one } = window;", "cannot join 'const { one }"),
    ],
)
def test_modules_that_cannot_be_joined(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        others = {
            "d.js": "export const one = 1;\n",
            "e.js": "import './d.js';\nexport const two = 2;\nfunction one() {}\n",
        }
        join_modules({"x.js": f"{text}\n", **others}, {"page": "x.js"})


def test_our_modules_are_joined_into_a_script_that_parses(tmp_path: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node to parse scripts with")
    place = tmp_path / "script.cjs"
    for version, kind in MOST_SENT:
        place.write_text(join_modules(web_files(version, kind, notes=True), entries_of(kind)))
        subprocess.run([node, "--check", str(place)], check=True, timeout=60)


def test_what_a_browser_is_sent_stays_small() -> None:
    for (version, kind), most in MOST_SENT.items():
        page = viewer_page(web_files(version, kind), page_config("", [], {}, "scene.fgs"), kind=kind)
        assert len(gzip.compress(page.text.encode())) <= most
    assert len(gzip.compress(join_modules(web_files(2, SPATIAL, notes=True), ELEMENT).encode())) <= 27_500
