"""Frames of ROS: how cameras' names become names of frames and back, and poses from a tree of transforms.

Owns      which names ROS takes, the reversible spelling of all others, the note in a file that says how its frames
          are named, walking a tree of transforms.
Leaves    what a launch file and a URDF look like to their own files.

The world is REP-103's, Z up; a camera's frame is optical: x right, y down, z forward. A tree of others may hang from a
camera instead, of which nobody knows how it is tilted.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from loguru import logger

from aruco.errors import InputError
from aruco.pose_math import Pose
from rigcal.formats.rig import CAMERA_WORD, ExportOptions, Rig, filled, listed, y_up, y_up_of_z_up, z_up

# A hall of a hundred cameras takes 100 kB.
MAX_FILE_BYTES = 2**20
# No robot has an arm of more joints, no frame a longer name.
MAX_DEPTH = 64
MAX_NAME = 255
_FRAME = re.compile("[A-Za-z0-9_]+(/[A-Za-z0-9_]+)*")
_NOTE = "Camera frames are named"
# ZED's wrapper before and since 5.1, then all others. A ZED's right eye is no camera of its own, so its left one goes
# first.
_DEFAULT_PATTERNS = (
    ExportOptions().frame_name,
    "{camera}_left_camera_frame_optical",
    "{camera}_optical_frame",
    "{camera}_frame_optical",
)
# zed_camera_link, cam0, camera_color_optical_frame: bodies that are mounted at any tilt.
# What is called a world or a map is none of them, whoever made it: cam_world.
_CAMERAS_OWN = re.compile(
    "(?!(.*[_/])?(world|map)$)(.*[_/])?cam(era)?[0-9]*($|[_/])|(.*[_/])?optical(_frame)?$", re.IGNORECASE
)
# What comes back as another sign: such parts of names are spelt too.
_LIKE_SPELT = "_(?=x[0-9a-f]{1,6}(?:_|[^A-Za-z0-9_]))"
MOVES = "moves; give a file with fixed cameras"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Link:
    """A frame's place in its parent."""

    parent: str
    T_parent_child: Pose | None  # None: not known
    unknown: str = MOVES  # what such a frame does, and what to do about it


def frame_of(camera: str, pattern: str) -> str:
    """The frame of a camera. What ROS does not take in a name is spelt ``_x<hex>_``, so that the name comes back."""
    spelt = re.sub(f"[^A-Za-z0-9_]|{_LIKE_SPELT}", lambda found: f"_x{ord(found.group()):x}_", camera)
    return filled(pattern, spelt)


def camera_of(frame: str, pattern: str) -> str | None:
    """The camera whose frame this is; None: the frame does not follow the pattern."""
    if len(frame) > MAX_NAME:
        return None
    first, second, *more = (re.escape(part) for part in pattern.split(CAMERA_WORD))
    found = re.fullmatch("".join([first, "(?P<camera>.+)", second, *("(?P=camera)" + part for part in more)]), frame)
    return re.sub("_x([0-9a-f]{1,6})_", _letter, found["camera"]) if found else None


def _letter(found: re.Match[str]) -> str:
    code = int(found.group(1), 16)
    return chr(code) if code < 0x110000 else found.group()


def frames_of(rig: Rig, options: ExportOptions, who: str) -> dict[str, str]:
    """Camera -> frame.

    Raises:
        InputError: ROS does not take a name, or two frames have one name.
    """
    for option, frame in (("--parent-frame", options.parent_frame), ("--frame-name", filled(options.frame_name, "c"))):
        if not _FRAME.fullmatch(frame):
            raise InputError(
                f"{who}: {option} does not give a name for a frame ({frame[:80]!r}), which has letters, digits and _, "
                "parted by single slashes; choose another one."
            )
    frames = {camera: frame_of(camera, options.frame_name) for camera in rig.T_world_cam}
    _refuse_long(frames, options, who)
    if options.parent_frame in frames.values():
        raise InputError(
            f"{who}: --parent-frame {options.parent_frame} is the frame of a camera as well; choose another one."
        )
    return frames


def _refuse_long(frames: Mapping[str, str], options: ExportOptions, who: str) -> None:
    """See that every name that is written is short enough to be read.

    Raises:
        InputError: One is not.
    """
    long = {camera: frame for camera, frame in frames.items() if len(frame) > MAX_NAME}
    if len(options.frame_name) > MAX_NAME or len(options.parent_frame) > MAX_NAME:
        raise InputError(f"{who}: --parent-frame and --frame-name have {MAX_NAME} signs at most; give shorter ones.")
    for camera, frame in long.items():
        raise InputError(
            f"{who}: the frame of camera {camera[:40]!r}... would have {len(frame)} signs, and names of frames have "
            f"{MAX_NAME} at most; rename the camera or give a shorter --frame-name."
        )


def note(options: ExportOptions) -> str:
    """The sentence by which a file says how its frames are named."""
    return f"{_NOTE} {options.frame_name}"


def upright(rig: Rig, who: str) -> dict[str, Pose]:
    """T_world_cam of every camera in a world with Z up.

    Raises:
        InputError: Nobody knows what is up.
    """
    return {camera: z_up(T) for camera, T in y_up(rig, who).items()}


def rig_of(links: Mapping[str, Link], text: str, path: Path) -> Rig:
    """The cameras among the frames of a file's ``text``, in the world at the root of its tree, turned to Y up.

    A tree that hangs from a camera keeps that camera's axes for its world: a camera may be tilted, so up is unknown.

    Args:
        links: Every frame that has a parent -> where it is in it.
        text: The file, which may say how the frames of cameras are named.
        path: For messages.

    Raises:
        InputError: No frame is a camera's, they hang from several roots, or from something that has no place.
    """
    stated = _stated_pattern(text)
    ours = _named_by(stated, links) if stated else {}
    cameras = ours or _cameras(links, path)
    placed = {camera: _placed(frame, links, path) for camera, frame in cameras.items()}
    if len(roots := {root for root, _ in placed.values()}) > 1:
        raise InputError(f"{path}: its cameras hang from several roots ({listed(roots)}); give a file with one world.")
    # A file of ours says that its root has z up, whatever that is called.
    if not ours and _CAMERAS_OWN.match(root := roots.pop()):
        logger.warning(
            "{}: its frames hang from {}, a camera's by its name, which may be tilted, so which way is up stays "
            "unknown; if its z points up, rename it: a root called world or map is taken to have z up",
            path,
            root,
        )
        return Rig(T_world_cam={camera: T for camera, (_, T) in placed.items()}, origin="camera")
    return Rig(T_world_cam={camera: y_up_of_z_up(T) for camera, (_, T) in placed.items()}, up="+y")


def _stated_pattern(text: str) -> str | None:
    """How a file says that its cameras' frames are named."""
    stated = re.search(f"{_NOTE} ([A-Za-z0-9_/{{}}]{{1,{MAX_NAME}}})", text)
    return stated.group(1) if stated and CAMERA_WORD in stated.group(1) else None


def _named_by(pattern: str, frames: Iterable[str]) -> dict[str, str]:
    """Camera -> frame, of the frames that follow a pattern."""
    return {camera: frame for frame in frames if (camera := camera_of(frame, pattern))}


def _cameras(links: Mapping[str, Link], path: Path) -> dict[str, str]:
    """Camera -> frame: by the usual endings, else all ends of the tree, and what is named like these or as optical."""
    parents = {link.parent for link in links.values()}
    roots = sorted(parents - links.keys())
    for pattern in _DEFAULT_PATTERNS:
        found = _named_by(pattern, (*links, *roots))
        if links.keys() & set(found.values()):
            _say_left_out({*links, *roots} - set(found.values()), pattern, path)
            return found
    if not (ends := links.keys() - parents):
        raise InputError(f"{path}: holds no frame of a camera; give a file with a transform for each camera.")
    fixed = {end for end in ends if _is_fixed(end, links)}
    if fixed and (loose := listed(ends - fixed)):
        logger.warning("{}: {} have no place that is known and fixed, and are left out", path, loose)
    taken = {frame: frame for frame in fixed or ends}
    alike = {_without_number(frame) for frame in taken}
    others = {frame for frame in parents if _CAMERAS_OWN.match(frame)}
    taken |= {frame: frame for frame in others if _without_number(frame) in alike and _is_fixed(frame, links)}
    taken |= {_named_alone(root, taken): root for root in roots if _is_optical(root)}
    logger.warning(
        "{}: no frame that hangs on another is named as an optical one; {} are taken for cameras with z forward, x "
        "right, y down{}",
        path,
        listed(taken.values()),
        f"; {rest} are left out" if (rest := listed(others - set(taken.values()))) else "",
    )
    return taken


def _is_fixed(frame: str, links: Mapping[str, Link]) -> bool:
    """Whether every link above a frame is known; what has no end is found later."""
    for _ in range(MAX_DEPTH):
        if frame not in links:
            return True
        if links[frame].T_parent_child is None:
            return False
        frame = links[frame].parent
    return True


def _without_number(frame: str) -> str:
    """cam0 and cam1 are of one kind, cam0 and cam0_imu are not."""
    return re.sub("[0-9]+", "", frame)


def _named_alone(frame: str, taken: Iterable[str]) -> str:
    """The camera of an optical frame, which is called as the frame where the name is another's."""
    names = (camera_of(frame, pattern) for pattern in _DEFAULT_PATTERNS)
    return next((name for name in names if name and name not in taken), frame)


def _say_left_out(frames: Iterable[str], pattern: str, path: Path) -> None:
    if left_out := listed(frame for frame in frames if _is_optical(frame)):
        logger.warning("{}: cameras are the frames named {} here; {} are left out", path, pattern, left_out)


def _is_optical(frame: str) -> bool:
    return any(camera_of(frame, pattern) for pattern in _DEFAULT_PATTERNS)


def _placed(frame: str, links: Mapping[str, Link], path: Path) -> tuple[str, Pose]:
    """The root above a frame, and the frame's pose in it."""
    T_root_frame, at, seen = np.eye(4), frame, {frame}
    while at in links:
        link = links[at]
        if link.T_parent_child is None:
            hung = "" if at == frame else f" hangs on {at}, which"
            raise InputError(f"{path}: frame {frame}{hung} {link.unknown}.")
        T_root_frame, at = link.T_parent_child @ T_root_frame, link.parent
        if at in seen:
            raise InputError(f"{path}: frame {frame} hangs in a circle of frames; mend its parents.")
        if len(seen) > MAX_DEPTH:
            raise InputError(f"{path}: frame {frame} hangs below more than {MAX_DEPTH} others; give a simpler tree.")
        seen.add(at)
    return at, T_root_frame
