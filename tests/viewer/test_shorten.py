"""Scripts, shaders and styles made short: they do the same."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from flexgs_edge.viewer import join as shorten
from flexgs_edge.viewer.assets import web_files
from flexgs_edge.viewer.join import shorten_script, shorten_shader, shorten_style


def test_shaders_lose_what_only_readers_need() -> None:
    script = "const a = `#version 300 es\n  // why\n  int a = - -1;  // b\n  f( b ) [c & 1] / 2.0;\n`;"
    assert "#version 300 es\nint a=- -1;f(b)[c&1]/2.;`" in shorten_script(script)


def test_names_of_shaders_become_short_but_for_those_that_others_know() -> None:
    text = (
        "layout(location = 0) in uint row;\nuniform float near;\nflat out vec2 centre;\n"
        "float halved(float near, vec3 place) {\n  float a = near - -1.0, other = place.x + place.place;\n  i++;\n"
        "  return 0.28209479177387814 * other * near;\n}\nvoid main() { centre = vec2(halved(near, row.xyz)); }\n"
    )
    assert shorten_shader(text) == (
        "layout(location=0)in uint row;uniform float near;flat out vec2 centre;"
        "float b(float near,vec3 c){float a=near- -1.,d=c.x+c.place;i++;"
        "return .282094792*d*near;}void main(){centre=vec2(b(near,row.xyz));}"
    )


def test_numbers_of_shaders_lose_zeros() -> None:
    text = "vec4(0.0, 10.05, 20.0, 0.05) * t0.x + 1.0e5 - 0.30 + 0;"
    assert shorten_shader(text) == "vec4(0.,10.05,20.,.05)*t0.x+1.0e5-.30+0;"


def test_other_templates_stay() -> None:
    assert "`\n  // no shader ${a}\n`" in shorten_script("f(`\n  // no shader ${a}\n`);")


def test_styles() -> None:
    assert shorten_style("a {\n  color: #ffffff;\n}\n") == "a{color:#fff}"


def test_without_the_minifier(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shorten, "find_spec", lambda name: None)
    assert shorten_script("const a = 1; // one\n") == "const a = 1; // one\n"
    assert shorten_style("a { }") == "a { }"


def test_the_decoder_and_the_viewer_made_short_pass_their_tests(tmp_path: Path, repository: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node to run the tests of the decoder")
    shutil.copytree(repository / "web", tmp_path / "web")
    for path, text in web_files().items():
        if path.endswith(".js"):
            short = shorten_script(text)
            assert len(short) < len(text)
            (tmp_path / "web" / path).write_text(short)
    for part in ("decoder", "viewer"):
        run = subprocess.run(
            [node, "--test", "tests/"], cwd=tmp_path / "web" / part, capture_output=True, text=True, timeout=200
        )
        assert run.returncode == 0 and "# fail 0" in run.stdout, run.stdout[-3000:] + run.stderr
        assert "# pass 0" not in run.stdout
