"""The ZED SDK's Fusion configuration: JSON, one entry a camera, keyed by its serial number.

Owns      both layouts (SDK 5.x, written and read; SDK 4.x, read), putting poses into a file that is there.
Leaves    changing a text without touching the rest of it to json_edit.

On disk always: metres, the SDK's IMAGE axes (x right, y down, z forward) for world and camera, camera to world, left
eye. So ``T_disk = diag(1, -1, -1, 1) @ T_world_cam`` of a world with Y up and OpenCV's camera axes, and a camera at
height H has ty = -H. ``override_gravity`` true says that the pose is whole; false lets the SDK (5.2 and later) turn it
further by the roll and pitch that the camera's accelerometer measures, which would tilt a levelled pose twice.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from loguru import logger

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.pose_math import Pose, matrix_to_rvec_tvec, pose_text, rvec_tvec_to_matrix
from rigcal.formats.json_edit import Edit, Span, before, edited, members
from rigcal.formats.native import MAX_FILE_BYTES, json_bytes
from rigcal.formats.reading import number, numbers, read_text
from rigcal.formats.rig import HALF_TURN_X, ExportOptions, Format, Rig, listed, y_up
from rigcal.formats.rotations import rigid_pose, steady, words

NAME = "zed-fusion"
# The key under which a camera has its pose: SDK 5.x, SDK 4.x.
LAYOUTS = ("FusionConfiguration", "world")
# The SDK holds a serial number in 32 bits; a number with zeros before it would not come back.
_SERIAL = re.compile("[1-9][0-9]{0,9}")
_MAX_SERIAL = 2**32 - 1
# Below this angle a rotation vector and Euler angles in any order agree to 0.01 deg (half the angle squared).
_SMALL_RAD = np.deg2rad(1.0)
_WHAT = "a ZED Fusion configuration"


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write a configuration of SDK 5.x, or the poses into one that is there; whole or not at all.

    Raises:
        InputError: A name is no serial number, nobody knows what is up, or the file to fill cannot be used.
        OutputError: The file cannot be written.
    """
    T_disk = {_checked_serial(name): HALF_TURN_X @ T for name, T in y_up(rig, NAME).items()}
    if options.into is not None:
        write_whole(out, _filled_file(options.into, T_disk))
    else:
        write_whole(out, json_bytes({serial: _entry(serial, T) for serial, T in T_disk.items()}))


def read(path: Path) -> Rig:
    """The cameras of a configuration of SDK 4.x or 5.x, in a world with Y up.

    Raises:
        InputError: It cannot be read or an entry has no rigid pose; the message names file and camera.
    """
    _, content = _parsed(path)
    poses = {serial: _T_disk(camera, f"{path}: camera {serial}") for serial, camera in content.items()}
    if live := listed(serial for serial, camera in content.items() if not _is_whole(camera)):
        logger.warning(
            "{}: override_gravity is false for camera {}: the SDK turns such a pose further by the roll and pitch that "
            "the accelerometer measures, and what is read here lacks that part; see that the cameras' tilt is right",
            path,
            live,
        )
    for serial, camera in content.items():
        stated = camera.get(LAYOUTS[0], {}).get("serial_number", serial)
        if str(stated) != serial:
            logger.warning(
                "{}: camera {} has serial_number {}; it is taken for {}", path, serial, str(stated)[:40], serial
            )
    return Rig(T_world_cam={serial: HALF_TURN_X @ T for serial, T in poses.items()}, up="+y")


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file begins as either layout does."""
    if not head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        return False
    return b'"FusionConfiguration"' in head or all(
        word in head for word in (b'"world"', b'"rotation"', b'"translation"', b'"input"')
    )


def _checked_serial(name: str) -> str:
    if not _SERIAL.fullmatch(name) or int(name) > _MAX_SERIAL:
        raise InputError(
            f"{NAME}: camera {name[:80]!r} is not named by a serial number, by which the ZED SDK finds its cameras; "
            "rename the camera in the calibration to the digits of its serial number."
        )
    return name


def _entry(serial: str, T_disk: Pose) -> dict[str, Any]:
    communication = {"communication_type": "INTRA PROCESS", "ip_add": "", "ip_port": 0}
    source = {
        "input_type_conf": serial,
        "input_type_conf_right": "0",
        "input_type_input": "AUTO",
        "input_virtual_serial_number": 0,
    }
    content = {
        "communication_parameters": {"CommunicationParameters": communication},
        "input_type": {"InputType": source},
        "override_gravity": True,
        "pose": _pose_text(T_disk),
        "serial_number": int(serial),
    }
    return {"FusionConfiguration": content}


def _pose_text(T_disk: Pose) -> str:
    return pose_text(steady(T_disk))


def _parsed(path: Path) -> tuple[str, dict[str, Any]]:
    """A configuration's text, and its cameras, each of which has one of LAYOUTS; remarks beside them are ignored."""
    text = read_text(path, _WHAT, MAX_FILE_BYTES)
    try:
        content = json.loads(text)
        names = [name for name, _ in members(text)]
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON ({str(error)[:200]}); give {_WHAT}.") from error
    cameras = {key: entry for key, entry in content.items() if _SERIAL.fullmatch(key) or _layout(entry)}
    if not cameras:
        raise InputError(f"{path}: holds no camera; give {_WHAT}.")
    if twins := listed(name for name, count in Counter(names).items() if count > 1 and name in cameras):
        raise InputError(f"{path}: camera {twins} is there twice; remove one of them.")
    for serial, camera in cameras.items():
        if not _SERIAL.fullmatch(serial) or _layout(camera) is None:
            raise InputError(
                f"{path}: {serial[:80]!r} is not a camera of {_WHAT}, which is a serial number with a "
                "FusionConfiguration (SDK 5) or a world (SDK 4); remove it or give another file."
            )
    return text, cameras


def _layout(camera: object) -> str | None:
    """Which of LAYOUTS a camera is in."""
    known = [key for key in LAYOUTS if isinstance(camera, dict) and isinstance(camera.get(key), dict)]
    return known[0] if known else None


def _is_whole(camera: Mapping[str, Any]) -> bool:
    """Whether the SDK adds nothing to a pose; SDK 4.x writes the word as a text."""
    stated = camera[_layout(camera) or ""].get("override_gravity", False)
    return stated is True or (isinstance(stated, str) and stated.strip().lower() == "true")


def _T_disk(camera: Mapping[str, Any], where: str) -> Pose:
    if _layout(camera) == "world":
        return _pose_of_old(camera["world"], where)
    text = camera["FusionConfiguration"].get("pose")
    if not isinstance(text, str) or len(text.split()) != 16:
        raise InputError(f"{where}: has no pose of sixteen numbers, row by row; mend it or leave the camera out.")
    rows = [number(word, f"{where}: pose") for word in text.split()]
    return rigid_pose(np.array(rows).reshape(4, 4), where)


def _pose_of_old(world: Mapping[str, Any], where: str) -> Pose:
    rotation = numbers(world.get("rotation"), f"{where}: world.rotation", 3)
    translation = numbers(world.get("translation"), f"{where}: world.translation", 3)
    _say_presumed(float(np.linalg.norm(rotation)), where)
    return rvec_tvec_to_matrix(rotation, translation)


def _say_presumed(angle_rad: float, where: str) -> None:
    if angle_rad > _SMALL_RAD:
        logger.warning(
            "{}: the layout of SDK 4 does not say what its three numbers of a rotation of {:.1f} deg mean; they are "
            "taken for a rotation vector (Rodrigues): compare with what the SDK shows, or use a file of SDK 5",
            where,
            float(np.rad2deg(angle_rad)),
        )


def _filled_file(path: Path, T_disk: Mapping[str, Pose]) -> bytes:
    """The bytes of a configuration with the poses of its cameras replaced and all else as it is."""
    text, there = _parsed(path)
    shared = [serial for serial in T_disk if serial in there]
    if not shared:
        raise InputError(
            f"{path}: has none of the calibration's cameras (it has {listed(there)}; the calibration has "
            f"{listed(T_disk)}); give the configuration of this rig."
        )
    if absent := listed(T_disk.keys() - there.keys()):
        logger.warning("{}: lacks camera {} of the calibration, whose pose is not written", path, absent)
    if old := listed(there.keys() - T_disk.keys()):
        logger.warning("{}: camera {} is not in the calibration and keeps its old pose, in its old world", path, old)
    at = dict(members(text))
    edits: list[Edit] = []
    for serial in shared:
        layout = _layout(there[serial]) or ""
        entry = dict(members(text, dict(members(text, at[serial].start))[layout].start))
        edits += _edits(text, entry, _fresh(layout, T_disk[serial], f"{path}: camera {serial}"), f"{path}: {serial}")
    return edited(text, edits).encode()


def _fresh(layout: str, T_disk: Pose, where: str) -> dict[str, str]:
    """The members of an entry that hold the pose, and what their values become."""
    if layout == "FusionConfiguration":
        return {"pose": json.dumps(_pose_text(T_disk))}
    rvec, tvec = matrix_to_rvec_tvec(T_disk)
    _say_presumed(float(np.linalg.norm(rvec)), where)
    return {"rotation": f"[{', '.join(words(rvec))}]", "translation": f"[{', '.join(words(tvec))}]"}


def _edits(text: str, entry: Mapping[str, Span], fresh: Mapping[str, str], where: str) -> list[Edit]:
    """What to change in one entry: the pose, and that it is whole."""
    if missing := listed(fresh.keys() - entry.keys()):
        raise InputError(f"{where}: lacks {missing}, so that nothing can be replaced; write a new file without --into.")
    edits = [Edit(start=entry[key].start, end=entry[key].end, words=value) for key, value in fresh.items()]
    stated = entry.get("override_gravity")
    if stated is None:
        true = "true" if "pose" in fresh else '"true"'
        return [*edits, before(text, entry[min(fresh)], f'"override_gravity": {true}')]
    true = '"true"' if text[stated.start] == '"' else "true"
    return [*edits, Edit(start=stated.start, end=stated.end, words=true)]


FORMAT = Format(
    name=NAME,
    suffix=".json",
    explain=(
        "ZED SDK Fusion configuration (5.x): camera to world of the left eye, sixteen numbers row by row, metres, "
        "world and camera x right, y down, z forward (a camera at height H has ty = -H), override_gravity true; poses "
        "only, cameras are named by their serial numbers."
    ),
    put=write,
    read=read,
    recognises=recognises,
    needs_up=True,
    takes=frozenset({"into"}),
)
