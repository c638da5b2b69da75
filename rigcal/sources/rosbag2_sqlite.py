"""The SQLite files of rosbag2 (.db3): messages by topic and number.

Owns      tables and queries; what of a damaged file can be had.
Leaves    opening to sqlite_file, metadata.yaml to rosbag2_metadata, split bags to ros_bag, messages to ros_messages.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence, Set
from pathlib import Path, PurePath

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from rigcal.sources.decompression import MAX_MESSAGE_BYTES, DamagedError
from rigcal.sources.message_places import MAX_MESSAGES
from rigcal.sources.message_store import Head, Topic, plain_type, span_of
from rigcal.sources.rosbag2_metadata import Metadata, read_metadata
from rigcal.sources.sqlite_file import DATABASE_ERRORS, SqliteFile
from rigcal.sources.topic_names import COMPRESSED, IMAGE

SIGNATURE = b"SQLite format 3\0"
MAX_TOPICS = 100_000
_ROWS = 10_000


class SqliteStore:
    """The messages of one .db3 file; implements MessageStore. Nothing stays open."""

    def __init__(self, path: Path) -> None:
        """Index the file; no message is read.

        Raises:
            InputError: It is no rosbag2 file, or damaged beyond use.
        """
        self.path = path
        self._file = SqliteFile(path)
        try:
            with self._file.connected() as base:
                topics = base.execute(
                    "SELECT id, name, type, serialization_format FROM topics ORDER BY id LIMIT ?", (MAX_TOPICS,)
                ).fetchall()
                rows, is_whole = _all_rows(base)
        except DATABASE_ERRORS as error:
            raise InputError(f"{path}: is not a whole rosbag2 file ({error}); copy it again.") from error
        if not is_whole:
            _tell_loss(path, len(rows), {name for key, name, *_ in topics if (rows[:, 1] == key).any()})
        self._rows: dict[str, NDArray[np.int64]] = {}  # topic -> (n, 2) row and log time, in the file's order
        self.topics: dict[str, Topic] = {}
        for key, name, kind, encoding in topics:
            mine = rows[rows[:, 1] == key] if isinstance(key, int) else rows[:0]
            mine = np.concatenate([self._rows.get(str(name), mine[:0, [0, 2]]), mine[:, [0, 2]]])
            self._rows[str(name)] = mine
            self.topics[str(name)] = Topic(
                name=str(name), type=plain_type(str(kind)), encoding=str(encoding), count=len(mine)
            )

    def message(self, topic: str, index: int) -> bytes:
        """A message's bytes; raises DamagedError where they are lost."""
        try:
            with self._file.connected() as base:
                return _blob(base, int(self._rows[topic][index, 0]), None)
        except DATABASE_ERRORS as error:
            raise DamagedError(f"cannot be read ({error})") from error

    def heads(self, topics: Sequence[str], size: int) -> Iterator[Head]:
        """The first bytes of every message of some topics; the rest of a message is not read."""
        with self._file.connected() as base:
            for topic in topics:
                for index, (row, log_time_ns) in enumerate(self._rows[topic].tolist()):
                    try:
                        data = _blob(base, row, size)
                    except (*DATABASE_ERRORS, DamagedError):
                        data = None
                    yield Head(topic=topic, index=index, log_time_ns=log_time_ns, data=data)

    def span_ns(self) -> tuple[int, int] | None:
        """When the first and the last message were logged; None without messages."""
        return span_of([rows[:, 1] for rows in self._rows.values()])


def _tell_loss(path: Path, found: int, there: Set[str]) -> None:
    """Say what is used of a damaged file, and of how much where metadata.yaml beside it tells."""
    try:
        stated = read_metadata(path.parent)
    except (OSError, InputError) as error:
        logger.debug("{}: how much is lost is not known: {}", path, error)
        stated = Metadata()
    total = stated.count_of_file.get(path.name)
    of = f" of {total}" if total is not None and total >= found else ""
    logger.warning("{}: is damaged or cut off; the {}{} messages that are found are used", path, found, of)
    if tuple(PurePath(name).name for name in stated.files) != (path.name,):
        return  # of a split bag it does not say in which file a topic is
    images = [topic for topic in stated.topics if plain_type(topic.type) in (IMAGE, COMPRESSED) and topic.count]
    if lost := sorted(f"{topic.name} ({topic.count})" for topic in images if topic.name not in there):
        logger.warning("{}: nothing was found of {}", path, ", ".join(lost))


def _all_rows(base: sqlite3.Connection) -> tuple[NDArray[np.int64], bool]:
    """((n, 3) row, topic and log time of every message in the order of rows, whether the file ends as it should)."""
    found: list[NDArray[np.int64]] = [np.empty((0, 3), dtype=np.int64)]
    rows: list[tuple[int, int, int]] = []
    is_whole = True
    try:
        # What is before the data in a row is read without the data. One by one: rows before damage are good.
        for row in base.execute("SELECT id, topic_id, timestamp FROM messages ORDER BY id LIMIT ?", (MAX_MESSAGES,)):
            if all(isinstance(value, int) for value in row):
                rows.append(row)
            if len(rows) == _ROWS:  # arrays need a tenth of the memory
                found.append(np.array(rows, dtype=np.int64))
                rows = []
    except DATABASE_ERRORS as error:
        if len(found) == 1 and not rows:
            raise
        logger.debug("the table of messages ends early: {}", error)
        is_whole = False
    found.append(np.array(rows, dtype=np.int64).reshape(-1, 3))
    return np.concatenate(found), is_whole


def _blob(base: sqlite3.Connection, row: int, size: int | None) -> bytes:
    with base.blobopen("messages", "data", row, readonly=True) as blob:
        if len(blob) > MAX_MESSAGE_BYTES:
            raise DamagedError(f"states {len(blob)} bytes, more than a message has")
        return blob.read(len(blob) if size is None else min(size, len(blob)))
