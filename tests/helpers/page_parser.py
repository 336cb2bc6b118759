"""Reads a report page back: text, pictures, tables, and everything that could fetch something."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser

import numpy as np
from PIL import Image

VOID = {"meta", "link", "img", "input"}


class Page(HTMLParser):
    """A parsed page.

    Attributes
    ----------
    tags : list of (str, dict)
        Every start tag with its attributes.
    cells : list of list of list of str
        Tables, rows, cells.
    """

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.unbalanced: list[str] = []
        self.words: list[str] = []
        self.cells: list[list[list[str]]] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.cells.append([])
        elif tag == "tr":
            self.cells[-1].append([])
        elif tag in ("td", "th"):
            self.cells[-1][-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.unbalanced.append(tag)

    def handle_data(self, data: str) -> None:
        if not {"script", "style"} & set(self.open):
            self.words.append(data)
            if {"td", "th"} & set(self.open):
                self.cells[-1][-1][-1] += data

    @property
    def text(self) -> str:
        """All words, white space as the browser shows it."""
        return re.sub("[ \n]+", " ", " ".join(self.words))

    def named(self, tag: str, part: str = "") -> list[dict[str, str]]:
        """Attributes of all tags of a name, with `part` among their classes."""
        return [attributes for name, attributes in self.tags if name == tag and part in attributes.get("class", "")]

    def pictures(self, kind: str) -> list[np.ndarray]:
        """[H, W, 3] f64 in [0, 1] of the pictures of a kind (original, compressed, error, photo), in order."""
        found = []
        for index, (tag, attributes) in enumerate(self.tags):
            if tag == "figure" and attributes.get("class") == kind:
                source = self.tags[index + 1][1]
                data = source["src"].removeprefix("data:image/jpeg;base64,")
                pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(data, validate=True))), np.float64) / 255
                assert pixels.shape == (int(source["height"]), int(source["width"]), 3)
                found.append(pixels)
        return found

    def fetched(self) -> list[str]:
        """Whatever the page would ask for from elsewhere."""
        places = [
            attributes.get(name, "") for _, attributes in self.tags for name in ("src", "href", "srcset", "action")
        ]
        return [place for place in places if place and not place.startswith(("data:", "#"))]
