"""Opening a recording of ROS messages: its cameras, their intrinsics, and the stamps of all messages that are used.

Owns      the order of steps, whose intrinsics count, and what to say when there is no camera.
Leaves    pairing topics to ros_topics, realsense_topics and rigcal_topics, messages that are read for it to
          ros_samples, CameraInfo to ros_cameras, frames to ros_recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError, OutputError
from aruco.model import Camera
from aruco.svo_sync import MAX_STAMP_NS
from rigcal.sources.decompression import DamagedError
from rigcal.sources.given_cameras import fitting, listed, meant
from rigcal.sources.message_store import MessageStore
from rigcal.sources.options import SourceOptions
from rigcal.sources.realsense_topics import is_realsense, realsense_cameras, with_depth_unit
from rigcal.sources.rgbd_writer import refuse_unusable_name
from rigcal.sources.rigcal_topics import beside, rigcal_cameras, with_layout
from rigcal.sources.ros_cameras import baseline_of, camera_of
from rigcal.sources.ros_messages import HEAD_BYTES, read_header
from rigcal.sources.ros_recording import CameraSource, RosRecording, Stamped
from rigcal.sources.ros_samples import Samples
from rigcal.sources.ros_topics import CameraTopics, listing, paired


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
        self._samples = Samples(store)

    def recording(self) -> RosRecording:
        found = self._paired()
        given = self._given(found)
        cameras: list[tuple[CameraTopics, Camera, Camera | None]] = []
        left_out: list[str] = []
        refused: list[InputError] = []
        for topics in found:
            try:
                camera = given.get(topics.name) or self._recorded_camera(topics)
            except InputError as error:
                refused.append(error)
                left_out.append(f"{topics.image} is left out: {error}")
                continue
            if camera is None:
                left_out.append(f"{topics.image} is left out, {self._without(topics.name)}")
                continue
            camera = replace(camera, baseline_m=camera.baseline_m or self._baseline(topics))
            lens = self._depth_lens(topics, camera, is_given=topics.name in given)
            cameras.append((topics, camera, lens))
        if not cameras:
            raise refused[0] if refused else self._no_camera(found)
        for line in left_out:
            logger.warning("{}: {}", self._store.path, line)
        stamped = self._stamped([topics for topics, _, _ in cameras])
        return RosRecording(self._store, [_source(topics, camera, lens, stamped) for topics, camera, lens in cameras])

    def _paired(self) -> Sequence[CameraTopics]:
        topics = self._store.topics
        if self._options.topics:
            found = paired(topics, self._samples.first, self._options.topics)
            found = [with_layout(topics, with_depth_unit(self._store, camera)) for camera in found]
        elif is_realsense(topics):
            found = realsense_cameras(self._store)
        else:
            own = rigcal_cameras(topics)
            found = [*own, *paired(beside(topics, own), self._samples.first, ())]
        _refuse_same_names(found)
        for camera in found:
            try:
                refuse_unusable_name(camera.name)
            except OutputError as error:
                raise InputError(f"{error} (--topics NAME={camera.image} does)") from error
            logger.debug("camera {}: {}", camera.name, camera)
        return found

    def _given(self, found: Sequence[CameraTopics]) -> Mapping[str, Camera]:
        """The cameras of the recording that the user gives intrinsics of.

        Raises:
            InputError: They are of images of another size, or of raw ones where these are rectified.
        """
        file, known = self._options.intrinsics, self._known
        if file is None:
            return {}
        is_only = self._options.is_only and len(found) == 1
        cameras: dict[str, Camera] = {}
        for topics in found:
            camera = meant(known, topics.name, only=is_only)
            if camera is not None:
                camera = fitting(camera, file, topics.image, self._samples.size(topics.image))
                self._check_rectified(camera, file, topics)
                cameras[topics.name] = replace(camera, name=topics.name)
        if instead := [topics.name for topics in found if topics.name in cameras and topics.info is not None]:
            logger.info("{}: intrinsics of {} are used instead of CameraInfo", file, ", ".join(instead))
        if not cameras and any(topics.info for topics in found):
            # With others beside it the file may be meant for these.
            tell = logger.warning if self._options.is_only else logger.info
            names = ", ".join(topics.name for topics in found)
            tell("{}: has intrinsics of {}, none of {}, whose CameraInfo is used", file, listed(known), names)
        return cameras

    def _check_rectified(self, camera: Camera, file: Path, topics: CameraTopics) -> None:
        """Intrinsics with distortion are hardly those of rectified images; the user who has named these may know."""
        if not (topics.is_rectified and camera.has_distortion):
            return
        text = f"{file}: the intrinsics have distortion, but {topics.image} is rectified"
        if not self._options.topics:
            raise InputError(
                f"{text}; name the raw images with --topics {topics.name}=IMAGE_TOPIC, or {topics.image} where the "
                f"intrinsics are of it; its topics: {listing(self._store.topics)}."
            )
        logger.warning("{}; they are used for it as named", text)

    @cached_property
    def _known(self) -> Mapping[str, Camera]:
        """What the user's file of intrinsics holds."""
        file = self._options.intrinsics
        if file is None:
            return {}
        try:
            return self._options.read_cameras(file)
        except InputError as error:
            if self._options.is_only or not file.is_dir():
                raise
            # It may hold those of the videos that are read beside this recording.
            logger.debug("{}: {}", self._store.path, error)
            return {}

    def _recorded_camera(self, topics: CameraTopics) -> Camera | None:
        """The camera of its CameraInfo; None: there is none."""
        if topics.info is None:
            return None
        info = self._samples.info(topics.name, topics.info)
        return camera_of(info, topics.name, is_rectified=topics.is_rectified, size=self._samples.size(topics.image))

    def _baseline(self, topics: CameraTopics) -> float | None:
        if topics.baseline_m is not None or topics.right_info is None:
            return topics.baseline_m
        return baseline_of(self._samples.info(topics.name, topics.right_info))

    def _depth_lens(self, topics: CameraTopics, camera: Camera, *, is_given: bool) -> Camera | None:
        """The camera of the depth images; without a CameraInfo of their own they are pixel by pixel the image's."""
        if topics.depth is None or topics.depth_info is None:
            return camera
        try:
            info = self._samples.info(topics.name, topics.depth_info)
            return camera_of(info, topics.name, is_rectified=topics.depth_is_rectified, size=None)
        except InputError as error:
            if is_given and self._samples.first(topics.depth).size == (camera.width, camera.height):
                return camera
            logger.warning("{}: depth {} is left out: {}", self._store.path, topics.depth, error)
            return None

    def _without(self, camera: str) -> str:
        """Why a camera has no intrinsics."""
        file = self._options.intrinsics
        there = "" if file is None else f", and {file} has intrinsics of {listed(self._known)}, not of {camera}"
        return f"it has no CameraInfo{there}"

    def _no_camera(self, found: Sequence[CameraTopics]) -> InputError:
        topics = listing(self._store.topics)
        if not found:
            return InputError(f"holds no images that are read; its topics: {topics}.")
        images, names = ", ".join(camera.image for camera in found), ", ".join(camera.name for camera in found)
        if (file := self._options.intrinsics) is not None:
            return InputError(
                f"no CameraInfo beside {images}, and {file} has intrinsics of {listed(self._known)}, not of {names}; "
                f"call its cameras so, or name the images with --topics NAME=IMAGE; its topics: {topics}."
            )
        return InputError(
            f"no CameraInfo beside {images}; record the camera_info topics too, name them with --topics "
            f"NAME=IMAGE,CAMERA_INFO, or give --intrinsics FILE with {names}; its topics: {topics}."
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


def _refuse_same_names(found: Sequence[CameraTopics]) -> None:
    for camera in found:
        same = [other.image for other in found if other.name == camera.name]
        if len(same) > 1:
            raise InputError(
                f"camera {camera.name} is both {' and '.join(same)}; name them with --topics NAME=IMAGE_TOPIC."
            )


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
