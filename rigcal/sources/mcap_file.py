"""MCAP files of ROS 2 or ROS 1 messages.

Owns      recognising them, channels as topics.
Leaves    records to mcap_index, what messages mean to ros_recording.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from loguru import logger

from aruco.errors import InputError
from aruco.model import Recording
from rigcal.sources.mcap_index import MAGIC, McapChannel, McapIndex
from rigcal.sources.message_store import READABLE, Head, Topic, plain_type, span_of
from rigcal.sources.options import SourceOptions
from rigcal.sources.ros_topics import listing


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file is an MCAP file; asked after SVO2, which is one too."""
    return head.startswith(MAGIC)


def opened(path: Path, options: SourceOptions) -> Recording:
    """The recording in an MCAP file.

    Raises:
        InputError: It cannot be used.
        MissingExtraError: The package mcap is not installed.
    """
    from rigcal.sources.ros_opening import ros_recording

    return ros_recording(McapStore(path), options)


class McapStore:
    """The messages of an MCAP file by topic; implements MessageStore."""

    def __init__(self, path: Path) -> None:
        """Index the file.

        Raises:
            InputError: It cannot be read, or holds no ROS messages.
        """
        self.path = path
        self._index = McapIndex(path)
        if self._index.loss is not None:
            logger.warning("{}: {}", path, self._index.loss)
        groups: dict[str, list[McapChannel]] = {}
        for channel in self._index.channels:
            groups.setdefault(channel.topic, []).append(channel)
        groups = {name: self._alike(group) for name, group in groups.items()}
        self.topics = {name: self._topic(name, group) for name, group in groups.items()}
        if self.topics and all(topic.encoding not in READABLE for topic in self.topics.values()):
            raise InputError(
                f"{path}: holds no ROS messages, and others are not read; record with ROS 2, or convert it; its "
                f"topics: {listing(self.topics)}."
            )
        # Messages of several publishers of a topic are numbered one publisher after the other.
        self._firsts: dict[int, int] = {}
        for group in groups.values():
            first = 0
            for channel in group:
                self._firsts[channel.id] = first
                first += self._index.count(channel.id)
        self._ids = {name: [channel.id for channel in group] for name, group in groups.items()}

    def message(self, topic: str, index: int) -> bytes:
        """A message's bytes; raises DamagedError where they are lost."""
        channel = [channel for channel in self._ids[topic] if self._firsts[channel] <= index][-1]
        return self._index.message(channel, index - self._firsts[channel])

    def heads(self, topics: Sequence[str], size: int) -> Iterator[Head]:
        """The first bytes of every message of some topics."""
        names = {channel: topic for topic in topics for channel in self._ids[topic]}
        times = {channel: self._index.log_times_ns(channel) for channel in names}
        for part in self._index.parts(list(names), size):
            yield Head(
                topic=names[part.channel],
                index=self._firsts[part.channel] + part.index,
                log_time_ns=int(times[part.channel][part.index]),
                data=part.data,
            )

    def span_ns(self) -> tuple[int, int] | None:
        """When the first and the last message were logged; None without messages."""
        return span_of([self._index.log_times_ns(channel) for channel in self._firsts])

    def _alike(self, channels: Sequence[McapChannel]) -> list[McapChannel]:
        """Publishers of one topic are one where they agree; otherwise those like the one with most messages."""
        best = max(channels, key=lambda channel: self._index.count(channel.id))
        alike = [c for c in channels if (c.schema_name, c.encoding) == (best.schema_name, best.encoding)]
        if len(alike) < len(channels):
            logger.warning("{}: of topic {} only {} is read", self.path, best.topic, best.schema_name)
        return alike

    def _topic(self, name: str, channels: Sequence[McapChannel]) -> Topic:
        return Topic(
            name=name,
            type=plain_type(channels[0].schema_name),
            encoding=channels[0].encoding,
            count=sum(self._index.count(channel.id) for channel in channels),
            about=channels[0].metadata,
        )
