"""Where the messages of a container lie: its chunks, and the index of messages as it is built.

Owns      chunks, places, what of an index counts, and the memory that it takes.
Leaves    finding them to mcap_walk and rosbag1_index, reading messages to chunked_file.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError

# A day of a 400 Hz sensor has 35 million; each costs 20 bytes here.
MAX_MESSAGES = 100_000_000
NO_CHUNK = -1


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """Messages that are stored together."""

    at: int  # of the stored contents in the file
    stored: int  # bytes there
    stated: int  # bytes when decompressed
    compression: str
    crc: int = 0  # of the decompressed bytes; 0: not known
    cut: bool = False  # the file ends within
    damage: str = ""  # why its contents are lost; completes "the chunk at byte <n> ..."

    @property
    def is_plain(self) -> bool:
        """Whether a part of it can be read without the rest."""
        return not self.damage and self.compression in ("", "none")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Places:
    """The messages of one channel in the order in which they lie in the file."""

    log_times_ns: NDArray[np.int64]  # (n,)
    chunks: NDArray[np.int32]  # (n,) number of the chunk, NO_CHUNK: in none
    offsets: NDArray[np.int64]  # (n,) of the message's record in the chunk or in the file


@dataclass(slots=True, kw_only=True, eq=False)
class _Pieces:
    """A channel's places as they come; arrays take a tenth of the memory that Python's numbers do."""

    log_times_ns: array[int] = field(default_factory=lambda: array("q"))
    chunks: array[int] = field(default_factory=lambda: array("i"))
    offsets: array[int] = field(default_factory=lambda: array("q"))


class IndexBuilder:
    """Chunks and places, gathered in one walk through a file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.chunks: list[Chunk] = []
        self.unindexed: set[int] = set()  # chunks whose index has not been seen whole
        self.users: dict[int, set[int]] = {}  # chunk -> channels that its index names
        self._pieces: dict[int, _Pieces] = {}
        # Index of the chunk that has just been; None: no chunk has, or its index is damaged.
        self._pending: list[tuple[int, NDArray[np.int64]]] | None = None
        self._total = 0
        self._n_left_out = 0
        self._first_left_out = ""

    @property
    def channels(self) -> set[int]:
        """Channels that have messages."""
        return set(self._pieces)

    def begin_chunk(self, chunk: Chunk) -> None:
        """A chunk; it counts as unindexed until ``settle``."""
        self.unindexed.add(len(self.chunks))
        self.chunks.append(chunk)
        self._pending = []

    def index_last_chunk(self, channel: int, entries: NDArray[np.int64]) -> None:
        """A piece of the index, (n, 2) of log time and offset, that follows the last chunk."""
        if self._pending is not None:
            self._pending.append((channel, entries))

    def spoil_last_index(self) -> None:
        """A piece of the last chunk's index is damaged: what the others leave out is in the chunk alone."""
        self._pending = None

    def settle(self, *, whole: bool = True) -> None:
        """The index of the last chunk has ended; where the file ends with it, it need not be whole."""
        if self._pending and whole:
            number = len(self.chunks) - 1
            self.unindexed.discard(number)
            for channel, entries in self._pending:
                self.add(channel, entries, number)
                if len(entries):
                    self.users.setdefault(number, set()).add(channel)
        self._pending = None

    def add(self, channel: int, entries: NDArray[np.int64], chunk: int) -> None:
        """Messages of one channel, (n, 2) of log time and offset, in one chunk; raises InputError if too many."""
        if len(entries):
            pieces = self._room(channel, len(entries))
            pieces.log_times_ns.frombytes(entries[:, 0].tobytes())
            pieces.offsets.frombytes(entries[:, 1].tobytes())
            pieces.chunks.frombytes(np.full(len(entries), chunk, dtype=np.int32).tobytes())

    def add_one(self, channel: int, log_time_ns: int, offset: int, chunk: int) -> None:
        """A message in a chunk without index or in none; raises InputError if it is one too many."""
        pieces = self._room(channel, 1)
        pieces.log_times_ns.append(log_time_ns)
        pieces.offsets.append(offset)
        pieces.chunks.append(chunk)

    def leave_out(self, what: str) -> None:
        """A damaged record, by its place and damage: "the one at byte <n> ..."."""
        self._n_left_out += 1
        self._first_left_out = self._first_left_out or what

    def tell_left_out(self) -> None:
        """Warn of damaged records, if there were any."""
        if self._n_left_out:
            first = self._first_left_out
            logger.warning("{}: damaged records left out: {}; first {}", self._path, self._n_left_out, first)

    def places(self, channel: int) -> Places:
        """Where a channel's messages lie, in the file's order."""
        pieces = self._pieces.get(channel, _Pieces())
        times, offsets = np.asarray(pieces.log_times_ns, dtype=np.int64), np.asarray(pieces.offsets, dtype=np.int64)
        chunks = np.asarray(pieces.chunks, dtype=np.int32)
        order = np.lexsort((offsets, chunks))
        return Places(log_times_ns=times[order], chunks=chunks[order], offsets=offsets[order])

    def must_look_into(self, chunk: int, known: Collection[int]) -> bool:
        """Whether a chunk has no index, or its index names a channel that is not among the known ones."""
        return chunk in self.unindexed or not self.users.get(chunk, set()) <= {*known}

    def loss(self, at: int, size: int) -> str:
        """How a file of so many bytes ends that is cut off in the record at some byte; completes "<file> ..."."""
        return (
            f"is cut off or damaged: the record at byte {at} of {size} is not whole; the {self._span_s():.3f} s of "
            "messages before are used"
        )

    def _span_s(self) -> float:
        """Seconds from the first message to the last."""
        span = span_of([np.asarray(pieces.log_times_ns, dtype=np.int64) for pieces in self._pieces.values()])
        return 0.0 if span is None else (span[1] - span[0]) / 1e9

    def _room(self, channel: int, count: int) -> _Pieces:
        self._total += count
        if self._total > MAX_MESSAGES:
            raise InputError(f"{self._path}: has more than {MAX_MESSAGES} messages; give a part of the recording.")
        return self._pieces.setdefault(channel, _Pieces())


def span_of(log_times_ns: Sequence[NDArray[np.int64]]) -> tuple[int, int] | None:
    """The first and the last of all times; None where there are none."""
    times = [times for times in log_times_ns if len(times)]
    return (min(int(t.min()) for t in times), max(int(t.max()) for t in times)) if times else None
