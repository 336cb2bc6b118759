"""Load the chunks of a streamed scene in another thread, while the chunks before them are drawn."""

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from flexgs_edge.kernels.backend import Backend
from flexgs_edge.render.chunks import ChunkArrays, ChunkPlanes
from flexgs_edge.render.fit import padded

SLOTS = 2  # Chunks that memory always has room for: one is drawn while the next one loads
MOST_SLOTS = 3
"""Chunks if memory has room for one more: the disk then rests less between two. docs/results/tuning.md#most_slots"""
Span = tuple[int, int, int]  # First row, row after the last, and SH degree of a chunk


@dataclass
class Loading:
    """A chunk that another thread loads; with `stays`, its arrays outlive the view."""

    arrays: ChunkArrays
    stays: bool
    future: Future[None]


class ChunkLoads:
    """The chunks that one view asks for, in turn; close when done.

    `may_stay`: whether a chunk of so many rows may get arrays of its own, which outlive this object.
    """

    def __init__(
        self,
        backend: Backend,
        planes: ChunkPlanes,  # fills the chunks
        may_stay: Callable[[int], bool],
        may_add: Callable[[int], bool],  # whether memory has room for one chunk of so many rows beyond `SLOTS`
    ) -> None:
        self._backend, self._planes, self._may_stay, self._may_add = backend, planes, may_stay, may_add
        self._loader = ThreadPoolExecutor(1, "load")
        self._coming: dict[int, Loading] = {}
        self._held: list[ChunkArrays] = []
        self._free: list[tuple[ChunkArrays, Callable[[], None]]] = []
        """Slots whose chunk was drawn; the call waits for the kernels that drew it."""
        self._slots = 0

    def take(self, span: Span) -> Loading:
        """A loaded chunk; one that was not asked for ahead waits until the chunks before it in the queue are loaded."""
        if span[0] not in self._coming:
            self._ask(span)
        loading = self._coming.pop(span[0])
        loading.future.result()
        return loading

    def go_on(self, spans: Iterable[Span]) -> None:
        """Start to load the first of these chunks, as many as there is room for."""
        for span in spans:
            if len(self._coming) >= MOST_SLOTS - 1:
                return
            if span[0] not in self._coming and not self._ask(span, ahead=True):
                return

    def keep(self, loading: Loading) -> None:
        """Leave the arrays of a chunk to the caller."""
        self._held.remove(loading.arrays)

    def give_back(self, loading: Loading) -> None:
        """Give a slot back after the kernels that draw its chunk were started."""
        self._free.append((loading.arrays, self._backend.mark()))

    def close(self) -> None:
        """Stop loading, wait for the chunk under way, and free all arrays that were not kept."""
        self._loader.shutdown(cancel_futures=True)
        for arrays in self._held:
            arrays.release()
        self._held, self._free, self._coming = [], [], {}

    def _ask(self, span: Span, ahead: bool = False) -> bool:
        """Start to load a chunk. One that is asked for ahead leaves a slot free for a chunk that must come before it."""
        start, stop, _ = span
        done: Callable[[], None] = _nothing
        stays = self._may_stay(stop - start)
        if stays:
            arrays = self._made(span)
        elif ahead and sum(not loading.stays for loading in self._coming.values()) >= max(self._slots, SLOTS) - 1:
            if self._slots != SLOTS or not self._may_add(stop - start):
                return False
            arrays = self._slot(span)
        elif self._slots < SLOTS and not (self._free and _fits(self._free[0][0], span)):
            arrays = self._slot(span)
        else:
            arrays, done = self._free.pop(0)
            if not _fits(arrays, span):
                done()
                arrays.release()
                self._held.remove(arrays)
                arrays, done = self._made(span), _nothing

        def load() -> None:
            done()
            self._planes.load(start, stop, arrays.stored)

        self._coming[start] = Loading(arrays, stays, self._loader.submit(load))
        return True

    def _slot(self, span: Span) -> ChunkArrays:
        arrays = self._made(span)
        self._slots += 1
        return arrays

    def _made(self, span: Span) -> ChunkArrays:
        start, stop, degree = span
        arrays = ChunkArrays(self._backend, degree, padded(stop - start))
        self._held.append(arrays)
        return arrays


def _fits(arrays: ChunkArrays, span: Span) -> bool:
    start, stop, degree = span
    return (arrays.degree, arrays.stride) == (degree, padded(stop - start))


def _nothing() -> None:
    """Wait for nothing: a new slot has no kernels that use it."""
