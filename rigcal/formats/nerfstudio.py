"""nerfstudio's ``transforms.json``: one frame a camera, with its own intrinsics.

Owns      the file's keys, its world, its lenses.
Leaves    nothing.

A frame's ``transform_matrix`` maps OpenGL's camera (x right, y up, looking along -z) into a world with Z up, and the
principal point counts from the corner of the top left pixel: ours plus half a pixel. ``camera_model`` is read from the
root of the file only, so one file holds fisheyes or other lenses, not both. ``applied_transform`` (3 x 4) says what
turned the original world into the file's; nerfstudio turns point clouds by it, so a cloud in the calibration's world
lies right. ``orientation_override`` keeps nerfstudio from turning a world upright that is.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from aruco.errors import InputError
from aruco.model import Camera, DistortionModel, UpAxis
from aruco.pose_math import Array, Pose
from rigcal.formats.image_names import image_name
from rigcal.formats.native import read_json, write_json
from rigcal.formats.reading import MAX_NUMBER, matrix, number, placed, whole, word
from rigcal.formats.rig import (
    HALF_PIXEL,
    HALF_TURN_X,
    ExportOptions,
    Format,
    Rig,
    check_name,
    pinhole_of,
    refuse_distortion,
    turned,
    y_up,
    y_up_of_z_up,
    z_up,
)
from rigcal.formats.rotations import nearest_rotation, rigid_pose, steady

NAME = "nerfstudio"
WHAT = "a transforms.json of nerfstudio"
DEFAULT_PATTERN = "{camera}.png"
# nerfstudio's names of the coefficients, in OpenCV's order.
_PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE = ("k1", "k2", "k3", "k4")
_MODELS: Mapping[str, DistortionModel] = {
    "SIMPLE_PINHOLE": "plumb_bob",
    "PINHOLE": "plumb_bob",
    "SIMPLE_RADIAL": "plumb_bob",
    "RADIAL": "plumb_bob",
    "OPENCV": "plumb_bob",
    "OPENCV_FISHEYE": "equidistant",
    "SIMPLE_RADIAL_FISHEYE": "equidistant",
    "RADIAL_FISHEYE": "equidistant",
}


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write the file; see Format.write."""
    poses = {name: z_up(T) @ HALF_TURN_X for name, T in y_up(rig, NAME).items()}
    frames = [
        {
            "file_path": image_name(options.image_name or DEFAULT_PATTERN, name, NAME),
            "camera_name": name,
            **_intrinsics(rig.cameras[name]),
            "transform_matrix": steady(T).tolist(),
        }
        for name, T in poses.items()
    ]
    head = {
        "camera_model": _camera_model(rig),
        "orientation_override": "none",
        "applied_transform": _applied(rig.up).tolist(),
        "rigcal": {"up": rig.up},
    }
    write_json(out, {**head, "frames": frames})


def _applied(up: UpAxis | None) -> Array:
    """The (3, 4) transform from the calibration's world into the file's."""
    T_y_up = np.eye(4) if up == "+y" else HALF_TURN_X
    return z_up(T_y_up)[:3] + 0.0


def _camera_model(rig: Rig) -> str:
    """The one model that all cameras have to share.

    Raises:
        InputError: Some are fisheyes and some are not.
    """
    fish = sorted(name for name, camera in rig.cameras.items() if camera.distortion_model == "equidistant")
    if fish and len(fish) < len(rig.cameras):
        raise InputError(
            f"{NAME} has one camera model a file, and camera {', '.join(fish)} has a fisheye lens, the others not; "
            "undistort the images of one kind first, or choose another format."
        )
    return "OPENCV_FISHEYE" if fish else "OPENCV"


def _intrinsics(camera: Camera) -> dict[str, Any]:
    fx, fy, cx, cy = pinhole_of(camera, NAME)
    if camera.distortion[5:].any():
        raise refuse_distortion(camera, NAME, "k1, k2, k3, p1 and p2, or a fisheye's k1 to k4")
    names = _FISHEYE if camera.distortion_model == "equidistant" else _PERSPECTIVE
    pinhole = {"fl_x": fx, "fl_y": fy, "cx": cx + HALF_PIXEL, "cy": cy + HALF_PIXEL}
    return {"w": camera.width, "h": camera.height, **pinhole, **dict(zip(names, camera.distortion.tolist()))}


def read(path: Path) -> Rig:
    """Read the file; every frame is a camera. See Format.read."""
    content = read_json(path, WHAT)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{path}: lists no frames; give {WHAT}.")
    up, R_world_file, scale = _world(content, path)
    poses: dict[str, Pose] = {}
    cameras: dict[str, Camera] = {}
    for n, frame in enumerate(frames):
        where = f"{path}: frame {n}"
        name = _camera_name(frame, where)
        if name in poses:
            raise InputError(
                f"{where}: camera {name} is there twice; only a rig at rest can be read, one image a camera."
            )
        T_file_gl = rigid_pose(_padded(frame.get("transform_matrix"), f"{where}: transform_matrix"), where)
        T_file_gl[:3, 3] = _unscaled(T_file_gl[:3, 3], scale, where)
        poses[name] = R_world_file @ T_file_gl @ HALF_TURN_X
        camera = _camera(name, {**frame, **content}, where)
        cameras.update({} if camera is None else {name: camera})
    return Rig(T_world_cam=poses, up=up, cameras=cameras)


def _world(content: Mapping[str, Any], path: Path) -> tuple[UpAxis | None, Pose, float]:
    """Which way is up in the world that is given back, the transform into it, and how lengths were scaled.

    A file of ours gives back the calibration's world. Of others, what ``applied_transform`` did is undone and nobody
    knows what is up; where there is none, the world is nerfstudio's, with Z up.
    """
    scale = number(content.get("applied_scale", 1.0), f"{path}: applied_scale")
    if scale <= 0:
        raise InputError(f"{path}: applied_scale must be positive, got {scale:g}.")
    given = content.get("applied_transform")
    if given is None:
        return "+y", y_up_of_z_up(np.eye(4)), scale
    where = f"{path}: applied_transform"
    T_file_world = _padded(given, where)
    R = nearest_rotation(T_file_world[:3, :3], where)
    ours = content.get("rigcal")
    up = ours.get("up") if isinstance(ours, dict) else None
    T_world_file = turned(R.T, np.eye(4))
    T_world_file[:3, 3] = -R.T @ T_file_world[:3, 3]
    return up if up in ("+y", "-y") else None, T_world_file, scale


def _unscaled(t_file: Array, scale: float, where: str) -> Array:
    """A place (3,) in metres."""
    with np.errstate(over="ignore"):
        t = t_file / scale
    if not (np.abs(t) <= MAX_NUMBER).all():
        raise InputError(f"{where}: its place divided by the file's applied_scale of {scale:g} is none; mend the file.")
    return t


def _padded(value: object, where: str) -> Array:
    """A (4, 4) matrix, of which a file may leave out the last row."""
    short = isinstance(value, list) and len(value) == 3
    rows = matrix(value, where, (3, 4) if short else (4, 4))
    return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]]) if short else rows


def _camera_name(frame: Mapping[str, Any], where: str) -> str:
    """The camera's name, or its image's."""
    name, image = frame.get("camera_name"), frame.get("file_path")
    if not isinstance(name, str):
        if not isinstance(image, str):
            raise InputError(f"{where}: has no file_path; mend or remove it.")
        path = PurePosixPath(image.removeprefix("./").removeprefix("images/"))
        name = str(path.parent / path.stem).replace("/", "-")  # not every file's names have a suffix
    check_name(name, where)
    return name


def _camera(name: str, keys: Mapping[str, Any], where: str) -> Camera | None:
    """The lens of a frame, whose keys count where the file's root has none; None where no focal length is given."""
    if "fl_x" not in keys:
        return None
    kind = _kind(keys, where)

    def told(key: str, default: object = None) -> float:
        return number(keys.get(key, default), f"{where}: {key}")

    if kind == "plumb_bob" and told("k4", 0.0):
        raise InputError(f"{where}: k4 of {told('k4'):g} has no counterpart in OpenCV's model; undistort the images.")
    K = np.diag([told("fl_x"), told("fl_y", keys["fl_x"]), 1.0])
    K[:2, 2] = told("cx") - HALF_PIXEL, told("cy") - HALF_PIXEL
    distortion = np.array([told(key, 0.0) for key in (_FISHEYE if kind == "equidistant" else _PERSPECTIVE)])
    width, height = whole(keys.get("w"), f"{where}: w"), whole(keys.get("h"), f"{where}: h")
    with placed(where):
        return Camera(name=name, width=width, height=height, K=K, distortion_model=kind, distortion=distortion)


def _kind(keys: Mapping[str, Any], where: str) -> DistortionModel:
    """The model that a file names, or as instant-ngp's do: a fisheye or not."""
    fisheye = keys.get("is_fisheye", False)
    if not isinstance(fisheye, bool):
        raise InputError(f"{where}: is_fisheye must be true or false; mend the file.")
    model = word(keys.get("camera_model", "OPENCV_FISHEYE" if fisheye else "OPENCV"))
    if model not in _MODELS:
        raise InputError(f"{where}: camera_model {model!r} has no counterpart here; known: {', '.join(_MODELS)}.")
    if fisheye and _MODELS[model] != "equidistant":
        raise InputError(
            f"{where}: is_fisheye is true, and camera_model {model} is no fisheye's; remove the wrong one."
        )
    return _MODELS[model]


def recognises(path: Path, head: bytes) -> bool:
    """Whether a JSON file holds frames with matrices; see Format.recognises."""
    return head.lstrip().startswith(b"{") and b'"frames"' in head and b'"transform_matrix"' in head


FORMAT = Format(
    name=NAME,
    suffix=".json",
    explain=(
        "transforms.json: camera to world, OpenGL cameras (x right, y up, looking along -z), metres, world Z up: "
        "(x, y, z) -> (x, -z, y) of the +Y-up world, as applied_transform says; intrinsics in every frame, "
        "principal points from the pixel's corner (ours + 0.5); file_path is relative to the file."
    ),
    put=write,
    read=read,
    recognises=recognises,
    needs_up=True,
    needs_cameras=True,
    takes=frozenset({"image_name"}),
)
