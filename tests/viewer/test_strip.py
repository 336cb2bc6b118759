"""Scripts without comments and spaces: every token stays, and our own decoder still passes its tests."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from flexgs_edge.viewer.assets import web_files
from flexgs_edge.viewer.strip import strip_script, tokens_of


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ("const a = 1; // one\n", "const a=1;"),
        ("a = b /* // ' */ + c;", "a=b+c;"),
        ("f('a // b', \"/* c */\");", "f('a // b',\"/* c */\");"),
        ("f('it\\'s', `a  ${ b + `c  ${ d } // e` } /* f */`);", "f('it\\'s',`a  ${b+`c  ${d} // e`} /* f */`);"),
        ("x = a / b / c;", "x=a/b/c;"),
        ("x = f(a) / 2 // half\n+ 1;", "x=f(a)/2+1;"),
        ("x = /[/'\"`]\\/ */g.test( y );", "x=/[/'\"`]\\/ */g.test(y);"),
        ("if (a) /b c/.test(d);", "if(a)/b c/.test(d);"),
        ("return /a/ / /b/;", "return/a/ / /b/;"),
        ("a + +b - -c + ++d - --e;", "a+ +b- -c+ ++d- --e;"),
        ("while (i-- > 0) f();", "while(i-- >0)f();"),
        ("a < !b; a < /c/;", "a< !b;a< /c/;"),
        ("1 .toFixed(); a ? .5 : 1;", "1 .toFixed();a?.5:1;"),
        ("typeof a in b; async () => c;", "typeof a in b;async()=>c;"),
        ("a = b\nc = d\n++e", "a=b\nc=d\n++e"),
        ("return\n(a);", "return\n(a);"),
        ("class A {\n  #b = 1;\n  static #c() {}\n  *d() {}\n}\n", "class A{#b=1;static #c(){}\n*d(){}}"),
        ("f(\n  a,\n  b,\n)\n  .g();", "f(a,b,).g();"),
        ("`#version 300 es\n  // why\n  int a;  // b\n`;", "`#version 300 es\nint a;\n`;"),
        ("`\n  // no shader\n`;", "`\n  // no shader\n`;"),
    ],
)
def test_what_is_left(given: str, wanted: str) -> None:
    assert strip_script(given) == wanted


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("'open", "no token begins so"),
        ("`open ${a}", "without an end"),
        ("a = /open\n", "pattern without an end"),
        ("{ } /a/.b;", "cannot tell"),
        ("f(", "ends within"),
        ("f)", "nothing to close"),
        ("a = \N{DEGREE SIGN};", "no token begins so"),
    ],
)
def test_what_is_refused(given: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        strip_script(given)


def test_our_own_scripts_keep_their_tokens() -> None:
    for path, text in web_files().items():
        if not path.endswith(".js"):
            continue
        made = strip_script(text)
        assert len(made) < len(text) and strip_script(made) == made
        if "shaders" not in path:
            assert [token.text for token in tokens_of(made)] == [token.text for token in tokens_of(text)]


def test_the_decoder_and_the_viewer_without_spaces_pass_their_tests(tmp_path: Path, repository: Path) -> None:
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node to run the tests of the decoder")
    shutil.copytree(repository / "web", tmp_path / "web")
    for path, text in web_files().items():
        if path.endswith(".js"):
            (tmp_path / "web" / path).write_text(strip_script(text))
    for part in ("decoder", "viewer"):
        run = subprocess.run(
            [node, "--test", "tests/"], cwd=tmp_path / "web" / part, capture_output=True, text=True, timeout=200
        )
        assert run.returncode == 0 and "# fail 0" in run.stdout, run.stdout[-3000:] + run.stderr
        assert "# pass 0" not in run.stdout
