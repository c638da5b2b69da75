"""Open3D's pinhole camera trajectory (JSON), one set of parameters a camera.

Owns      the layout, which Open3D's own reader takes: matrices column by column.
Leaves    JSON to native.

Open3D has no lens distortion. The members ``name``, ``distortion_model`` and ``distortion_coefficients`` of a camera
and ``world_up`` are additions, which it ignores, and drops where it writes the file anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from loguru import logger

from aruco.errors import InputError
from aruco.model import Camera, DistortionModel
from aruco.pose_math import Pose, invert_transform
from rigcal.formats import native
from rigcal.formats.reading import numbers, placed, whole, word
from rigcal.formats.rig import (
    UP_WORDS,
    ExportOptions,
    Format,
    Rig,
    listed,
    numbered_name,
    pinhole_of,
)
from rigcal.formats.rotations import rigid_pose, steady

TRAJECTORY, PARAMETERS = "PinholeCameraTrajectory", "PinholeCameraParameters"
WHAT = "a camera trajectory as Open3D writes it"
_VERSION = {"version_major": 1, "version_minor": 0}


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write the cameras in the order of their names.

    Raises:
        InputError: A camera matrix has skew.
        OutputError: The file cannot be written.
    """
    if bent := [name for name, camera in rig.cameras.items() if camera.has_distortion]:
        logger.warning(
            "Open3D has no lens distortion, and camera {} has some: its intrinsics there hold for images that were "
            "undistorted to the same camera matrix; its coefficients stand in members that Open3D ignores",
            listed(bent),
        )
    content = {
        "class_name": TRAJECTORY,
        "parameters": [_parameters(T, rig.cameras[name]) for name, T in rig.T_world_cam.items()],
        **({"world_up": rig.up} if rig.up else {}),
        **_VERSION,
    }
    native.write_json(out, content)


def _parameters(T_world_cam: Pose, camera: Camera) -> dict[str, Any]:
    pinhole_of(camera, "open3d")  # its renderers ignore a skew
    return {
        "class_name": PARAMETERS,
        "name": camera.name,
        "distortion_model": camera.distortion_model,
        "distortion_coefficients": camera.distortion.tolist(),
        "extrinsic": steady(invert_transform(T_world_cam).ravel(order="F")).tolist(),
        "intrinsic": {
            "height": camera.height,
            "intrinsic_matrix": camera.K.ravel(order="F").tolist(),
            "width": camera.width,
        },
        **_VERSION,
    }


def read(path: Path) -> Rig:
    """The cameras of a trajectory, or of a single set of parameters.

    Raises:
        InputError: The file cannot be read, or an entry is not what it should be.
    """
    content = native.read_json(path, WHAT)
    entries = _entries(content, path)
    poses: dict[str, Pose] = {}
    for name, entry in entries.items():
        where = f"{path}: camera {name}: extrinsic"
        matrix = numbers(entry.get("extrinsic"), where, 16).reshape(4, 4, order="F")
        poses[name] = invert_transform(rigid_pose(matrix, where))
    return Rig(T_world_cam=poses, up=UP_WORDS.get(word(content.get("world_up"))), cameras=_cameras(entries, path))


def read_cameras(path: Path) -> Mapping[str, Camera]:
    """Intrinsics only."""
    return _cameras(_entries(native.read_json(path, WHAT), path), path)


def _entries(content: Mapping[str, Any], path: Path) -> dict[str, Mapping[str, Any]]:
    """Name -> parameters."""
    given = [content] if content.get("class_name") == PARAMETERS else content.get("parameters")
    if not isinstance(given, list) or not given or not all(isinstance(entry, dict) for entry in given):
        raise InputError(f"{path}: has no list of camera parameters; give {WHAT}.")
    names = [word(entry.get("name")) or numbered_name(index) for index, entry in enumerate(given)]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: two cameras have one name; rename one of them.")
    if len(given) > 1 and not any("name" in entry for entry in given):
        logger.warning("{}: cameras have no names there and are called {}, ...", path, names[0])
    return dict(zip(names, given))


def _cameras(entries: Mapping[str, Mapping[str, Any]], path: Path) -> dict[str, Camera]:
    if bare := listed(name for name, entry in entries.items() if "distortion_coefficients" not in entry):
        logger.warning(
            "{}: Open3D's format has no place for lens distortion, so camera {} is taken for a pinhole, which holds "
            "for images that were undistorted, not as they were recorded",
            path,
            bare,
        )
    return {name: _camera(name, entry, f"{path}: camera {name}") for name, entry in entries.items()}


def _camera(name: str, entry: Mapping[str, Any], where: str) -> Camera:
    given = entry.get("intrinsic")
    if not isinstance(given, dict):
        raise InputError(f"{where} has no intrinsic; give {WHAT}.")
    width, height = whole(given.get("width"), f"{where}: width"), whole(given.get("height"), f"{where}: height")
    K = numbers(given.get("intrinsic_matrix"), f"{where}: intrinsic_matrix", 9).reshape(3, 3, order="F")
    model: DistortionModel = entry.get("distortion_model", "plumb_bob")
    distortion = numbers(entry.get("distortion_coefficients", []), f"{where}: distortion_coefficients")
    with placed(where):
        return Camera(name=name, width=width, height=height, K=K, distortion_model=model, distortion=distortion)


def recognises(path: Path, head: bytes) -> bool:
    """JSON that names one of Open3D's classes."""
    return head.lstrip().startswith(b"{") and (TRAJECTORY.encode() in head or PARAMETERS.encode() in head)


FORMAT = Format(
    name="open3d",
    suffix=".json",
    explain=(
        "Open3D PinholeCameraTrajectory JSON: extrinsic maps world to camera (inverse of T_world_cam), 16 numbers "
        "column by column, metres, camera axes x right, y down, z forward, the calibration's own world; "
        "intrinsic_matrix is column by column too; Open3D has no distortion: undistort images first; names and "
        "distortion stand in members that it ignores."
    ),
    put=write,
    read=read,
    recognises=recognises,
    read_cameras=read_cameras,
    needs_cameras=True,
)
