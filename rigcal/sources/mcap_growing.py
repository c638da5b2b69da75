"""An MCAP file that grows by one chunk at a time, and that a later run can go on with.

Owns      the order of records: header, schemas and channels, then chunks with their message indexes, then the summary.
Leaves    what the messages hold to its caller, the layout of single records to the package mcap.

Every chunk is handed to the system in one piece as soon as it is made. So what a killed run leaves is whole chunks and
at most one cut off, which is dropped when the file is opened again. Layout: the MCAP specification, version 0.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING, NamedTuple

from aruco.errors import MissingExtraError, OutputError
from rigcal.sources.mcap_records import MAGIC, RECORD, Opcode

if TYPE_CHECKING:
    from mcap.records import Channel, McapRecord, Schema

_TIMES = struct.Struct("<QQQ")  # of a chunk: first and last log time, size of its records


class ChunkMessage(NamedTuple):
    """One message of a chunk."""

    channel: int
    log_time_ns: int
    data: bytes


class PackedChunk(NamedTuple):
    """A chunk as it will stand in the file."""

    record: bytes
    indexes: dict[int, bytes]  # channel -> message index
    times: bytes
    compression: str
    stored: int


def packed_chunk(messages: Sequence[ChunkMessage], *, compressed: bool) -> PackedChunk:
    """A chunk of messages of different channels; a file's chunks end with a message of one of its last channels."""
    from mcap.records import Chunk, Message, MessageIndex

    records = bytearray()
    indexes: dict[int, bytes] = {}
    for channel, log_time_ns, data in messages:
        indexes[channel] = _written(MessageIndex(channel, [(log_time_ns, len(records))]))
        records += _written(Message(channel, log_time_ns, data, log_time_ns, sequence=0))
    times = [message.log_time_ns for message in messages]
    compression = "zstd" if compressed else ""
    stored = _zstandard(records) if compressed else bytes(records)
    record = _written(
        Chunk(
            compression=compression,
            data=stored,
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=zlib.crc32(records),
            uncompressed_size=len(records),
        )
    )
    return PackedChunk(record, indexes, record[RECORD.size :][: _TIMES.size], compression, len(stored))


class GrowingMcap:
    """An MCAP file on disk that is not finished yet."""

    def __init__(
        self, path: Path, schemas: Sequence[Schema], channels: Sequence[Channel], last: frozenset[int]
    ) -> None:
        """Begin the file, or go on with it after the last whole chunk.

        Args:
            path: Where it is or will be.
            schemas: Every schema that a channel names.
            channels: Every channel that a message will have; the same as when the file was begun.
            last: Channels that a chunk's last message is of: a chunk counts as whole only with the index of such one.

        Raises:
            OutputError: The file begins otherwise.
            MissingExtraError: The package mcap is not installed.
        """
        self._schemas, self._channels, self._last = schemas, channels, last
        self.log_times_ns: dict[int, list[int]] = {channel: [] for channel in last}  # of the messages that are there
        self._counts: Counter[int] = Counter()
        self._indexes: list[bytes] = []
        self._span: tuple[int, int] | None = None
        beginning = MAGIC + _written(_header(), *schemas, *channels)
        self._file = path.open("r+b" if path.exists() else "w+b")
        found = self._file.read(len(beginning))
        if len(found) < len(beginning) and beginning.startswith(found):
            self._file.seek(0)
            self._file.write(beginning)
        elif found != beginning:
            self._file.close()
            raise OutputError(f"{path}: does not begin as this conversion would; remove it.")
        self._end = len(beginning)
        self._find_chunks()
        self._file.truncate(self._end)
        self._file.seek(self._end)

    def add(self, chunk: PackedChunk) -> None:
        """Write a chunk, in one piece."""
        self._file.write(chunk.record + b"".join(chunk.indexes.values()))
        self._file.flush()
        self._counts.update(chunk.indexes.keys())
        lengths = {channel: len(index) for channel, index in chunk.indexes.items()}
        self._note(_Group(len(chunk.record), chunk.times, chunk.compression, chunk.stored, lengths))

    def finish(self) -> None:
        """Write the summary and close the file."""
        from mcap.records import DataEnd, Footer, Statistics

        self._file.write(_written(DataEnd(data_section_crc=0)))
        start = self._file.tell()
        first, last = self._span or (0, 0)
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(sorted(self._counts.items())),
            chunk_count=len(self._indexes),
            message_count=self._counts.total(),
            message_end_time=last,
            message_start_time=first,
            metadata_count=0,
            schema_count=len(self._schemas),
        )
        groups = [
            (Opcode.SCHEMA, _written(*self._schemas)),
            (Opcode.CHANNEL, _written(*self._channels)),
            (Opcode.STATISTICS, _written(statistics)),
            (Opcode.CHUNK_INDEX, b"".join(self._indexes)),
        ]
        summary = b"".join(data for _, data in groups)
        offsets_start = start + len(summary)
        summary += _summary_offsets(start, groups)
        # The checksum covers the footer too, up to itself.
        footer = RECORD.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", start, offsets_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        self._file.write(summary + _written(Footer(start, offsets_start, crc)) + MAGIC)
        self.close()

    def close(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _find_chunks(self) -> None:
        """Go over the chunks that are there; stop at what is not whole."""
        size = self._file.seek(0, 2)
        while (group := _group(self._file, self._end, size)) is not None and group.lengths.keys() & self._last:
            self._counts.update(group.lengths.keys())
            self._note(group)

    def _note(self, group: _Group) -> None:
        """Keep what the summary says of a chunk; as bytes, since long recordings have many."""
        from mcap.records import ChunkIndex

        start_ns, end_ns, uncompressed = _TIMES.unpack(group.times)
        offsets, at = {}, self._end + group.length
        for channel, index_length in group.lengths.items():
            offsets[channel] = at
            at += index_length
        index = ChunkIndex(
            chunk_length=group.length,
            chunk_start_offset=self._end,
            compression=group.compression,
            compressed_size=group.stored,
            message_end_time=end_ns,
            message_index_length=at - self._end - group.length,
            message_index_offsets=offsets,
            message_start_time=start_ns,
            uncompressed_size=uncompressed,
        )
        self._indexes.append(_written(index))
        for channel in group.lengths.keys() & self._last:
            self.log_times_ns[channel].append(end_ns)
        known = self._span or (start_ns, end_ns)
        self._span = (min(known[0], start_ns), max(known[1], end_ns))
        self._end = at


def has_chunk(path: Path) -> bool:
    """Whether a file that was begun holds a chunk with its index."""
    size = path.stat().st_size
    with path.open("rb") as file:
        at = len(MAGIC)
        while at + RECORD.size <= size:  # the header, schemas and channels first
            file.seek(at)
            opcode, length = RECORD.unpack(file.read(RECORD.size))
            if opcode == Opcode.CHUNK:
                group = _group(file, at, size)
                return group is not None and bool(group.lengths)
            at += RECORD.size + length
    return False


class _Group(NamedTuple):
    """A chunk and the message indexes behind it."""

    length: int  # of the chunk's record
    times: bytes
    compression: str
    stored: int
    lengths: dict[int, int]  # channel -> length of its message index


def _group(file: IO[bytes], at: int, size: int) -> _Group | None:
    """The whole chunk at an offset with its whole indexes; None: there is none."""
    if at + RECORD.size > size:
        return None
    file.seek(at)
    opcode, length = RECORD.unpack(file.read(RECORD.size))
    end = at + RECORD.size + length
    if opcode != Opcode.CHUNK or end > size:
        return None
    head = file.read(_TIMES.size + 8)
    compression = file.read(int.from_bytes(head[-4:], "little")).decode()
    stored = int.from_bytes(file.read(8), "little")
    lengths: dict[int, int] = {}
    index = end
    while index + RECORD.size <= size:
        file.seek(index)
        opcode, length = RECORD.unpack(file.read(RECORD.size))
        if opcode != Opcode.MESSAGE_INDEX or index + RECORD.size + length > size:
            break
        lengths[int.from_bytes(file.read(2), "little")] = RECORD.size + length
        index += RECORD.size + length
    return _Group(end - at, head[: _TIMES.size], compression, stored, lengths)


def _header() -> McapRecord:
    try:
        from mcap.records import Header
    except ModuleNotFoundError as error:
        if error.name != "mcap":
            raise
        raise MissingExtraError("mcap", "bags") from error
    return Header(profile="ros2", library="rigcal")


def _summary_offsets(start: int, groups: Sequence[tuple[int, bytes]]) -> bytes:
    """Where the groups of the summary begin, for readers that want only one of them."""
    offsets = b""
    for opcode, data in groups:
        offsets += (
            RECORD.pack(Opcode.SUMMARY_OFFSET, 17) + struct.pack("<BQQ", opcode, start, len(data)) if data else b""
        )
        start += len(data)
    return offsets


def _written(*records: McapRecord) -> bytes:
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def _zstandard(data: bytes | bytearray) -> bytes:
    import zstandard  # comes with mcap

    # Level 1 halves depth as level 3 does, in half the time.
    return zstandard.ZstdCompressor(level=1).compress(data)
