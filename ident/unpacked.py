"""What a packed log would take in memory, looked up before it is unpacked: recordings pack ten times, bombs
thousands."""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from robot_assets.errors import DataError

FREE = 2**28  # bytes that every log may take
PACKED = 100  # times the size of the file, that a longer one may take
# bytes unpacked at a time to count them, and given at a time: what is left of these is copied
PIECE, FED = 2**20, 2**16
TAG, COMPRESSED = 8, 15  # bytes of the tag of an element; type of one that is packed (MAT-File Format, 1-9)
CELLS = (1, 2, 3)  # classes of arrays of arrays: cells, structures, objects (1-16)


def check_size(path: Path, size: int) -> None:
    """Raise a DataError where ``size`` bytes are more than a recording of such a file takes."""
    stored = path.stat().st_size
    if size > max(FREE, PACKED * stored):
        found = f"{size / 2**20:.4g} MB packed into {stored / 2**20:.3g}"
        raise DataError("log", str(path), found, f"at most {PACKED} times the file, or {FREE / 2**20:.0f} MB")


def check_zip(path: Path, wanted: set[str] | None) -> None:
    """The arrays of an NPZ file, by the directory of the archive; None wants them all."""
    with zipfile.ZipFile(path) as file:
        check_size(
            path,
            sum(i.file_size for i in file.infolist() if wanted is None or i.filename.removesuffix(".npy") in wanted),
        )


def check_matlab(path: Path) -> None:
    """The variables of a MATLAB file up to version 7, unpacked piece by piece and counted; their cells too."""
    total = 0
    with path.open("rb") as file:
        header = file.read(128)
        order = ">" if header[126:128] == b"MI" else "<"
        while len(tag := file.read(TAG)) == TAG:
            kind, length = struct.unpack(f"{order}II", tag)
            if kind == COMPRESSED:
                for k, piece in enumerate(_inflated(file.read(length))):
                    total += len(piece)
                    check_size(path, total + (_cells(piece[TAG:], order) if k == 0 else 0))
            else:
                after = file.tell() + length
                check_size(path, _cells(file.read(min(length, 1024)), order))
                file.seek(after)


def _cells(array: bytes, order: str) -> int:
    """Bytes that the places of a cell or structure array take, whatever stands in them; 0 for another array."""
    if len(array) < 24 or array[8 if order == "<" else 11] not in CELLS:
        return 0
    length = int(struct.unpack(f"{order}I", array[20:24])[0])
    dimensions = struct.unpack(f"{order}{length // 4}i", array[24 : 24 + 4 * (length // 4)])
    return 8 * math.prod(dimensions)


def _inflated(data: bytes) -> Iterator[bytes]:
    """The pieces that packed data unpack to."""
    unpack = zlib.decompressobj()
    for start in range(0, len(data), FED):
        given = data[start : start + FED]
        while given and not unpack.eof:
            yield unpack.decompress(given, PIECE)
            given = unpack.unconsumed_tail


def check_mcap(path: Path) -> None:
    """The chunks of an MCAP file, unpacked piece by piece and counted."""
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    total = 0
    with path.open("rb") as file:
        for record in StreamReader(file, emit_chunks=True).records:
            if isinstance(record, Chunk):
                for size in _chunk(record):
                    total += size
                    check_size(path, total)


def _chunk(chunk: Any) -> Iterator[int]:
    """Lengths of the pieces that a chunk unpacks to."""
    if chunk.compression == "zstd":
        import zstandard

        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            while piece := reader.read(PIECE):
                yield len(piece)
    elif chunk.compression == "lz4":
        import lz4.frame

        with lz4.frame.open(io.BytesIO(chunk.data)) as reader:
            while piece := reader.read(PIECE):
                yield len(piece)
    else:
        yield len(chunk.data)
