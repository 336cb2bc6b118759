"""Times the decoder in Node and in Chromium, and the viewer over a slow line: docs/viewer.md.

python -m benchmarks.web [--scene fox|sample] [--repeats N]

Needs Node and Chromium. The browser draws in software.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import ROOT, SCENES, Timer, check, parse
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.compress import compress
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.scene.source import read_all

sys.path.insert(0, str(ROOT / "tests" / "helpers"))
import browser as browser_module
from browser import Browser, find_browser
from viewer_tab import SOFTWARE, served, until
from web_vectors import expected as expected_of

DECODER = ROOT / "web" / "decoder"
MANY = 500_000
"""Rows of the larger file."""
AGAIN = 3
"""Decodes behind the first one in a process, or on a page."""
LINE: dict[str, Any] = {"offline": False, "latency": 20, "downloadThroughput": 1.25e6, "uploadThroughput": 1.25e6}
"""10 Mbit/s; the latency is in milliseconds."""
POSES = 30
"""Poses whose frames are timed."""
PAUSE = 3.0
"""Seconds between two pages."""
NODE = """
const { readFileSync } = await import('node:fs');
const { open } = await import(process.argv[1]);
const bytes = new Uint8Array(readFileSync(process.argv[2]));
const seconds = [];
for (let k = 0; k <= Number(process.argv[3]); k++) {
  const before = process.cpuUsage();
  for await (const chunk of (await open(bytes)).chunks()) chunk.values();
  const used = process.cpuUsage(before);
  seconds.push((used.user + used.system) / 1e6);
}
const [, peak] = readFileSync('/proc/self/status', 'utf8').match(/VmHWM:\\s*(\\d+) kB/);
console.log(JSON.stringify({ seconds, peak: peak * 1024 }));
"""
PAGE = """
(async (times) => {
  const { openInWorker } = await import('/src/worker-client.js');
  const bytes = new Uint8Array(await (await fetch('/scene.fgs')).arrayBuffer());
  const worker = new Worker('/src/worker.js', { type: 'module' });
  const seconds = [];
  for (let k = 0; k < times; k++) {
    const start = performance.now();
    const file = await openInWorker(bytes.slice(), { worker });
    for await (const chunk of file.chunks({ values: true }));
    seconds.push((performance.now() - start) / 1000);
  }
  worker.terminate();
  return seconds;
})(%d)
"""


def many_of(place: Path, scene: Path) -> Path:
    """A file of `MANY` rows on the steps of another: its rows again and again, each time a step further."""
    source = GridSource(scene)
    grid, planes = source.grid(), read_all(source, IN_MEMORY)
    rows = np.arange(MANY) % source.count
    planes = {name: np.ascontiguousarray(values[:, rows]) for name, values in planes.items()}
    planes["means"] += (np.arange(MANY) // source.count * grid.step_sizes.position).astype(np.float32)
    found, _ = to_grid(planes, grid.sh_degrees[rows], grid.step_sizes, source.origin)
    write_grid(place, found, {})
    return place


def bench_node(timer: Timer, name: str, file: Path, node: str) -> None:
    """Time the decoder in processes of Node, of which each decodes a file several times."""
    wanted = {file.name: expected_of(file)}
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "expected.json").write_text(json.dumps(wanted))
        shutil.copy(file, folder)
        told = subprocess.run([node, DECODER / "tests" / "compare.mjs", folder], capture_output=True, check=True)
    check(json.loads(told.stdout)["different"] == [], "codes and values of `decompress`")
    command = [node, "--input-type=module", "-e", NODE, (DECODER / "src" / "index.js").as_uri(), str(file), str(AGAIN)]
    found = [json.loads(subprocess.check_output(command)) for _ in range(timer.repeats)]
    count, peak = GridSource(file).count, max(one["peak"] for one in found)
    note = f"{count} Gaussians, {file.stat().st_size} bytes, codes and values of decompress"
    firsts, later = [one["seconds"][0] for one in found], [s for one in found for s in one["seconds"][1:]]
    timer.add(f"{name}, Node, first time", [count / s / 1e6 for s in firsts], "M/s of processor time", note, peak)
    timer.add(f"{name}, Node, later", [count / s / 1e6 for s in later], "M/s of processor time", note, peak)


class Silent(SimpleHTTPRequestHandler):
    """Serves files and says nothing."""

    def log_message(self, format: str, *args: Any) -> None:
        """Not logged."""


@contextmanager
def page_of(file: Path) -> Iterator[str]:
    """The address of an empty page beside the decoder's modules and a file."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "src").symlink_to(DECODER / "src")
        (Path(folder) / "index.html").write_text("<!doctype html><title>decoder</title>")
        shutil.copy(file, Path(folder) / "scene.fgs")
        with ThreadingHTTPServer(("127.0.0.1", 0), partial(Silent, directory=folder)) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            yield f"http://127.0.0.1:{server.server_port}/"
            server.shutdown()


def bench_worker(timer: Timer, name: str, file: Path, tab: Browser) -> None:
    """Time the decoder in a worker that has just been made, and again."""
    count, firsts, later = GridSource(file).count, [], []
    with page_of(file) as address:
        for _ in range(timer.repeats):
            tab.send("Page.navigate", url=address)
            tab.wait("Page.loadEventFired")
            first, *more = [count / seconds / 1e6 for seconds in tab.run(PAGE % (1 + AGAIN))]
            firsts.append(first)
            later += more
    note = f"{count} Gaussians in one worker, from bytes in memory to values on the page"
    timer.add(f"{name}, Chromium, first time", firsts, "M/s", note)
    timer.add(f"{name}, Chromium, later", later, "M/s", note)


def bench_line(timer: Timer, name: str, file: Path, cameras: Path, tab: Browser) -> None:
    """Time the viewer's first picture and its whole scene over the slow line, and its frames."""
    firsts, wholes, frames, sorts = [], [], [], []
    tab.send("Emulation.setDeviceMetricsOverride", width=960, height=720, deviceScaleFactor=1, mobile=False)
    with served(file, str(cameras)) as address:
        tab.send("Network.setCacheDisabled", cacheDisabled=True)
        tab.send("Network.emulateNetworkConditions", **LINE)
        for _ in range(timer.repeats):
            # Frames of the page before would still be drawn.
            tab.send("Page.navigate", url="about:blank")
            tab.wait("Page.loadEventFired")
            time.sleep(PAUSE)
            tab.send("Page.navigate", url=address)
            tab.wait("Page.loadEventFired")
            until(tab, "globalThis.viewer && viewer.stats.wholeMs > 0 && viewer.stats.firstMs > 0")
            # `started` counts from the navigation.
            first, whole = tab.run("[viewer.started + viewer.stats.firstMs, viewer.started + viewer.stats.wholeMs]")
            firsts.append(first)
            wholes.append(whole)
        for pose in range(POSES):
            tab.run(
                f"(async () => {{ viewer.setPose({pose}); await new Promise((done) => setTimeout(done, 250)); }})()"
            )
            frame, sort = tab.run("[viewer.stats.frameMs, viewer.stats.sortMs]")
            frames.append(frame)
            sorts.append(sort)
    note = f"{file.stat().st_size} bytes at 10 Mbit/s, 20 ms; after navigation"
    timer.add(f"{name}, first picture", firsts, "ms", note)
    timer.add(f"{name}, whole scene", wholes, "ms", note)
    timer.add(f"{name}, JavaScript of a frame", frames, "ms", "960x720, software GL")
    timer.add(f"{name}, sort in its worker", sorts, "ms")


def main() -> None:
    options = parse(__doc__, repeats=8)
    node, program = shutil.which("node"), find_browser()
    if node is None or program is None:
        raise SystemExit("Node and Chromium are needed")
    scene, timer = SCENES[options.scene], Timer("Node and Chromium", options.repeats)
    flags = tuple(flag for flag in browser_module.FLAGS if flag != "--disable-gpu")
    browser_module.FLAGS = (*flags, *SOFTWARE)
    with tempfile.TemporaryDirectory() as folder:
        plain, fast = Path(folder) / "plain.fgs", Path(folder) / "fast.fgs"
        compress(scene, plain)
        compress(scene, fast, effort="fast")
        files = {options.scene: plain, f"{options.scene} by fast": fast}
        files["half a million"] = many_of(Path(folder) / "many.fgs", fast)
        for name, file in files.items():
            bench_node(timer, name, file, node)
        with Browser(program, Path(folder) / "profile") as tab:
            for name, file in files.items():
                bench_worker(timer, name, file, tab)
            for name in list(files)[:2]:
                bench_line(timer, name, files[name], scene / "cameras.json", tab)


if __name__ == "__main__":
    main()
