"""MCAP files that rigcal wrote: which topics belong to which camera.

Owns      the layout of such files.
Leaves    writing them to mcap_writer, other programs' topics to ros_topics.

A camera's topics stand in its namespace::

    /<namespace>/image/compressed      sensor_msgs/msg/CompressedImage, PNG; header.frame_id is the camera's name
    /<namespace>/camera_info           sensor_msgs/msg/CameraInfo
    /<namespace>/depth/image           sensor_msgs/msg/Image, 16UC1 mm where that loses nothing, else 32FC1 m
    /<namespace>/depth/camera_info
    /<namespace>/confidence/image      sensor_msgs/msg/Image, mono8, 0..100, lower is more trustworthy

A topic's parts may not begin with a digit in ROS 2, as serial numbers do. So the namespace may differ from the name,
which stands in the channel's metadata, as does the baseline, which no message holds. The names say nothing: a camera
may be called like a stream. Images are as recorded, whatever they are called.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from rigcal.sources.message_store import READABLE, Topic
from rigcal.sources.ros_topics import CameraTopics

NAME_KEY, BASELINE_KEY = "rigcal.camera", "rigcal.baseline_m"
TOPICS = ("image/compressed", "camera_info", "depth/image", "depth/camera_info", "confidence/image")
TYPES = ("CompressedImage", "CameraInfo", "Image", "CameraInfo", "Image")
IMAGE, INFO, DEPTH, DEPTH_INFO, CONFIDENCE = range(len(TOPICS))


def rigcal_cameras(topics: Mapping[str, Topic]) -> tuple[CameraTopics, ...]:
    """The cameras that rigcal wrote, sorted by name."""
    cameras: list[CameraTopics] = []
    for image, topic in topics.items():
        if NAME_KEY in topic.about and image.endswith(f"/{TOPICS[IMAGE]}") and _there(topics, image):
            _, info, depth, depth_info, confidence = (
                _there(topics, image.removesuffix(TOPICS[IMAGE]) + name) for name in TOPICS
            )
            camera = CameraTopics(
                name=topic.about[NAME_KEY],
                image=image,
                info=info,
                depth=depth,
                depth_info=depth_info,
                confidence=confidence,
                baseline_m=_positive(topic.about.get(BASELINE_KEY, "")),
            )
            cameras.append(camera)
    return tuple(sorted(cameras, key=lambda camera: camera.name))


def beside(topics: Mapping[str, Topic], cameras: Sequence[CameraTopics]) -> dict[str, Topic]:
    """The topics outside of the namespaces of cameras that rigcal wrote: those of other programs."""
    namespaces = tuple(camera.image.removesuffix(TOPICS[IMAGE]) for camera in cameras)
    return {name: topic for name, topic in topics.items() if not name.startswith(namespaces)}


def with_layout(topics: Mapping[str, Topic], camera: CameraTopics) -> CameraTopics:
    """A camera whose topics the user has named, with what the layout knows about them."""
    own = next((one for one in rigcal_cameras(topics) if one.image == camera.image), None)
    if own is None:
        return camera
    return replace(camera, is_rectified=False, depth_is_rectified=False, baseline_m=own.baseline_m)


def _there(topics: Mapping[str, Topic], name: str) -> str | None:
    return name if name in topics and topics[name].count and topics[name].encoding in READABLE else None


def _positive(word: str) -> float | None:
    try:
        value = float(word)
    except ValueError:
        return None
    return value if 0 < value < math.inf else None
