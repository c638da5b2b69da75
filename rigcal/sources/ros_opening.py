"""Opening a recording of ROS messages: its cameras, their intrinsics, and the stamps of all messages that are used.

Owns      the order of steps, and what to say when there is no camera.
Leaves    pairing topics to ros_topics and realsense_topics, CameraInfo to ros_cameras, frames to ros_recording.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError, OutputError
from aruco.model import Camera
from aruco.svo_sync import MAX_STAMP_NS
from rigcal.sources.decompression import DamagedError
from rigcal.sources.message_store import MessageStore
from rigcal.sources.options import SourceOptions
from rigcal.sources.realsense_topics import is_realsense, realsense_cameras, with_depth_unit
from rigcal.sources.rgbd_writer import refuse_unusable_name
from rigcal.sources.ros_cameras import baseline_of, camera_of
from rigcal.sources.ros_images import image_pixels
from rigcal.sources.ros_messages import HEAD_BYTES, CameraInfo, RawImage, read_camera_info, read_header
from rigcal.sources.ros_recording import CameraSource, RosRecording, Stamped, parsed_image
from rigcal.sources.ros_topics import CameraTopics, First, listing, paired
from rigcal.sources.topic_names import INFO

_T = TypeVar("_T")
# Of a topic whose messages are all alike, spread over the recording: where one is damaged its neighbours may be.
TRIED_MESSAGES = 10


def ros_recording(store: MessageStore, options: SourceOptions) -> RosRecording:
    """The recording in a container of ROS messages; images are decoded when they are asked for.

    Raises:
        InputError: There is no camera, or one without usable intrinsics; the message names the topics.
    """
    opening = _Opening(store, options)
    try:
        return opening.recording()
    except InputError as error:
        raise InputError(f"{store.path}: {error}") from error


class _Opening:
    def __init__(self, store: MessageStore, options: SourceOptions) -> None:
        self._store, self._options = store, options
        self._firsts: dict[str, First] = {}

    def recording(self) -> RosRecording:
        found = self._paired()
        cameras: list[tuple[CameraTopics, Camera, Camera | None]] = []
        for topics in found:
            camera = self._camera(topics)
            if camera is not None:
                lens = self._depth_lens(topics, camera) if topics.depth is not None else None
                cameras.append((topics, camera, lens))
            elif len(found) > 1:
                logger.warning("{}: {} is left out, it has no CameraInfo", self._store.path, topics.image)
        if not cameras:
            raise self._no_camera(found)
        stamped = self._stamped([topics for topics, _, _ in cameras])
        return RosRecording(self._store, [_source(topics, camera, lens, stamped) for topics, camera, lens in cameras])

    def _paired(self) -> Sequence[CameraTopics]:
        topics = self._store.topics
        if not self._options.topics and is_realsense(topics):
            found = realsense_cameras(self._store)
        else:
            found = paired(topics, self._first, self._options.topics)
            found = [with_depth_unit(self._store, camera) for camera in found]
        for camera in found:
            try:
                refuse_unusable_name(camera.name)
            except OutputError as error:
                raise InputError(f"{error} (--topics NAME={camera.image} does)") from error
            logger.debug("camera {}: {}", camera.name, camera)
        return found

    def _first(self, topic: str) -> First:
        """What a topic's first message tells; nothing where it is damaged."""
        if topic not in self._firsts:
            try:
                self._firsts[topic] = self._read_first(topic)
            except DamagedError as error:
                logger.debug("{}: the first message of {} {}", self._store.path, topic, error)
                self._firsts[topic] = First()
        return self._firsts[topic]

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

    def _camera(self, topics: CameraTopics) -> Camera | None:
        """The camera of its CameraInfo or of the file that the user names; None: neither is there."""
        if topics.info is None:
            file = self._options.intrinsics
            return None if file is None else self._options.read_cameras(file).get(topics.name)
        info = self._only_info(topics.name, topics.info)
        camera = camera_of(info, topics.name, is_rectified=topics.is_rectified, size=self._size(topics.image))
        return replace(camera, baseline_m=self._baseline(topics))

    def _baseline(self, topics: CameraTopics) -> float | None:
        if topics.baseline_m is not None or topics.right_info is None:
            return topics.baseline_m
        return baseline_of(self._info(topics.right_info))  # was read before

    def _depth_lens(self, topics: CameraTopics, camera: Camera) -> Camera | None:
        """The camera of the depth images; without a CameraInfo of their own they are pixel by pixel the image's."""
        if topics.depth_info is None:
            return camera
        try:
            info = self._only_info(topics.name, topics.depth_info)
            return camera_of(info, topics.name, is_rectified=topics.depth_is_rectified, size=None)
        except InputError as error:
            logger.warning("{}: depth {} is left out: {}", self._store.path, topics.depth, error)
            return None

    def _only_info(self, name: str, topic: str) -> CameraInfo:
        """The first CameraInfo; whether the last still says the same is told."""
        count = self._store.topics[topic].count
        try:
            first = self._info(topic)
            if count > 1 and not first.same_lens(self._info(topic, last=True)):
                logger.warning("camera {}: {} changes during the recording; the first is used", name, topic)
        except DamagedError as error:
            raise InputError(
                f"camera {name}: every message of {topic} that was tried {error}; record again."
            ) from error
        return first

    def _size(self, topic: str) -> tuple[int, int] | None:
        """(width, height) of a topic's first image; None where it cannot be read."""
        first = self._first(topic)
        if first.size is not None:
            return first.size
        try:
            pixels = self._whole(topic, lambda data: image_pixels(parsed_image(data, self._store, topic)))
        except DamagedError:
            return None
        return pixels.shape[1], pixels.shape[0]

    def _no_camera(self, found: Sequence[CameraTopics]) -> InputError:
        topics = listing(self._store.topics)
        if not found:
            return InputError(f"holds no images that are read; its topics: {topics}.")
        return InputError(
            f"no CameraInfo beside {', '.join(camera.image for camera in found)}; record the camera_info topics too, "
            f"name them with --topics NAME=IMAGE,CAMERA_INFO, or give --intrinsics; its topics: {topics}."
        )

    def _stamped(self, found: Sequence[CameraTopics]) -> Mapping[str, Stamped]:
        """The stamps of all topics that are used, in one pass over the container."""
        topics = sorted({t for c in found for t in (c.image, c.depth, c.confidence) if t is not None})
        rows: dict[str, list[tuple[int, int, int]]] = {topic: [] for topic in topics}
        lost = 0
        for head in self._store.heads(topics, HEAD_BYTES):
            try:
                if head.data is None:
                    raise DamagedError("is lost")
                stamp_ns = read_header(head.data, self._store.topics[head.topic].encoding).stamp_ns
                rows[head.topic].append((stamp_ns, head.log_time_ns, head.index))
            except DamagedError as error:
                logger.debug("{}: message {} of {} {}", self._store.path, head.index, head.topic, error)
                lost += 1
        if lost:
            logger.warning("{}: {} messages are damaged and left out", self._store.path, lost)
        return {topic: _by_stamp(topic, np.array(rows[topic], dtype=np.int64).reshape(-1, 3)) for topic in topics}


def _source(topics: CameraTopics, camera: Camera, lens: Camera | None, stamped: Mapping[str, Stamped]) -> CameraSource:
    if topics.depth is None or lens is None:
        return CameraSource(camera=camera, image=stamped[topics.image])
    return CameraSource(
        camera=replace(camera, depth_K=lens.K, depth_scale=topics.depth_scale),
        image=stamped[topics.image],
        depth=stamped[topics.depth],
        depth_lens=lens,
        confidence=None if topics.confidence is None else stamped[topics.confidence],
    )


def _by_stamp(topic: str, rows: NDArray[np.int64]) -> Stamped:
    """Messages, (n, 3) of header stamp, log time and number, in the order of their stamps, each stamp once."""
    if len(rows) and not rows[:, 0].any():
        logger.warning("{}: its headers have no stamps; the times of recording are used", topic)
        rows = rows[:, [1, 1, 2]]
    rows = rows[np.abs(rows[:, 0]) <= MAX_STAMP_NS]
    stamps, firsts = np.unique(rows[:, 0], return_index=True)
    if len(stamps) < len(rows):
        logger.debug("{}: {} messages have the stamp of another and are left out", topic, len(rows) - len(stamps))
    stamps.setflags(write=False)
    return Stamped(topic=topic, stamps_ns=stamps, numbers=rows[firsts, 2])
