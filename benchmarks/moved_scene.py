"""Moves, scales and turns a scene together with its cameras, so that the pictures stay the same."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.kernels.twins.project import sh_basis
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import MemorySource, SceneSource

NO_TURN = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class Similarity:
    """x' = factor * turn @ x + shift.

    Parameters
    ----------
    factor : float
        Scale.
    turn : np.ndarray
        [4] f64, rotation as a unit quaternion w x y z.
    shift : np.ndarray
        [3] f64, translation in units of the new scene.
    """

    factor: float
    turn: np.ndarray
    shift: np.ndarray

    @classmethod
    def drawn(cls, factor: float, seed: int = 0) -> Similarity:
        """A random turn and a random shift, of about 3 units of the new scene."""
        rng = np.random.default_rng(seed)
        turn = rng.normal(size=4)
        return cls(factor, turn / np.linalg.norm(turn), 3 * factor * rng.normal(size=3))

    @property
    def matrix(self) -> np.ndarray:
        """[3, 3] f64, the rotation as a matrix."""
        w, x, y, z = self.turn
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return np.array(rows)

    def scene(self, source: SceneSource) -> MemorySource:
        """The moved scene. Positions, sizes and rotations change, and SH turn degree by degree."""
        planes = source.read(slice(0, source.count), list(FIELD))
        means = planes["means"].astype(np.float64) + source.origin[:, None]
        moved = {
            **planes,
            "means": self.factor * (self.matrix @ means),
            "log_scales": planes["log_scales"] + np.log(self.factor),
        }
        # Without a turn, rotations and SH keep their bits.
        if not np.array_equal(self.turn, NO_TURN):
            moved["quats"] = _product(self.turn, planes["quats"].astype(np.float64))
            rest = planes["sh_rest"].reshape(3, sh_rest_count(source.sh_degree), source.count)
            turned = rest.astype(np.float64)
            for degree in range(1, source.sh_degree + 1):
                band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
                turned[:, band] = turn_of_band(self.matrix, degree) @ rest[:, band]
            moved["sh_rest"] = turned.reshape(planes["sh_rest"].shape)
        return MemorySource(
            {name: values.astype(np.float32) for name, values in moved.items()}, source.sh_degree, self.shift
        )

    def camera(self, camera: Camera) -> Camera:
        """The same view of the moved scene."""
        rotation = camera.rotation @ self.matrix.T
        return replace(camera, rotation=rotation, translation=self.factor * camera.translation - rotation @ self.shift)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[4, n] Hamilton products of one quaternion ([4]) and many ([4, n])."""
    w, x, y, z = a
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    product: np.ndarray = matrix @ b
    return product


def turn_of_band(matrix: np.ndarray, degree: int) -> np.ndarray:
    """[2l + 1, 2l + 1] f64, matrix that turns SH coefficients of degree l when the world is turned by `matrix`.

    It is fitted by least squares: a colour seen along d before is seen along `matrix @ d` after. Functions of one degree
    stay functions of that degree, so the fit is exact.
    """
    directions = np.random.default_rng(degree).normal(size=(3, 200))
    directions /= np.linalg.norm(directions, axis=0)
    band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
    before = np.array(sh_basis(degree, *directions)[band]).T
    after = np.array(sh_basis(degree, *(matrix @ directions))[band]).T
    fitted, *_ = np.linalg.lstsq(after, before, rcond=None)
    result: np.ndarray = fitted
    return result
