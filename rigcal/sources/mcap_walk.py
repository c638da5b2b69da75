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
from rigcal.sources.chunked_file import NO_CHUNK, Chunk, IndexBuilder
from rigcal.sources.decompression import MAX_CHUNK_BYTES, DamagedError

MAGIC = b"\x89MCAP0\r\n"
# A schema with all that it refers to has some 10 kB.
MAX_DEFINITION_BYTES = 16 * 2**20
MAX_COMPRESSION_NAME_BYTES = 64

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, MESSAGE, _CHUNK, _MESSAGE_INDEX, _METADATA = 1, 2, 3, 4, 5, 6, 7, 0xC
_DATA_END = 0xF
RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_CHUNK_HEAD = struct.Struct("<QQQII")  # first and last log time, size and CRC of the contents, length of compression
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


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
        self.index = IndexBuilder()
        self.header = ("", "")  # profile and library
        self.metadata: dict[str, dict[str, str]] = {}
        self._schemas: dict[int, Any] = {}
        self._channels: dict[int, Any] = {}
        self._loose: dict[int, list[tuple[int, int]]] = {}  # messages outside of chunks
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
        while opcode != _FOOTER:
            file.seek(at)
            head = file.read(RECORD.size)
            opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
            body, end = at + RECORD.size, at + RECORD.size + length
            if opcode == 0 or end > self._size:
                self._cut(file, at, opcode, body)
                break
            if opcode != _MESSAGE_INDEX:
                self.index.settle()
            if opcode in handlers:
                handlers[opcode](file, body, length)
            self._has_all_data |= opcode == _DATA_END
            at = end
        self._add(self._loose, NO_CHUNK)

    def must_look_into(self, chunk: int) -> bool:
        """Whether a chunk has no index, or its index names a channel of which no definition is known yet."""
        return self.index.must_look_into(chunk, self._channels)

    def look_into(self, data: memoryview, chunk: int) -> None:
        """Definitions, and messages where there is no index, of those records of a chunk that are whole."""
        with_messages = chunk in self.index.unindexed
        at, found = 0, dict[int, list[tuple[int, int]]]()
        while at + RECORD.size <= len(data):
            opcode, length = RECORD.unpack_from(data, at)
            body, end = at + RECORD.size, at + RECORD.size + length
            if end > len(data):
                break
            if opcode == MESSAGE and with_messages and length >= MESSAGE_HEAD.size:
                channel, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, body)
                found.setdefault(channel, []).append((log_time, at))
            elif opcode in (_SCHEMA, _CHANNEL) and length <= MAX_DEFINITION_BYTES:
                self._define(opcode, bytes(data[body:end]))
            at = end
        self._add(found, chunk)

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
        def define(opcode: int) -> Callable[[IO[bytes], int, int], None]:
            return lambda file, at, length: self._define(opcode, self._body(file, at, length))

        return {
            _HEADER: define(_HEADER),
            _SCHEMA: define(_SCHEMA),
            _CHANNEL: define(_CHANNEL),
            _METADATA: define(_METADATA),
            MESSAGE: self._message,
            _CHUNK: self._chunk,
            _MESSAGE_INDEX: self._message_index,
        }

    def _body(self, file: IO[bytes], at: int, length: int, limit: int = MAX_DEFINITION_BYTES) -> bytes:
        if length > limit:
            raise DamagedError(f"the record at byte {at} states {length} bytes, more than such a record has")
        file.seek(at)
        return file.read(length)

    def _define(self, opcode: int, body: bytes) -> None:
        from mcap.exceptions import McapError

        stream = self._stream(BytesIO(body))
        try:
            if opcode == _SCHEMA:
                schema = self._records.Schema.read(stream)
                self._schemas[schema.id] = schema
            elif opcode == _CHANNEL:
                channel = self._records.Channel.read(stream)
                self._channels[channel.id] = channel
            elif opcode == _HEADER:
                header = self._records.Header.read(stream)
                self.header = (header.profile, header.library)
            else:
                metadata = self._records.Metadata.read(stream)
                self.metadata[metadata.name] = metadata.metadata
        except (McapError, struct.error, ValueError) as error:
            logger.warning("{}: a damaged record (opcode {}) is left out: {}", self._path, opcode, error)

    def _message(self, file: IO[bytes], at: int, length: int) -> None:
        head = file.read(MESSAGE_HEAD.size)
        if length >= MESSAGE_HEAD.size == len(head):
            channel, _, log_time, _ = MESSAGE_HEAD.unpack(head)
            self._loose.setdefault(channel, []).append((log_time, at - RECORD.size))

    def _chunk(self, file: IO[bytes], at: int, length: int, *, cut: bool = False) -> None:
        head = file.read(_CHUNK_HEAD.size)
        if len(head) < _CHUNK_HEAD.size:
            return
        _, _, stated, crc, name_length = _CHUNK_HEAD.unpack(head)
        name = file.read(min(name_length, MAX_COMPRESSION_NAME_BYTES)).decode("utf-8", "replace")
        stored = file.read(8)
        begin = at + _CHUNK_HEAD.size + name_length + 8
        if name_length > MAX_COMPRESSION_NAME_BYTES or len(stored) < 8 or begin > at + length:
            raise DamagedError(f"the chunk at byte {at} has a damaged header")
        size = int.from_bytes(stored, "little")
        if max(stated, size) > MAX_CHUNK_BYTES:
            raise DamagedError(f"the chunk at byte {at} states {max(stated, size)} bytes, more than 1 GiB")
        size = min(size, at + length - begin)
        self.index.begin_chunk(Chunk(at=begin, stored=size, stated=stated, compression=name, crc=crc, cut=cut))

    def _message_index(self, file: IO[bytes], at: int, length: int) -> None:
        body = self._body(file, at, length, limit=MAX_CHUNK_BYTES)
        if len(body) < 6 or (len(body) - 6) % 16:
            raise DamagedError(f"the index at byte {at} is damaged")
        # What exceeds 63 bits wraps to a negative number, which is refused when the message is read.
        entries = np.frombuffer(body, dtype="<i8", offset=6).reshape(-1, 2)
        self.index.index_last_chunk(int.from_bytes(body[:2], "little"), entries)

    def _add(self, found: Mapping[int, list[tuple[int, int]]], chunk: int) -> None:
        for channel, entries in found.items():
            self.index.add(channel, np.array(entries, dtype=np.uint64).astype(np.int64), chunk)

    def _cut(self, file: IO[bytes], at: int, opcode: int, body: int) -> None:
        """The file ends here; a chunk that has begun is kept as far as it goes."""
        self._cut_at = at
        self.index.settle(whole=False)
        # A few bytes of its header are of no use.
        if opcode == _CHUNK and self._size - body > _CHUNK_HEAD.size + MAX_COMPRESSION_NAME_BYTES:
            self._chunk(file, body, self._size - body, cut=True)
