"""The messages of an MCAP file by channel and number, read one at a time; also of files that are cut off.

Owns      opening an MCAP file, and messages in it (mcap.dev/spec).
Leaves    the other records to mcap_walk, chunks to chunked_file, what messages mean to mcap_file and svo2.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from rigcal.sources.chunked_file import ChunkedFile, Part, Read
from rigcal.sources.decompression import MAX_MESSAGE_BYTES, DamagedError
from rigcal.sources.mcap_walk import MAGIC, MESSAGE, MESSAGE_HEAD, RECORD, McapChannel, McapWalk

__all__ = ["MAGIC", "DamagedError", "McapChannel", "McapIndex", "Part"]


class McapIndex:
    """Channels, metadata and messages of one MCAP file. Nothing stays open; one chunk at most stays in memory."""

    def __init__(self, path: Path, *, extra: str = "bags") -> None:
        """Walk through the file; no message is read.

        Args:
            path: The file.
            extra: Which of rigcal's extras a user lacks who has no mcap package.

        Raises:
            InputError: Not an MCAP file, damaged beyond use, or of absurd sizes.
            MissingExtraError: The package mcap is not installed.
        """
        walk = McapWalk(path, extra)
        self.path = path
        self._file = ChunkedFile(path, walk.index.chunks, _extent)
        try:
            with path.open("rb") as file:
                walk.through(file)
                # Chunks without an index, and those that define a channel which nothing else does.
                for number in range(len(walk.index.chunks)):
                    if walk.must_look_into(number):
                        try:
                            walk.look_into(self._file.contents(file, number), number)
                        except DamagedError as error:
                            logger.debug("{}: chunk {} is not indexed: {}", path, number, error)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error}); mend its permissions.") from error
        except DamagedError as error:
            raise InputError(f"{path}: {error}; record or copy the file again.") from error
        self.loss: str | None = walk.loss()  # how a file ends that is cut off: "<file> ..."
        self.profile, self.library = walk.header  # "ros2", and who wrote the file
        self.metadata: Mapping[str, Mapping[str, str]] = walk.metadata  # name -> its entries
        self.channels: tuple[McapChannel, ...] = walk.known_channels()  # sorted by topic
        self._file.places = {channel.id: walk.index.places(channel.id) for channel in self.channels}

    def count(self, channel: int) -> int:
        """How many messages a channel has."""
        return len(self._file.places[channel].offsets)

    def log_times_ns(self, channel: int) -> NDArray[np.int64]:
        """(n,) when each message was logged, in the order in which they lie in the file."""
        return self._file.places[channel].log_times_ns

    def message(self, channel: int, index: int) -> bytes:
        """The bytes of a channel's message; raises DamagedError where its chunk is lost."""
        return self._file.message(channel, index)

    def parts(self, channels: Sequence[int], size: int, *, start: int = 0) -> Iterator[Part]:
        """A few bytes of every message of some channels; see ChunkedFile.parts."""
        return self._file.parts(channels, size, start=start)


def _extent(read: Read, at: int, end: int, channel: int) -> tuple[int, int]:
    """(begin, size) of the message whose record is at ``at`` of ``end`` bytes."""
    begin = at + RECORD.size + MESSAGE_HEAD.size
    start = read(at, RECORD.size + MESSAGE_HEAD.size) if at >= 0 and begin <= end else b""
    if len(start) < RECORD.size + MESSAGE_HEAD.size:
        raise DamagedError("is not where the index says")
    opcode, length = RECORD.unpack_from(start)
    size = length - MESSAGE_HEAD.size
    if opcode != MESSAGE or MESSAGE_HEAD.unpack_from(start, RECORD.size)[0] != channel:
        raise DamagedError("is not where the index says")
    if not 0 <= size <= MAX_MESSAGE_BYTES or begin + size > end:
        raise DamagedError(f"states {size} bytes, more than a message or its chunk has")
    return begin, size
