"""RealSense's own recordings (of the Viewer or rs2::recorder): which topics belong to which camera.

Owns      their layout, as librealsense's document "Record and Playback" and its writer have it.
Leaves    ROS drivers' topics to ros_topics, reading messages to ros_recording.

    /device_0/info                                        KeyValue: "Serial Number", ...
    /device_0/sensor_0/option/Depth_Units/value           Float32, metres
    /device_0/sensor_0/Depth_0/{image/data, info/camera_info, tf/0}
    /device_0/sensor_0/Infrared_1/...
    /device_0/sensor_1/Color_0/...

``tf/<group>`` holds where a stream stands: depth of the D400 shares the place of the left infrared image, not of the
colour image. Newer versions of the SDK write the same topics into a rosbag2 file (.db3).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from rigcal.sources.decompression import DamagedError
from rigcal.sources.message_store import READABLE, MessageStore, Topic
from rigcal.sources.ros_messages import read_float32, read_image, read_key_value, read_transform
from rigcal.sources.ros_topics import CameraTopics
from rigcal.sources.topic_names import IMAGE

_IMAGE = re.compile(r"/(device_\d+)/(sensor_\d+)/([A-Za-z]+)_(\d+)/image/data")
# Image streams in the order in which they are taken.
_ORDER = (("Color", 0), ("Infrared", 0), ("Infrared", 1), ("Fisheye", 0), ("Fisheye", 1))
# Streams of one sensor have the same numbers; others are millimetres apart.
_SAME_PLACE = 1e-6

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Stream:
    device: str
    sensor: str
    kind: tuple[str, int]  # ("Color", 0)

    @property
    def prefix(self) -> str:
        return f"/{self.device}/{self.sensor}/{self.kind[0]}_{self.kind[1]}"

    @property
    def image(self) -> str:
        return f"{self.prefix}/image/data"

    @property
    def info(self) -> str:
        return f"{self.prefix}/info/camera_info"


def is_realsense(topics: Mapping[str, Topic]) -> bool:
    """Whether a recording has RealSense's layout."""
    return any(_IMAGE.fullmatch(name) for name in topics)


def realsense_cameras(store: MessageStore) -> tuple[CameraTopics, ...]:
    """The cameras of a RealSense recording, one a device, named by serial number."""
    streams: dict[str, list[_Stream]] = {}
    for name, topic in sorted(store.topics.items()):
        stream = _stream(name)
        if stream is not None and topic.type == IMAGE and topic.count and topic.encoding in READABLE:
            streams.setdefault(stream.device, []).append(stream)
    cameras = [_camera(store, device, found) for device, found in streams.items()]
    return tuple(sorted((camera for camera in cameras if camera is not None), key=lambda camera: camera.name))


def with_depth_unit(store: MessageStore, camera: CameraTopics) -> CameraTopics:
    """A camera whose topics the user has named, with what the recording knows about its depth."""
    image, depth = _stream(camera.image), _stream(camera.depth or "")
    if image is None or depth is None:
        return camera
    if not _same_place(store, image, depth):
        logger.warning(
            "camera {}: {} is not in the frame of {}, but taken as named", camera.name, depth.image, image.image
        )
    return replace(camera, depth_scale=_depth_unit(store, depth), baseline_m=_baseline(store, depth))


def _stream(topic: str) -> _Stream | None:
    match = _IMAGE.fullmatch(topic)
    return match and _Stream(device=match[1], sensor=match[2], kind=(match[3], int(match[4])))


def _camera(store: MessageStore, device: str, streams: Sequence[_Stream]) -> CameraTopics | None:
    images = sorted((one for one in streams if one.kind in _ORDER), key=lambda one: _ORDER.index(one.kind))
    if not images:
        return None
    best = images[0]
    name = _key_values(store, f"/{device}/info").get("Serial Number", device)
    camera = CameraTopics(name=name, image=best.image, info=_there(store, best.info))
    depth = next((one for one in streams if one.kind[0] == "Depth"), None)
    if depth is None:
        return camera
    if not _same_place(store, best, depth):
        _tell_unaligned(store, name, images, depth)
        return camera
    return replace(
        camera,
        depth=depth.image,
        depth_info=_there(store, depth.info),
        depth_scale=_depth_unit(store, depth),
        baseline_m=_baseline(store, depth),
    )


def _tell_unaligned(store: MessageStore, name: str, images: Sequence[_Stream], depth: _Stream) -> None:
    other = next((one for one in images if _same_place(store, one, depth)), None)
    instead = (
        f"--topics {name}={other.image},{other.info},{depth.image} takes the images that share it"
        if other is not None
        else "record the left infrared images too"
    )
    logger.warning("camera {}: depth is not in the frame of {} and is left out; {}", name, images[0].prefix, instead)


def _same_place(store: MessageStore, one: _Stream, other: _Stream) -> bool:
    places = [_place(store, stream) for stream in (one, other)]
    if places[0] is None or places[1] is None:
        return False
    return places[0][0] == places[1][0] and bool(np.allclose(places[0][1], places[1][1], rtol=0, atol=_SAME_PLACE))


def _place(store: MessageStore, stream: _Stream) -> tuple[str, NDArray[np.float64]] | None:
    """(group, transform (7,)) of a stream; None where it is not recorded."""
    for name in sorted(store.topics):
        head, _, group = name.rpartition("/")
        if head == f"{stream.prefix}/tf":
            transform = _first(store, name, read_transform)
            return None if transform is None else (group, transform)
    return None


def _depth_unit(store: MessageStore, depth: _Stream) -> float:
    """Metres per unit: from the images themselves, else from the sensor's option, else a millimetre."""
    image = _first(store, depth.image, read_image)
    if image is not None and image.depth_unit_m is not None:
        return image.depth_unit_m
    value = _option(store, depth, "Depth_Units")
    return value if value is not None else 0.001


def _baseline(store: MessageStore, depth: _Stream) -> float | None:
    """Metres between the eyes."""
    value_mm = _option(store, depth, "Stereo_Baseline")
    return value_mm / 1e3 if value_mm is not None else None


def _option(store: MessageStore, stream: _Stream, option: str) -> float | None:
    """The value of a sensor's option where it is positive; blanks are underscores in some versions."""
    for name in (option, option.replace("_", " ")):
        value = _first(store, f"/{stream.device}/{stream.sensor}/option/{name}/value", read_float32)
        if value is not None and np.isfinite(value) and value > 0:
            return value
    return None


def _key_values(store: MessageStore, topic: str) -> dict[str, str]:
    found: dict[str, str] = {}
    # A device has some twenty entries.
    for index in range(min(store.topics[topic].count, 1000) if topic in store.topics else 0):
        try:
            key, value = read_key_value(store.message(topic, index), store.topics[topic].encoding)
        except DamagedError as error:
            logger.debug("{}: {} {}", store.path, topic, error)
        else:
            found[key] = value
    return found


def _there(store: MessageStore, topic: str) -> str | None:
    return topic if topic in store.topics and store.topics[topic].count else None


def _first(store: MessageStore, topic: str, read: Callable[[bytes, str], _T]) -> _T | None:
    """A topic's first message; None where there is none that can be read."""
    if _there(store, topic) is None:
        return None
    try:
        return read(store.message(topic, 0), store.topics[topic].encoding)
    except DamagedError as error:
        logger.debug("{}: {} {}", store.path, topic, error)
        return None
