"""The messages of an MCAP file by channel and number, read one at a time; also of files that are cut off.

Owns      opening an MCAP file, and messages in it (mcap.dev/spec).
Leaves    the other records to mcap_walk, chunks to chunked_file, what messages mean to mcap_file and svo2.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rigcal.sources.chunked_file import ChunkedFile, Part, Read
from rigcal.sources.decompression import MAX_MESSAGE_BYTES, DamagedError
from rigcal.sources.mcap_records import RECORD, Opcode
from rigcal.sources.mcap_walk import MESSAGE_HEAD, McapChannel, McapWalk

__all__ = ["DamagedError", "McapChannel", "McapIndex", "Part"]


class McapIndex(ChunkedFile):
    """Channels, metadata and messages of one MCAP file. Nothing stays open; one chunk at most stays in memory."""

    def __init__(self, path: Path, *, extra: str = "bags") -> None:
        """Walk through the file; no message is read.

        Args:
            path: The file.
            extra: Which of rigcal's extras a user lacks who has no mcap package.

        Raises:
            InputError: Not an MCAP file, or one of too many messages.
            MissingExtraError: The package mcap is not installed.
        """
        walk = McapWalk(path, extra)
        super().__init__(path, walk.index.chunks, _extent)
        self.walk_through(walk)
        self.loss: str | None = walk.loss()  # how a file ends that is cut off: "<file> ..."
        self.profile, self.library = walk.header  # "ros2", and who wrote the file
        self.metadata: Mapping[str, Mapping[str, str]] = walk.metadata  # name -> its entries
        self.channels: tuple[McapChannel, ...] = walk.known_channels()  # sorted by topic
        self.places = {channel.id: walk.index.places(channel.id) for channel in self.channels}

    def count(self, channel: int) -> int:
        """How many messages a channel has."""
        return len(self.places[channel].offsets)


def _extent(read: Read, at: int, end: int, channel: int) -> tuple[int, int]:
    """(begin, size) of the message whose record is at ``at`` of ``end`` bytes."""
    begin = at + RECORD.size + MESSAGE_HEAD.size
    start = read(at, RECORD.size + MESSAGE_HEAD.size) if at >= 0 and begin <= end else b""
    if len(start) < RECORD.size + MESSAGE_HEAD.size:
        raise DamagedError("is not where the index says")
    opcode, length = RECORD.unpack_from(start)
    size = length - MESSAGE_HEAD.size
    if opcode != Opcode.MESSAGE or MESSAGE_HEAD.unpack_from(start, RECORD.size)[0] != channel:
        raise DamagedError("is not where the index says")
    if not 0 <= size <= MAX_MESSAGE_BYTES or begin + size > end:
        raise DamagedError(f"states {size} bytes, more than a message or its chunk has")
    return begin, size
