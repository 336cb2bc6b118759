"""A sequence of cameras, from files or from matrices."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from flexgs_edge.api.words import StrPath
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.json_values import MAX_SIDE, ROTATION_TOLERANCE
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import InputError


class Cameras(Sequence[Camera]):
    """A sequence of cameras. A slice of it is again `Cameras`.

    Parameters
    ----------
    cameras : iterable of Camera
        The cameras, in the order of the sequence.
    path : path, optional
        The file they were read from, so that `compress` finds photos beside it. Default: none.
    """

    def __init__(self, cameras: Iterable[Camera], path: StrPath | None = None) -> None:
        self._cameras = tuple(cameras)
        self.path = None if path is None else os.fspath(path)

    @classmethod
    def open(cls, path: StrPath, *, ignore_distortion: bool = False) -> Cameras:
        """Read cameras, in order of name.

        Parameters
        ----------
        path : path
            INRIA's cameras.json, a transforms.json, a COLMAP model, or a folder that holds one.
        ignore_distortion : bool
            Use the poses of cameras with lens distortion, without their photos. Default: raise `InputError` for them.

        Raises
        ------
        InputError
            If the cameras cannot be read.
        """
        return cls(read_cameras(path, ignore_distortion), path)

    @classmethod
    def from_matrices(
        cls, world_to_camera: ArrayLike, intrinsics: ArrayLike, sizes: ArrayLike, names: Sequence[str] | None = None
    ) -> Cameras:
        """Make V cameras from matrices, such as those of COLMAP, OpenCV or gsplat.

        Parameters
        ----------
        world_to_camera : array_like
            [V, 4, 4]: world to camera, with x right, y down, z forward, as in COLMAP and OpenCV.
        intrinsics : array_like
            [V, 3, 3], pixels, without skew. (0, 0) is the corner of the image, so its centre is (W / 2, H / 2).
        sizes : array_like
            [V, 2]: width and height in pixels.
        names : sequence of str, optional
            V different names. Default: view_00000, view_00001, ...

        Raises
        ------
        InputError
            If an argument is invalid. The message names it, what was expected and what was found.
        """
        poses = _numbers("world_to_camera", world_to_camera, (4, 4), None)
        lenses = _numbers("intrinsics", intrinsics, (3, 3), len(poses))
        pixels = _numbers("sizes", sizes, (2,), len(poses))
        labels = [f"view_{i:05d}" for i in range(len(poses))] if names is None else list(names)
        if len(labels) != len(poses) or len(set(labels)) != len(labels):
            raise InputError(
                f"names: expected {len(poses)} names that differ, found {len(labels)}, {len(set(labels))} different"
            )
        return cls(
            _camera(i, name, pose, lens, size)
            for i, (name, pose, lens, size) in enumerate(zip(labels, poses, lenses, pixels, strict=True))
        )

    @overload
    def __getitem__(self, index: int) -> Camera: ...
    @overload
    def __getitem__(self, index: slice) -> Cameras: ...
    def __getitem__(self, index: int | slice) -> Camera | Cameras:
        return Cameras(self._cameras[index]) if isinstance(index, slice) else self._cameras[index]

    def __len__(self) -> int:
        return len(self._cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self._cameras)

    def __repr__(self) -> str:
        return f"Cameras({len(self)}{'' if self.path is None else f' of {self.path}'})"


def _numbers(name: str, values: ArrayLike, inner: tuple[int, ...], count: int | None) -> np.ndarray:
    """Convert `values` to [V, *inner] f64, and check that they are finite."""
    array = np.asarray(values)
    shape = "[" + ", ".join(map(str, ("V" if count is None else count, *inner))) + "]"
    right = array.ndim == 1 + len(inner) and array.shape[1:] == inner and count in (None, len(array))
    if not right or array.dtype.kind not in "fiu":
        raise InputError(f"{name}: expected {shape} numbers, found shape {list(array.shape)} of {array.dtype}")
    numbers = array.astype(np.float64)
    if not np.isfinite(numbers).all():
        raise InputError(f"{name}: expected finite numbers, found {numbers[~np.isfinite(numbers)][0]}")
    return numbers


def _camera(i: int, name: str, pose: np.ndarray, lens: np.ndarray, size: np.ndarray) -> Camera:
    turn = pose[:3, :3]
    off = float(np.abs(turn @ turn.T - np.eye(3)).max())
    if not off <= ROTATION_TOLERANCE or np.linalg.det(turn) < 0 or np.any(pose[3] != (0, 0, 0, 1)):
        raise InputError(
            f"world_to_camera[{i}]: expected a rotation and a translation above the row 0 0 0 1, found {pose.tolist()}"
        )
    if lens[0, 0] <= 0 or lens[1, 1] <= 0 or lens[0, 1] or lens[1, 0] or np.any(lens[2] != (0, 0, 1)):
        raise InputError(
            f"intrinsics[{i}]: expected [fx, 0, cx], [0, fy, cy], [0, 0, 1] with focal lengths above 0, found {lens.tolist()}"
        )
    if np.any(size != np.rint(size)) or np.any(size < 1) or np.any(size > MAX_SIDE):
        raise InputError(f"sizes[{i}]: expected whole numbers of pixels from 1 to {MAX_SIDE}, found {size.tolist()}")
    return Camera(
        name=name,
        width=int(size[0]),
        height=int(size[1]),
        rotation=turn,
        translation=pose[:3, 3],
        fx=float(lens[0, 0]),
        fy=float(lens[1, 1]),
        # A Camera has its origin at the centre of the first pixel.
        cx=float(lens[0, 2]) - 0.5,
        cy=float(lens[1, 2]) - 0.5,
    )
