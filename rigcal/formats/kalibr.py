"""Kalibr's camchain.yaml: every camera relative to the one before it.

Owns      the keys, the chain of transforms, names of cameras in topics, which lenses Kalibr knows.
Leaves    reading YAML safely to reading.

``cam{n}.T_cn_cnm1`` maps points of camera n - 1 into camera n; the world is that of the first camera. Kalibr calls
cameras cam0, cam1, ...: ours stand in ``rostopic`` as ``/<name>/image_raw``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from loguru import logger

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.model import Camera, DistortionModel
from aruco.pose_math import Pose, invert_transform
from rigcal.formats.reading import matrix, numbers, placed, read_yaml, size, word
from rigcal.formats.rig import (
    ExportOptions,
    Format,
    Rig,
    listed,
    numbered_name,
    pinhole_of,
    refuse_distortion,
)
from rigcal.formats.rotations import rigid_pose, steady

WHAT = "a camchain.yaml of Kalibr"
_CAMERA_KEY = re.compile("cam([0-9]{1,4})")
_TOPIC = re.compile(r"/([^/_][^/]*)/image_raw")
_RECOGNISED = re.compile(rb"^cam[0-9]+\s*:", re.MULTILINE)
_MODELS: Mapping[str, tuple[DistortionModel, int]] = {
    "radtan": ("plumb_bob", 4),
    "equi": ("equidistant", 4),
    "none": ("plumb_bob", 0),
}


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write the cameras in the order of their names.

    Raises:
        InputError: Kalibr has no such lens.
        OutputError: The file cannot be written.
    """
    chain: dict[str, Any] = {}
    before: Pose | None = None
    for index, (name, T_world_cam) in enumerate(rig.T_world_cam.items()):
        T_cam_world = invert_transform(T_world_cam)
        relative = {} if before is None else {"T_cn_cnm1": steady(T_cam_world @ before).tolist()}
        chain[numbered_name(index)] = {**relative, **_intrinsics(rig.cameras[name])}
        before = T_world_cam
    text = yaml.safe_dump(chain, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)
    write_whole(out, text.encode())


def _intrinsics(camera: Camera) -> dict[str, Any]:
    model, coefficients = _distortion(camera)
    return {
        "camera_model": "pinhole",
        "intrinsics": list(pinhole_of(camera, "kalibr")),
        "distortion_model": model,
        "distortion_coeffs": coefficients,
        "resolution": [camera.width, camera.height],
        "rostopic": f"/{camera.name}/image_raw",
    }


def _distortion(camera: Camera) -> tuple[str, list[float]]:
    coefficients = [float(value) for value in camera.distortion]
    if camera.distortion_model == "equidistant":
        return "equi", coefficients
    if any(coefficients[4:]):
        raise refuse_distortion(camera, "kalibr", "k1, k2, p1, p2 (radtan) or four of a fisheye lens (equi) only")
    return "radtan", coefficients[:4]


def read(path: Path) -> Rig:
    """The cameras of a chain, in the world of its first camera.

    Raises:
        InputError: The file cannot be read or is no chain; the message names file and key.
    """
    entries = _entries(path)
    names = _names(entries, path)
    poses: dict[str, Pose] = {}
    T_world_cam: Pose = np.eye(4)
    for index, (key, entry) in enumerate(entries.items()):
        if index:
            if "T_cn_cnm1" not in entry:
                raise InputError(
                    f"{path}: {key} has no T_cn_cnm1; give the chain that Kalibr wrote for all cameras of one run."
                )
            where = f"{path}: {key}.T_cn_cnm1"
            T_world_cam = T_world_cam @ invert_transform(rigid_pose(matrix(entry["T_cn_cnm1"], where, (4, 4)), where))
        poses[names[key]] = T_world_cam
    return Rig(T_world_cam=poses, origin="camera", cameras=_cameras(entries, names, path))


def read_cameras(path: Path) -> Mapping[str, Camera]:
    """Intrinsics only; a chain is not needed."""
    entries = _entries(path)
    return _cameras(entries, _names(entries, path), path)


def _entries(path: Path) -> dict[str, dict[str, Any]]:
    content = read_yaml(path, WHAT)
    keys = sorted((int(found[1]), key) for key in content if (found := _CAMERA_KEY.fullmatch(key)))
    if not keys or any(not isinstance(content[key], dict) for _, key in keys):
        raise InputError(f"{path}: has no cameras cam0, cam1, ... with keys of their own; give {WHAT}.")
    if [number for number, _ in keys] != list(range(len(keys))):
        raise InputError(f"{path}: cameras are not numbered cam0, cam1, ... without a gap; give {WHAT} as it was made.")
    return {key: content[key] for _, key in keys}


def _names(entries: Mapping[str, Mapping[str, Any]], path: Path) -> dict[str, str]:
    """Kalibr's name -> ours, from the topics where they have one, else Kalibr's."""
    topics = {key: _TOPIC.fullmatch(word(entry.get("rostopic"))) for key, entry in entries.items()}
    found = {key: match[1] for key, match in topics.items() if match}
    names = {key: found.get(key, key) for key in entries}
    if not found:
        return names
    if len(set(names.values())) < len(names):  # two cameras on one topic, or a topic called like another camera
        logger.warning(
            "{}: its topics do not tell its cameras apart, which are called {} as Kalibr does", path, listed(entries)
        )
        return {key: key for key in entries}
    if nameless := entries.keys() - found.keys():
        logger.warning(
            "{}: {} keeps the name that Kalibr gave, as its rostopic is none like /NAME/image_raw; if the file was cut "
            "short, copy it again",
            path,
            listed(nameless),
        )
    return names


def _cameras(entries: Mapping[str, Mapping[str, Any]], names: Mapping[str, str], path: Path) -> dict[str, Camera]:
    return {names[key]: _camera(names[key], entry, f"{path}: {key}") for key, entry in entries.items()}


def _camera(name: str, entry: Mapping[str, Any], where: str) -> Camera:
    lens, model = word(entry.get("camera_model")), word(entry.get("distortion_model"))
    if lens != "pinhole" or model not in _MODELS:
        raise InputError(
            f"{where}: camera_model {lens[:40]!r} with distortion_model {model[:40]!r} is not known here; calibrate it "
            "with pinhole-radtan or pinhole-equi."
        )
    kind, count = _MODELS[model]
    fx, fy, cx, cy = numbers(entry.get("intrinsics"), f"{where}.intrinsics", 4)
    width, height = size(entry.get("resolution"), f"{where}.resolution")
    distortion = numbers(entry.get("distortion_coeffs", []), f"{where}.distortion_coeffs", count or None)
    with placed(where):
        return Camera(
            name=name,
            width=width,
            height=height,
            K=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            distortion_model=kind,
            distortion=distortion[:count],
        )


def recognises(path: Path, head: bytes) -> bool:
    """YAML whose keys are cam0, cam1, ... with Kalibr's intrinsics."""
    return b"camera_model" in head and b"intrinsics" in head and _RECOGNISED.search(head) is not None


FORMAT = Format(
    name="kalibr",
    suffix=".yaml",
    explain=(
        "Kalibr camchain.yaml: cam{n}.T_cn_cnm1 maps points of camera n-1 into camera n, metres, optical axes (x "
        "right, y down, z forward); cameras are cam0, cam1, ... in the order of their names, which stand in rostopic "
        "/<name>/image_raw; the world is lost: read back, it is the first camera's frame, and up is unknown."
    ),
    put=write,
    read=read,
    recognises=recognises,
    read_cameras=read_cameras,
    needs_cameras=True,
)
