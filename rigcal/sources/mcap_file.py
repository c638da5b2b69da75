"""MCAP files of ROS 2 or ROS 1 messages.

Owns      recognising them, channels as topics.
Leaves    records to mcap_index, what messages mean to ros_recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from loguru import logger

from aruco.errors import InputError
from aruco.model import Recording
from rigcal.sources.mcap_index import McapChannel, McapIndex
from rigcal.sources.mcap_records import MAGIC
from rigcal.sources.message_store import READABLE, ChannelStore, Topic, plain_type
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


class McapStore(ChannelStore):
    """The messages of an MCAP file by topic; implements MessageStore."""

    def __init__(self, path: Path) -> None:
        """Index the file.

        Raises:
            InputError: It cannot be read, or holds no ROS messages.
        """
        self.path = path
        index = McapIndex(path)
        if index.loss is not None:
            logger.warning("{}: {}", path, index.loss)
        groups: dict[str, list[McapChannel]] = {}
        for channel in index.channels:
            groups.setdefault(channel.topic, []).append(channel)
        groups = {name: _alike(group, index) for name, group in groups.items()}
        super().__init__(index, {name: [channel.id for channel in group] for name, group in groups.items()})
        self.topics = {name: self._topic(name, group[0]) for name, group in groups.items()}
        if self.topics and all(topic.encoding not in READABLE for topic in self.topics.values()):
            raise InputError(
                f"{path}: holds no ROS messages, and others are not read; record with ROS 2, or convert it; its "
                f"topics: {listing(self.topics)}."
            )

    def _topic(self, name: str, channel: McapChannel) -> Topic:
        return Topic(
            name=name,
            type=plain_type(channel.schema_name),
            encoding=channel.encoding,
            count=self.count(name),
            about=channel.metadata,
        )


def _alike(channels: Sequence[McapChannel], index: McapIndex) -> list[McapChannel]:
    """Publishers of one topic are one where they agree; otherwise those like the one with most messages."""
    best = max(channels, key=lambda channel: index.count(channel.id))
    alike = [c for c in channels if (c.schema_name, c.encoding) == (best.schema_name, best.encoding)]
    if len(alike) < len(channels):
        logger.warning("{}: of topic {} only {} is read", index.path, best.topic, best.schema_name)
    return alike
