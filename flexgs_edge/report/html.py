"""Pieces of the pages that reports and studies write: one file each, nothing fetched from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape

from flexgs_edge._version import __version__

_STYLE = """
:root { color-scheme: light dark; }
:root { --ink: #1d2329; --paper: #ffffff; --soft: #5b6670; --line: #d7dde2; --band: #f4f6f8; --mark: #0b63c5; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6eaee; --paper: #14181c; --soft: #9aa6b1; --line: #313a42; --band: #1c2228; --mark: #6fb1ff; }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 64rem; padding: 1rem; font: 1rem/1.5 system-ui, sans-serif; }
body { color: var(--ink); background: var(--paper); }
h1 { font-size: 1.5rem; } h2 { font-size: 1.2rem; margin-top: 2rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { background: var(--band); font-weight: 600; }
th:first-child, td:first-child { text-align: left; }
figure { margin: 1rem 0; } img, svg { max-width: 100%; height: auto; }
figcaption, footer { color: var(--soft); font-size: .9rem; }
"""


def page(title: str, body: str, style: str = "", script: str = "") -> str:
    """A whole HTML document; `body` is HTML, `title` is text."""
    code = f"<script>{script}</script>" if script else ""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f'<link rel="icon" href="data:,">\n<title>{escape(title)}</title>\n<style>{_STYLE}{style}</style>\n</head>\n'
        f"<body>\n<h1>{escape(title)}</h1>\n{body}\n"
        f"<footer>Made by flexgs-edge {__version__}.</footer>\n{code}\n</body>\n</html>\n"
    )


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table of text cells (escaped); it scrolls sideways where the screen is too narrow."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "\n".join("<tr>" + "".join(f"<td>{escape(str(cell))}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table>\n<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>'


def data_uri(data: bytes, kind: str) -> str:
    """`data` as the value of a `src`, such as an image of kind `image/png`.

    >>> data_uri(b"abc", "text/plain")
    'data:text/plain;base64,YWJj'
    """
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def picture(data: bytes, kind: str, caption: str) -> str:
    """An embedded picture with its caption."""
    text = escape(caption)
    return f'<figure><img src="{data_uri(data, kind)}" alt="{text}"><figcaption>{text}</figcaption></figure>'
