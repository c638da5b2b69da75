"""rigcal's own extrinsics file, as one of the formats that are converted to and from.

Owns      which of its entries a rig consists of, intrinsics beside the poses.
Leaves    the layout and everything else in such a file to native.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from loguru import logger

from aruco.errors import InputError
from aruco.model import Camera, DistortionModel
from aruco.pose_math import pose_text
from rigcal.formats import native
from rigcal.formats.reading import numbers, placed, whole
from rigcal.formats.rig import ExportOptions, Format, Rig, listed

_POSE = re.compile(rb'"pose"\s*:\s*"[-+.0-9eE\s]{31,}"')


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write poses, world and intrinsics; see native.write_extrinsics for all that a calibration has."""
    meta = {
        "format": native.FORMAT,
        "version": native.VERSION,
        "world": {"up": native.UP_VECTORS[rig.up] if rig.up else None, "origin": rig.origin},
    }
    entries = {name: _entry(T, rig.cameras.get(name)) for name, T in rig.T_world_cam.items()}
    native.write_json(out, {**entries, "_meta": meta})


def _entry(T_world_cam: Any, camera: Camera | None) -> dict[str, Any]:
    pose = {"pose": pose_text(T_world_cam)}
    if camera is None:
        return pose
    return {
        **pose,
        "intrinsics": {
            "image_width": camera.width,
            "image_height": camera.height,
            "camera_matrix": [float(value) for value in camera.K.ravel()],
            "distortion_model": camera.distortion_model,
            "distortion_coefficients": [float(value) for value in camera.distortion],
        },
    }


def read(path: Path) -> Rig:
    """Poses, world and intrinsics.

    Raises:
        InputError: The file cannot be read, or an entry is not what it should be.
    """
    content = native.read_json(path)
    native.check_version(content, path)
    meta = content.get("_meta")
    up, origin = _world(meta, path)
    _warn(meta if isinstance(meta, dict) else {}, path)
    cameras = _cameras(content, path)
    return Rig(T_world_cam=native.poses_of(content, path), up=up, origin=origin, cameras=cameras)


def _warn(meta: Mapping[str, Any], path: Path) -> None:
    """What other formats have no place for and a user must not miss."""
    parts = meta.get("parts")
    apart = [name for part in parts if isinstance(part, dict) for name in part] if isinstance(parts, list) else []
    if apart := [name for name in apart if not name.startswith("_")]:
        logger.warning("{}: camera {} stands in a world of its own and is left out", path, listed(apart))
    lost = meta.get("without_pose")
    if isinstance(lost, dict) and lost:
        logger.warning("{}: camera {} has no pose there and is left out", path, listed(lost))
    quality = meta.get("quality")
    if isinstance(quality, dict) and quality.get("verdict") == "bad":
        logger.warning("{}: this calibration calls itself bad; see _meta.quality.reasons there", path)


def read_cameras(path: Path) -> Mapping[str, Camera]:
    """Intrinsics only."""
    content = native.read_json(path)
    native.check_version(content, path)
    return _cameras(content, path)


def _world(meta: object, path: Path) -> tuple[Any, str]:
    world = meta.get("world") if isinstance(meta, dict) else None
    if world is None:
        return None, "unknown"
    up, origin = (world.get("up"), world.get("origin", "unknown")) if isinstance(world, dict) else ("", "")
    axis = next((axis for axis, vector in native.UP_VECTORS.items() if vector == up), None)
    if not isinstance(origin, str) or (up is not None and axis is None):
        raise InputError(
            f"{path}: _meta.world wants up [0, 1, 0], [0, -1, 0] or null and an origin in words; mend or remove it."
        )
    return axis, origin


def _cameras(content: Mapping[str, Any], path: Path) -> dict[str, Camera]:
    entries = {name: entry for name, entry in content.items() if not name.startswith("_") and isinstance(entry, dict)}
    given = {name: entry["intrinsics"] for name, entry in entries.items() if "intrinsics" in entry}
    return {name: _camera(name, value, f"{path}: camera {name}: intrinsics") for name, value in given.items()}


def _camera(name: str, given: object, where: str) -> Camera:
    if not isinstance(given, dict):
        raise InputError(f"{where} must be an object; mend or remove them.")
    width = whole(given.get("image_width"), f"{where}: image_width")
    height = whole(given.get("image_height"), f"{where}: image_height")
    K = numbers(given.get("camera_matrix"), f"{where}: camera_matrix", 9).reshape(3, 3)
    distortion = numbers(given.get("distortion_coefficients"), f"{where}: distortion_coefficients")
    with placed(where):
        return Camera(
            name=name,
            width=width,
            height=height,
            K=K,
            distortion_model=cast(DistortionModel, given.get("distortion_model")),
            distortion=distortion,
        )


def recognises(path: Path, head: bytes) -> bool:
    """A JSON object with poses of sixteen numbers, or one that says that it is such a file."""
    if not head.lstrip().startswith(b"{") or b'"FusionConfiguration"' in head:
        return False
    return native.FORMAT.encode() in head or _POSE.search(head) is not None


FORMAT = Format(
    name="native",
    suffix=".json",
    explain=(
        "rigcal's own JSON: pose = T_world_cam, 16 numbers row by row, camera to world, metres, OpenCV camera axes (x "
        "right, y down, z forward); _meta.world.up says which way is up; intrinsics stand beside the pose; figures of "
        "quality and covariances are not carried over."
    ),
    put=write,
    read=read,
    recognises=recognises,
    read_cameras=read_cameras,
)
