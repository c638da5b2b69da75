"""Messages by topic and number, whatever container they lie in.

Owns      what a container of ROS messages offers, channels as topics, and several files as one.
Leaves    the containers to mcap_file, rosbag1_index and rosbag2_sqlite, messages to ros_messages.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from aruco.errors import InputError
from rigcal.sources.chunked_file import ChunkedFile
from rigcal.sources.decompression import MAX_MESSAGE_BYTES, DamagedError, decompressed_head
from rigcal.sources.message_places import span_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """What a container says about a topic."""

    name: str
    type: str  # "sensor_msgs/Image", for ROS 1 and ROS 2 alike
    encoding: str  # "cdr", "ros1", or what rigcal cannot read
    count: int  # messages
    about: Mapping[str, str] = field(default_factory=dict)  # what the writer adds

    def __str__(self) -> str:
        encoding = "" if self.encoding in READABLE else f" as {self.encoding or 'unknown bytes'}"
        return f"{self.name} ({self.type or 'unknown type'}{encoding}, {self.count})"


READABLE = ("cdr", "ros1")


@dataclass(frozen=True, slots=True, kw_only=True)
class Head:
    """The first bytes of a message."""

    topic: str
    index: int
    log_time_ns: int
    data: bytes | None  # None: the message is lost


class MessageStore(Protocol):
    """One container of messages."""

    path: Path

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The topics by name."""
        ...

    def message(self, topic: str, index: int) -> bytes:
        """A message's bytes; raises DamagedError where they are lost."""
        ...

    def heads(self, topics: Sequence[str], size: int) -> Iterator[Head]:
        """The first bytes of every message of some topics; each topic's in ascending index."""
        ...


def plain_type(name: str) -> str:
    """sensor_msgs/Image of sensor_msgs/msg/Image, which ROS 2 writes, and of sensor_msgs::msg::dds_::Image_."""
    parts = [part for part in name.replace("::", "/").split("/") if part not in ("msg", "dds_")]
    return "/".join(parts).removesuffix("_") if "::" in name else "/".join(parts)


class ChannelStore:
    """Messages of a file that keeps them by channel, of which several may be one topic's; a part of a MessageStore.

    Messages of several publishers of a topic are numbered one publisher after the other.
    """

    def __init__(self, index: ChunkedFile, ids: Mapping[str, Sequence[int]]) -> None:
        """The channels of each topic."""
        self._index = index
        self._ids = ids
        self._firsts: dict[int, int] = {}  # number of a channel's first message among its topic's
        for group in ids.values():
            counts = [len(index.log_times_ns(channel)) for channel in group]
            self._firsts.update(zip(group, np.cumsum([0, *counts]).tolist()))

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

    def count(self, topic: str) -> int:
        """How many messages a topic has."""
        return sum(len(self._index.log_times_ns(channel)) for channel in self._ids[topic])


class SplitStore:
    """Files of one recording, one after the other; implements MessageStore."""

    def __init__(self, path: Path, stores: Sequence[MessageStore]) -> None:
        """Topics of one name are one topic.

        Raises:
            InputError: A topic has two types.
        """
        self.path = path
        self._stores = stores
        self.topics: dict[str, Topic] = {}
        self._firsts: dict[str, list[int]] = {}  # topic -> number of its first message in each file, and the end
        for name in sorted({name for store in stores for name in store.topics}):
            owners = [store.topics[name] for store in stores if name in store.topics]
            if len({(topic.type, topic.encoding) for topic in owners}) > 1:
                raise InputError(f"{path}: topic {name} has several types in its files; give the files one by one.")
            counts = [store.topics[name].count if name in store.topics else 0 for store in stores]
            self._firsts[name] = np.cumsum([0, *counts]).tolist()
            self.topics[name] = replace(owners[0], count=sum(counts))

    def message(self, topic: str, index: int) -> bytes:
        """A message's bytes; raises DamagedError where they are lost."""
        firsts = self._firsts[topic]
        which = int(np.searchsorted(firsts, index, side="right")) - 1
        return self._stores[which].message(topic, index - firsts[which])

    def heads(self, topics: Sequence[str], size: int) -> Iterator[Head]:
        """The first bytes of every message of some topics."""
        for which, store in enumerate(self._stores):
            for head in store.heads([topic for topic in topics if topic in store.topics], size):
                yield replace(head, index=head.index + self._firsts[head.topic][which])


class ZstdMessages:
    """A store whose messages are compressed one by one (rosbag2's compression mode "message")."""

    def __init__(self, store: MessageStore) -> None:
        self._store = store
        self.path = store.path

    @property
    def topics(self) -> Mapping[str, Topic]:
        """The topics by name."""
        return self._store.topics

    def message(self, topic: str, index: int) -> bytes:
        """A message's bytes; raises DamagedError where they are lost."""
        data = decompressed_head(self._store.message(topic, index), "zstd", MAX_MESSAGE_BYTES + 1)
        if len(data) > MAX_MESSAGE_BYTES:
            raise DamagedError(f"yields more than {MAX_MESSAGE_BYTES} bytes")
        return data

    def heads(self, topics: Sequence[str], size: int) -> Iterator[Head]:
        """The first bytes of every message of some topics; a compressed message must be read whole for them."""
        for head in self._store.heads(topics, 0):
            try:
                data = decompressed_head(self._store.message(head.topic, head.index), "zstd", size)
            except DamagedError:
                data = None
            yield replace(head, data=data)
