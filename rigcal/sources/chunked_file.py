"""Containers that keep messages in chunks (MCAP, ROS 1 bags): where messages lie, and reading one of them.

Owns      the index of messages while and after it is built, chunks that turn out to be damaged, memory.
Leaves    what records look like to mcap_walk and rosbag1_index, compressed blocks to decompression.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Protocol

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from rigcal.sources.decompression import DamagedError, decompressed

# A day of a 400 Hz sensor has 35 million; each costs 20 bytes here.
MAX_MESSAGES = 100_000_000
NO_CHUNK = -1

Read = Callable[[int, int], bytes]  # (at, size)
# (read, at, end, channel) -> (begin, size) of the message whose record begins at ``at``; raises DamagedError.
Extent = Callable[[Read, int, int, int], tuple[int, int]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Chunk:
    """Messages that are stored together."""

    at: int  # of the stored contents in the file
    stored: int  # bytes there
    stated: int  # bytes when decompressed
    compression: str
    crc: int = 0  # of the decompressed bytes; 0: not known
    cut: bool = False  # the file ends within


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Places:
    """The messages of one channel in the order in which they lie in the file."""

    log_times_ns: NDArray[np.int64]  # (n,)
    chunks: NDArray[np.int32]  # (n,) number of the chunk, NO_CHUNK: in none
    offsets: NDArray[np.int64]  # (n,) of the message's record in the chunk or in the file


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Some bytes of a message."""

    channel: int
    index: int
    total: int  # bytes of the whole message
    data: bytes | None  # None: the message is lost


@dataclass(slots=True, kw_only=True, eq=False)
class _Pieces:
    """A channel's places as they come."""

    log_times_ns: list[NDArray[np.int64]] = field(default_factory=list)
    chunks: list[NDArray[np.int32]] = field(default_factory=list)
    offsets: list[NDArray[np.int64]] = field(default_factory=list)


class IndexBuilder:
    """Chunks and places, gathered in one walk through a file."""

    def __init__(self) -> None:
        self.chunks: list[Chunk] = []
        self.unindexed: set[int] = set()  # chunks whose index has not been seen whole
        self.users: dict[int, set[int]] = {}  # chunk -> channels that its index names
        self._pieces: dict[int, _Pieces] = {}
        self._pending: list[tuple[int, NDArray[np.int64]]] = []  # index of the last chunk
        self._total = 0

    @property
    def channels(self) -> set[int]:
        """Channels that have messages."""
        return set(self._pieces)

    def begin_chunk(self, chunk: Chunk) -> None:
        """A chunk; it counts as unindexed until ``settle``."""
        self.unindexed.add(len(self.chunks))
        self.chunks.append(chunk)

    def index_last_chunk(self, channel: int, entries: NDArray[np.int64]) -> None:
        """A piece of the index, (n, 2) of log time and offset, that follows the last chunk."""
        if self.chunks:
            self._pending.append((channel, entries))

    def settle(self, *, whole: bool = True) -> None:
        """The index of the last chunk has ended; where the file ends with it, it need not be whole."""
        if self._pending and whole:
            number = len(self.chunks) - 1
            self.unindexed.discard(number)
            for channel, entries in self._pending:
                self.add(channel, entries, number)
                if len(entries):
                    self.users.setdefault(number, set()).add(channel)
        self._pending = []

    def add(self, channel: int, entries: NDArray[np.int64], chunk: int) -> None:
        """Messages of one channel, (n, 2) of log time and offset, in one chunk."""
        self._total += len(entries)
        if self._total > MAX_MESSAGES:
            raise DamagedError(f"has more than {MAX_MESSAGES} messages")
        if len(entries):
            pieces = self._pieces.setdefault(channel, _Pieces())
            pieces.log_times_ns.append(entries[:, 0].copy())
            pieces.offsets.append(entries[:, 1].copy())
            pieces.chunks.append(np.full(len(entries), chunk, dtype=np.int32))

    def places(self, channel: int) -> Places:
        """Where a channel's messages lie, in the file's order."""
        pieces = self._pieces.get(channel)
        if pieces is None:
            nothing = np.empty(0, dtype=np.int64)
            return Places(log_times_ns=nothing, chunks=np.empty(0, dtype=np.int32), offsets=nothing)
        times, offsets = np.concatenate(pieces.log_times_ns), np.concatenate(pieces.offsets)
        chunks = np.concatenate(pieces.chunks)
        order = np.lexsort((offsets, chunks))
        return Places(log_times_ns=times[order], chunks=chunks[order], offsets=offsets[order])

    def must_look_into(self, chunk: int, known: Collection[int]) -> bool:
        """Whether a chunk has no index, or its index names a channel that is not among the known ones."""
        return chunk in self.unindexed or not self.users.get(chunk, set()) <= {*known}

    def loss(self, at: int, size: int) -> str:
        """How a file of so many bytes ends that is cut off in the record at some byte; completes "<file> ..."."""
        return (
            f"is cut off: the record at byte {at} of {size} is not whole; the {self._span_s():.3f} s of messages "
            "before are used"
        )

    def _span_s(self) -> float:
        """Seconds from the first message to the last."""
        span = span_of([times for pieces in self._pieces.values() for times in pieces.log_times_ns])
        return 0.0 if span is None else (span[1] - span[0]) / 1e9


def span_of(log_times_ns: Sequence[NDArray[np.int64]]) -> tuple[int, int] | None:
    """The first and the last of all times; None where there are none."""
    times = [times for times in log_times_ns if len(times)]
    return (min(int(t.min()) for t in times), max(int(t.max()) for t in times)) if times else None


class Walk(Protocol):
    """One pass over a file's records."""

    index: IndexBuilder

    def through(self, file: IO[bytes]) -> None:
        """Walk from the first record to the end, or to where the file is cut off."""
        ...

    def must_look_into(self, chunk: int) -> bool:
        """Whether a chunk's contents are needed to know its messages and their channels."""
        ...

    def look_into(self, data: memoryview, chunk: int) -> None:
        """Learn from a chunk's contents what its index does not say."""
        ...


class ChunkedFile:
    """Messages by channel and number. Nothing stays open; one chunk at most stays in memory."""

    def __init__(self, path: Path, chunks: Sequence[Chunk], extent: Extent) -> None:
        """A file whose chunks are known, or will be; ``places`` is set when the index is complete.

        Args:
            path: The file.
            chunks: Its chunks.
            extent: Finds a message's bytes from its record.
        """
        self.path = path
        self.places: Mapping[int, Places] = {}
        self._chunks = chunks
        self._extent = extent
        self._cached: tuple[int, memoryview] | None = None
        self._lost: set[int] = set()

    def walk_through(self, walk: Walk, what: str) -> None:
        """Find the chunks and what lies in them; no message is read.

        Args:
            walk: Over the file's records; its index has the chunks.
            what: The file is: "file", "bag".

        Raises:
            InputError: It is something else, damaged beyond use, or of absurd sizes.
        """
        try:
            with self.path.open("rb") as file:
                walk.through(file)
                # Chunks without an index, and those that define a channel which nothing else does.
                for number in filter(walk.must_look_into, range(len(self._chunks))):
                    try:
                        walk.look_into(self.contents(file, number), number)
                    except DamagedError as error:
                        logger.debug("{}: chunk {} is not indexed: {}", self.path, number, error)
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be read ({error.strerror or error}); mend its permissions."
            ) from error
        except DamagedError as error:
            raise InputError(f"{self.path}: {error}; record or copy the {what} again.") from error

    def log_times_ns(self, channel: int) -> NDArray[np.int64]:
        """(n,) when each message was logged, in the order in which they lie in the file."""
        return self.places[channel].log_times_ns

    def message(self, channel: int, index: int) -> bytes:
        """The bytes of a channel's message; raises DamagedError where its chunk is lost."""
        try:
            with self.path.open("rb") as file:
                read, begin, size = self._found(file, channel, index, whole=True)
                return read(begin, size)
        except OSError as error:
            raise DamagedError(f"cannot be read ({error.strerror or error})") from error

    def parts(self, channels: Sequence[int], size: int, *, start: int = 0) -> Iterator[Part]:
        """A few bytes of every message of some channels; chunks that are not compressed are not read for it.

        Args:
            channels: Ids of the channels wanted.
            size: How many bytes of each message, at most.
            start: Of which byte on; negative: counted from the message's end.

        Yields:
            The parts in the order in which the messages lie in the file. Checksums are not looked at where the chunk
            is not read.
        """
        with self.path.open("rb") as file:
            for which, index in _file_order([self.places[channel] for channel in channels]):
                channel = channels[which]
                try:
                    read, begin, total = self._found(file, channel, index, whole=False)
                except DamagedError:
                    yield Part(channel=channel, index=index, total=0, data=None)
                    continue
                first = max(0, total + start) if start < 0 else min(start, total)
                yield Part(
                    channel=channel, index=index, total=total, data=read(begin + first, min(size, total - first))
                )

    def contents(self, file: IO[bytes], number: int) -> memoryview:
        """A chunk's contents; raises DamagedError, and warns once, where they are lost."""
        cached = self._cached  # read once: another thread may forget it
        if cached is not None and cached[0] == number:
            return cached[1]
        if number in self._lost:
            raise DamagedError("lies in a damaged chunk")
        self._cached = None
        chunk = self._chunks[number]
        try:
            file.seek(chunk.at)
            data = decompressed(file.read(chunk.stored), chunk.compression, chunk.stated, cut=chunk.cut)
            if chunk.crc and not chunk.cut and zlib.crc32(data) != chunk.crc:
                raise DamagedError("does not fit its checksum")
        except DamagedError as error:
            self._lost.add(number)
            logger.warning("{}: the chunk at byte {} {}; its messages are lost", self.path, chunk.at, error)
            raise DamagedError("lies in a damaged chunk") from error
        self._cached = (number, data)
        return data

    def _found(self, file: IO[bytes], channel: int, index: int, *, whole: bool) -> tuple[Read, int, int]:
        """How to read, and begin and size of a message there; a whole message comes from a checked chunk."""
        places = self.places[channel]
        number, offset = int(places.chunks[index]), int(places.offsets[index])
        if number == NO_CHUNK:
            read, end = reader(file), file.seek(0, 2)
        elif not whole and self._chunks[number].compression in ("", "none"):
            read, end = reader(file, self._chunks[number].at), self._chunks[number].stored
        else:
            data = self.contents(file, number)
            read, end = (lambda at, size: bytes(data[at : at + size])), len(data)
        return read, *self._extent(read, offset, end, channel)


def _file_order(places: Sequence[Places]) -> Iterator[tuple[int, int]]:
    """(which, index) of all messages in the order in which they lie in the file."""
    if not places:
        return
    counts = [len(place.offsets) for place in places]
    which = np.repeat(np.arange(len(places)), counts)
    index = np.concatenate([np.arange(count) for count in counts])
    order = np.lexsort(
        (np.concatenate([place.offsets for place in places]), np.concatenate([place.chunks for place in places]))
    )
    for at in order:
        yield int(which[at]), int(index[at])


def reader(file: IO[bytes], base: int = 0) -> Read:
    """Reading of a file from some byte on."""

    def read(at: int, size: int) -> bytes:
        file.seek(base + at)
        return file.read(size)

    return read
