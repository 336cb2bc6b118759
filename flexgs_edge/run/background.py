"""The background before which a scene without photos is compared."""

from __future__ import annotations

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.scene.source import SceneSource

Colour = tuple[float, float, float]

ALIKE = 0.1
"""A colour is that of the background if no channel differs by more than this."""
MOST_SHARE = 0.1
"""We take another background if more than this share of the matter has the colour of the one before."""
BACKGROUNDS: dict[str, Colour] = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0)}
SAMPLE_ROWS = 1 << 16
LARGEST = 0.99  # Splats larger than this quantile count as this large: a sky is not most of the matter


def contrasting_background(source: SceneSource, usual: Colour) -> tuple[Colour, str | None]:
    """A background that the scene stands out from: `usual` unless much of the matter has its colour.

    Before its own colour, matter could go without any picture telling. Returns the colour, and a note if it is another one.
    """
    rows = np.arange(0, source.count, max(-(-source.count // SAMPLE_ROWS), 1))
    planes = source.read(rows, ["sh_dc", "opacity_logits", "log_scales"])
    colours = planes["sh_dc"].astype(np.float64) * SH_C0 + 0.5
    logs = np.sort(np.clip(planes["log_scales"].astype(np.float64), -40, 40), axis=0)[1:].sum(axis=0)
    areas = np.exp(np.minimum(logs, np.quantile(logs, LARGEST)))
    areas /= 1 + np.exp(-np.clip(planes["opacity_logits"][0].astype(np.float64), -60, 60))

    def share(background: Colour) -> float:
        alike = np.all(np.abs(np.clip(colours, 0, 1) - np.array(background)[:, None]) <= ALIKE, axis=0)
        return float(areas[alike].sum() / max(float(areas.sum()), 1e-300))

    hidden = share(usual)
    if hidden <= MOST_SHARE:
        return usual, None
    name = next((name for name, each in BACKGROUNDS.items() if share(each) <= MOST_SHARE), "green")
    return BACKGROUNDS[
        name
    ], f"compared before {name}: {100 * hidden:.0f} % of the matter has the colour of the background"
