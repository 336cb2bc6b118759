"""Pieces of the pages that reports and studies write: one file each, nothing fetched from elsewhere."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Sequence
from html import escape

from flexgs_edge._version import __version__

_STYLE = """
:root { color-scheme: light dark; --ink: #1d2329; --paper: #ffffff; --soft: #5b6670; --line: #d7dde2;
  --band: #f4f6f8; --mark: #0b63c5; --warm: #b4530a; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6eaee; --paper: #14181c; --soft: #9aa6b1; --line: #313a42; --band: #1c2228; --mark: #6fb1ff;
  --warm: #f0a35e; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 64rem; padding: 1rem; font: 1rem/1.5 system-ui, sans-serif; color: var(--ink);
  background: var(--paper); overflow-wrap: anywhere; }
h1 { font-size: 1.5rem; line-height: 1.25; } h2 { font-size: 1.2rem; margin-top: 2rem; }
a { color: var(--mark); }
:focus-visible { outline: 2px solid var(--mark); outline-offset: 2px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { background: var(--band); font-weight: 600; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1rem 0; } img, svg { max-width: 100%; height: auto; }
figcaption, footer { color: var(--soft); font-size: .9rem; }
"""

# The page's own promise, kept by the browser: pictures are inside, and nothing is fetched.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"

# What HTML forbids (controls, halves of surrogate pairs, as in names that are no UTF-8) or what turns text around.
_UNFIT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


class Markup(str):
    """Text that is HTML already: `table` takes it as it is."""


def text(value: object) -> Markup:
    r"""Any value as text of a page; what HTML cannot hold becomes U+FFFD.

    >>> str(text("<a & 'b'>")), text("\udc80") == chr(0xFFFD)
    ('&lt;a &amp; &#x27;b&#x27;&gt;', True)
    """
    return value if isinstance(value, Markup) else Markup(escape(_UNFIT.sub("\ufffd", str(value))))


def page(title: str, body: str, style: str = "", script: str = "") -> str:
    """A whole HTML document; `body` is HTML, `title` is text."""
    code = f"<script>{script}</script>" if script else ""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<link rel="icon" href="data:,">\n<title>{text(title)}</title>\n<style>{_STYLE}{style}</style>\n</head>\n'
        f"<body>\n<h1>{text(title)}</h1>\n{body}\n"
        f"<footer>Made by flexgs-edge {__version__}.</footer>\n{code}\n</body>\n</html>\n"
    )


def table(heads: Sequence[object], rows: Iterable[Sequence[object]], label: str = "") -> str:
    """A table of cells (text, or `Markup`); it scrolls sideways in a box of its own where the screen is too narrow.

    `label` names the box for screen readers; with it the box can be scrolled by keys.
    """
    head = "".join(f'<th scope="col">{text(cell)}</th>' for cell in heads)
    body = "\n".join("<tr>" + "".join(f"<td>{text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    box = f' tabindex="0" role="region" aria-label="{text(label)}"' if label else ""
    return (
        f'<div class="scroll"{box}><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'
    )


def data_uri(data: bytes, kind: str) -> str:
    """`data` as the value of a `src`, such as an image of kind `image/png`.

    >>> data_uri(b"abc", "text/plain")
    'data:text/plain;base64,YWJj'
    """
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def picture(data: bytes, kind: str, caption: str) -> str:
    """An embedded picture with its caption."""
    words = text(caption)
    return f'<figure><img src="{data_uri(data, kind)}" alt="{words}"><figcaption>{words}</figcaption></figure>'
