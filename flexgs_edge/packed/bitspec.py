"""Bits per code for every attribute: `--bits` of the command line, and `bits` of the container."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields

from flexgs_edge.errors import InputError
from flexgs_edge.packed.bitpack import MAX_BITS
from flexgs_edge.scene.fields import FIELD


@dataclass(frozen=True)
class BitSpec:
    """Bits per code, 1 to 16, for every attribute; the default is the choice of the FlexGaussian paper."""

    xyz: int = 16
    dc: int = 8
    scale: int = 8
    rot: int = 8
    opacity: int = 4
    rest: int = 4

    def __post_init__(self) -> None:
        for name, bits in asdict(self).items():
            if type(bits) is not int or not 1 <= bits <= MAX_BITS:
                raise InputError(f"bits of {name}: expected 1 to {MAX_BITS}, got {bits!r}")

    @classmethod
    def parse(cls, text: str) -> BitSpec:
        """Read `xyz=16,dc=8,...`; attributes that are not named keep the default bits.

        >>> str(BitSpec.parse("rest=3,xyz=14"))
        'xyz=14,dc=8,scale=8,rot=8,opacity=4,rest=3'
        """
        names = [field.name for field in fields(cls)]
        given: dict[str, int] = {}
        for item in text.split(","):
            name, _, value = (part.strip() for part in item.partition("="))
            if name not in names or not (value.isascii() and value.isdigit()):
                raise InputError(f"bits {text!r}: {item!r} is not NAME=NUMBER with a name of {', '.join(names)}")
            if name in given:
                raise InputError(f"bits {text!r}: {name} is given twice")
            given[name] = int(value[:4])
        return cls(**given)

    @classmethod
    def rtn(cls, bits: int) -> BitSpec:
        """The same bits for all attributes; with `groups=1`, plain round to nearest, a baseline of the studies."""
        return cls(*[bits] * len(fields(cls)))

    def of(self, field: str) -> int:
        """Bits of a scene field, such as `log_scales`."""
        return int(getattr(self, FIELD[field].bits))

    def __str__(self) -> str:
        return ",".join(f"{name}={bits}" for name, bits in asdict(self).items())


PAPER = BitSpec()  # 16 bits for positions, 8 for DC, scale and rotation, 4 for opacity and SH
