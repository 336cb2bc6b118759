"""The one door to the templates of `templates/`: pages of reports and studies, one file each, nothing fetched."""

from __future__ import annotations

import base64
import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from flexgs_edge._version import __version__
from flexgs_edge.units import format_size

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).with_name("templates")

# What HTML forbids (controls, halves of surrogate pairs, as in names that are no UTF-8) or what turns text around.
_UNFIT = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")


def render(template: str, **values: object) -> str:
    """What a template makes of `values`, as HTML that other templates take as it is.

    Every value is escaped; what HTML cannot hold becomes U+FFFD.
    """
    from markupsafe import Markup  # slow to import; a run without a report need not pay for it

    return Markup(_UNFIT.sub("\ufffd", environment().get_template(template).render(values)))


@cache
def environment() -> Environment:
    """What knows the templates, and the filters that they use."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    made = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        auto_reload=False,
    )
    made.filters.update(count=count, data_uri=data_uri, decibel=decibel, figure=figure, size=format_size)
    made.globals["version"] = __version__
    return made


def data_uri(data: bytes, kind: str) -> str:
    """`data` as the value of a `src`, such as an image of kind `image/png`.

    >>> data_uri(b"abc", "text/plain")
    'data:text/plain;base64,YWJj'
    """
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def figure(value: float | None, form: str, missing: str = "\u2013") -> str:
    """A number in a format of Python, or a dash.

    >>> figure(0.98765, ".4f")
    '0.9877'
    """
    return missing if value is None else format(value, form)


def decibel(value: float | None) -> str:
    """A PSNR or a difference of two; `None` stands for identical pictures.

    >>> decibel(1.5), decibel(None)
    ('1.500', 'identical')
    """
    return figure(value, ".3f", "identical")


def count(value: int) -> str:
    """A whole number by digit groups; a narrow no-break space keeps them in one piece.

    >>> count(1234567) == "1\u202f234\u202f567"
    True
    """
    return f"{value:,}".replace(",", "\u202f")
