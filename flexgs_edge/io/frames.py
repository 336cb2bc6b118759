"""Frames: which way the axes of a scene point, and scenes in another frame than their file's.

A frame is named by the directions of x, y and z: R or L (right, left), U or D (up, down), F or B (forward, back). Inside the
program every scene is in INRIA's frame, RDF, which is COLMAP's. All frames have the same three axes, so that a change of
frame only changes signs: of positions, of quaternions and of spherical harmonics.
"""

from dataclasses import dataclass

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import Planes, SceneSource, WrappedSource

_POSITIVE = "RDF"
_NEGATIVE = "LUB"
_ODD_AXES = (
    *("y", "z", "x"),
    *("xy", "yz", "", "xz", ""),
    *("y", "xyz", "y", "z", "x", "z", "x"),
    *("xy", "yz", "xy", "yz", "", "xz", "", "xz", ""),
)  # The axes in which each SH function above degree 0 is odd, in the order of INRIA's coefficients, for degrees 1 to 4


@dataclass(frozen=True)
class Frame:
    """Directions of the axes, relative to RDF."""

    name: str  # three letters, such as `RUB`

    def __post_init__(self) -> None:
        letters = tuple(zip(_POSITIVE, _NEGATIVE, strict=True))
        if len(self.name) != 3 or any(letter not in pair for letter, pair in zip(self.name, letters)):
            raise InputError(
                f"frame {self.name!r}: expected three letters, R or L (x), then U or D (y), then F or B (z), such as RDF or RUB"
            )

    @property
    def signs(self) -> np.ndarray:
        """[3] f32 of 1 and -1: this frame's coordinates times these are RDF's, and the other way round."""
        return np.array([1 if a == b else -1 for a, b in zip(self.name, _POSITIVE)], np.float32)

    @property
    def quat_signs(self) -> np.ndarray:
        """[4] f32, signs of w x y z. For a mirrored frame too: a Gaussian looks the same when its own axes turn round."""
        x, y, z = self.signs
        return np.array([1, y * z, z * x, x * y], np.float32)

    def sh_signs(self, sh_degree: int) -> np.ndarray:
        """[K] f32, signs of the SH coefficients above degree 0 of one colour channel."""
        by_axis = dict(zip("xyz", self.signs, strict=True))
        signs = [np.prod([by_axis[axis] for axis in axes]) for axes in _ODD_AXES[: sh_rest_count(sh_degree)]]
        return np.array(signs, np.float32)


RDF = Frame("RDF")  # x right, y down, z forward: INRIA's and COLMAP's frame, and the one inside this program
RUB = Frame("RUB")  # x right, y up, z back: the frame of OpenGL, three.js and `.spz`
LUF = Frame("LUF")  # x left, y up, z forward: the frame of glTF


class FrameSource(WrappedSource):
    """A scene with its axes turned from RDF into `frame`, or from `frame` into RDF: both are the same change of signs."""

    def __init__(self, parent: SceneSource, frame: Frame) -> None:
        super().__init__(parent)
        self.frame = frame
        self.origin = parent.origin * frame.signs + 0.0  # no -0.0, which would show in files and messages

    def change(self, planes: Planes) -> None:
        with np.errstate(invalid="ignore"):  # NaN of the kind that signals; check_scene reports all of them
            if "means" in planes:
                planes["means"] *= self.frame.signs[:, None]
            if "quats" in planes:
                planes["quats"] *= self.frame.quat_signs[:, None]
            if "sh_rest" in planes and self.sh_degree:
                planes["sh_rest"] *= np.tile(self.frame.sh_signs(self.sh_degree), 3)[:, None]


def in_frame(source: SceneSource, frame: Frame) -> SceneSource:
    """`source` with its axes changed between RDF and `frame`; `source` itself if nothing changes."""
    return source if frame == RDF else FrameSource(source, frame)
