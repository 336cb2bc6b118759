"""Write, open, cut and verify `.fgs` files of version 2 (docs/format.md)."""

import io
import os
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, BinaryIO, TypeVar

import numpy as np

from flexgs_edge.codec.sections import (
    PREAMBLE_BYTES,
    ChunkEntry,
    Section,
    SectionFile,
    Verification,
    checked,
    format_error,
    preamble,
)
from flexgs_edge.codec.v2.device.launch import Device
from flexgs_edge.codec.v2.encode import Encoded, encode_grid
from flexgs_edge.codec.v2.header import (
    CHUNK_ROWS,
    HEADER_MOST,
    Channels,
    Chunk,
    GridHeader,
    check_end,
    decode_header,
    encode_header,
    least_bytes,
)
from flexgs_edge.codec.v2.ports import DecodePort, Model
from flexgs_edge.codec.v2.rans import Decoder, StreamError, lane_count
from flexgs_edge.codec.v2.walk import ChunkCodes, TooManyNodes, walk_chunk
from flexgs_edge.errors import InputError, TargetError
from flexgs_edge.files import atomic_write
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.memory.rows import read_rows
from flexgs_edge.memory.storage import IN_MEMORY, Storage

BOXES = "boxes"  # Its name among the settings of a file
FEWEST, MOST = 8, 4096  # Fewer chunks come one after the other anyway; of more, the header would grow too long
VERSION = 2


def with_boxes(settings: Mapping[str, Any], grid: GridScene, chunks: Sequence[Chunk]) -> dict[str, Any]:
    """The settings of a file of these chunks, with their boxes if there are enough of them.

    A box is seven integers: the least position codes x, y, z of the chunk's rows, the largest ones, and its rows with SH.
    """
    others = {name: value for name, value in settings.items() if name != BOXES}
    if not FEWEST <= len(chunks) <= MOST:
        return others
    return {**others, BOXES: [_box(grid, slice(chunk.start, chunk.stop)) for chunk in chunks]}


def _box(grid: GridScene, rows: slice) -> list[int]:
    position = read_rows(grid.position, rows)
    with_sh = int(np.count_nonzero(grid.sh_degrees[rows]))
    return [*position.min(axis=1).tolist(), *position.max(axis=1).tolist(), with_sh]


def decode_chunk(
    model: Model, rows: int, data: bytes, base_only: bool = False, cost: np.ndarray | None = None
) -> ChunkCodes:
    """Decode the codes of a chunk; raises `StreamError` for bytes that no encoder writes.

    `model`: the model of the file. `rows`: rows of the chunk. `data`: the whole chunk. `base_only`: stop before the SH;
    False by default. `cost`: [alphabets] f64, to which the bits of each alphabet are added.
    """
    stream = Decoder(data, lane_count(rows))
    codes = walk_chunk(rows, model.depth, model.sh_degree, DecodePort(model, stream, cost), None, base_only)
    if not base_only:
        check_end(data, rows, stream.finish())
    return codes


Result = TypeVar("Result")


def write_grid(
    path: str | os.PathLike[str],  # usually ends in `.fgs`
    grid: GridScene,  # from `to_grid`
    settings: Mapping[str, Any],
    *,
    force: bool = False,  # replace an existing file
    chunk_rows: int = CHUNK_ROWS,  # rows of a chunk, at most 65536 (default)
    device: Device | None = None,  # Counts and codes the symbols; the bytes are the same. NumPy by default.
    encoded: Encoded | None = None,  # the result of `encode_grid(grid, chunk_rows)`, if the caller has it already
    storage: Storage = IN_MEMORY,  # holds the symbols until they are written
    preview: bytes = b"",
    boxes: bool = True,  # tell where chunks lie, if there are many
) -> int:
    """Encode a grid scene into a file, which gets its name only when it is complete.

    `settings`: JSON values that tell how the file was made; nothing that differs between runs or machines. A file of
    many chunks also tells where they lie. `preview`: a file of a much smaller scene, for viewers to show until the
    first layer is there. Default: none. Returns bytes of the file, equal to `coded_size`.
    """
    encoded = encoded or encode_grid(grid, chunk_rows, device, storage)
    model = encoded.model.to_bytes()
    told = with_boxes(settings, grid, encoded.chunks) if boxes else settings
    header = _header(grid, encoded, len(model), told, chunk_rows, len(preview))
    with atomic_write(path, force) as file:
        file.seek(PREAMBLE_BYTES)
        file.write(encode_header(header))
        file.write(checked(model))
        file.write(preview)
        entries = []
        for stream in encoded.streams():
            entries.append((len(stream), zlib.crc32(stream)))
            file.write(stream)
        return _finish(file, header, entries)


def coded_size(
    grid: GridScene,
    settings: Mapping[str, Any],
    chunk_rows: int = CHUNK_ROWS,
    device: Device | None = None,
    encoded: Encoded | None = None,
    storage: Storage = IN_MEMORY,
    preview: bytes = b"",
) -> int:
    """Exact bytes of the file that `write_grid` makes of these arguments; as slow as writing it."""
    encoded = encoded or encode_grid(grid, chunk_rows, device, storage)
    told = with_boxes(settings, grid, encoded.chunks)
    header = _header(grid, encoded, len(encoded.model.to_bytes()), told, chunk_rows, len(preview))
    return header.chunks_offset + sum(map(len, encoded.streams())) + header.table_bytes


def trim_container(
    source: str | os.PathLike[str], path: str | os.PathLike[str], max_size: int, force: bool = False
) -> int:
    """Copy as many whole layers as fit into `max_size` bytes, with the preview; return the bytes of the new file.

    If not even the first layer fits, the new file is the preview.

    Raises `TargetError` if nothing fits.
    """
    container = GridContainer(source)
    if os.path.realpath(source) == os.path.realpath(path):
        raise InputError(f"{path}: expected another file than the one to cut")
    entries = container.read_table()
    for layers in range(len(container.header.layers), 0, -1):
        header = container.header
        kept = [entry for entry, chunk in zip(entries, header.chunks(), strict=True) if chunk.layer < layers]
        if layers < len(header.layers):
            header = header.cut(layers, container.size)
        payload = sum(entry.section.length for entry in kept)
        size = header.chunks_offset + payload + header.table_bytes
        if size <= max_size:
            break
    else:
        if not 0 < container.header.preview.length <= max_size:
            raise TargetError(f"{source}: its first layer needs {size} bytes, {max_size} are allowed")
        with atomic_write(path, force) as file:
            return file.write(Preview(container).data)
    with container.open() as old, atomic_write(path, force) as file:
        file.seek(PREAMBLE_BYTES)
        file.write(encode_header(header))
        file.write(checked(container.read_section(old, container.header.model)))
        file.write(container.read_preview())
        for entry in kept:
            container.copy_chunk(old, entry, file)
        return _finish(file, header, [(entry.section.length, entry.checksum) for entry in kept])


def _header(
    grid: GridScene,
    encoded: Encoded,
    model_bytes: int,
    settings: Mapping[str, Any],
    chunk_rows: int,
    preview_bytes: int,
) -> GridHeader:
    low = encoded.low.tolist()
    channels = Channels.of(_by_alphabet(encoded.model, encoded.bits), [band.shape[1] for band in grid.sh])
    return GridHeader.of_grid(
        grid,
        encoded.layers,
        low,
        encoded.model.depth,
        chunk_rows,
        model_bytes,
        settings,
        channels,
        preview_bytes or None,
    )


def _by_alphabet(model: Model, bits: np.ndarray) -> dict[str, float]:
    """Bytes of each alphabet, by its name."""
    names = ["position", "repeats", *(group.kind.name for group in model.groups)]
    return dict(zip(names, (bits / 8).tolist(), strict=True))


def _finish(file: BinaryIO, header: GridHeader, entries: Sequence[tuple[int, int]]) -> int:
    """Write the chunk table and, last, the preamble; return the size of the file."""
    file.write(checked(np.array(entries, "<u4").tobytes()))
    size = file.tell()
    block = encode_header(header)
    file.seek(0)
    file.write(preamble(VERSION, size, block))
    return size


class GridContainer(SectionFile):
    """A file of version 2; its header is checked against the size of the file.

    `path`: the file is opened for each read, and never held open. Raises `FormatError` if anything differs from the
    format; the message names the byte, the expected and the found value. Raises `InputError` if the file cannot be read
    at all.
    """

    version = VERSION

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        with self.open() as file:
            size = self.size = file.seek(0, os.SEEK_END)
            file.seek(0)
            self.header = self._read_header(file, size, _wrong_length, decode_header)
        least = self.header.least_size
        if least > size:
            raise self._error(PREAMBLE_BYTES, f"header: its counts make a file of at least {least} bytes, got {size}")

    def read_model(self) -> Model:
        """Read and check the model."""
        header = self.header
        with self.open() as file:
            data = self.read_section(file, header.model)
        try:
            return Model.from_bytes(data, header.sh_degree, header.depth)
        except StreamError as error:
            raise format_error(self.path, header.model.offset, f"model: {error}") from None

    def read_preview(self) -> bytes:
        """Read the preview, which has not been checked; no bytes if there is none."""
        section = self.header.preview
        with self.open() as file:
            file.seek(section.offset)
            return self._read(file, section.length, section.name)

    def read_table(self) -> list[ChunkEntry]:
        """Read the place and checksum of every chunk, and check that the chunks fill the file."""
        section = self.header.table(self.size)
        with self.open() as file:
            table = np.frombuffer(self.read_section(file, section), "<u4").reshape(-1, 2)
        entries = []
        offset = self.header.chunks_offset
        for i, (chunk, (length, checksum)) in enumerate(zip(self.header.chunks(), table.tolist(), strict=True)):
            least = least_bytes(chunk.stop - chunk.start)
            if length < least or length % 2:
                raise format_error(
                    self.path,
                    section.offset + 8 * i,
                    f"chunk {i}: length: wanted an even {least} or more, got {length}",
                )
            entries.append(ChunkEntry(Section(f"chunk {i}", offset, length), checksum))
            offset += length
        if offset != section.offset:
            raise format_error(
                self.path, section.offset, f"chunk table: wanted chunks that end at {section.offset}, got {offset}"
            )
        return entries

    def decode(self, model: Model, chunk: Chunk, entry: ChunkEntry, base_only: bool = False) -> ChunkCodes:
        """Decode and check the codes of a chunk; with `base_only`, stop before the SH."""
        return self._decode(model, chunk, entry, base_only, None)

    def decode_on(
        self,
        decode: Callable[[list[tuple[int, bytes]]], Sequence[Result | ValueError]],
        chunks: Sequence[tuple[Chunk, ChunkEntry]],
    ) -> list[Result]:
        """Let `decode` work on the rows and bytes of some chunks. An error of a chunk is raised with its name and place."""
        jobs = [(chunk.stop - chunk.start, self.read_chunk(entry)) for chunk, entry in chunks]
        results: list[Result] = []
        for (_, entry), result in zip(chunks, decode(jobs), strict=True):
            if isinstance(result, ValueError):
                raise format_error(self.path, entry.section.offset, f"{entry.section.name}: {result}")
            results.append(result)
        return results

    def cost(self, model: Model, chunk: Chunk, entry: ChunkEntry, cost: np.ndarray) -> ChunkCodes:
        """Decode a chunk, and add the bits of each of its alphabets to `cost` ([alphabets] f64)."""
        return self._decode(model, chunk, entry, False, cost)

    def _decode(
        self, model: Model, chunk: Chunk, entry: ChunkEntry, base_only: bool, cost: np.ndarray | None
    ) -> ChunkCodes:
        section = entry.section
        data = self.read_chunk(entry)
        try:
            return decode_chunk(model, chunk.stop - chunk.start, data, base_only, cost)
        except (StreamError, TooManyNodes) as error:
            raise format_error(self.path, section.offset, f"{section.name}: {error}") from None


class Preview(GridContainer):
    """The preview of a file, which is held in memory: a file of its own.

    `whole`: the file. Raises `FormatError` if anything differs from the format. Bytes count from where the preview
    begins.
    """

    def __init__(self, whole: GridContainer) -> None:
        self.data = whole.read_preview()
        super().__init__(f"{whole.path} (preview)")
        if self.header.preview_bytes is not None:
            raise self._error(PREAMBLE_BYTES, "header: preview_bytes: wanted none in a preview")
        own, others = self.header, whole.header
        if own.origin != others.origin:
            raise self._error(PREAMBLE_BYTES, f"header: origin: wanted {others.origin}, got {own.origin}")
        if own.sh_degree not in (0, others.sh_degree):
            raise self._error(
                PREAMBLE_BYTES, f"header: sh_degree: wanted 0 or {others.sh_degree} in a preview, got {own.sh_degree}"
            )

    @contextmanager
    def open(self) -> Iterator[BinaryIO]:
        """Open the bytes for reading."""
        yield io.BytesIO(self.data)

    def verify(self) -> None:
        """Check every byte; raises `FormatError`."""
        self.read_model()
        for entry in self.read_table():
            self.check_chunk(entry)


def verify_grid(path: str | os.PathLike[str], raise_errors: bool = True) -> list[Section]:
    """Check every byte of a version 2 file, which is read in pieces; see `flexgs_edge.codec.v1.container.verify`."""
    container = GridContainer(path)
    header = container.header
    found = Verification(header.block, raise_errors)
    found.check(header.model, container.read_model)
    if header.preview.length:
        found.check(header.preview, lambda: Preview(container).verify())
    # The end of a chunk stands only in the table.
    table = header.table(container.size)
    chunks = [Section("chunks", header.chunks_offset, table.offset - header.chunks_offset)]
    return found.check_chunks(container, table, container.read_table, chunks)


def _wrong_length(length: int, left: int) -> str:
    most = min(HEADER_MOST, left)
    return "" if length <= most else f"wanted at most {most}"


def channel_bytes(
    path: str | os.PathLike[str], look: Callable[[Chunk, ChunkEntry, ChunkCodes], None] | None = None
) -> dict[str, float]:
    """Bytes that each channel takes in a version 2 file, by name; the bytes of the other sections, by section.

    This decodes all chunks. `look` is called with each decoded chunk.
    """
    container = GridContainer(path)
    model = container.read_model()
    cost = np.zeros(len(model.tables))
    entries = container.read_table()
    for chunk, entry in zip(container.header.chunks(), entries, strict=True):
        codes = container.cost(model, chunk, entry, cost)
        if look is not None:
            look(chunk, entry, codes)
    table = _by_alphabet(model, cost)
    payload = sum(entry.section.length for entry in entries)
    table["lanes"] = payload - float(cost.sum()) / 8
    table["model"] = float(container.header.model.length)
    table["preview"] = float(container.header.preview.length)
    table["header"] = float(container.size - payload) - table["model"] - table["preview"]
    return table
