"""Fill the templates of `templates/`. Each page is one file and fetches nothing. Only this module imports jinja2."""

import base64
import json
import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from flexgs_edge._version import __version__
from flexgs_edge.units import format_size

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).with_name("templates")

# Characters that HTML forbids, and those that change the direction of text. Names that are not UTF-8 hold lone surrogates.
_UNFIT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


def render(template: str, **values: object) -> str:
    """Fill a template with `values`. The result is HTML that other templates do not escape again.

    Every value is escaped. Characters that HTML cannot hold become U+FFFD.
    """
    from markupsafe import Markup  # imported here because it is slow, and only reports need it

    return Markup(_UNFIT.sub("\ufffd", environment().get_template(template).render(values)))


@cache
def environment() -> "Environment":
    """Create the jinja2 environment: the templates and their filters."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    made = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        auto_reload=False,
    )
    made.filters.update(
        as_is=Markup,
        base64=base64_text,
        json=json_text,
        count=count,
        data_uri=data_uri,
        decibel=decibel,
        figure=figure,
        size=format_size,
    )
    made.globals["version"] = __version__
    return made


def data_uri(data: bytes, kind: str) -> str:
    """Encode `data` as a data URI; `kind` is its media type, such as `image/png`.

    >>> data_uri(b"abc", "text/plain")
    'data:text/plain;base64,YWJj'
    """
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def base64_text(data: bytes) -> str:
    """Bytes as letters that no page escapes.

    >>> base64_text(b"abc")
    'YWJj'
    """
    return base64.b64encode(data).decode()


def json_text(value: object) -> str:
    """JSON for a script element, which no name of a file or camera ends.

    >>> print(json_text({"name": "</script>"}))
    {"name": "\\u003c/script>"}
    """
    from markupsafe import Markup

    return Markup(json.dumps(value, allow_nan=False).replace("<", "\\u003c"))


def figure(value: float | None, form: str, missing: str = "\u2013") -> str:
    """Format a number with a Python format, or return a dash for `None`.

    >>> figure(0.98765, ".4f")
    '0.9877'
    """
    return missing if value is None else format(value, form)


def decibel(value: float | None) -> str:
    """Format a PSNR or a difference of two; `None` means identical pictures.

    >>> decibel(1.5), decibel(None)
    ('1.500', 'identical')
    """
    return figure(value, ".3f", "identical")


def count(value: int) -> str:
    """Format a whole number in groups of three digits, with a narrow no-break space between them.

    >>> count(1234567) == "1\u202f234\u202f567"
    True
    """
    return f"{value:,}".replace(",", "\u202f")
