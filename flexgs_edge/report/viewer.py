"""Pictures of views that a slider wipes between; without script they stand side by side."""

from __future__ import annotations

from collections.abc import Sequence

from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.report.html import data_uri, text
from flexgs_edge.report.material import Shot

KIND = "image/jpeg"

STYLE = """
.views { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 1.5rem; }
.view { position: relative; min-width: 0; } .view:first-child { grid-column: 1 / -1; }
@media (max-width: 45rem) { .views { grid-template-columns: minmax(0, 1fr); } }
.view h3 { font-size: 1rem; margin: 0; } .view p { margin: 0 0 .5rem; color: var(--soft); font-size: .9rem; }
.view h3 b { display: inline-block; min-width: 1.5em; margin-right: .4em; border-radius: 1em; text-align: center;
  color: var(--paper); background: var(--ink); }
.stage { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 9rem), 1fr)); gap: .5rem; }
.stage figure { margin: 0; } .stage img { display: block; width: 100%; border-radius: 6px; background: var(--band); }
.controls { display: none; }
.js .stage { position: relative; display: block; overflow: hidden; border-radius: 6px; touch-action: pan-y;
  cursor: ew-resize; --cut: 50%; }
.js .stage, .js .controls { width: min(100%, 80vh * var(--width) / var(--height)); margin: 0 auto; }
.js .stage figure { display: none; } .js .stage figure.original { display: block; }
.js .stage[data-right=compressed] figure.compressed, .js .stage[data-right=error] figure.error,
  .js .stage[data-right=photo] figure.photo
  { display: block; position: absolute; inset: 0; clip-path: inset(0 0 0 var(--cut)); }
.js .stage img { border-radius: 0; user-select: none; }
.js .stage figcaption { position: absolute; left: .5rem; bottom: .5rem; padding: 0 .5rem; border-radius: 1em;
  color: #fff; background: #0009; font-size: .8rem; }
.js .stage figure:not(.original) figcaption { left: auto; right: .5rem; }
.js .stage::after { content: ""; position: absolute; top: 0; bottom: 0; left: var(--cut); width: 2px;
  margin-left: -1px; background: #fff; box-shadow: 0 0 3px #000; pointer-events: none; }
.js .controls { display: block; } .controls input[type=range] { display: block; width: 100%; margin: .4rem 0 0;
  accent-color: var(--mark); min-height: 1.6rem; }
.controls fieldset { display: flex; flex-wrap: wrap; gap: .2rem 1rem; margin: 0; padding: 0; border: 0;
  font-size: .9rem; }
.controls legend { position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%); }
.controls label { padding: .15rem 0; } .controls input[type=radio] { accent-color: var(--mark); margin: 0 .3rem 0 0; }
.ramp { display: inline-block; width: 6rem; height: .7rem; margin: 0 .3rem; border-radius: 2px; }
"""

SCRIPT = """
(function () {
  document.documentElement.classList.add('js');
  document.querySelectorAll('.view').forEach(function (view) {
    var stage = view.querySelector('.stage'), range = view.querySelector('input[type=range]');
    function show() {
      stage.style.setProperty('--cut', range.value + '%');
      var right = view.querySelector('input[type=radio]:checked');
      stage.dataset.right = right.value;
      var left = stage.querySelector('.original figcaption').textContent;
      range.setAttribute('aria-valuetext', range.value + ' % ' + left + ', the rest ' + right.parentNode.textContent.trim());
    }
    function follow(event) {
      var box = stage.getBoundingClientRect();
      range.value = Math.round(100 * (event.clientX - box.left) / box.width);
      show();
    }
    stage.addEventListener('pointerdown', function (event) { stage.setPointerCapture(event.pointerId); follow(event); });
    stage.addEventListener('pointermove', function (event) { if (event.buttons) follow(event); });
    view.addEventListener('input', show);
    show();
  });
})();
"""


def viewer(shots: Sequence[Shot], quality: Quality, left: str, right: str) -> str:
    """All views with their pictures.

    Parameters
    ----------
    left, right : str
        What the two scenes are called, such as `original` and `compressed`.
    """
    views = (_view(number, shot, quality.views[shot.view], left, right) for number, shot in enumerate(shots, start=1))
    return '<div class="views">\n' + "\n".join(views) + "\n</div>"


def _view(number: int, shot: Shot, figures: ViewQuality, left: str, right: str) -> str:
    name = text(figures.name)
    layers = [
        ("original", left, shot.original),
        ("compressed", right, shot.compressed),
        ("error", "error map", shot.error),
    ]
    if shot.photo is not None:
        layers.append(("photo", "photo", shot.photo))
    pictures = "\n".join(
        f'<figure class="{kind}"><img src="{data_uri(data, KIND)}" width="{shot.width}" height="{shot.height}" '
        f'alt="{text(label)}, view {name}" draggable="false"><figcaption>{text(label)}</figcaption></figure>'
        for kind, label, data in layers
    )
    choices = " ".join(
        f'<label><input type="radio" name="right-{number}" value="{kind}"{" checked" if index == 0 else ""}>'
        f"{text(label)}</label>"
        for index, (kind, label, _) in enumerate(layers[1:])
    )
    return (
        f'<article class="view" id="view-{number}" style="--width:{shot.width};--height:{shot.height}">\n'
        f"<h3><b>{number}</b>{shot.place}: {name}</h3>\n"
        f"<p>{text(view_words(figures))}</p>\n"
        f'<div class="stage">\n{pictures}\n</div>\n<div class="controls">'
        f'<input type="range" min="0" max="100" value="50" aria-label="Wipe between both pictures of view {name}">'
        f"<fieldset><legend>{text(left)} beside</legend>{choices}</fieldset></div>\n</article>"
    )


def view_words(view: ViewQuality) -> str:
    """The figures of a view in a line."""
    words = ["renders identical" if view.fidelity is None else f"fidelity {view.fidelity:.2f} dB"]
    if view.drop is not None:
        words.insert(0, f"drop {view.drop:.2f} dB")
    return ", ".join(words)
