"""Make shaders short for a page: GLSL that says the same in fewer letters."""

from __future__ import annotations

import re
from string import ascii_letters

_OUTSIDE = re.compile(r"\b(?:uniform|in|out) [^;(){}]*;")  # Names that the page or another shader knows
_DECLARED = re.compile(r"\b(?:float|int|u?vec[234]|mat3|void) (\w+)|, (\w+) = ")
_DIGITS = re.compile(r"\d+\.\d{9,}")


def shorten_shader(text: str) -> str:
    """A shader without comments, indentation and most spaces, with short names and no digits that float32 cannot hold."""
    text = re.sub(r"\n\s+", "\n", re.sub(r"[ \t]*//[^\n]*", "", text))
    text = _DIGITS.sub(lambda found: f"{float(found[0]):.9g}", _renamed(text))
    text = re.sub(r" ?([*/=<>(){},;?:&|!]+) ?", r"\1", text)
    # Two signs beside each other would become another one.
    return re.sub(r"(?<![+-]) ?([+-]=?) ?(?![+-])", r"\1", text)


def _renamed(text: str) -> str:
    used = set(re.findall(r"\w+", text))
    known = set(re.findall(r"\w+", " ".join(_OUTSIDE.findall(text)))) | {"main"}
    declared = [one or other for one, other in _DECLARED.findall(_OUTSIDE.sub("", text))]
    own = [name for name in dict.fromkeys(declared) if name not in known and len(name) > 1]
    free = (letter for letter in ascii_letters if letter not in used)
    for old, new in zip(own, free, strict=False):
        text = re.sub(rf"(?<![.\w]){old}\b", new, text)
    return text
