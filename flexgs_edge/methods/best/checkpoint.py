"""`--resume`: saves the rounds of a search in a folder, so that a killed run goes on from its last finished round."""

import json
import os
import shutil
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import DISK_FULL, BudgetError, InputError
from flexgs_edge.memory.rows import blocks, read_rows
from flexgs_edge.memory.storage import Storage
from flexgs_edge.methods.best.effort import effort_of, finetune_steps
from flexgs_edge.methods.best.poses import is_fine
from flexgs_edge.progress import LOG
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.fingerprint import fingerprint
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.scene.fields import FIELD

DONE = "done"  # File that is written last, with the checksums of all others. A round without it was cut short.


class Checkpoint:
    """A folder with one folder for each finished round of a search.

    `folder`: made if missing. Its name holds the fingerprint of the search.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self._sound: set[int] = set()  # rounds whose files were checked, or written by this run
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder}: cannot keep the state of the run there ({error.strerror})") from error

    def has(self, number: int) -> bool:
        """Whether round `number` was finished, and its files are as they were written. A damaged one is removed."""
        place = self._place(number)
        if number not in self._sound and (place / DONE).is_file():
            damaged = _damaged(place)
            if damaged is None:
                self._sound.add(number)
            else:
                LOG.warning("%s is damaged: that round of the search is computed anew", damaged)
                shutil.rmtree(place, ignore_errors=True)
        return number in self._sound

    @property
    def key(self) -> str:
        """The fingerprint in the folder's name."""
        return self.folder.name.rpartition("-")[2]

    @property
    def rounds(self) -> int:
        """How many rounds were finished."""
        number = 0
        while self.has(number):
            number += 1
        return number

    def load(self, number: int, storage: Storage) -> dict[str, np.ndarray]:
        """The arrays of a round that `has` found, by name, in `storage`."""
        places = sorted(self._place(number).glob("*.npy"))
        return {place.stem: storage.copy(np.load(place, mmap_mode="r", allow_pickle=False)) for place in places}

    def save(self, number: int, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
        """Save a round. Remains of an earlier run are written over.

        Raises `BudgetError` when the disk is full.
        """
        place = self._place(number)
        shutil.rmtree(place, ignore_errors=True)
        try:
            place.mkdir()
            for name, values in arrays:
                with open(place / f"{name}.npy", "wb") as file:
                    np.lib.format.write_array_header_1_0(
                        file, {"descr": values.dtype.str, "fortran_order": False, "shape": values.shape}
                    )
                    for plane in values.reshape(-1, values.shape[-1]) if values.size else ():
                        for rows in blocks(values.shape[-1], 1 << 20):
                            file.write(np.ascontiguousarray(read_rows(plane, rows)).data)
                    file.flush()
                    os.fsync(file.fileno())
            sums = {file.name: _checksum(file) for file in place.iterdir()}
            (place / DONE).write_text(json.dumps(sums), encoding="utf-8")
            self._sound.add(number)
        except OSError as error:
            if error.errno not in DISK_FULL:
                raise
            raise BudgetError(
                f"{place}: the disk is full ({error.strerror}): --resume keeps every round of the search there; free some space, "
                "name another folder with --scratch, or leave --resume out"
            ) from error

    def remove(self) -> None:
        """Remove the folder: the run is done."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _place(self, number: int) -> Path:
        return self.folder / f"round-{number}"


def _checksum(path: Path) -> int:
    """CRC-32 of a file."""
    found = 0
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            found = zlib.crc32(block, found)
    return found


def _damaged(place: Path) -> Path | None:
    """A file of a finished round that is missing, or not as it was written; `None` if all are."""
    try:
        sums = json.loads((place / DONE).read_text(encoding="utf-8"))
        wrong = [name for name, found in sums.items() if _checksum(place / name) != found]
        return place / min(wrong) if wrong else None
    except (OSError, ValueError, AttributeError, TypeError):
        return place


def open_checkpoint(
    run: Run[CompressOptions], renderer: Renderer, scored: Sequence[Camera], folder: Path
) -> Checkpoint:
    """Open the folder for the rounds of a search. Its name holds a fingerprint of all that they depend on."""
    options = run.options
    # Rounds that lead to a descent also keep references from between the scored poses.
    steps = finetune_steps(options, len(scored), run.source.count, fine=is_fine(options, run.source))
    plan = effort_of(run)
    words = f"path {plan.keep!r} {options.refit} {options.unseen_share!r} {renderer.background!r} {steps > 0}"
    if steps and plan.interleaved:
        # The target says between which rounds a descent comes.
        words += f" {plan.interleaved!r} {steps} {run.target!r}"
    assert options.near is not None
    key = fingerprint(run.source, scored, words, options.near, bool(options.antialiased), list(FIELD))
    checkpoint = Checkpoint(folder / f".flexgs-resume-{key[:16]}")
    if checkpoint.rounds:
        where = checkpoint.folder, checkpoint.rounds
        LOG.info("%s: an earlier run was cut short after %d rounds: going on from there", *where)
    return checkpoint
