"""Compressed blocks of containers (MCAP chunks, ROS 1 bag chunks), undone within limits.

Owns      which compressions there are, and how much memory a block may ask for.
Leaves    where blocks lie to mcap_index and rosbag1_index.
"""

from __future__ import annotations

import bz2
from collections.abc import Iterator
from typing import Any

from aruco.errors import MissingExtraError

# Writers cut chunks at a few MiB; one message is at most MAX_MESSAGE_BYTES.
MAX_CHUNK_BYTES = 2**30
MAX_MESSAGE_BYTES = 256 * 2**20
COMPRESSIONS = ("", "none", "lz4", "zstd", "bz2")

# Undone piece by piece, so that a block which yields more than it states is caught after this many bytes.
_PIECE_BYTES = 2**20


class DamagedError(Exception):
    """Bytes of a container that cannot be used; the message completes the sentence "<place> ..."."""


def decompressed(data: bytes | memoryview, compression: str, stated: int, *, cut: bool = False) -> memoryview:
    """A block's contents.

    Args:
        data: The block as stored.
        compression: One of COMPRESSIONS.
        stated: How many bytes it must yield; more are not made of it.
        cut: The end of ``data`` is missing: what can be had is wanted.

    Returns:
        ``stated`` bytes, read-only; fewer only of a cut block.

    Raises:
        DamagedError: The block is damaged, or yields another size than stated.
        MissingExtraError: The package for the compression is not installed.
    """
    if compression in ("", "none"):
        if len(data) != stated and not (cut and len(data) < stated):
            raise DamagedError(f"holds {len(data)} bytes and states {stated}")
        return memoryview(data).toreadonly()
    out = bytearray()  # grows with what is there: what a damaged block states is not believed
    for piece in _told_pieces(data, compression, cut):
        if len(out) + len(piece) > stated:
            raise DamagedError(f"yields more than the {stated} bytes that it states")
        out += piece
    if len(out) != stated and not cut:
        raise DamagedError(f"yields {len(out)} bytes and states {stated}")
    return memoryview(out).toreadonly()


def decompressed_head(data: bytes | memoryview, compression: str, size: int) -> bytes:
    """The first ``size`` bytes that a block yields, fewer if it has fewer; raises DamagedError."""
    head = bytearray()
    for piece in _told_pieces(data, compression, False, min(size, _PIECE_BYTES)):
        head += piece
        if len(head) >= size:
            break
    return bytes(head[:size])


def _told_pieces(
    data: bytes | memoryview, compression: str, cut: bool, piece_bytes: int = _PIECE_BYTES
) -> Iterator[bytes]:
    """The pieces of a block; what a package complains about is damage, or the end of a cut block."""
    try:
        yield from _pieces(data, compression, piece_bytes)
    except (DamagedError, MissingExtraError, MemoryError):
        raise
    # Each package has errors of its own: RuntimeError, ZstdError, OSError, EOFError, ValueError.
    except Exception as error:
        if not cut:
            raise DamagedError(f"cannot be decompressed ({' '.join(str(error).split())[:100]})") from error


def _pieces(data: bytes | memoryview, compression: str, size: int) -> Iterator[bytes]:
    if compression == "zstd":
        yield from _zstd_pieces(data, size)
    elif compression == "lz4":
        yield from _lz4_pieces(data, size)
    elif compression == "bz2":
        yield from _bz2_pieces(data, size)
    else:
        raise DamagedError(f"has the unknown compression {compression[:20]!r}; known: lz4, zstd, bz2 and none")


def _zstd_pieces(data: bytes | memoryview, size: int) -> Iterator[bytes]:
    try:
        import zstandard
    except ImportError as error:
        raise MissingExtraError("zstandard", "bags") from error
    with zstandard.ZstdDecompressor(max_window_size=2**27).stream_reader(data, read_across_frames=True) as stream:
        while piece := stream.read(size):
            yield piece


def _lz4_pieces(data: bytes | memoryview, size: int) -> Iterator[bytes]:
    try:
        import lz4.frame
    except ImportError as error:
        raise MissingExtraError("lz4", "bags") from error
    yield from _pieces_of(lz4.frame.LZ4FrameDecompressor(), data, size)


def _bz2_pieces(data: bytes | memoryview, size: int) -> Iterator[bytes]:
    yield from _pieces_of(bz2.BZ2Decompressor(), data, size)


def _pieces_of(decompressor: Any, data: bytes | memoryview, size: int) -> Iterator[bytes]:
    """Of one whose decompress takes a limit."""
    piece = decompressor.decompress(data, max_length=size)
    while piece or not (decompressor.eof or decompressor.needs_input):
        yield piece
        if decompressor.eof:
            return
        piece = decompressor.decompress(b"", max_length=size)
