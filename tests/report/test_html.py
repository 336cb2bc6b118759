"""The door to the templates: everything is escaped, nothing is missing in silence, every file is a template that is used."""

from __future__ import annotations

import re

import pytest
from jinja2 import UndefinedError

from flexgs_edge.report.html import TEMPLATES, environment, render

ASKED = r'{%-? *(?:extends|include|import|from) "([^"]+)"'


def test_every_value_is_escaped_in_texts_and_attributes() -> None:
    assert environment().autoescape is True, "for every kind of file"
    words = environment().from_string("<b title='{{ words }}'>{{ words }}</b>").render(words="<i>\"'&")
    assert words == "<b title='&lt;i&gt;&#34;&#39;&amp;'>&lt;i&gt;&#34;&#39;&amp;</b>"


def test_what_a_template_makes_is_taken_as_it_is_by_another() -> None:
    page = render("study.html", name="rate", title="<t>\udc80\x07", intro="", facts=(), experiments=())
    assert "<h1>&lt;t&gt;\ufffd\ufffd</h1>" in page
    assert environment().from_string("{{ page }}").render(page=page) == page


def test_a_value_that_nobody_gave_is_a_fault() -> None:
    with pytest.raises(UndefinedError, match="intro"):
        render("study.html", title="", name="rate", facts=(), experiments=())


def test_every_file_is_a_template_that_is_used() -> None:
    names = set(environment().list_templates())
    assert names == {path.name for path in TEMPLATES.iterdir()}
    asked = {name for path in TEMPLATES.iterdir() for name in re.findall(ASKED, path.read_text(encoding="utf-8"))}
    rendered = {"compress.html", "report.html", "study.html", "step_chart.svg"}
    assert asked | rendered == names
    for name in names:
        environment().get_template(name)


def test_templates_switch_no_escaping_off() -> None:
    for path in TEMPLATES.iterdir():
        assert not re.search(r"\|\s*safe\b|autoescape", path.read_text(encoding="utf-8")), path.name
