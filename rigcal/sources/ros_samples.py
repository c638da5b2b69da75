"""What some messages of a topic tell about all: the first that can be read, and whether the last says the same.

Owns      which messages are tried where one is damaged, and remembering what was read.
Leaves    the fields of messages to ros_messages, pixels to ros_images.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from loguru import logger

from aruco.errors import InputError
from rigcal.sources.decompression import DamagedError
from rigcal.sources.message_store import MessageStore
from rigcal.sources.ros_cameras import baseline_of
from rigcal.sources.ros_images import image_pixels
from rigcal.sources.ros_messages import CameraInfo, RawImage, read_camera_info
from rigcal.sources.ros_recording import parsed_image
from rigcal.sources.ros_streams import First
from rigcal.sources.topic_names import INFO

_T = TypeVar("_T")
# Of a topic whose messages are all alike, spread over the recording: where one is damaged its neighbours may be.
TRIED_MESSAGES = 10


class Samples:
    """Messages out of a store."""

    def __init__(self, store: MessageStore) -> None:
        self._store = store
        self._firsts: dict[str, First] = {}

    def first(self, topic: str) -> First:
        """What a topic's first message tells; nothing where it is damaged."""
        if topic not in self._firsts:
            try:
                self._firsts[topic] = self._read_first(topic)
            except DamagedError as error:
                logger.debug("{}: the first message of {} {}", self._store.path, topic, error)
                self._firsts[topic] = First()
        return self._firsts[topic]

    def size(self, topic: str) -> tuple[int, int] | None:
        """(width, height) of a topic's first image; None where it cannot be read."""
        first = self.first(topic)
        if first.size is not None:
            return first.size
        try:
            pixels = self._whole(topic, lambda data: image_pixels(parsed_image(data, self._store, topic)))
        except DamagedError:
            return None
        return pixels.shape[1], pixels.shape[0]

    def info(self, name: str, topic: str) -> CameraInfo:
        """A camera's first CameraInfo; that the last says something else is told.

        Raises:
            InputError: None that was tried can be read.
        """
        try:
            first = self._info(topic)
            if self._store.topics[topic].count > 1 and not first.same_lens(self._info(topic, last=True)):
                logger.warning("camera {}: {} changes during the recording; the first is used", name, topic)
        except DamagedError as error:
            raise InputError(
                f"camera {name}: every message of {topic} that was tried {error}; record again, or give --intrinsics."
            ) from error
        return first

    def _read_first(self, topic: str) -> First:
        if self._store.topics[topic].type == INFO:
            info = self._info(topic)
            return First(frame_id=info.header.frame_id, eyes_apart=baseline_of(info) is not None)
        message = self._whole(topic, lambda data: parsed_image(data, self._store, topic))
        frame_id = message.header.frame_id
        if isinstance(message, RawImage):
            return First(encoding=message.encoding, frame_id=frame_id, size=(message.width, message.height))
        return First(encoding=message.format, frame_id=frame_id)

    def _info(self, topic: str, *, last: bool = False) -> CameraInfo:
        encoding = self._store.topics[topic].encoding
        return self._whole(topic, lambda data: read_camera_info(data, encoding), last=last)

    def _whole(self, topic: str, read: Callable[[bytes], _T], *, last: bool = False) -> _T:
        """The first of a topic's messages that can be read, or the last, of some that are tried."""
        numbers = np.unique(np.linspace(0, self._store.topics[topic].count - 1, TRIED_MESSAGES).astype(int)).tolist()
        damage = DamagedError("is not there")
        for number in numbers[::-1] if last else numbers:
            try:
                return read(self._store.message(topic, number))
            except DamagedError as error:
                damage = error
        raise damage
