"""Cameras as they would be if their file were meant in another convention, to name the one that fits a scene."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.small_matrices import product as matrix_product

_MIRROR = np.diag([-1.0, 1.0, 1.0])
_OPENGL = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class Convention:
    """Another meaning of the poses in a camera file."""

    words: str  # What it is, as the end of the sentence "the cameras fit if ..."
    turn: np.ndarray  # [3, 3] f64, signed permutation from the world of the file to that of the scene
    opengl: bool = False  # The cameras' own axes are OpenGL's (y up, looking along -z)
    inverse: bool = False  # Poses are world to camera where camera to world was read, or the other way round

    @property
    def signs(self) -> np.ndarray | None:
        """[3] f64 of 1 and -1 if the axes of the world only change their directions, else `None`."""
        signs: np.ndarray = np.diagonal(self.turn)
        return signs if np.all(signs) and not (self.opengl or self.inverse) else None

    def applied(self, camera: Camera) -> tuple[Camera, bool]:
        """The camera by this convention; and whether its picture is to be mirrored, left to right."""
        rotation, center = camera.rotation, camera.center
        if self.inverse:
            rotation, center = rotation.T, camera.translation
        if self.opengl:
            rotation = matrix_product(_OPENGL, rotation)
        if self.opengl and self.inverse:  # the reader's change of axes stood on the other side
            rotation, center = matrix_product(rotation, _OPENGL), matrix_product(_OPENGL, center)
        rotation = matrix_product(rotation, self.turn.T)
        mirrored = float(np.linalg.det(self.turn)) < 0
        if mirrored:  # a mirrored world is the mirrored picture of a turned camera
            rotation = matrix_product(_MIRROR, rotation)
        translation = matrix_product(-rotation, matrix_product(self.turn, center))
        cx = camera.width - 1 - camera.cx if mirrored else camera.cx
        return replace(camera, rotation=rotation, translation=translation, cx=cx), mirrored


def other_conventions() -> Iterator[Convention]:
    """The 47 other directions and orders of the world's axes, then cameras in OpenGL's axes, and inverted poses."""
    same = np.eye(3)
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if not np.array_equal(turn, same):
                axes = ", ".join(("-" if sign < 0 else "") + "xyz"[axis] for axis, sign in zip(order, signs))
                yield Convention(f"their world's x, y, z are taken as the scene's {axes}", turn)
    yield Convention("their own axes are taken as OpenGL's (y up, looking along -z)", same, opengl=True)
    yield Convention("their poses are inverted (world to camera, camera to world)", same, inverse=True)
    yield Convention("their poses are inverted and their own axes taken as OpenGL's", same, opengl=True, inverse=True)
