"""The page of a `compress` and of an `evaluate`: records and pictures in, one HTML document out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import PurePath
from typing import Any

from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.report import camera_plan, search_chart, viewer
from flexgs_edge.report.html import Markup, page, table, text
from flexgs_edge.report.material import Material, Shot
from flexgs_edge.report.results import CompressResult, EvaluateResult
from flexgs_edge.report.run_info import RunInfo, SceneInfo, ViewsInfo
from flexgs_edge.report.summary import decided_words, device_words, memory_words
from flexgs_edge.report.tones import ERROR_SCALE, css_ramp
from flexgs_edge.units import format_size

_STYLE = """
.lead { font-size: 1.1rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); gap: .6rem; margin: 1.2rem 0;
  padding: 0; list-style: none; }
.tiles li { padding: .7rem .9rem; border-radius: 8px; background: var(--band); }
.tiles b { display: block; font-size: 1.4rem; line-height: 1.3; font-variant-numeric: tabular-nums; }
.tiles span { color: var(--soft); font-size: .9rem; }
dl { display: grid; grid-template-columns: minmax(6rem, auto) minmax(0, 1fr); gap: .25rem 1rem; margin: .5rem 0; }
dt { color: var(--soft); } dd { margin: 0; }
.warn { padding: .6rem .9rem; border-left: 4px solid var(--warm); background: var(--band); }
.two { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); gap: 1rem 2rem; }
.two > * { min-width: 0; }
.tall .scroll { max-height: 32rem; overflow-y: auto; } .tall th { position: sticky; top: 0; }
details { margin: .8rem 0; } summary { cursor: pointer; color: var(--mark); }
footer { margin-top: 3rem; }
"""
FEW_ROWS = 16
"""With more steps their table is folded up, and with more views theirs gets a height of its own."""
_WORDS = (
    (
        "drop",
        "how much PSNR against the photos is lost: that of the original's render less that of this scene's render",
    ),
    ("fidelity", "PSNR between the two scenes' renders; 42 dB is very hard to see"),
    ("modelled drop", "what the drop would be if the original's own error had nothing to do with the compression's"),
    ("SSIM", "likeness of structure, 1 for identical pictures"),
    ("ratio", "bytes of the original's PLY, as INRIA writes it with normals, for each byte of the file"),
)


def compress_page(result: CompressResult, material: Material) -> str:
    """The page of a `compress`."""
    quality = result.quality
    name = _name(result.output or result.scene.path)
    done, became = ("would be", "would become") if result.output is None else ("is", "became")
    lead = f"{format_size(result.scene.ply_bytes)} of PLY {became} {format_size(result.size)}."
    if quality is not None:
        lead += f" {_loss_words(quality, result.quality_views)}"
    parts = [f'<p class="lead">{text(lead)}</p>']
    if result.output is None:
        parts.append("<p>A dry run: no file was written, and this is what it would be.</p>")
    if result.reached is False:
        missed = f"The target, {result.target}, was not reached: this is the closest point (--best-effort)."
        parts.append(f'<p class="warn">{text(missed)}</p>')
    parts += [f'<p class="warn">{text(f"Beware: {words}.")}</p>' for words in result.warnings]
    parts.append(
        _tiles(
            [
                (f"{result.ratio:.2f}\u00d7", "smaller"),
                (format_size(result.size), f"file, of {format_size(result.scene.ply_bytes)}"),
                *_quality_tiles(quality),
                (f"{100 * result.count / max(result.scene.count, 1):.1f} %", f"{_count(result.count)} Gaussians kept"),
            ]
        )
    )
    if quality is not None:
        parts += _pictures(material, quality, "original", "compressed")
        parts += _view_section(material.shots, quality, result.quality_views)
    parts += _search_section(result, material)
    parts += _contents_section(material.contents)
    if result.views is not None:
        parts += _views_section(result.views, material)
    parts += _run_section(_compress_facts(result), result.run)
    return page(f"{name} {done} {result.ratio:.1f} times smaller", "\n".join(parts), _styles(), _script(material))


def evaluate_page(result: EvaluateResult, material: Material) -> str:
    """The page of an `evaluate`."""
    quality, contents = result.quality, material.contents
    parts = [f'<p class="lead">{text(_loss_words(quality, result.quality_views))}</p>']
    tiles = _quality_tiles(quality)
    if contents is not None and contents.get("ratio"):
        tiles.insert(0, (f"{contents['ratio']:.2f}\u00d7", f"smaller: {format_size(contents['size'])}"))
    kept = f"Gaussians, of {_count(result.reference.count)}"
    parts.append(_tiles([*tiles, (_count(result.scene.count), kept)]))
    parts += _pictures(material, quality, "reference", "this scene")
    parts += _view_section(material.shots, quality, result.quality_views)
    parts += _contents_section(contents)
    parts += _views_section(result.views, material)
    facts = [*_scene_facts("scene", result.scene), *_scene_facts("against", result.reference)]
    parts += _run_section(facts, result.run)
    title = f"{_name(result.scene.path)} against {_name(result.reference.path)}"
    return page(title, "\n".join(parts), _styles(), _script(material))


def _name(path: str) -> str:
    return PurePath(path).name or path


def _styles() -> str:
    return _STYLE + viewer.STYLE + search_chart.STYLE + camera_plan.STYLE


def _script(material: Material) -> str:
    return viewer.SCRIPT if material.shots else ""


def _loss_words(quality: Quality, kind: str) -> str:
    over = f"mean over {len(quality.views)} {kind} view{'s' if len(quality.views) != 1 else ''}"
    if quality.fidelity is None:
        return f"The renders are identical ({over})."
    if quality.drop is not None:
        if quality.drop < 0:  # compression can smooth noise away
            return f"Against the photos PSNR rose by {-quality.drop:.2f} dB ({over})."
        return f"Against the photos {quality.drop:.2f} dB of PSNR were lost ({over})."
    return f"Its renders have a PSNR of {quality.fidelity:.2f} dB against the original's ({over}); there are no photos."


def _quality_tiles(quality: Quality | None) -> list[tuple[str, str]]:
    if quality is None:
        return [("\u2013", "not measured: no cameras")]
    tiles = []
    if quality.drop is not None:
        tiles.append((f"{quality.drop:.2f} dB", "drop against the photos"))
    else:
        tiles.append((f"{quality.modelled_drop:.2f} dB", f"modelled drop, from {quality.base_psnr:g} dB"))
    tiles.append(("identical" if quality.fidelity is None else f"{quality.fidelity:.2f} dB", "fidelity"))
    if quality.ssim_original is not None:
        tiles.append((f"{quality.ssim_original:.4f}", "SSIM against the original"))
    return tiles


def _tiles(items: Iterable[tuple[str, str]]) -> str:
    return (
        '<ul class="tiles">' + "".join(f"<li><b>{text(a)}</b><span>{text(b)}</span></li>" for a, b in items) + "</ul>"
    )


def _facts(items: Iterable[tuple[str, object]]) -> str:
    return "<dl>" + "".join(f"<dt>{text(name)}</dt><dd>{text(value)}</dd>" for name, value in items) + "</dl>"


def _pictures(material: Material, quality: Quality, left: str, right: str) -> list[str]:
    if not material.shots:
        return []
    ramp = f'<span class="ramp" style="background:{css_ramp()}"></span>'
    widest = max(shot.width for shot in material.shots)
    return [
        "<h2>Pictures</h2>",
        viewer.viewer(material.shots, quality, left, right),
        f'<p class="key">Error maps: the largest difference of the three channels, {ramp} from 0 to {ERROR_SCALE:g} of the full '
        "range and more; the same scale in all maps of all pages. All figures are of the renders as drawn; the pictures here are "
        f"JPEG, at most {widest} pixels wide.</p>",
    ]


def _view_section(shots: tuple[Shot, ...], quality: Quality, kind: str) -> list[str]:
    numbers = {shot.view: number for number, shot in enumerate(shots, start=1)}
    photos = any(view.photo_error is not None for view in quality.views)
    heads = ["view", "fidelity", "SSIM"]
    if photos:
        heads = ["view", "drop", "PSNR", "of the original", "SSIM", "of the original", "fidelity", "SSIM to original"]
    rows = []
    for index in quality.by_loss:
        view = quality.views[index]
        name = text(view.name)
        if index in numbers:
            name = Markup(f'<a href="#view-{numbers[index]}">{name}</a>')
        alike = [_decibel(view.fidelity), _similar(view.ssim_original)]
        against = [_decibel(view.drop), _decibel(view.psnr), _decibel(view.original_psnr)]
        rows.append(
            [name, *against, _similar(view.ssim_photo), _similar(view.original_ssim), *alike]
            if photos
            else [name, *alike]
        )
    title = f"The {kind} view{'s' if len(rows) != 1 else ''}, worst first"
    tall = ' class="tall"' if len(rows) > FEW_ROWS else ""
    return [f"<h2>{text(title)}</h2>", f"<div{tall}>{table(heads, rows, title)}</div>"]


def _search_section(result: CompressResult, material: Material) -> list[str]:
    search = result.search
    if search is None or result.target is None or material.target is None:
        words = "fixed rates, nothing was searched" if result.target is None else "no step was measured"
        return ["<h2>Search</h2>", f"<p>Target: {words}.</p>"]
    verdict = "Reached" if result.reached else "Not reached"
    words = f"Target: {result.target}. {verdict} after {len(search.steps)} steps; decided by {decided_words(result)}."
    rows = []
    for number, step in enumerate(search.steps, start=1):
        found = step.measurement
        mark = "chosen" if step is search.chosen else "holds" if step.holds else "misses"
        figures = ["\u2013"] * 3
        if found is not None:
            figures = [_decibel(found.drop, missing=True), _decibel(found.modelled_drop), _decibel(found.fidelity)]
        rates = [f"{step.choice.prune / 1000:g}", f"{step.choice.sh / 1000:g}"]
        name = f"{number} {step.phase}{', estimated' if step.estimated else ''}"
        rows.append([name, format_size(step.size), *figures, mark, *rates, f"{step.seconds:.1f} s"])
    heads = ["step", "size", "drop", "modelled", "fidelity", "target", "prune rate", "SH rate", "time"]
    state = " open" if len(rows) <= FEW_ROWS else ""
    return [
        "<h2>Search</h2>",
        f"<p>{text(words)}</p>",
        f'<div class="two"><div>{search_chart.step_chart(search.steps, search.chosen, material.target)}</div>',
        f"<details{state}><summary>All steps</summary>{table(heads, rows, 'Steps of the search')}</details></div>",
    ]


def _contents_section(contents: Mapping[str, Any] | None) -> list[str]:
    channels = (contents or {}).get("channels")
    if not contents or not channels:
        return []
    size = max(contents["size"], 1)
    packed = contents.get("version") == 1
    heads = ["attribute", "bytes", "share", "rows", *(("bits", "groups") if packed else ("step", "bits a row"))]
    rows: list[tuple[str, float, list[object]]] = []
    for name, item in channels.items():
        more = [item["bits"], item["groups"]] if packed else [_short(item["step"]), _short(item["bits_per_row"])]
        share = f"{100 * item['bytes'] / size:.1f} %"
        rows.append((name, item["bytes"], [_count(item["bytes"]), share, _count(item["rows"]), *more]))
    rest = contents["overhead_bytes"]
    rows.append(("headers and checksums", rest, [_count(rest), f"{100 * rest / size:.1f} %", "", "", ""]))
    each = f", {contents['bits_per_gaussian']:.1f} bits a Gaussian" if contents.get("bits_per_gaussian") else ""
    words = f"{_count(contents['size'])} bytes{each}, container version {contents.get('version')}."
    return [
        "<h2>Bytes of the file</h2>",
        f"<p>{text(words)}</p>",
        search_chart.bar_table(heads, rows, "Bytes by attribute"),
    ]


def _views_section(views: ViewsInfo, material: Material) -> list[str]:
    split = f"{views.total} of {views.width}\u00d7{views.height}: {views.train} training, {views.held_out} held out"
    facts = [("views", split), ("cameras", views.cameras), ("photos", views.images or "none")]
    facts += [("note", note) for note in views.notes]
    parts = ["<h2>Cameras</h2>", _facts(facts)]
    if material.rig is not None:
        numbers = {material.rig.names[index]: number for index, number in _pictured(material)}
        parts.append(camera_plan.plans(material.rig, numbers))
    return parts


def _pictured(material: Material) -> Iterable[tuple[int, int]]:
    """Indices of cameras and the numbers of their pictures."""
    return ((shot.camera, number) for number, shot in enumerate(material.shots, start=1))


def _compress_facts(result: CompressResult) -> list[tuple[str, object]]:
    facts = _scene_facts("scene", result.scene)
    facts.append(("file", result.output or "none (dry run)"))
    ratios = f"{result.ratio:.2f} times smaller ({result.ratio_without_normals:.2f} than a PLY without normals)"
    facts.append(("size", f"{_count(result.size)} bytes, {ratios}"))
    kept = f"{_count(result.count)} of {_count(result.scene.count)} Gaussians, {_count(result.sh_count)} with SH"
    facts.append(("kept", f"{kept} (prune rate {result.prune_rate:g}, SH rate {result.sh_rate:g})"))
    facts.append(("method", result.method + (f", score {result.score}" if result.score else "")))
    if result.steps is not None:
        steps = (f"{name} {value:.3g}" for name, value in result.steps.items() if not isinstance(value, list))
        facts.append(("grid steps", ", ".join(steps)))
    elif result.bits:
        found = " (found by sensitivity)" if result.sensitivity else ""
        facts.append(("bits", ", ".join(f"{name} {bits}" for name, bits in result.bits.items()) + found))
    if result.target is not None:
        facts += [("target", result.target), ("decided by", decided_words(result))]
    if result.scores_saved:
        facts.append(("scores", f"saved to {result.scores_saved}"))
    return facts


def _scene_facts(label: str, scene: SceneInfo) -> list[tuple[str, object]]:
    words = f"{scene.path}: {_count(scene.count)} Gaussians, SH degree {scene.sh_degree}, {format_size(scene.ply_bytes)} as PLY"
    return [(label, words), *(("note", note) for note in scene.notes)]


def _run_section(facts: list[tuple[str, object]], run: RunInfo) -> list[str]:
    facts = list(facts)
    facts.append(("took", f"{run.seconds:.1f} s, of these start-up of the device {run.startup_seconds:.1f} s"))
    facts.append(("memory", memory_words(run)))
    if run.device is not None:
        facts.append(("device", device_words(run.device)))
    stages = [(name, seconds, [f"{seconds:.2f} s"]) for name, seconds in run.stages.items()]
    return [
        "<h2>Run</h2>",
        _facts(facts),
        search_chart.bar_table(["stage", "time"], stages, "Seconds by stage"),
        f"<details><summary>What the words mean</summary>{_facts(_WORDS)}</details>",
    ]


def _decibel(value: float | None, missing: bool = False) -> str:
    return ("\u2013" if missing else "identical") if value is None else f"{value:.3f}"


def _similar(value: float | None) -> str:
    return "\u2013" if value is None else f"{value:.4f}"


def _short(value: float | None) -> str:
    return "\u2013" if value is None else f"{value:.4g}"


def _count(value: int) -> str:
    return f"{value:,}".replace(",", "\u202f")
