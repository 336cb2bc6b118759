"""A scene from a file or from arrays, which can be read, written and drawn."""

import os
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flexgs_edge.api.words import Arrays, Floats, Numbers, StrPath
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.errors import InputError, brief
from flexgs_edge.io.ply import choose_origin, origin_rows
from flexgs_edge.io.reading import Reading
from flexgs_edge.run.inputs import CheckedScene, checked_scene, companions_of, load_scene
from flexgs_edge.run.open_renderer import open_renderer
from flexgs_edge.run.options import NO_CAMERAS, ViewOptions
from flexgs_edge.run.run import open_run
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import REST_WIDTHS, MemorySource, Planes, SceneSource


class Scene:
    """A scene of N Gaussians: at least one, all with finite values. Files are read when values are asked for.

    `Scene.open`, `Scene.from_arrays`, `decode` and `FgsFile` return scenes.

    Parameters
    ----------
    checked : CheckedScene
        The scene, and the settings that its file states.
    """

    def __init__(self, checked: CheckedScene) -> None:
        self.checked = checked

    @classmethod
    def open(
        cls,
        path: StrPath,
        *,
        drop_invalid: bool = False,
        frame: str | None = None,
        lod: int | None = None,
        sh_degree: int | None = None,
        crop: str | None = None,
    ) -> "Scene":
        """Open a scene file (`.ply`, `.fgs`, `.spz`, `.sog`, `.compressed.ply`) or a model folder.

        Parameters
        ----------
        path : path
            The file or folder. `compress` finds cameras and photos beside it, as on the command line.
        drop_invalid : bool
            Leave out Gaussians with NaN, infinity or zero quaternions. Default: raise `InputError` for them.
        frame : str, optional
            Directions of the file's axes, such as `RUB` (x right, y up, z back). The scene has them in RDF. Default: as the
            file says, else as its format has it.
        lod : int, optional
            Level of detail of a streamed scene, 0 is the finest. Default: the finest that is there.
        sh_degree : int, optional
            Leave out SH above this degree. Default: keep all.
        crop : str, optional
            Keep only Gaussians inside: `x,y,z,X,Y,Z`, `x,y,z,R`, or the path of a JSON file, as for `--crop`. Default: keep all.

        Raises
        ------
        InputError
            If there is no such file, or its values are invalid.
        FormatError
            If the file does not follow its format.
        """
        if not isinstance(path, (str, os.PathLike)):
            raise InputError(f"path={brief(path)}: expected a path, found {type(path).__name__}")
        return cls(load_scene(path, drop_invalid, Reading.of(frame, lod, sh_degree, crop)))

    @classmethod
    def from_arrays(
        cls,
        *,
        means: Numbers,
        log_scales: Numbers,
        quats: Numbers,
        opacity_logits: Numbers,
        sh_dc: Numbers,
        sh_rest: Numbers | None = None,
        antialiased: bool = False,
        drop_invalid: bool = False,
    ) -> "Scene":
        """Make a scene from the values that training stores, before exp, sigmoid and normalisation. Copies the values.

        Parameters
        ----------
        means : np.ndarray
            [N, 3], world coordinates. Give positions far from zero as float64: they keep all digits. All other values become
            float32.
        log_scales : np.ndarray
            [N, 3], natural logarithms of the standard deviations.
        quats : np.ndarray
            [N, 4], w x y z, any norm.
        opacity_logits : np.ndarray
            [N], opacities before the sigmoid.
        sh_dc : np.ndarray
            [N, 3], SH of degree 0.
        sh_rest : np.ndarray, optional
            [N, K, 3], SH above degree 0. K is 3, 8, 15 or 24 at SH degree 1 to 4. Default: none.
        antialiased : bool
            The scene was trained with opacities reduced to make up for the screen-space dilation. Default: no.
        drop_invalid : bool
            See `open`.

        Raises
        ------
        InputError
            If an argument is invalid. The message names it, what was expected and what was found.
        """
        first = np.asarray(means)
        count = len(first) if first.ndim else 0
        rest = np.zeros((count, 0, 3), np.float32) if sh_rest is None else np.asarray(sh_rest)
        places = _array("means", first, count, (3,)).T
        planes: Planes = {
            "log_scales": _plane(_array("log_scales", log_scales, count, (3,)).T),
            "quats": _plane(_array("quats", quats, count, (4,)).T),
            "opacity_logits": _plane(_array("opacity_logits", opacity_logits, count, ())[None]),
            "sh_dc": _plane(_array("sh_dc", sh_dc, count, (3,)).T),
            # Planes hold all coefficients of red, then of green, then of blue.
            "sh_rest": _plane(_rest(rest, count).transpose(2, 1, 0).reshape(3 * rest.shape[1], count)),
        }
        origin = choose_origin(places[:, origin_rows(count)].T.astype(np.float64)) if count else np.zeros(3)
        planes["means"] = _plane(places.astype(np.float64) - origin[:, None] if origin.any() else places)
        source = MemorySource(planes, origin=origin)
        # Near zero, NumPy's default type says nothing of what the values were.
        source.doubles = bool(origin.any()) and places.dtype == np.float64
        checked = checked_scene(source, drop_invalid=drop_invalid)
        settings = {"antialiased": True} if antialiased else {}
        return cls(CheckedScene(None, checked.source, count, checked.source.sh_degree, settings))

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return self.source.count

    @property
    def sh_degree(self) -> int:
        """SH degree, 0 to 4."""
        return self.source.sh_degree

    @property
    def antialiased(self) -> bool:
        """Whether its file or model folder asks to draw the scene antialiased."""
        path, stored = self.checked.path, self.checked.settings
        if "antialiased" in stored:
            return stored["antialiased"] is True
        return path is not None and companions_of(path).antialiased is True

    @property
    def source(self) -> SceneSource:
        """The lazy source of the scene. It reads planes [width, n] by row range, for other functions of this package."""
        return self.checked.source

    def arrays(self, rows: slice | Sequence[int] | NDArray[np.integer] | None = None) -> Arrays:
        """Read the stored values of some Gaussians, in the shapes of `from_arrays`. Each call returns new arrays.

        Parameters
        ----------
        rows : slice or integers, optional
            Gaussians to read. Default: all of them.
        """
        source = self.source
        if isinstance(rows, slice):
            span = range(*rows.indices(source.count))
            if span.step == 1:
                planes = source.read(slice(span.start, max(span.start, span.stop)), list(FIELD))
                return _arrays(planes, source.origin)
            rows = list(span)
        if rows is not None:
            source = source.select(np.asarray(rows, np.int64 if len(rows) == 0 else None))
        return _arrays(source.read(slice(0, source.count), list(FIELD)), source.origin)

    def save(self, path: StrPath, *, force: bool = False) -> None:
        """Write a `.ply`, `.spz`, `.sog` or `.compressed.ply`, as `decompress` does. Use `compress` for a `.fgs`."""
        decompress(self.checked, path, force)

    def render(
        self,
        camera: Camera,
        *,
        device: str | None = None,
        memory_limit: int | None = None,
        near: float | None = None,
        background: tuple[float, float, float] | None = None,
    ) -> Floats:
        """Draw one view. Each call opens the device and loads the scene; `render_views` does so once for many views.

        Parameters
        ----------
        camera : Camera
            The camera, in world coordinates.
        device : str, optional
            OpenCL device (number, part of its name, `cpu` or `gpu`) or `numpy`. Default: the one that `devices` shows as
            chosen.
        memory_limit : int, optional
            Bytes for the whole process. Default: three quarters of the free memory.
        near, background : optional
            Near plane in scene units, and background colour. Default: as the file states, else 0.2 and black.

        Returns
        -------
        np.ndarray
            [H, W, 3] float32, not clamped to [0, 1].
        """
        options = ViewOptions(
            cameras=NO_CAMERAS, device=device, memory_limit=memory_limit, near=near, background=background
        )
        run = open_run(self.checked, options, photos=False)
        with open_renderer(run) as renderer, renderer.load(run.source) as loaded:
            return np.ascontiguousarray(renderer.render(loaded, camera), np.float32)

    def __repr__(self) -> str:
        return f"Scene({self.source.name!r}: {self.count} Gaussians, SH degree {self.sh_degree})"


def _array(name: str, values: Numbers, count: int, inner: tuple[int, ...]) -> np.ndarray:
    """Convert `values` to an array, and check that it holds [N, *inner] numbers."""
    array = np.asarray(values)
    shape = ("N" if name == "means" else count, *inner)
    if array.shape != (count, *inner):
        raise InputError(f"{name}: expected shape [{', '.join(map(str, shape))}], found {list(array.shape)}")
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name}: expected float32 numbers, found {array.dtype}")
    return array


def _rest(values: np.ndarray, count: int) -> np.ndarray:
    """Check that `values` is [N, K, 3] with a K that belongs to an SH degree."""
    if values.ndim == 3 and 3 * values.shape[1] in REST_WIDTHS:
        return _array("sh_rest", values, count, (values.shape[1], 3))
    raise InputError(f"sh_rest: expected shape [{count}, K, 3] with K of 0, 3, 8, 15 or 24, found {list(values.shape)}")


def _plane(values: np.ndarray) -> np.ndarray:
    """Copy `values` to a contiguous [width, N] f32 array."""
    with np.errstate(over="ignore"):  # the check of the scene reports infinity
        return np.array(values, np.float32, order="C")


def _arrays(planes: Planes, origin: np.ndarray) -> Arrays:
    means, rest = planes["means"].T, planes["sh_rest"]
    count = len(means)
    return {
        "means": np.ascontiguousarray(means) if not origin.any() else means.astype(np.float64) + origin,
        "log_scales": np.ascontiguousarray(planes["log_scales"].T),
        "quats": np.ascontiguousarray(planes["quats"].T),
        "opacity_logits": planes["opacity_logits"].reshape(count),
        "sh_dc": np.ascontiguousarray(planes["sh_dc"].T),
        "sh_rest": np.ascontiguousarray(rest.reshape(3, len(rest) // 3, count).transpose(2, 1, 0)),
    }
