"""The table of a Gaussian's attributes: names, widths, meaning and PLY properties. No other place repeats them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Field:
    """One attribute of a Gaussian."""

    name: str  # name of the field in our arrays and files
    space: str  # meaning of the stored numbers, such as a logarithm
    ply: tuple[str, ...]  # names of INRIA's PLY properties, one a channel (for `sh_rest` a prefix: see `ply_names`)
    bits: str  # name in `--bits` and in the container

    def width(self, sh_degree: int) -> int:
        """Number of channels in a scene with this SH degree."""
        return 3 * sh_rest_count(sh_degree) if self.name == "sh_rest" else len(self.ply)

    def ply_names(self, sh_degree: int) -> tuple[str, ...]:
        """Names of PLY properties in channel order (`sh_rest` is channel-major: all red, all green, all blue)."""
        if self.name == "sh_rest":
            return tuple(f"f_rest_{i}" for i in range(self.width(sh_degree)))
        return self.ply


OPACITY_LIMIT = 7.0
"""Logits of opacities 0 and 1 are -7 and 7. Files hold these opacities, and no finite logit reaches them. Half a step of 8
bits from the end is 6.2."""


def sh_rest_count(sh_degree: int) -> int:
    """Number of SH coefficients above degree 0, for one colour channel.

    >>> [sh_rest_count(d) for d in range(5)]
    [0, 3, 8, 15, 24]
    """
    return (sh_degree + 1) ** 2 - 1


FIELDS: tuple[Field, ...] = (
    Field("means", "position, scene units, world minus the source's origin", ("x", "y", "z"), "xyz"),
    Field("sh_dc", "SH coefficient of degree 0, red green blue", ("f_dc_0", "f_dc_1", "f_dc_2"), "dc"),
    Field("sh_rest", "SH coefficients above degree 0, channel-major", (), "rest"),
    Field("opacity_logits", "logit of the opacity", ("opacity",), "opacity"),
    Field(
        "log_scales", "natural log of the standard deviations, scene units", ("scale_0", "scale_1", "scale_2"), "scale"
    ),
    Field("quats", "rotation quaternion w x y z, any norm", ("rot_0", "rot_1", "rot_2", "rot_3"), "rot"),
)  # All fields, in the order of INRIA's PLY

FIELD: dict[str, Field] = {field.name: field for field in FIELDS}
