"""One page for a whole study: every chart, table and finding, in one file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

from flexgs_edge.report import html
from flexgs_edge.studies.experiment import Experiment

_STYLE = """
figure img { background: #ffffff; }
summary { cursor: pointer; }
"""


@dataclass(frozen=True)
class Section:
    """A scene of the page: its name, lines about it, and its experiments with their charts as SVG."""

    name: str
    facts: Sequence[tuple[str, str]]
    experiments: Sequence[tuple[Experiment, bytes]]


def study_page(title: str, intro: str, sections: Sequence[Section]) -> str:
    """The page as HTML."""
    body = [f"<p>{escape(intro)}</p>"]
    if len(sections) > 1:
        links = (f'<li><a href="#{escape(s.name)}">{escape(s.name)}</a></li>' for s in sections)
        body.append(f"<ul>{''.join(links)}</ul>")
    for section in sections:
        body.append(f'<h2 id="{escape(section.name)}">{escape(section.name)}</h2>')
        body.append(html.table(("scene", ""), section.facts))
        for experiment, svg in section.experiments:
            body += _experiment(experiment, svg, section.name)
    return html.page(title, "\n".join(body), _STYLE)


def _experiment(experiment: Experiment, svg: bytes, name: str) -> Iterable[str]:
    yield f"<h3>{escape(experiment.title)}</h3>"
    yield f"<p>{escape(experiment.question)}</p>"
    yield html.picture(svg, "image/svg+xml", f"{name}: {experiment.chart.title}")
    yield "<ul>" + "".join(f"<li>{escape(words)}</li>" for words in experiment.findings) + "</ul>"
    if experiment.beside:
        rows = [(item.what, item.here, item.paper) for item in experiment.beside]
        yield html.table(("beside the paper", "here", "paper"), rows)
    yield f"<details><summary>All rows ({experiment.key}.csv)</summary>{experiment.table.to_html()}</details>"
