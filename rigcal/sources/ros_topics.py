"""Which topics of a ROS recording belong to which camera.

Owns      what is chosen where there is a choice, and ``--topics``.
Leaves    topics as streams to ros_streams, reading messages to ros_opening, RealSense's own files to realsense_topics,
          rigcal's to rigcal_topics.

A camera is a namespace: ``/zed/zed_node/left/image_rect_color`` is the stream ``left`` of ``/zed/zed_node``. Of its
streams one is taken, in this order: with a camera_info before without; colour (``color``, ``rgb``), left, no stream
named, grey, infrared, right, both eyes side by side; rectified before raw images; colour before grey; messages as they
are before compressed ones. Left and right are two cameras where no camera_info calls them the two eyes of one; so are
they and colour, and streams of one kind, where each has a frame and a camera_info of its own. Depth is taken in the
image's frame only.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from loguru import logger

from aruco.errors import InputError
from rigcal.sources.message_store import Topic
from rigcal.sources.ros_streams import First, Peek, Stream, Streams
from rigcal.sources.topic_names import BOTH_EYES, COMPRESSED, GREY, IMAGE, INFO, NO_DEPTH, TRANSPORTS, camera_name

_MAX_LISTED = 40
# The last part of the name of the only confidence whose meaning is known besides rigcal's own.
_ZED_CONFIDENCE = "confidence_map"


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


def paired(topics: Mapping[str, Topic], peek: Peek, given: Sequence[str]) -> tuple[CameraTopics, ...]:
    """The cameras of a recording.

    Args:
        topics: Its topics.
        peek: What a topic's first message tells.
        given: What the user says, "<camera>=<image>[,<camera info>[,<depth>]]" each; empty: found by name.

    Returns:
        The cameras, sorted by name; two may have one name.

    Raises:
        InputError: A topic that is given is not there.
    """
    streams = Streams(topics, peek)
    if given:
        cameras = [_given(words, streams) for words in given]
    else:
        groups: dict[str, list[Stream]] = {}
        for stream in streams.images:
            groups.setdefault(stream.namespace, []).append(stream)
        cameras = [camera for group in groups.values() for camera in _of_namespace(group, streams)]
    return tuple(sorted(cameras, key=lambda camera: camera.name))


def listing(topics: Mapping[str, Topic]) -> str:
    """All topics with types and counts; only so many that a message remains readable."""
    images_first = sorted(topics.values(), key=lambda topic: (topic.type not in (IMAGE, COMPRESSED, INFO), topic.name))
    shown = [str(topic) for topic in images_first[:_MAX_LISTED]]
    more = len(topics) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "") if topics else "none"


def _of_namespace(group: Sequence[Stream], streams: Streams) -> list[CameraTopics]:
    ranked = sorted(
        group,
        key=lambda one: (one.info is None, one.kind, not one.is_rectified, bool(GREY.search(one.name)), one.base),
    )
    has_eyes = any(one.side == "right" and one.info and streams.peek(one.info).eyes_apart for one in group)
    taken = ranked[:1]
    for one in ranked[1:]:
        if not (has_eyes and one.side == "right") and _is_another(one, taken, streams.peek):
            taken.append(one)
    _tell_left_out([one for one in ranked if one not in taken], taken, streams)
    return [_camera(name, one, streams, beside=taken) for name, one in zip(_names(taken), taken)]


def _is_another(one: Stream, taken: Sequence[Stream], peek: Peek) -> bool:
    """Whether a stream is another camera's than those that are taken."""
    sides = [other.side for other in taken]
    if one.side == "right" and "left" in sides and "right" not in sides:
        return True
    has_own_info = one.info is not None and one.info not in [other.info for other in taken]
    # Infrared and grey images beside colour are of one device; a camera may be called stereo.
    is_alike = bool(one.side) or one.kind in (taken[0].kind, BOTH_EYES)
    return is_alike and has_own_info and _is_elsewhere(one, taken, peek)


def _is_elsewhere(one: Stream, taken: Sequence[Stream], peek: Peek) -> bool:
    """Whether a stream is in no frame of those that are taken, nor computed from another."""
    frame, frames = peek(one.topic).frame_id, [peek(other.topic).frame_id for other in taken]
    return bool(frame) and all(frames) and frame not in frames and "_to_" not in one.name


def _names(taken: Sequence[Stream]) -> list[str]:
    """What the cameras of one namespace are called."""
    name, sides = camera_name(taken[0].namespace), [one.side for one in taken]
    if len(taken) == 1:
        return [name or sides[0] or "camera"]
    if sides == ["left", "right"]:
        return [f"{name}_{side}".strip("_") for side in sides]
    return [camera_name((one.info or one.base).rpartition("/")[0]) or "camera" for one in taken]


def _tell_left_out(left_out: Sequence[Stream], taken: Sequence[Stream], streams: Streams) -> None:
    images, namespace = " and ".join(one.topic for one in taken), taken[0].namespace
    # A device has a namespace, depth, or images as another sensor has them; else cameras may be called like streams.
    has_depth = any(one.namespace == namespace for one in streams.depths)
    is_device = bool(namespace) or has_depth or any("_to_" in one.name for one in left_out)
    unclear = [one for one in left_out if not is_device and _is_elsewhere(one, taken, streams.peek)]
    if unclear:
        logger.warning(
            "{} {} taken to be of the camera of {} and left out; where these are several cameras name all with "
            "--topics NAME=IMAGE_TOPIC",
            ", ".join(one.base for one in unclear),
            _be(unclear),
            images,
        )
    if known := [one.base for one in left_out if one not in unclear]:
        text = "of one camera's images {} {} taken, not {} (--topics chooses)"
        logger.info(text, images, _be(taken), ", ".join(known))


def _be(things: Sequence[object]) -> str:
    return "is" if len(things) == 1 else "are"


def _camera(
    name: str, image: Stream, streams: Streams, *, beside: Sequence[Stream] = (), but_depth: bool = False
) -> CameraTopics:
    """The camera of an image; beside: the images of all cameras of its namespace."""
    camera = CameraTopics(
        name=name,
        image=image.topic,
        info=image.info,
        is_rectified=image.is_rectified,
        right_info=streams.right_info(image.namespace),
    )
    frame = streams.peek(image.topic).frame_id
    others = {streams.peek(other.topic).frame_id for other in beside} - {frame, ""}
    here = [] if but_depth else [one for one in streams.depths if one.namespace == image.namespace]
    mine = [one for one in here if not frame or streams.peek(one.topic).frame_id not in others]
    camera = _with_depth(camera, [one for one in mine if not NO_DEPTH.search(one.name)], streams.peek)
    return _with_confidence(camera, [one for one in mine if "confidence" in one.name], streams.peek)


def _with_depth(camera: CameraTopics, depths: Sequence[Stream], peek: Peek) -> CameraTopics:
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
    best = min(usable, key=lambda one: (not re.search("aligned|_to_|registered", one.name), one.base))
    return replace(camera, depth=best.topic, depth_info=best.info, depth_is_rectified=best.is_rectified)


def _with_confidence(camera: CameraTopics, found: Sequence[Stream], peek: Peek) -> CameraTopics:
    """With the ZED's confidence of the depth; other programs' numbers mean something else."""
    if camera.depth is None or not found:
        return camera
    depth = peek(camera.depth)
    for one in found:
        first = peek(one.topic)
        is_of_depth = _may_have_one_size(depth, first) and first.frame_id == depth.frame_id
        if is_of_depth and one.base.endswith(f"/{_ZED_CONFIDENCE}"):
            return replace(camera, confidence=one.topic)
    logger.warning(
        "camera {}: confidence {} is left out: only the ZED driver's is known ({}, of depth's frame and size)",
        camera.name,
        ", ".join(one.base for one in found),
        _ZED_CONFIDENCE,
    )
    return camera


def _may_have_one_size(image: First, depth: First) -> bool:
    return image.size is None or depth.size is None or image.size == depth.size


def _is_aligned(depth: Stream, image_topic: str, image: First, first: First) -> bool:
    if image.frame_id and first.frame_id:
        return image.frame_id == first.frame_id
    # Nobody has said which frame; then the name must.
    named = [f"depth_to_{part}" for part in image_topic.split("/") if part]
    return "registered" in depth.name or any(
        name in depth.base.split("/") or f"aligned_{name}" in depth.base for name in named
    )


def _given(words: str, streams: Streams) -> CameraTopics:
    """A camera as the user names its topics."""
    name, sign, rest = words.partition("=")
    parts = [part.strip() for part in rest.split(",")]
    if not sign or not name or not parts[0] or len(parts) > 3:
        raise InputError(f"--topics {words}: want <camera>=<image topic>[,<camera info topic>[,<depth topic>]].")
    image = _there(parts[0], (IMAGE, COMPRESSED), streams)
    info = _there(parts[1], (INFO,), streams) if len(parts) > 1 and parts[1] else None
    camera = _camera(name, streams.of(image, info), streams, but_depth=len(parts) == 3)
    if len(parts) < 3 or not parts[2]:
        return camera
    depth = streams.of(_there(parts[2], (IMAGE, COMPRESSED), streams))
    frames = [streams.peek(topic).frame_id for topic in (image, depth.topic)]
    if all(frames) and frames[0] != frames[1]:
        logger.warning(
            "camera {}: depth {} is in frame {}, the image in {}; taken as named", name, depth.topic, *frames[::-1]
        )
    return replace(camera, depth=depth.topic, depth_info=depth.info, depth_is_rectified=depth.is_rectified)


def _there(name: str, types: Sequence[str], streams: Streams) -> str:
    """The topic of that name, or of a way of its transport."""
    for topic in (name, *(f"{name}/{transport}" for transport in TRANSPORTS)):
        if topic in streams.readable and streams.readable[topic].type in types:
            return topic
    raise InputError(
        f"--topics: {name} is no {' or '.join(types)} with messages here; its topics: {listing(streams.topics)}."
    )
