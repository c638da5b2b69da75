"""A TUM trajectory with one line a camera.

Owns      the line, the comments that hold what the format has no place for: names of cameras, which way is up.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from loguru import logger

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.model import UpAxis
from aruco.pose_math import Pose, make_pose
from rigcal.formats.reading import numbers, read_text
from rigcal.formats.rig import UP_WORDS, ExportOptions, Format, Rig, numbered_name
from rigcal.formats.rotations import rotation_of_xyzw, words, xyzw_of_rotation

WHAT = "a TUM trajectory (timestamp tx ty tz qx qy qz qw)"
MAX_FILE_BYTES = 2**20  # some thousand cameras
_CAMERA = re.compile(r'#\s*camera:\s*(".*")\s*')
_UP = re.compile(r"#\s*world_up:\s*([-+]y)\s*")


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write one line a camera; the time stamp is its index.

    Raises:
        OutputError: The file cannot be written.
    """
    lines = ["# T_world_cam of each camera [m], optical axes; the time stamp counts cameras"]
    if rig.up:
        lines.append(f"# world_up: {rig.up}")
    lines.append("# timestamp tx ty tz qx qy qz qw")
    for index, (name, T) in enumerate(rig.T_world_cam.items()):
        lines.append(f"# camera: {json.dumps(name, ensure_ascii=False)}")
        lines.append(" ".join([str(index), *words(T[:3, 3]), *words(xyzw_of_rotation(T[:3, :3]))]))
    write_whole(out, ("\n".join(lines) + "\n").encode())


def read(path: Path) -> Rig:
    """One camera a line.

    Raises:
        InputError: The file cannot be read, or a line is not eight numbers; the message names it.
    """
    poses: dict[str, Pose] = {}
    up: UpAxis | None = None
    name, unnamed = "", 0
    for count, line in enumerate(read_text(path, WHAT, MAX_FILE_BYTES).splitlines(), 1):
        text, where = line.strip(), f"{path}: line {count}"
        if found := _UP.fullmatch(text):
            up = UP_WORDS[found[1]]
        elif text.startswith("#"):
            name = _name(text) or name
        elif text:
            unnamed += not name
            name = name or numbered_name(len(poses))
            if name in poses:
                raise InputError(f"{where}: a second camera called {name[:80]!r}; rename one of them.")
            poses[name] = _pose(text, where)
            name = ""
    if not poses:
        raise InputError(f"{path}: holds no pose; give {WHAT}.")
    if unnamed:
        logger.warning(
            "{}: {} of {} poses have no name and are called {}, ...; poses are taken for cameras of a rig, not for one "
            "camera's way",
            path,
            unnamed,
            len(poses),
            numbered_name(0),
        )
    return Rig(T_world_cam=poses, up=up)


def _name(comment: str) -> str:
    found = _CAMERA.fullmatch(comment)
    try:
        return str(json.loads(found[1])) if found else ""
    except ValueError:
        return ""


def _pose(text: str, where: str) -> Pose:
    values = numbers(text.split(), where, 8)
    return make_pose(rotation_of_xyzw(values[4:], where), values[1:4])


def recognises(path: Path, head: bytes) -> bool:
    """Its first line that is no comment has eight numbers."""
    lines = (line.strip() for line in head.splitlines()[:200])
    first = next((line for line in lines if line and not line.startswith(b"#")), b"")
    try:
        return np.array([float(word) for word in first.split()]).shape == (8,)
    except ValueError:
        return False


FORMAT = Format(
    name="tum",
    suffix=".txt",
    explain=(
        "TUM trajectory: timestamp tx ty tz qx qy qz qw = T_world_cam (camera to world), metres, scalar last, OpenCV "
        "camera axes (x right, y down, z forward), the calibration's own world; one line a camera, the time stamp is "
        "its index, its name stands in the comment above; intrinsics are not kept."
    ),
    put=write,
    read=read,
    recognises=recognises,
)
