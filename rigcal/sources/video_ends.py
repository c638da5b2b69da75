"""Where a video file should end, read off its outermost headers, and so whether it was cut off.

Owns      the outer layout of ISO (MP4, MOV), Matroska (MKV, WebM), RIFF (AVI) and transport stream (TS) files.
Leaves    everything inside to libav.

libav reads as far as it can and does not say that more was promised. Layouts: ISO/IEC 14496-12, 4.2; RFC 8794 and
RFC 9559; Microsoft's RIFF with OpenDML's several RIFF chunks; ISO/IEC 13818-1, 2.4.3.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

EBML, SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
# First boxes of ISO files; very old QuickTime files begin with others than ftyp.
ISO_FIRST = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")
TS_SYNC, TS_SIZES = 0x47, (188, 192, 204)
_MAX_BOXES = 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class Ends:
    """A file's length, as it is and as its headers promise."""

    size: int
    promised: int | None  # None: nothing is promised
    has_index: bool = True  # ISO: whether the box that says where the frames are is there, and whole
    is_ragged: bool = False  # whether it ends within a packet

    @property
    def cut(self) -> str:
        """What is missing, to complete the sentence "<file> ..."; empty where nothing is known to be."""
        if self.promised is not None and self.promised > self.size:
            return (
                f"is cut off at byte {self.size} of {self.promised} ({100 * self.size / self.promised:.1f} % are there)"
            )
        return f"is cut off at byte {self.size}, within a packet" if self.is_ragged else ""


def read_ends(path: Path) -> Ends:
    """What a file's outer headers promise; nothing where they are of no kind known here. Raises OSError."""
    size = os.path.getsize(path)
    with open(path, "rb") as file:
        head = file.read(4096)
        if is_iso(head):
            boxes = list(_boxes(file, size))
            promised = max((end for _, end in boxes), default=None)
            index_ends = [end for kind, end in boxes if kind == b"moov"]
            return Ends(size=size, promised=promised, has_index=bool(index_ends) and min(index_ends) <= size)
        if head.startswith(EBML):
            return Ends(size=size, promised=_segment_end(head))
        if is_avi(head):
            return Ends(size=size, promised=max(_riff_ends(file, size)))
    period = ts_period(head)
    return Ends(size=size, promised=None, is_ragged=period is not None and size % period > 0)


def is_iso(head: bytes) -> bool:
    """Whether a file begins as MP4 and MOV do."""
    return head[4:8] in ISO_FIRST


def is_avi(head: bytes) -> bool:
    """Whether a file begins as AVI does."""
    return head[:4] == b"RIFF" and head[8:12] == b"AVI "


def ts_period(head: bytes) -> int | None:
    """The distance of a transport stream's packets; None if it is none."""
    for period in TS_SIZES:
        first = 4 if period == 192 else 0
        marks = head[first : first + 5 * period : period]
        if len(marks) >= 2 and set(marks) == {TS_SYNC}:
            return period
    return None


def _boxes(file: BinaryIO, size: int) -> Iterator[tuple[bytes, int]]:
    """(kind, end) of the outermost boxes of an ISO file."""
    at = 0
    for _ in range(_MAX_BOXES):
        if at > size:
            return
        file.seek(at)
        header = file.read(16)
        if len(header) < 8:
            return
        length = int.from_bytes(header[:4], "big")
        if length == 1:
            length = int.from_bytes(header[8:16], "big")
        elif length == 0:  # to the end of the file
            length = size - at
        if length < 8:
            return
        at += length
        yield header[4:8], at


def _segment_end(head: bytes) -> int | None:
    """Where Matroska's segment ends; None where that was not known when it was written."""
    at = 4
    length, at = _vint(head, at)
    at += length or 0
    if head[at : at + 4] != SEGMENT:
        return None
    length, at = _vint(head, at + 4)
    return None if length is None else at + length


def _vint(data: bytes, at: int) -> tuple[int | None, int]:
    """A number of variable length and where it ends; None for the one that means unknown."""
    first = data[at] if at < len(data) else 0
    n = 9 - first.bit_length()
    if not 1 <= n <= 8 or at + n > len(data):
        return None, at
    value = int.from_bytes(data[at : at + n], "big") & ((1 << 7 * n) - 1)
    return None if value == (1 << 7 * n) - 1 else value, at + n


def _riff_ends(file: BinaryIO, size: int) -> Iterator[int]:
    at = 0
    while at < size:
        file.seek(at)
        header = file.read(8)
        if len(header) < 8 or header[:4] != b"RIFF":
            break
        at += 8 + int.from_bytes(header[4:], "little")
        yield at
        at += at % 2
    yield 0
