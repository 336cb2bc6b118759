"""Pack codes of 1 to 16 bits into bytes, least significant bit first: the code of row i starts at bit i * bits.

Eight codes of b bits fill exactly b bytes, so every eighth row starts at a whole byte. We join eight codes in two 64-bit words
and keep the first b bytes. Any range of rows can be read without the rest. `BitSpec` says how many bits each attribute has.
"""

from dataclasses import asdict, dataclass, fields

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.scene.fields import FIELD

MAX_BITS = 16  # Most bits of a code: two bytes


def plane_bytes(rows: int, bits: int) -> int:
    """Bytes of a plane of `rows` codes of `bits` bits.

    >>> plane_bytes(3, 4), plane_bytes(0, 7), plane_bytes(9, 1)
    (2, 0, 2)
    """
    return (rows * bits + 7) // 8


def pack(codes: np.ndarray, bits: int) -> np.ndarray:
    """Pack codes into bytes; unused bits of the last byte are zero.

    `codes`: [n] u16, each below 2^bits (higher bits are not masked). `bits`: 1 to 16. Returns [ceil(n * bits / 8)] u8.
    """
    n = len(codes)
    if bits == 16:
        return codes.astype("<u2", copy=False).view(np.uint8)
    if bits == 8:
        return codes.astype(np.uint8)
    if n % 8:
        codes = np.concatenate([codes, np.zeros(-n % 8, codes.dtype)])
    if bits == 4:
        pairs = codes.astype(np.uint8)
        packed = pairs[0::2] | (pairs[1::2] << np.uint8(4))
    elif bits == 1:
        packed = np.packbits(codes.astype(np.uint8), bitorder="little")
    else:
        eights = codes.astype("<u8").reshape(-1, 8)
        first, second = _join(eights[:, :4], bits), _join(eights[:, 4:], bits)
        words = np.empty((len(eights), 2), "<u8")
        words[:, 0] = first | (second << np.uint64(4 * bits))
        words[:, 1] = second >> np.uint64(64 - 4 * bits)
        packed = words.view(np.uint8)[:, :bits].reshape(-1)
    return packed[: plane_bytes(n, bits)]


def unpack(plane: np.ndarray, bits: int, start: int, stop: int) -> np.ndarray:
    """Unpack the codes of rows [start, stop) of a plane.

    `plane`: [bytes] u8, contiguous, from `pack`. `bits`: 1 to 16. `start`, `stop`: rows, 0 <= start <= stop <= rows of
    the plane. Returns [stop - start] u16.
    """
    if stop <= start:
        return np.zeros(0, np.uint16)
    if bits == 16:
        return plane[2 * start : 2 * stop].view("<u2").astype(np.uint16, copy=False)
    if bits == 8:
        return plane[start:stop].astype(np.uint16)
    head = start // 8 * 8
    used = plane[head * bits // 8 : plane_bytes(stop, bits)]
    if bits == 4:
        codes = np.empty(2 * len(used), np.uint16)
        np.bitwise_and(used, 15, out=codes[0::2])
        np.right_shift(used, 4, out=codes[1::2])
    elif bits == 1:
        codes = np.unpackbits(used, bitorder="little").astype(np.uint16)
    else:
        codes = _unpack_eights(used, bits).reshape(-1)
    return codes[start - head : stop - head]


def pack_into(plane: np.ndarray, bits: int, start: int, codes: np.ndarray) -> None:
    """Write codes into a plane from row `start` on; rows [0, start) are kept, and later rows are lost."""
    head = start // 8 * 8
    if head != start:
        codes = np.concatenate([unpack(plane, bits, head, start), codes])
    packed = pack(codes, bits)
    first = head * bits // 8
    plane[first : first + len(packed)] = packed


def _join(fours: np.ndarray, bits: int) -> np.ndarray:
    """Join the four codes of each row ([m, 4] u64) in one word of 4 * bits bits."""
    word = fours[:, 0].copy()
    for i in range(1, 4):
        word |= fours[:, i] << np.uint64(i * bits)
    return word


def _unpack_eights(used: np.ndarray, bits: int) -> np.ndarray:
    """[m, 8] u16 codes of the bytes `used`; missing bytes of the last eight codes read as zero."""
    eights = -(-len(used) // bits)
    padded = np.zeros((eights, 16), np.uint8)
    whole = len(used) // bits
    padded[:whole, :bits] = used[: whole * bits].reshape(whole, bits)
    if whole < eights:
        padded[whole, : len(used) - whole * bits] = used[whole * bits :]
    words = padded.view("<u8")
    first = words[:, 0]
    second = (first >> np.uint64(4 * bits)) | (words[:, 1] << np.uint64(64 - 4 * bits))
    mask = np.uint64(2**bits - 1)
    codes = np.empty((eights, 8), np.uint16)
    for i in range(4):
        codes[:, i] = (first >> np.uint64(i * bits)) & mask
        codes[:, 4 + i] = (second >> np.uint64(i * bits)) & mask
    return codes


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
    def parse(cls, text: str) -> "BitSpec":
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
    def rtn(cls, bits: int) -> "BitSpec":
        """The same bits for all attributes; with `groups=1`, plain round to nearest, a baseline of the studies."""
        return cls(*[bits] * len(fields(cls)))

    def of(self, field: str) -> int:
        """Bits of a scene field, such as `log_scales`."""
        return int(getattr(self, FIELD[field].bits))

    def __str__(self) -> str:
        return ",".join(f"{name}={bits}" for name, bits in asdict(self).items())


PAPER = BitSpec()  # 16 bits for positions, 8 for DC, scale and rotation, 4 for opacity and SH
