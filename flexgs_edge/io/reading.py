"""What a user may say about how a scene file is read."""

from __future__ import annotations

from dataclasses import dataclass, replace

from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import InputError
from flexgs_edge.io.crops import parse_crop
from flexgs_edge.io.frames import Frame
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.scene.crop import Crop


@dataclass(frozen=True)
class Reading:
    """How to read a scene file."""

    # The frame of the file's axes, if it breaks the rule of its format. Default: as the file says, else as its format
    # has it.
    frame: Frame | None = None
    lod: int | None = None  # Level of detail of a streamed scene, 0 is the finest. Default: the finest that is there.
    sh_degree: int | None = None  # Leave out SH above this degree. Default: keep all.
    crop: Crop | None = None  # Leave out Gaussians beyond it. Default: keep all.
    budget: MemoryBudget | None = None  # What a file unpacks to must fit into it. Default: it is not checked.
    held: int = 0  # Bytes of other files that are read with this one

    @classmethod
    def of(
        cls, frame: str | None, lod: int | None = None, sh_degree: int | None = None, crop: str | None = None
    ) -> Reading:
        """From the words of options."""
        box = None if crop is None else parse_crop(crop)
        return cls(None if frame is None else Frame(frame.strip().upper()), lod, sh_degree, box)

    def require(self, name: str, size: int) -> None:
        """Raise `BudgetError` unless `size` bytes fit that reading the file `name` takes."""
        if self.budget is not None:
            self.budget.require(f"reading {name}", self.held + size)

    def beside(self, held: int) -> Reading:
        """For one more file where others hold so many bytes."""
        return replace(self, held=held)

    def __post_init__(self) -> None:
        if self.sh_degree is not None and not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise InputError(f"--sh-degree {self.sh_degree}: expected 0 to {MAX_SH_DEGREE}")
        if self.lod is not None and self.lod < 0:
            raise InputError(f"--lod {self.lod}: expected 0 (the finest level) or more")


GLB_KINDS = ("plain", "spz")


@dataclass(frozen=True)
class Writing:
    """How to write a scene for other programs."""

    spz_version: int = 3  # Version of a `.spz`. Older programs read only 3.
    antialiased: bool = False  # the model is antialiased; formats that can say so, do
    # Write a scene also where the format cannot hold its positions: see `check_positions`.
    force_lossy: bool = False
    glb: str = "plain"  # What holds the values of a `.glb`: `plain` numbers or a `spz`.
    double: bool = False  # Positions of a `.ply` are float64. Default: as they came, see `exchange.wants_double`.

    def __post_init__(self) -> None:
        if self.spz_version not in (3, 4):
            raise InputError(f"--spz-version {self.spz_version}: expected 3 or 4")
        if self.glb not in GLB_KINDS:
            raise InputError(f"--glb {self.glb}: expected {' or '.join(GLB_KINDS)}")


AS_WRITTEN = Reading()
PLAIN = Writing()
