"""Draw views on the workers of a Dask cluster; sums and pictures come back in the order of the views.

The same numbers are added in the same order as on one machine, so the file does not depend on which worker drew a view.
Dask schedules the views. If a worker is lost, another one draws its views again.
"""

from __future__ import annotations

import uuid
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import DeviceError, InputError
from flexgs_edge.progress import LOG
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource
from flexgs_edge.views.one_view import Drawn
from flexgs_edge.views.worker import Drawing, draw_planes, draw_sums, worker_version

AHEAD = 2  # Views asked for ahead, for each worker; their sums wait in the memory of the workers
SENDINGS = 3  # How many times a scene is sent before we give up, if all workers that held it were lost
CONNECT_SECONDS = 30


class Cluster:
    """Workers that draw views; a context manager.

    `address`: address of a Dask scheduler, such as `tcp://10.0.0.5:8786`. `drawing`: how workers draw. Raises
    `InputError` if the package is missing, nobody answers, or workers run another version of this program.
    """

    def __init__(self, address: str, drawing: Drawing) -> None:
        if find_spec("distributed") is None:
            raise InputError("--cluster needs the package distributed: pip install 'flexgs-edge[cluster]'")
        import distributed as dask  # slow to import

        distributed: Any = dask  # it has no types
        self._drawing, self._lost = drawing, distributed.KilledWorker
        try:
            client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
            versions = set(client.run(worker_version).values())
        except (OSError, ValueError, ImportError) as error:
            raise InputError(
                f"--cluster {address}: no cluster of workers with flexgs-edge answers ({error})"
            ) from error
        self._client: Any = client
        if versions != {__version__}:
            self.close()
            raise InputError(
                f"--cluster {address}: expected workers with flexgs-edge {__version__}, found "
                f"{', '.join(sorted(versions)) or 'no worker'}"
            )

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close()

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def planes(self, source: SceneSource, cameras: Sequence[Camera]) -> Iterator[np.ndarray]:
        """Draw each view as `Renderer.render_planes` does, in their order."""
        return self._drawn(draw_planes, source, [partial(_words, camera) for camera in cameras])

    def sums(
        self,
        source: SceneSource,
        kind: str,
        cameras: Sequence[Camera],
        references: Callable[[int], np.ndarray] | None,
        pictures: bool,
    ) -> Iterator[Drawn]:
        """Draw each view and yield its sums, in their order; see `ViewSums.draw`."""

        def words(view: int) -> tuple[Any, ...]:
            return kind, cameras[view], None if references is None else references(view), pictures

        return self._drawn(draw_sums, source, [partial(words, view) for view in range(len(cameras))])

    def _drawn(
        self, draw: Callable[..., Any], source: SceneSource, views: Sequence[Callable[[], tuple[Any, ...]]]
    ) -> Iterator[Any]:
        if not isinstance(source, MemorySource):
            source = MemorySource(source.read(slice(0, source.count), list(FIELD)), source.sh_degree, source.origin)
        done = 0
        for _ in range(SENDINGS):
            try:
                for found in self._ask(draw, source, views[done:]):
                    yield found
                    done += 1
                return
            except CancelledError:
                LOG.warning("all workers with the scene were lost; it is sent to others")
            except self._lost as error:
                raise DeviceError(
                    f"--cluster: workers died while they drew ({error}); is their memory too small?"
                ) from error
        raise DeviceError(f"--cluster: the workers were lost {SENDINGS} times")

    def _ask(
        self, draw: Callable[..., Any], source: MemorySource, views: Sequence[Callable[[], tuple[Any, ...]]]
    ) -> Iterator[Any]:
        """Yield the results in order; only a few views are under way at a time."""
        client = self._client
        held = client.scatter([(uuid.uuid4().hex, source)], broadcast=True, hash=False)[0]
        most, asked = AHEAD * max(len(client.nthreads()), 1), deque[Any]()
        try:
            for view in views:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # Dask warns of a "large graph" for targets of large views
                    asked.append(client.submit(draw, held, self._drawing, *view(), pure=False))
                if len(asked) == most:
                    yield asked.popleft().result()
            while asked:
                yield asked.popleft().result()
        finally:
            client.cancel([held, *asked])


def _words(*words: Any) -> tuple[Any, ...]:
    return words
