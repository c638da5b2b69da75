"""The messages of a ROS 1 bag by connection and number; also of bags without an index and such that are cut off.

Owns      records of the format (wiki.ros.org/Bags/Format/2.0), and opening a bag.
Leaves    chunks to chunked_file, what messages mean to ros_messages.

A bag is walked from record to record and chunks are skipped, so an unindexed bag (``.bag.active``, "needs reindexing")
is read like any other. Topics come from the records' headers: RealSense's own bags do not repeat them inside.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from loguru import logger

from aruco.errors import InputError
from rigcal.sources.chunked_file import ChunkedFile, Read, reader
from rigcal.sources.decompression import MAX_MESSAGE_BYTES, DamagedError
from rigcal.sources.message_places import NO_CHUNK, Chunk, IndexBuilder

MAGIC = b"#ROSBAG V2.0\n"
# Headers hold a few numbers and a topic; a connection's data is a message definition.
MAX_HEADER_BYTES = 2**20
MAX_CONNECTION_BYTES = 16 * 2**20

_MESSAGE, _BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_U32 = struct.Struct("<I")
# What a log of times and offsets in a chunk is made of.
_INDEX_ENTRY = np.dtype([("s", "<u4"), ("ns", "<u4"), ("offset", "<u4")])


@dataclass(frozen=True, slots=True, kw_only=True)
class Connection:
    """One topic of one publisher."""

    id: int
    topic: str
    type: str  # "sensor_msgs/Image"


class Rosbag1Index(ChunkedFile):
    """Connections and messages of one ROS 1 bag. Nothing stays open; one chunk at most stays in memory."""

    def __init__(self, path: Path) -> None:
        """Walk through the bag; no message is read.

        Raises:
            InputError: Not a bag, encrypted, or of too many messages.
        """
        walk = _Walk(path)
        super().__init__(path, walk.index.chunks, _extent)
        self.walk_through(walk)
        self.loss: str | None = walk.loss()  # how a bag ends that is cut off: "<file> ..."
        self.connections: tuple[Connection, ...] = tuple(walk.connections[key] for key in sorted(walk.connections))
        self.places = {connection.id: walk.index.places(connection.id) for connection in self.connections}


class _Walk:
    """One pass over a bag's records."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = 0
        self.index = IndexBuilder(path)
        self.connections: dict[int, Connection] = {}
        self._cut_at: int | None = None

    def through(self, file: IO[bytes]) -> None:
        """Walk from the first record to the end, or to where the bag is cut off."""
        self._size = file.seek(0, 2)
        at = len(MAGIC)
        file.seek(0)
        if file.read(at) != MAGIC:
            raise InputError(f"{self._path}: is not a ROS 1 bag of version 2.0; convert older ones with rosbag fix.")
        while at < self._size:
            record = _record(reader(file), at, self._size)
            if record is None:
                self._cut(file, at)
                break
            fields, data, end = record
            if _op(fields) != _INDEX:
                self.index.settle()
            try:
                self._note(file, at, fields, data, end)
            except DamagedError as error:
                self.index.leave_out(f"the one at byte {at}, which {error}")
            at = end
        # The index of the last chunk can be missing whole, but then chunks follow no index and are looked into.
        self.index.settle(whole=self._cut_at is None)

    def must_look_into(self, chunk: int) -> bool:
        """Whether a chunk has no index, or its index names a connection that is not known yet."""
        return self.index.must_look_into(chunk, self.connections)

    def look_into(self, data: memoryview, chunk: int) -> None:
        """Connections, and messages where there is no index, of those records of a chunk that are whole."""
        with_messages = chunk in self.index.unindexed
        at = 0
        while record := _record(lambda at, size: bytes(data[at : at + size]), at, len(data)):
            fields, body, end = record
            try:
                if _op(fields) == _CONNECTION:
                    self._connection(fields, bytes(data[body : min(end, body + MAX_CONNECTION_BYTES)]))
                elif _op(fields) == _MESSAGE and with_messages:
                    self.index.add_one(_number(fields, b"conn"), _time_ns(fields), at, chunk)
            except DamagedError as error:
                self.index.leave_out(f"one in the chunk at byte {self.index.chunks[chunk].at}, which {error}")
            at = end

    def loss(self) -> str | None:
        """How the bag ends if it is cut off; completes "<file> ..."."""
        return None if self._cut_at is None else self.index.loss(self._cut_at, self._size)

    def _note(self, file: IO[bytes], at: int, fields: Mapping[bytes, bytes], data: int, end: int) -> None:
        op = _op(fields)
        if op == _BAG_HEADER and fields.get(b"encryptor"):
            how = fields[b"encryptor"][:40].decode("utf-8", "replace")
            raise InputError(f"{self._path}: is encrypted ({how}); decrypt it with rosbag decrypt.")
        if op == _CHUNK:
            self._chunk(fields, data, end)
        elif op == _INDEX:
            self._index(file, fields, data, end)
        elif op == _CONNECTION:
            self._connection(fields, reader(file)(data, min(end - data, MAX_CONNECTION_BYTES)))
        elif op == _MESSAGE:
            self.index.add_one(_number(fields, b"conn"), _time_ns(fields), at, NO_CHUNK)
        elif op not in (_BAG_HEADER, _CHUNK_INFO):
            raise DamagedError("is of no known kind")

    def _chunk(self, fields: Mapping[bytes, bytes], data: int, end: int, *, cut: bool = False) -> None:
        size = fields.get(b"size", b"")
        self.index.begin_chunk(
            Chunk(
                at=data,
                stored=end - data,
                stated=int.from_bytes(size, "little"),
                compression=fields.get(b"compression", b"none")[:20].decode("utf-8", "replace"),
                cut=cut,
                damage="" if len(size) == _U32.size else "has a damaged header",
            )
        )

    def _index(self, file: IO[bytes], fields: Mapping[bytes, bytes], data: int, end: int) -> None:
        try:
            count, connection = _number(fields, b"count"), _number(fields, b"conn")
        except DamagedError:
            count, connection = -1, -1
        if count * _INDEX_ENTRY.itemsize != end - data:
            logger.debug("{}: the index at byte {} is damaged; its chunk is looked into", self._path, data)
            self.index.spoil_last_index()
            return
        entries = np.frombuffer(reader(file)(data, end - data), dtype=_INDEX_ENTRY)
        times_ns = entries["s"].astype(np.int64) * 10**9 + entries["ns"]
        found = np.stack([times_ns, entries["offset"].astype(np.int64)], axis=1)
        self.index.index_last_chunk(connection, found)

    def _connection(self, fields: Mapping[bytes, bytes], data: bytes) -> None:
        key = _number(fields, b"conn")
        topic = fields.get(b"topic", b"").decode("utf-8", "replace")
        kind = _fields(data).get(b"type", b"").decode("utf-8", "replace")
        self.connections[key] = Connection(id=key, topic=topic, type=kind)

    def _cut(self, file: IO[bytes], at: int) -> None:
        """The bag ends within the record here; a chunk is kept as far as it goes."""
        self._cut_at = at
        self.index.settle(whole=False)
        head = _record(reader(file), at, self._size, cut=True)
        if head is not None and _op(head[0]) == _CHUNK:
            self._chunk(head[0], head[1], self._size, cut=True)


def _record(read: Read, at: int, end: int, *, cut: bool = False) -> tuple[Mapping[bytes, bytes], int, int] | None:
    """(header's fields, begin of the data, end) of the record at ``at``; None where it is not whole before ``end``.

    Of a ``cut`` record the header must be whole.
    """
    lengths = read(at, 4) if at + 8 <= end else b""
    if len(lengths) < 4:
        return None
    header = _U32.unpack(lengths)[0]
    if header > MAX_HEADER_BYTES or at + 8 + header > end:
        return None
    fields = _fields(read(at + 4, header))
    data = at + 8 + header
    stop = data + _U32.unpack(read(data - 4, 4))[0]
    # Nothing but zeros is how files end whose last blocks were never written.
    return None if not fields or (stop > end and not cut) else (fields, data, stop)


def _fields(header: bytes) -> dict[bytes, bytes]:
    """name=value pairs; what cannot be one ends the list."""
    fields, at = dict[bytes, bytes](), 0
    while at + 4 <= len(header):
        size = _U32.unpack_from(header, at)[0]
        name, sign, value = header[at + 4 : at + 4 + size].partition(b"=")
        if not sign or at + 4 + size > len(header):
            break
        fields[name] = value
        at += 4 + size
    return fields


def _op(fields: Mapping[bytes, bytes]) -> int:
    """What a record is; 0 for none."""
    return int.from_bytes(fields.get(b"op", b""), "little")


def _number(fields: Mapping[bytes, bytes], name: bytes) -> int:
    value = fields.get(name, b"")
    if len(value) != _U32.size:
        raise DamagedError(f"lacks its {name.decode()}")
    return _U32.unpack(value)[0]


def _time_ns(fields: Mapping[bytes, bytes]) -> int:
    value = fields.get(b"time", b"")
    if len(value) != 8:
        raise DamagedError("lacks its time")
    seconds, nanoseconds = struct.unpack("<II", value)
    return seconds * 10**9 + nanoseconds


def _extent(read: Read, at: int, end: int, connection: int) -> tuple[int, int]:
    """(begin, size) of the message at ``at``; the index of some writers points to a connection record before it."""
    for _ in range(2):
        record = _record(read, at, end) if at >= 0 else None
        if record is None:
            break
        fields, begin, stop = record
        if _op(fields) == _MESSAGE and _number(fields, b"conn") == connection:
            if stop - begin > MAX_MESSAGE_BYTES:
                raise DamagedError(f"states {stop - begin} bytes, more than a message has")
            return begin, stop - begin
        if _op(fields) != _CONNECTION:
            break
        at = stop
    raise DamagedError("is not where the index says")
