"""Which topics of a ROS recording belong to which camera.

Owns      what is chosen where there is a choice, and ``--topics``.
Leaves    the words in names to topic_names, reading messages to ros_opening, RealSense's own files to realsense_topics.

A camera is a namespace: ``/zed/zed_node/left/image_rect_color`` is the stream ``left`` of ``/zed/zed_node``. Of its
streams one is taken, in this order: with a camera_info before without; colour (``color``, ``rgb``), left, no stream
named, grey, infrared, right; rectified before raw images; colour before grey; messages as they are before compressed
ones. Left and right are two cameras where no camera_info calls them the two eyes of one. Depth is taken in the image's
frame only.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from loguru import logger

from aruco.errors import InputError
from rigcal.sources.message_store import READABLE, Topic
from rigcal.sources.topic_names import (
    COMPRESSED,
    GREY,
    IMAGE,
    INFO,
    NO_DEPTH,
    TRANSPORTS,
    base_of,
    camera_name,
    is_depth_topic,
    is_rectified,
    namespace_of,
    side_of,
)

# What rigcal writes into the metadata of an MCAP channel; see mcap_writer.
NAME_KEY, BASELINE_KEY = "rigcal.camera", "rigcal.baseline_m"

_MAX_LISTED = 40


@dataclass(frozen=True, slots=True, kw_only=True)
class First:
    """What a topic's first message tells."""

    encoding: str = ""  # of an Image, or the format of a CompressedImage
    frame_id: str = ""
    size: tuple[int, int] | None = None  # (width, height)
    eyes_apart: bool = False  # of a CameraInfo: of a second eye (P[0, 3] is not 0)


Peek = Callable[[str], First]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTopics:
    """The topics of one camera."""

    name: str
    image: str
    info: str | None
    is_rectified: bool = False
    depth: str | None = None
    depth_info: str | None = None
    depth_is_rectified: bool = False
    confidence: str | None = None
    depth_scale: float = 0.001  # metres per unit (REP 118)
    baseline_m: float | None = None
    right_info: str | None = None  # of the other eye, whose P holds the baseline


@dataclass(frozen=True, slots=True, kw_only=True)
class _Stream:
    """An image topic, whatever ways of transport it was recorded in."""

    namespace: str
    kind: int  # index into topic_names.STREAMS
    base: str  # without the transport
    topic: str
    info: str | None

    @property
    def is_rectified(self) -> bool:
        return is_rectified(self.base)


def paired(topics: Mapping[str, Topic], peek: Peek, given: Sequence[str]) -> tuple[CameraTopics, ...]:
    """The cameras of a recording.

    Args:
        topics: Its topics.
        peek: What a topic's first message tells.
        given: What the user says, "<camera>=<image>[,<camera info>[,<depth>]]" each; empty: found by name.

    Returns:
        The cameras, sorted by name.

    Raises:
        InputError: There is none, two have one name, or a topic that is given is not there.
    """
    readable = {name: topic for name, topic in topics.items() if topic.count and topic.encoding in READABLE}
    streams, depths = _sorted_out(readable, peek)
    if given:
        cameras = [_given(words, topics, readable, depths, peek) for words in given]
    else:
        groups: dict[str, list[_Stream]] = {}
        for stream in streams:
            groups.setdefault(stream.namespace, []).append(stream)
        cameras = [camera for group in groups.values() for camera in _of_namespace(group, readable, depths, peek)]
    if not cameras:
        raise InputError(f"holds no images that are read; its topics: {listing(topics)}.")
    names = [camera.name for camera in cameras]
    for camera in cameras:
        if names.count(camera.name) > 1:
            same = " and ".join(other.image for other in cameras if other.name == camera.name)
            raise InputError(f"camera {camera.name} is both {same}; name them with --topics NAME=IMAGE_TOPIC.")
    return tuple(sorted(cameras, key=lambda camera: camera.name))


def listing(topics: Mapping[str, Topic]) -> str:
    """All topics with types and counts; only so many that a message remains readable."""
    images_first = sorted(topics.values(), key=lambda topic: (topic.type not in (IMAGE, COMPRESSED, INFO), topic.name))
    shown = [str(topic) for topic in images_first[:_MAX_LISTED]]
    more = len(topics) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "") if topics else "none"


def _sorted_out(readable: Mapping[str, Topic], peek: Peek) -> tuple[list[_Stream], list[_Stream]]:
    """(images, depth and what goes with it), sorted by name; one stream for each way of transport is enough."""
    found: dict[str, list[str]] = {}
    for name, topic in sorted(readable.items()):
        if topic.type in (IMAGE, COMPRESSED):
            found.setdefault(base_of(topic), []).append(name)
    images, depths = [], []
    for base, names in sorted(found.items()):
        # As they are before compressed; depth that was compressed like a picture is worthless.
        names.sort(key=lambda name: (readable[name].type != IMAGE, not name.endswith("compressedDepth"), name))
        namespace, kind = namespace_of(base)
        stream = _Stream(namespace=namespace, kind=kind, base=base, topic=names[0], info=_info_of(base, readable))
        if is_depth_topic(base, peek(names[0]).encoding):
            depths.append(stream)
        else:
            pictures = [name for name in names if not name.endswith("compressedDepth")]
            images += [replace(stream, topic=name) for name in pictures[:1]]
    return images, depths


def _info_of(base: str, readable: Mapping[str, Topic]) -> str | None:
    """The camera_info beside an image, where image_transport puts it, or below it."""
    for name in (f"{base.rpartition('/')[0]}/camera_info", f"{base}/camera_info"):
        if name in readable and readable[name].type == INFO:
            return name
    return None


def _of_namespace(
    streams: Sequence[_Stream], readable: Mapping[str, Topic], depths: Sequence[_Stream], peek: Peek
) -> list[CameraTopics]:
    ranked = sorted(
        streams,
        key=lambda one: (one.info is None, one.kind, not one.is_rectified, bool(GREY.search(one.base)), one.base),
    )
    best = ranked[0]
    name = readable[best.topic].about.get(NAME_KEY) or camera_name(best.namespace)
    eyes = [one for one in ranked if side_of(one.kind) == "right"]
    right = eyes[0] if eyes and side_of(best.kind) == "left" else None
    if right is not None and not (right.info and peek(right.info).eyes_apart):
        chosen = [_camera(f"{name}_left".strip("_"), best, readable, depths, peek)]
        chosen.append(_camera(f"{name}_right".strip("_"), right, readable, depths, peek))
    else:
        chosen = [_camera(name or side_of(best.kind) or "camera", best, readable, depths, peek)]
    left_out = [one.base for one in ranked if one.topic not in [camera.image for camera in chosen]]
    if left_out:
        taken = " and ".join(camera.image for camera in chosen)
        logger.info("of one camera's images {} is taken, not {} (--topics chooses)", taken, ", ".join(left_out))
    return chosen


def _camera(
    name: str, image: _Stream, readable: Mapping[str, Topic], depths: Sequence[_Stream], peek: Peek
) -> CameraTopics:
    camera = CameraTopics(
        name=name,
        image=image.topic,
        info=image.info,
        is_rectified=image.is_rectified,
        baseline_m=_positive(readable[image.topic].about.get(BASELINE_KEY, "")),
        right_info=_right_info(image.namespace, readable, peek),
    )
    mine = [one for one in depths if one.namespace == image.namespace]
    confidence = next((one.topic for one in mine if "confidence" in one.base), None)
    return _with_depth(
        replace(camera, confidence=confidence), [one for one in mine if not NO_DEPTH.search(one.base)], peek
    )


def _positive(word: str) -> float | None:
    try:
        value = float(word)
    except ValueError:
        return None
    return value if 0 < value < math.inf else None


def _with_depth(camera: CameraTopics, depths: Sequence[_Stream], peek: Peek) -> CameraTopics:
    """With the depth that lies in the image's frame; what is left out is told."""
    if not depths:
        return camera
    image = peek(camera.image)
    aligned = [one for one in depths if _is_aligned(one, camera.image, image, peek(one.topic))]
    usable = [one for one in aligned if one.info is not None or _may_have_one_size(image, peek(one.topic))]
    if not usable:
        why = "it has no camera_info" if aligned else f"it is not in the image's frame {image.frame_id!r}"
        logger.warning(
            "camera {}: depth {} is left out, {}; record depth that is aligned to the image (--topics chooses)",
            camera.name,
            ", ".join(one.base for one in depths),
            why,
        )
        return camera
    best = min(usable, key=lambda one: (not re.search("aligned|_to_|registered", one.base), one.base))
    return replace(camera, depth=best.topic, depth_info=best.info, depth_is_rectified=best.is_rectified)


def _may_have_one_size(image: First, depth: First) -> bool:
    return image.size is None or depth.size is None or image.size == depth.size


def _is_aligned(depth: _Stream, image_topic: str, image: First, first: First) -> bool:
    if image.frame_id and first.frame_id:
        return image.frame_id == first.frame_id
    # Nobody has said which frame; then the name must.
    named = [f"depth_to_{part}" for part in image_topic.split("/") if part]
    return "registered" in depth.base or any(
        name in depth.base.split("/") or f"aligned_{name}" in depth.base for name in named
    )


def _right_info(namespace: str, readable: Mapping[str, Topic], peek: Peek) -> str | None:
    for name, topic in sorted(readable.items()):
        if topic.type == INFO and namespace_of(name)[0] == namespace and peek(name).eyes_apart:
            return name
    return None


def _given(
    words: str, topics: Mapping[str, Topic], readable: Mapping[str, Topic], depths: Sequence[_Stream], peek: Peek
) -> CameraTopics:
    """A camera as the user names its topics."""
    name, sign, rest = words.partition("=")
    parts = [part.strip() for part in rest.split(",")]
    if not sign or not name or not parts[0] or len(parts) > 3:
        raise InputError(f"--topics {words}: want <camera>=<image topic>[,<camera info topic>[,<depth topic>]].")
    image = _there(parts[0], (IMAGE, COMPRESSED), topics, readable)
    base = base_of(readable[image])
    info = _there(parts[1], (INFO,), topics, readable) if len(parts) > 1 and parts[1] else _info_of(base, readable)
    namespace, kind = namespace_of(base)
    stream = _Stream(namespace=namespace, kind=kind, base=base, topic=image, info=info)
    camera = _camera(name, stream, readable, depths if len(parts) < 3 else (), peek)
    if len(parts) < 3 or not parts[2]:
        return camera
    depth = _there(parts[2], (IMAGE, COMPRESSED), topics, readable)
    base = base_of(readable[depth])
    frames = [peek(topic).frame_id for topic in (image, depth)]
    if all(frames) and frames[0] != frames[1]:
        logger.warning(
            "camera {}: depth {} is in frame {}, the image in {}; taken as named", name, depth, *frames[::-1]
        )
    return replace(camera, depth=depth, depth_info=_info_of(base, readable), depth_is_rectified=is_rectified(base))


def _there(name: str, types: Sequence[str], topics: Mapping[str, Topic], readable: Mapping[str, Topic]) -> str:
    """The topic of that name, or of a way of its transport."""
    for topic in (name, *(f"{name}/{transport}" for transport in TRANSPORTS)):
        if topic in readable and readable[topic].type in types:
            return topic
    raise InputError(f"--topics: {name} is no {' or '.join(types)} with messages here; its topics: {listing(topics)}.")
