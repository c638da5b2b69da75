"""What the names of ROS image topics tell: streams, namespaces, ways of transport.

Owns      the words that drivers use (RealSense, ZED, Azure Kinect, Orbbec, image_transport, image_proc, usb_cam).
Leaves    choosing among topics to ros_topics.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from itertools import pairwise

from rigcal.sources.message_store import Topic
from rigcal.sources.ros_images import is_depth

IMAGE, COMPRESSED, INFO = "sensor_msgs/Image", "sensor_msgs/CompressedImage", "sensor_msgs/CameraInfo"

# Last parts of the names of topics that image_transport makes of one.
TRANSPORTS = ("compressed", "compressedDepth", "zstd", "theora")
# Streams in the order in which they are taken; None: the namespace is the camera's itself.
STREAMS = (
    ("colour", r"rgb|colou?r|rgb_raw|colou?r_raw|rgb_to_depth|colou?r_to_depth"),
    ("left", r"left|left_raw|left_rect"),
    ("", None),
    ("grey", r"mono|gr[ae]y|(left|rgb)(_raw)?_gr[ae]y"),
    ("infrared", r"ir|infra|infra1|infrared|infrared1|(left|ir)_(ir|left)|fisheye1?"),
    ("right", r"right|right_(raw|rect|(raw_)?gr[ae]y)"),
    ("second infrared", r"infra2|infrared2|(right|ir)_(ir|right)|fisheye2"),
    ("both eyes", r"stereo|stereo_raw"),  # side by side, or what is computed from them
)
# What stands behind two names of streams that are one (left/color/rect/image); elsewhere the first is a namespace.
_VERSIONS = ("rect", "raw")
BOTH_EYES = len(STREAMS) - 1
DEPTH = len(STREAMS)  # index of depth and what goes with it
_DEPTH = re.compile(
    r"depth|depth_(to_\w+|registered|raw|rect|rect_raw|image)|aligned_depth(_to_\w+)?|[sh]w_registered|"
    r"confidence(_map)?|disparity(_image)?",
    re.IGNORECASE,
)
# What is stored like depth beside it.
NO_DEPTH = re.compile(r"confidence|disparity|cost", re.IGNORECASE)
GREY = re.compile(r"gr[ae]y|mono", re.IGNORECASE)


def base_of(topic: Topic) -> str:
    """The name of an image topic without the way of its transport."""
    head, _, last = topic.name.rpartition("/")
    return head if topic.type == COMPRESSED and last in TRANSPORTS and head else topic.name


def is_rectified(stream: str) -> bool:
    """Whether a name, from the stream on, says that its images are rectified."""
    parts = stream.strip("/").split("/")
    if parts[-1].startswith("image_raw"):
        return "_rect" in parts[-1]
    return any(part == "rect" or part.startswith("image_rect") or part.endswith("_rect") for part in parts)


def named_like_streams(bases: Iterable[str]) -> frozenset[str]:
    """Namespaces that are called like a stream, of image topics: left of /left/color/image_raw, /left/zed/rgb/image."""
    found: set[str] = set()
    for base in bases:
        parts = base.strip("/").split("/")
        streams = [at for at, part in enumerate(parts[:-1]) if _kind(part) is not None]
        for at, inner in pairwise(streams):
            is_version = inner == at + 1 and parts[inner + 1] in _VERSIONS
            if _kind(parts[at]) != DEPTH and not is_version:
                found.add("/".join(parts[: at + 1]))
    return frozenset(found)


def namespace_of(base: str, namespaces: Collection[str] = ()) -> tuple[str, int]:
    """(the camera's namespace, index of the stream in STREAMS or DEPTH) of an image topic.

    Args:
        base: Its name.
        namespaces: What is none of its streams although it is called like one; see named_like_streams.
    """
    parts = base.strip("/").split("/")
    for at, part in enumerate(parts):
        kind = _kind(part)
        if kind is not None and "/".join(parts[: at + 1]) not in namespaces:
            return "/".join(parts[:at]), kind
    return "/".join(parts[:-1]), next(kind for kind, (_, pattern) in enumerate(STREAMS) if pattern is None)


def _kind(part: str) -> int | None:
    """The stream that a part of a name names."""
    for kind, (_, pattern) in enumerate(STREAMS):
        if pattern is not None and re.fullmatch(pattern, part, re.IGNORECASE):
            return kind
    return DEPTH if _DEPTH.fullmatch(part) else None


def is_depth_topic(base: str, encoding: str) -> bool:
    """Depth or what goes with it; a name alone is not enough: simulators call a colour camera depth_camera."""
    named = any(_DEPTH.fullmatch(part) for part in base.split("/"))
    return is_depth(encoding) or (named and encoding.lower() in ("mono16", "mono8", "8uc1", "32fc1"))


def camera_name(namespace: str) -> str:
    """A namespace as a name: camera of /camera/camera, zed of /zed/zed_node; empty for none."""
    parts = [part for part in namespace.split("/") if part]
    kept = [part for k, part in enumerate(parts) if part not in parts[:k] and (part != "zed_node" or k == 0)]
    return "_".join(kept).strip("_")


def side_of(kind: int) -> str:
    """left, right, or empty for neither, of an index into STREAMS."""
    name = STREAMS[kind][0] if kind < DEPTH else ""
    return name if name in ("left", "right") else ""
