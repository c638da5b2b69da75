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
from aruco.pose_math import Pose, make_pose
from rigcal.formats.reading import is_of_whole_lines, numbers, read_text, warn_of_cut
from rigcal.formats.rig import UP_WORDS, ExportOptions, Format, Rig, numbered_name
from rigcal.formats.rotations import rotation_of_xyzw, words, xyzw_of_rotation

WHAT = "a TUM trajectory (timestamp tx ty tz qx qy qz qw)"
MAX_FILE_BYTES = 2**20  # some thousand cameras
_CAMERA = re.compile(r'#\s*camera:\s*(".*")\s*')
_UP = re.compile(r"^[ \t]*#[ \t]*world_up:[ \t]*([-+]y)[ \t\r]*$", re.MULTILINE)
_COUNT = re.compile(r"^[ \t]*#[ \t]*cameras:[ \t]*([0-9]{1,6})[ \t\r]*$", re.MULTILINE)
# A quaternion of n decimals is as long as one but for 1e-n: four numbers, each half a digit off. Twice that for
# programs that cut digits off instead of rounding. Programs that write more than four need not be as exact as those.
_MOST_DIGITS = 4


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write one line a camera; the time stamp is its index.

    Raises:
        OutputError: The file cannot be written.
    """
    lines = [
        "# T_world_cam of each camera [m], optical axes; the time stamp counts cameras",
        f"# cameras: {len(rig.T_world_cam)}",
    ]
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
        InputError: The file cannot be read, a line is not eight numbers, or it was cut short; the message says where.
    """
    text = read_text(path, WHAT, MAX_FILE_BYTES)
    poses: dict[str, Pose] = {}
    name, unnamed = "", 0
    for count, line in enumerate(map(str.strip, text.splitlines()), 1):
        if line.startswith("#"):
            name = _name(line) or name
        elif line:
            where = f"{path}: line {count}"
            unnamed += not name
            name = name or numbered_name(len(poses))
            if name in poses:
                raise InputError(f"{where}: a second camera called {name[:80]!r}; rename one of them.")
            poses[name] = _pose(line, where)
            name = ""
    if not poses:
        raise InputError(f"{path}: holds no pose; give {WHAT}.")
    _check_whole(text, len(poses), name if name or unnamed < len(poses) else None, path)
    if unnamed:
        logger.warning(
            "{}: {} of {} poses have no name and are called {}, ...; poses are taken for cameras of a rig, not for one "
            "camera's way",
            path,
            unnamed,
            len(poses),
            numbered_name(0),
        )
    said: list[str] = _UP.findall(text)
    return Rig(T_world_cam=poses, up=UP_WORDS[said[-1]] if said else None)


def _check_whole(text: str, n_poses: int, waiting: str | None, path: Path) -> None:
    """See that nothing tells of a file that was cut short.

    Args:
        text: The file.
        n_poses: How many it holds.
        waiting: The camera that its last line names and does not place, or ""; None: it names no camera at all, so that
            another program wrote it, which need not end the last line.
        path: For messages.

    Raises:
        InputError: It was.
    """
    if waiting:
        raise InputError(f"{path}: camera {waiting[:80]!r} has no pose below its name; copy the file again or add it.")
    if waiting is None:
        warn_of_cut(text, path)
    elif not is_of_whole_lines(text):
        raise InputError(
            f"{path}: its last line has no end, so it was cut short; copy the file again, or end the line if it is "
            "whole."
        )
    said: list[str] = _COUNT.findall(text)
    if said and int(said[0]) != n_poses:
        logger.warning(
            "{}: says that it has {} cameras, and holds {}; if it was cut short, copy it again", path, said[0], n_poses
        )


def _name(comment: str) -> str:
    found = _CAMERA.fullmatch(comment)
    try:
        return str(json.loads(found[1])) if found else ""
    except ValueError:
        return ""


def _pose(text: str, where: str) -> Pose:
    values, given = numbers(text.split(), where, 8), text.split()[4:]
    R = rotation_of_xyzw(values[4:], where)
    digits = min(max(map(_digits, given)), _MOST_DIGITS)
    length = float(np.linalg.norm(values[4:]))
    if abs(length - 1.0) > 2.0 * 10.0**-digits:
        raise InputError(
            f"{where}: the quaternion's length is {length:.6g}, which rounding does not explain, so a number there may "
            "be cut short; copy the file again or leave the camera out."
        )
    return make_pose(R, values[1:4])


def _digits(word: str) -> float:
    """After which digit behind the point a number was rounded, as far as it can tell.

    A small one, 0.00012 or 1.2e-04, may have been rounded to so many digits, not decimals: larger ones have fewer.
    """
    mantissa, _, exponent = word.lower().partition("e")
    decimals = len(mantissa.partition(".")[2]) - float(exponent or 0)  # an int takes only some thousand digits
    return min(decimals, len(mantissa.lstrip("+-0.").replace(".", "")))


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
