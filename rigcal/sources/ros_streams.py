"""Image topics as streams of cameras, whatever ways of transport they were recorded in.

Owns      telling images from depth and what goes with it, the CameraInfo beside each.
Leaves    the words in names to topic_names, choosing among streams to ros_topics.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from rigcal.sources.message_store import READABLE, Topic
from rigcal.sources.topic_names import (
    COMPRESSED,
    IMAGE,
    INFO,
    base_of,
    is_depth_topic,
    is_rectified,
    named_like_streams,
    namespace_of,
    side_of,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class First:
    """What a topic's first message tells."""

    encoding: str = ""  # of an Image, or the format of a CompressedImage
    frame_id: str = ""
    size: tuple[int, int] | None = None  # (width, height)
    eyes_apart: bool = False  # of a CameraInfo: of a second eye (P[0, 3] is not 0)


Peek = Callable[[str], First]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stream:
    """An image topic, whatever ways of transport it was recorded in."""

    namespace: str
    kind: int  # index into topic_names.STREAMS
    base: str  # without the transport
    topic: str
    info: str | None

    @property
    def name(self) -> str:
        """Its name within the namespace, which may be called anything."""
        return self.base.strip("/").removeprefix(self.namespace)

    @property
    def is_rectified(self) -> bool:
        """Whether its name says so."""
        return is_rectified(self.name)

    @property
    def side(self) -> str:
        """left, right, or empty for neither."""
        return side_of(self.kind)


class Streams:
    """The streams of a recording."""

    def __init__(self, topics: Mapping[str, Topic], peek: Peek) -> None:
        """Sort the topics out.

        Args:
            topics: All of the recording.
            peek: What a topic's first message tells.
        """
        self.topics, self.peek = topics, peek
        self.readable = {name: topic for name, topic in topics.items() if topic.count and topic.encoding in READABLE}
        found: dict[str, list[str]] = {}
        for name, topic in sorted(self.readable.items()):
            if topic.type in (IMAGE, COMPRESSED):
                found.setdefault(base_of(topic), []).append(name)
        self._namespaces = named_like_streams(found)
        self.images: list[Stream] = []
        self.depths: list[Stream] = []  # and what goes with depth
        for _, names in sorted(found.items()):
            self._add(names)

    def of(self, topic: str, info: str | None = None) -> Stream:
        """The stream of an image topic; info: what the user names."""
        base = base_of(self.readable[topic])
        namespace, kind = namespace_of(base, self._namespaces)
        return Stream(namespace=namespace, kind=kind, base=base, topic=topic, info=info or self._info_of(base))

    def right_info(self, namespace: str) -> str | None:
        """The CameraInfo of a namespace's second eye."""
        for name, topic in sorted(self.readable.items()):
            is_here = topic.type == INFO and namespace_of(name, self._namespaces)[0] == namespace
            if is_here and self.peek(name).eyes_apart:
                return name
        return None

    def _add(self, names: list[str]) -> None:
        """One way of transport is enough: as messages are before compressed."""
        # Depth that was compressed like a picture is worthless.
        names.sort(key=lambda name: (self.readable[name].type != IMAGE, not name.endswith("compressedDepth"), name))
        stream = self.of(names[0])
        if is_depth_topic(stream.base, self.peek(names[0]).encoding):
            self.depths.append(stream)
        else:
            pictures = [name for name in names if not name.endswith("compressedDepth")]
            self.images += [replace(stream, topic=name) for name in pictures[:1]]

    def _info_of(self, base: str) -> str | None:
        """The camera_info beside an image, where image_transport puts it, or below it."""
        for name in (f"{base.rpartition('/')[0]}/camera_info", f"{base}/camera_info"):
            if name in self.readable and self.readable[name].type == INFO:
                return name
        return None
