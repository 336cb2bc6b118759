"""Make scripts and styles short for those who load them: no comments, no spaces, short names within functions."""

from __future__ import annotations

import re
from importlib.util import find_spec

_SHADER = re.compile(r"`#version[^`]*`")


def shorten_script(text: str) -> str:
    """A script of JavaScript that does the same; shaders in it lose comments and spaces."""
    return _shorten("application/javascript", _SHADER.sub(lambda found: _shorten_shader(found[0]), text))


def shorten_style(text: str) -> str:
    """A style that says the same."""
    return _shorten("text/css", text)


def _shorten(kind: str, text: str) -> str:
    # For some machines there is no wheel (Apple's processors, November 2026). Pages are longer there, and work as well.
    if find_spec("minify") is None:
        return text
    import minify  # a runtime of its own, which only pages need

    return str(minify.string(kind, text))


def _shorten_shader(text: str) -> str:
    """Without comments, indentation and spaces beside signs; not beside + and -, two of which would become another sign."""
    lines = re.sub(r"\n\s+", "\n", re.sub(r"[ \t]*//[^\n]*", "", text))
    return re.sub(r" ?([*/=<>(){},;?:&|!]+) ?", r"\1", lines)
