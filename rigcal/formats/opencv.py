"""OpenCV's FileStorage: cameras of a rig as YAML, and the intrinsics that its own samples write.

Owns      the layout, which cv2.FileStorage reads, and reading it without OpenCV's parser, which trusts what it reads.
Leaves    YAML to reading.

A rig is a sequence ``cameras`` of maps with ``name``, ``image_width``, ``image_height``, ``camera_matrix``,
``distortion_model``, ``distortion_coefficients``, ``rvec`` and ``tvec`` (world to camera, as cv2.projectPoints takes
them) and ``T_world_cam`` (4 x 4, the inverse).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from loguru import logger

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.model import Camera
from aruco.pose_math import Array, Pose, invert_transform, matrix_to_rvec_tvec, rvec_tvec_to_matrix
from rigcal.formats.reading import (
    MAX_YAML_BYTES,
    numbers,
    parsed_xml,
    placed,
    read_text,
    warn_of_cut,
    whole,
    word,
    yaml_mapping,
)
from rigcal.formats.rig import (
    UP_WORDS,
    ExportOptions,
    Format,
    Rig,
    pinhole_of,
)
from rigcal.formats.rotations import rigid_pose, steady

WHAT = "a YAML or XML file of OpenCV's FileStorage"
# How far rvec and tvec may be from T_world_cam [rad, m]: somebody changed only one of the two.
AGREED = 1e-6
# cv2 writes and reads no line longer than 4096 bytes; the name's key and indent are on it too.
MAX_TEXT_BYTES = 4000


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write a sequence of cameras.

    Raises:
        InputError: A camera matrix has skew, which OpenCV's functions ignore.
        OutputError: The file cannot be written.
    """
    import cv2

    mode = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    storage = cv2.FileStorage("rig.yaml", mode)
    storage.write("format", "rigcal.opencv")
    storage.write("units", "m")
    if rig.up:
        storage.write("world_up", rig.up)
    storage.startWriteStruct("cameras", cv2.FileNode_SEQ)
    for name, T_world_cam in rig.T_world_cam.items():
        storage.startWriteStruct("", cv2.FileNode_MAP)
        storage.write("name", _quoted(name, out))
        if name in rig.cameras:
            _write_lens(storage, rig.cameras[name])
        rvec, tvec = matrix_to_rvec_tvec(invert_transform(T_world_cam))
        for key, value in (("rvec", rvec[:, None]), ("tvec", tvec[:, None]), ("T_world_cam", T_world_cam)):
            storage.write(key, steady(value))
        storage.endWriteStruct()
    storage.endWriteStruct()
    write_whole(out, storage.releaseAndGetString().encode())


def _quoted(name: str, out: Path) -> str:
    """A name in quotes, which cv2 then leaves as they are.

    Its own it forgets around true, which OpenCV 5 takes for a number, and around apostrophes and outer blanks.
    """
    quoted = '"' + name.replace('"', '\\"') + '"'
    if len(quoted.encode()) > MAX_TEXT_BYTES:
        raise InputError(f"{out}: opencv cannot hold the name {name[:80]!r}..., which is too long; rename the camera.")
    return quoted


def _write_lens(storage: Any, camera: Camera) -> None:
    pinhole_of(camera, "opencv")
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", steady(camera.K))
    storage.write("distortion_model", camera.distortion_model)
    storage.write("distortion_coefficients", steady(camera.distortion[None, :]))


def read(path: Path) -> Rig:
    """The cameras of a rig.

    Raises:
        InputError: The file cannot be read, holds intrinsics only, or a camera is not what it should be.
    """
    content = _parsed(path)
    if "cameras" not in content:
        raise InputError(f"{path}: holds the intrinsics of a camera and no pose; give them beside a video instead.")
    entries = _entries(content, path)
    return Rig(
        T_world_cam={name: _pose(entry, f"{path}: camera {name}") for name, entry in entries.items()},
        up=UP_WORDS.get(word(content.get("world_up"))),
        cameras=_cameras(entries, path),
    )


def read_cameras(path: Path) -> Mapping[str, Camera]:
    """Intrinsics of a rig's cameras, or of the one camera of a calibration as OpenCV's samples write it."""
    content = _parsed(path)
    if "cameras" in content:
        return _cameras(_entries(content, path), path)
    # Versions differ in capitals: Camera_Matrix, image_Width.
    lens = {key.lower(): value for key, value in content.items()}
    name = word(lens.get("camera_name")) or path.stem
    return {name: _camera(name, lens, str(path))}


def _parsed(path: Path) -> dict[str, Any]:
    text = read_text(path, WHAT, MAX_YAML_BYTES)
    if text.lstrip().startswith("<"):
        return _of_xml(text, path)
    content = yaml_mapping(text, path, WHAT)
    if not text.lstrip().startswith("{"):  # JSON that is cut cannot be read
        warn_of_cut(text, path)
    return content


def _of_xml(text: str, path: Path) -> dict[str, Any]:
    """The same maps as YAML gives; only the maps of maps that a single calibration has."""
    root = parsed_xml(text, path, WHAT)
    return {
        node.tag: {part.tag: (part.text or "").split() if part.tag == "data" else (part.text or "") for part in node}
        if len(node)
        else (node.text or "").strip().strip('"')
        for node in root
    }


def _entries(content: Mapping[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    given = content["cameras"]
    if not isinstance(given, list) or not given or not all(isinstance(entry, dict) for entry in given):
        raise InputError(f"{path}: cameras must be a sequence of maps, each with a name and a T_world_cam.")
    names = [word(entry.get("name")) for entry in given]
    if "" in names or len(set(names)) < len(names):
        raise InputError(f"{path}: every camera needs a name of its own; mend the file.")
    return dict(zip(names, given))


def _pose(entry: Mapping[str, Any], where: str) -> Pose:
    T_world_cam = rigid_pose(_matrix(entry.get("T_world_cam"), f"{where}: T_world_cam", (4, 4)), where)
    if "rvec" in entry and "tvec" in entry:
        vectors = [_matrix(entry[key], f"{where}: {key}", (3, 1)) for key in ("rvec", "tvec")]
        # Identity, up to rounding: rotations of half a turn have two vectors.
        if not np.allclose(rvec_tvec_to_matrix(*vectors) @ T_world_cam, np.eye(4), atol=AGREED):
            raise InputError(
                f"{where}: rvec and tvec are not the inverse of T_world_cam; change both or leave one out."
            )
    return T_world_cam


def _cameras(entries: Mapping[str, Mapping[str, Any]], path: Path) -> dict[str, Camera]:
    return {n: _camera(n, entry, f"{path}: camera {n}") for n, entry in entries.items() if "camera_matrix" in entry}


def _camera(name: str, lens: Mapping[str, Any], where: str) -> Camera:
    K = _matrix(lens.get("camera_matrix"), f"{where}: camera_matrix", (3, 3))
    given = lens.get("distortion_coefficients")
    distortion = np.zeros(5) if given is None else _matrix(given, f"{where}: distortion_coefficients", None).ravel()
    width, height = (whole(lens.get(key), f"{where}: {key}") for key in ("image_width", "image_height"))
    with placed(where):
        return Camera(
            name=name,
            width=width,
            height=height,
            K=K,
            distortion_model=_model(lens, len(distortion), where),
            distortion=distortion,
        )


def _model(lens: Mapping[str, Any], count: int, where: str) -> Any:
    """What the file says, in our word or as OpenCV's samples do, else what so many coefficients mean to OpenCV."""
    if "distortion_model" in lens:
        return word(lens["distortion_model"])
    if word(lens.get("fisheye_model")) in ("1", "true"):
        return "equidistant"
    if count == 4 and "fisheye_model" not in lens:
        logger.warning(
            "{}: does not say what its four distortion coefficients are, and they are read as k1, k2, p1, p2 of an "
            "ordinary lens; if they are of cv2.fisheye, add the line fisheye_model: 1",
            where,
        )
    return "rational_polynomial" if count > 5 else "plumb_bob"


def _matrix(node: object, where: str, shape: tuple[int, int] | None) -> Array:
    """A matrix of OpenCV, of the shape wanted; None: any."""
    if not isinstance(node, dict):
        raise InputError(f"{where} must be a matrix with rows, cols and data; give {WHAT}.")
    rows, cols = whole(node.get("rows"), f"{where}: rows"), whole(node.get("cols"), f"{where}: cols")
    data = numbers(node.get("data"), where)
    if shape not in (None, (rows, cols)) or len(data) != rows * cols:
        want = f"{shape[0]} x {shape[1]}" if shape else f"{rows} x {cols}"
        raise InputError(f"{where} must be {want} numbers, got {rows} rows, {cols} cols and {len(data)} numbers.")
    return data.reshape(rows, cols)


def recognises(path: Path, head: bytes) -> bool:
    """FileStorage with a camera matrix; Kalibr and ROS have no OpenCV matrices."""
    return (b"opencv-matrix" in head and b"camera_matrix" in head.lower()) or b"rigcal.opencv" in head


FORMAT = Format(
    name="opencv",
    suffix=".yaml",
    explain=(
        "OpenCV FileStorage YAML: a sequence cameras, each with rvec and tvec = world to camera, as cv2.projectPoints "
        "and cv2.solvePnP have them (radians, metres), T_world_cam = the inverse (camera to world), and, where known, "
        "camera_matrix, distortion_coefficients and image size; camera axes x right, y down, z forward, the "
        "calibration's own world; equidistant lenses want cv2.fisheye."
    ),
    put=write,
    read=read,
    recognises=recognises,
    read_cameras=read_cameras,
)
