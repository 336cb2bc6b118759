"""Scores kept between runs, and taken again only for the same scene, poses and kind of score."""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.cameras import Camera
from flexgs_edge.errors import InputError
from flexgs_edge.scene.atomic import atomic_write
from flexgs_edge.scene.source import SceneSource

ROWS = 1 << 16
"""Rows of the scene hashed at a time."""
FIELDS = ("means", "log_scales", "quats", "opacity_logits")
"""What hits, weights and volumes depend on; colours change none of them."""


def fingerprint(
    source: SceneSource,
    cameras: Sequence[Camera],
    kind: str,
    near: float,
    extent: str,
    antialiased: bool = False,
    fields: Sequence[str] = FIELDS,
) -> str:
    """A digest of everything that scores depend on; reads the scene once, by default without its colours.

    Parameters
    ----------
    source : SceneSource
        The scene as it is scored: rows left out are not part of it.
    cameras : sequence of Camera
        The training poses, at the size they are drawn. Their names do not count.
    kind, near, extent, antialiased : str, float, str, bool
        Which score, and how views are drawn.
    fields : sequence of str
        What the score depends on.
    """
    digest = hashlib.sha256(
        f"{__version__} {kind} {near!r} {extent} {antialiased} {source.count} {len(cameras)}".encode()
    )
    digest.update(source.origin.astype("<f8").tobytes())
    for camera in cameras:
        numbers = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        for values in (numbers, camera.rotation, camera.translation):
            digest.update(np.asarray(values, "<f8").tobytes())
    for rows in source.chunks(ROWS):
        for plane in source.read(rows, fields).values():
            digest.update(np.ascontiguousarray(plane, "<f4").data)
    return digest.hexdigest()


class ScoreCache:
    """A file with the scores of one scene seen from one set of poses.

    Parameters
    ----------
    path : path
        Made by `save`; need not exist.
    fingerprint : str
        Of what is to be scored.
    """

    def __init__(self, path: str | Path, fingerprint: str) -> None:
        self.path, self.fingerprint = Path(path), fingerprint

    def load(self, count: int) -> np.ndarray | None:
        """[count] f64, or `None` where there is no file yet or it is of something else.

        Raises
        ------
        InputError
            When the file holds no scores that `save` wrote: it would be overwritten.
        """
        try:
            with open(self.path, "rb") as file, np.load(file, allow_pickle=False) as archive:
                key, scores = str(archive["fingerprint"]), archive["scores"]
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError, KeyError, TypeError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(
                f"{self.path}: expected scores kept by an earlier --score-cache, found something else ({error}); "
                "remove the file, or name another one"
            ) from error
        same = key == self.fingerprint and scores.shape == (count,) and scores.dtype == np.float64
        return scores if same else None

    def save(self, scores: np.ndarray) -> None:
        """Write, in place of what was there."""
        with atomic_write(self.path, force=True) as file:
            np.savez(file, fingerprint=np.array(self.fingerprint), scores=scores)
