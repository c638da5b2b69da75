"""One pass over the records of an MCAP file, which finds its channels and the places of its messages.

Owns      records (mcap.dev/spec), and what of a file that is cut off can be had.
Leaves    reading messages to mcap_index.

The file is walked from record to record; chunks are skipped where they are indexed. So a file without a summary
(whoever wrote it was interrupted) is read like any other.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from loguru import logger

from aruco.errors import InputError, MissingExtraError
from rigcal.sources.decompression import MAX_CHUNK_BYTES
from rigcal.sources.mcap_records import MAGIC, RECORD, Opcode
from rigcal.sources.message_places import NO_CHUNK, Chunk, IndexBuilder

# A schema with all that it refers to has some 10 kB.
MAX_DEFINITION_BYTES = 16 * 2**20
MAX_COMPRESSION_NAME_BYTES = 64

_CHUNK_HEAD = struct.Struct("<QQQII")  # first and last log time, size and CRC of the contents, length of compression
# Channel, sequence, log time, publish time; times that exceed 63 bits are nonsense and become negative.
MESSAGE_HEAD = struct.Struct("<HIqq")


@dataclass(frozen=True, slots=True, kw_only=True)
class McapChannel:
    """One topic of one publisher."""

    id: int
    topic: str
    encoding: str  # of messages: "cdr", "ros1", "json", "protobuf", ...
    schema_name: str  # "" for none
    schema_encoding: str  # "ros2msg", "ros1msg", "jsonschema", ...
    schema_data: bytes
    metadata: Mapping[str, str]


class McapWalk:
    """One pass over a file's records."""

    def __init__(self, path: Path, extra: str) -> None:
        try:
            from mcap import records
            from mcap.data_stream import ReadDataStream
        except ImportError as error:
            raise MissingExtraError("mcap", extra) from error
        self._records, self._stream = records, ReadDataStream
        self._path = path
        self._size = 0
        self.index = IndexBuilder(path)
        self.header = ("", "")  # profile and library
        self.metadata: dict[str, dict[str, str]] = {}
        self._schemas: dict[int, Any] = {}
        self._channels: dict[int, Any] = {}
        self._cut_at: int | None = None
        self._has_all_data = False

    def through(self, file: IO[bytes]) -> None:
        """Walk from the first record to the footer, or to where the file ends."""
        self._size = file.seek(0, 2)
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{self._path}: is not an MCAP file; check the path.")
        at, opcode = len(MAGIC), 0
        handlers = self._handlers()
        while opcode != Opcode.FOOTER:
            file.seek(at)
            head = file.read(RECORD.size)
            opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
            body, end = at + RECORD.size, at + RECORD.size + length
            if opcode == 0 or end > self._size:
                self._cut(file, at, opcode, body)
                break
            if opcode != Opcode.MESSAGE_INDEX:
                self.index.settle()
            if opcode in handlers:
                handlers[opcode](file, body, length)
            self._has_all_data |= opcode == Opcode.DATA_END
            at = end

    def must_look_into(self, chunk: int) -> bool:
        """Whether a chunk has no index, or its index names a channel of which no definition is known yet."""
        return self.index.must_look_into(chunk, self._channels)

    def look_into(self, data: memoryview, chunk: int) -> None:
        """Definitions, and messages where there is no index, of those records of a chunk that are whole."""
        with_messages = chunk in self.index.unindexed
        at = 0
        while at + RECORD.size <= len(data):
            opcode, length = RECORD.unpack_from(data, at)
            body, end = at + RECORD.size, at + RECORD.size + length
            if end > len(data):
                break
            if opcode == Opcode.MESSAGE and with_messages and length >= MESSAGE_HEAD.size:
                channel, _, log_time_ns, _ = MESSAGE_HEAD.unpack_from(data, body)
                self.index.add_one(channel, log_time_ns, at, chunk)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and length <= MAX_DEFINITION_BYTES:
                self._define(opcode, bytes(data[body:end]), self.index.chunks[chunk].at)
            at = end

    def known_channels(self) -> tuple[McapChannel, ...]:
        """The channels that are defined, sorted by topic and id."""
        unknown = sorted(self.index.channels - self._channels.keys())
        if unknown:
            logger.warning("{}: messages of undefined channels {} are left out", self._path, unknown)
        none = self._records.Schema(id=0, name="", encoding="", data=b"")
        channels = []
        for channel in sorted(self._channels.values(), key=lambda channel: (channel.topic, channel.id)):
            schema = self._schemas.get(channel.schema_id, none)
            channels.append(
                McapChannel(
                    id=channel.id,
                    topic=channel.topic,
                    encoding=channel.message_encoding,
                    schema_name=schema.name,
                    schema_encoding=schema.encoding,
                    schema_data=schema.data,
                    metadata=channel.metadata,
                )
            )
        return tuple(channels)

    def loss(self) -> str | None:
        """How the file ends if it is cut off; completes "<file> ..."."""
        if self._cut_at is None or self._has_all_data:
            return None
        return self.index.loss(self._cut_at, self._size)

    def _handlers(self) -> Mapping[int, Callable[[IO[bytes], int, int], None]]:
        def define(opcode: Opcode) -> Callable[[IO[bytes], int, int], None]:
            # What is longer is read as far as that, and so is damaged.
            return lambda file, at, length: self._define(opcode, file.read(min(length, MAX_DEFINITION_BYTES)), at)

        return {
            **{opcode: define(opcode) for opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA)},
            Opcode.MESSAGE: self._message,
            Opcode.CHUNK: self._chunk,
            Opcode.MESSAGE_INDEX: self._message_index,
        }

    def _define(self, opcode: int, body: bytes, at: int) -> None:
        from mcap.exceptions import McapError

        stream = self._stream(BytesIO(body))
        try:
            if opcode == Opcode.SCHEMA:
                schema = self._records.Schema.read(stream)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = self._records.Channel.read(stream)
                self._channels[channel.id] = channel
            elif opcode == Opcode.HEADER:
                header = self._records.Header.read(stream)
                self.header = (header.profile, header.library)
            else:
                metadata = self._records.Metadata.read(stream)
                self.metadata[metadata.name] = metadata.metadata
        except (McapError, struct.error, ValueError) as error:
            self.index.leave_out(f"the one at byte {at} (opcode {opcode}): {error}")

    def _message(self, file: IO[bytes], at: int, length: int) -> None:
        head = file.read(MESSAGE_HEAD.size)
        if length >= MESSAGE_HEAD.size == len(head):
            channel, _, log_time_ns, _ = MESSAGE_HEAD.unpack(head)
            self.index.add_one(channel, log_time_ns, at - RECORD.size, NO_CHUNK)

    def _chunk(self, file: IO[bytes], at: int, length: int, *, cut: bool = False) -> None:
        head = file.read(min(length, _CHUNK_HEAD.size + MAX_COMPRESSION_NAME_BYTES + 8))
        self.index.begin_chunk(_chunk_of(head, at, length, cut=cut))

    def _message_index(self, file: IO[bytes], at: int, length: int) -> None:
        body = file.read(length) if length <= MAX_CHUNK_BYTES else b""
        if len(body) < 6 or (len(body) - 6) % 16:
            logger.debug("{}: the index at byte {} is damaged; its chunk is looked into", self._path, at)
            self.index.spoil_last_index()
            return
        # What exceeds 63 bits wraps to a negative number, which is refused when the message is read.
        entries = np.frombuffer(body, dtype="<i8", offset=6).reshape(-1, 2)
        self.index.index_last_chunk(int.from_bytes(body[:2], "little"), entries)

    def _cut(self, file: IO[bytes], at: int, opcode: int, body: int) -> None:
        """The file ends here; a chunk that has begun is kept as far as it goes."""
        self._cut_at = at
        self.index.settle(whole=False)
        # A few bytes of its header are of no use.
        if opcode == Opcode.CHUNK and self._size - body > _CHUNK_HEAD.size + MAX_COMPRESSION_NAME_BYTES:
            self._chunk(file, body, self._size - body, cut=True)


def _chunk_of(head: bytes, at: int, length: int, *, cut: bool) -> Chunk:
    """The chunk whose record has ``length`` bytes at ``at`` that begin with ``head``; its messages may be indexed."""
    lost = Chunk(at=at, stored=length, stated=length, compression="", damage="has a damaged header")
    if len(head) < _CHUNK_HEAD.size:
        return lost
    _, _, stated, crc, name_length = _CHUNK_HEAD.unpack_from(head)
    begin = _CHUNK_HEAD.size + name_length + 8
    if begin > len(head):
        return lost
    return Chunk(
        at=at + begin,
        stored=min(int.from_bytes(head[begin - 8 : begin], "little"), length - begin),
        stated=stated,
        compression=head[_CHUNK_HEAD.size : begin - 8].decode("utf-8", "replace"),
        crc=crc,
        cut=cut,
    )
