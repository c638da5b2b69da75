"""Containers that keep messages in chunks (MCAP, ROS 1 bags): reading one message of them, or a part of many.

Owns      finding and reading a message, chunks that turn out to be damaged, memory.
Leaves    the index to message_places, what records look like to mcap_walk and rosbag1_index, compressed blocks to
          decompression.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from rigcal.sources.decompression import MAX_CHUNK_BYTES, DamagedError, decompressed
from rigcal.sources.message_places import NO_CHUNK, Chunk, IndexBuilder, Places

Read = Callable[[int, int], bytes]  # (at, size)
# (read, at, end, channel) -> (begin, size) of the message whose record begins at ``at``; raises DamagedError.
Extent = Callable[[Read, int, int, int], tuple[int, int]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Some bytes of a message."""

    channel: int
    index: int
    total: int  # bytes of the whole message
    data: bytes | None  # None: the message is lost


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

    def walk_through(self, walk: Walk) -> None:
        """Find the chunks and what lies in them; no message is read.

        Args:
            walk: Over the file's records; its index has the chunks.

        Raises:
            InputError: It cannot be read, is something else, or has too many messages.
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
                walk.index.tell_left_out()
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be read ({error.strerror or error}); mend its permissions."
            ) from error

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

    def parts(self, channels: Sequence[int], size: int, *, start: int = 0, step: int = 1) -> Iterator[Part]:
        """A few bytes of each message of some channels; chunks that are not compressed are not read for it.

        Args:
            channels: Ids of the channels wanted.
            size: How many bytes of each message, at most.
            start: Of which byte on; negative: counted from the message's end.
            step: Only each ``step``-th message of a channel, from the first on, is looked at.

        Yields:
            The parts in the order in which the messages lie in the file. Checksums are not looked at where the chunk
            is not read.
        """
        with self.path.open("rb") as file:
            for which, index in _file_order([self.places[channel] for channel in channels], step):
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
            if chunk.damage:
                raise DamagedError(chunk.damage)
            if max(chunk.stored, chunk.stated) > MAX_CHUNK_BYTES:
                raise DamagedError(f"states {max(chunk.stored, chunk.stated)} bytes, more than 1 GiB")
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
        elif not whole and self._chunks[number].is_plain:
            read, end = reader(file, self._chunks[number].at), self._chunks[number].stored
        else:
            data = self.contents(file, number)
            read, end = (lambda at, size: bytes(data[at : at + size])), len(data)
        return read, *self._extent(read, offset, end, channel)


def _file_order(places: Sequence[Places], step: int) -> Iterator[tuple[int, int]]:
    """(which, index) of each channel's every ``step``-th message, in the order in which they lie in the file."""
    if not places:
        return
    offsets = [place.offsets[::step] for place in places]
    which = np.repeat(np.arange(len(places)), [len(some) for some in offsets])
    index = np.concatenate([step * np.arange(len(some)) for some in offsets])
    order = np.lexsort((np.concatenate(offsets), np.concatenate([place.chunks[::step] for place in places])))
    for at in order:
        yield int(which[at]), int(index[at])


def reader(file: IO[bytes], base: int = 0) -> Read:
    """Reading of a file from some byte on."""

    def read(at: int, size: int) -> bytes:
        file.seek(base + at)
        return file.read(size)

    return read
