"""USD: a text file (usda) with one UsdGeom.Camera a camera, written by hand.

Owns      the stage, names of prims, the cameras' places and what their lenses leave out.
Leaves    focal lengths and apertures to usd_film, the syntax to usd_text.

USD's cameras are OpenGL's (x right, y up, looking along -z), its matrices act on rows: the transpose of ours. USD has
no lens distortion and no image size: both, and the camera matrix in double precision, stand in each camera's
customData, from where they are read back as long as they agree with the lens that USD shows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from loguru import logger

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.model import Camera, DistortionModel, UpAxis
from aruco.pose_math import Array, Pose
from rigcal.formats.reading import number, numbers, placed, read_text, whole
from rigcal.formats.rig import (
    HALF_TURN_X,
    ExportOptions,
    Format,
    Rig,
    check_name,
    listed,
    pinhole_of,
    y_up,
    y_up_of_z_up,
)
from rigcal.formats.rotations import rigid_pose, words
from rigcal.formats.usd_film import Film, film_of
from rigcal.formats.usd_text import Prim, UsdTextError, parsed, quoted

NAME = "usd"
WHAT = "a USD text file"
MAGIC, BINARY_MAGIC, ZIP_MAGIC = b"#usda", b"PXR-USDC", b"PK\x03\x04"
# A camera takes about one KiB; a scene's meshes would take minutes to read.
MAX_TEXT_BYTES = 8 * 2**20
_PREFIX = "camera_"
# What USD takes a stage's unit for when it does not say: centimetres.
_FALLBACK_UNIT_M = 0.01
# A scale nearer to one than this is the rounding of a rotation.
_ROUNDED_SCALE = 1e-3
# Single precision, over an image: what differs more was edited since.
_SAME_PX = 1e-3


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write the stage; see Format.write."""
    if out.suffix not in (".usda", ".usd"):
        raise InputError(f"{out}: is written as text, which USD knows by its name; name it like rig.usda.")
    if rig.up is None:
        poses = rig.T_world_cam
        logger.warning(
            "the calibration does not say which way is up, so {} does not either, and programs will take its y axis "
            "for up; a calibration made with --auto-align says it",
            out,
        )
    else:
        poses = y_up(rig, NAME)
    if bent := listed(name for name, camera in rig.cameras.items() if camera.has_distortion):
        logger.warning(
            "USD cameras have no lens distortion: programs will draw camera {} as a pinhole; its coefficients stand in "
            "customData only",
            bent,
        )
    lines = ["#usda 1.0", "(", "    customLayerData = {", '        string creator = "rigcal"', "    }"]
    lines += ['    defaultPrim = "Rig"', "    metersPerUnit = 1", *(['    upAxis = "Y"'] if rig.up else []), ")", ""]
    lines += ['def Xform "Rig"', "{"]
    for name, T in poses.items():
        lines += [f"    {line}".rstrip() for line in _camera_lines(rig.cameras[name], T @ HALF_TURN_X)]
    write_whole(out, "\n".join([*lines, "}", ""]).encode())


def prim_name(camera: str) -> str:
    """A prim's name for a camera's: letters and digits stay, ``_`` is doubled, others become ``_u<hex>_``."""
    return _PREFIX + re.sub("[^A-Za-z0-9]", lambda found: "__" if found[0] == "_" else f"_u{ord(found[0]):x}_", camera)


def camera_name(prim: str) -> str:
    """The inverse of prim_name; of names that it does not make, the same name."""
    if not re.fullmatch(f"{_PREFIX}(?:[A-Za-z0-9]|__|_u[0-9a-f]{{1,5}}_)+", prim):
        return prim
    pattern = "__|_u([0-9a-f]{1,5})_"
    return re.sub(pattern, lambda found: chr(int(found[1], 16)) if found[1] else "_", prim.removeprefix(_PREFIX))


def _camera_lines(camera: Camera, T_world_gl: Pose) -> Iterator[str]:
    film = film_of(pinhole_of(camera, NAME), camera.width, camera.height)
    rows = ", ".join(f"({', '.join(words(column))})" for column in T_world_gl.T)
    yield f"def Camera {quoted(prim_name(camera.name))} ("
    yield "    customData = {"
    yield "        dictionary rigcal = {"
    yield f"            double[] camera_matrix = [{', '.join(words(camera.K.ravel()))}]"
    yield f"            double[] distortion_coefficients = [{', '.join(words(camera.distortion))}]"
    yield f"            string distortion_model = {quoted(camera.distortion_model)}"
    yield f"            int image_height = {camera.height}"
    yield f"            int image_width = {camera.width}"
    yield f"            string name = {quoted(camera.name)}"
    yield "        }"
    yield "    }"
    yield ")"
    yield "{"
    yield "    float2 clippingRange = (0.01, 1000)"
    yield f"    float focalLength = {film.focal_length!r}"
    yield f"    float horizontalAperture = {film.aperture_x!r}"
    yield f"    float horizontalApertureOffset = {film.offset_x!r}"
    yield '    token projection = "perspective"'
    yield f"    float verticalAperture = {film.aperture_y!r}"
    yield f"    float verticalApertureOffset = {film.offset_y!r}"
    yield f"    matrix4d xformOp:transform = ( {rows} )"
    yield '    uniform token[] xformOpOrder = ["xformOp:transform"]'
    yield "}"
    yield ""


def read(path: Path) -> Rig:
    """Read the cameras of a stage in one text file; see Format.read."""
    root = _layer(path)
    unit_m = number(root.metadata.get("metersPerUnit", _FALLBACK_UNIT_M), f"{path}: metersPerUnit")
    if unit_m <= 0:
        raise InputError(f"{path}: metersPerUnit must be positive, got {unit_m:g}.")
    axis = root.metadata.get("upAxis")
    if axis not in (None, "Y", "Z"):
        raise InputError(f"{path}: upAxis must be Y or Z, got {str(axis)[:20]!r}.")
    poses: dict[str, Pose] = {}
    cameras: dict[str, Camera] = {}
    for prim, T_stage_gl in _cameras(root, np.eye(4), str(path)):
        where = f"{path}: camera {prim.name}"
        ours = _ours(prim)
        name = ours.get("name") if isinstance(ours.get("name"), str) else camera_name(prim.name)
        check_name(str(name), where)
        if name in poses:
            raise InputError(f"{where}: there are two cameras {name}; rename one.")
        T = rigid_pose(_unscaled(T_stage_gl), where) @ HALF_TURN_X
        T[:3, 3] *= unit_m
        poses[str(name)] = y_up_of_z_up(T) if axis == "Z" else T
        camera = _lens(prim, str(name), ours, where)
        cameras.update({} if camera is None else {str(name): camera})
    if not poses:
        raise InputError(f"{path}: holds no camera; give {WHAT} that has some.")
    up: UpAxis | None = None if axis is None else "+y"
    return Rig(T_world_cam=poses, up=up, cameras=cameras)


def _layer(path: Path) -> Prim:
    with_binary = path.suffix.lower() in (".usdc", ".usdz")
    try:
        with path.open("rb") as stream:
            with_binary |= stream.read(8).startswith((BINARY_MAGIC, ZIP_MAGIC))
    except OSError:
        pass  # read_text says why
    if with_binary:
        raise InputError(f"{path}: binary USD; write it as text first: usdcat --flatten {path} -o FILE.usda.")
    text = read_text(path, WHAT, MAX_TEXT_BYTES)
    if not text.startswith(MAGIC.decode()):
        raise InputError(f"{path}: does not begin with #usda; give {WHAT}.")
    try:
        return parsed(text)
    except UsdTextError as error:
        raise InputError(f"{path}: {error}; write it anew: usdcat --flatten {path} -o FILE.usda.") from error


def _cameras(prim: Prim, T_stage_parent: Pose, where: str) -> Iterator[tuple[Prim, Array]]:
    """Every camera below a prim, with the (4, 4) matrix from its axes to the stage's."""
    for child in prim.children:
        if child.kind == "class" or str(child.metadata.get("active")) in ("false", "0.0"):  # with all below it
            continue
        inside = f"{where}: {child.name}"
        T_parent_child = _local(child, inside)
        T = T_parent_child if T_parent_child is None else T_stage_parent @ T_parent_child
        if child.kind == "Camera":
            if T is None:
                raise _not_baked(inside)
            yield child, T
        for camera in _cameras(child, np.eye(4) if T is None else T, inside):
            if T is None:
                raise _not_baked(inside)
            yield camera


def _not_baked(where: str) -> InputError:
    return InputError(
        f"{where}: is placed by something else than one xformOp:transform without time samples; bake it to a matrix "
        "at one moment first."
    )


def _local(prim: Prim, where: str) -> Array | None:
    """The (4, 4) matrix into the parent's axes; None where it is not given as one matrix."""
    order = prim.attributes.get("xformOpOrder", [])
    if not order:
        return np.eye(4)
    value = None if _driven(prim, "xformOp:transform") else prim.attributes.get("xformOp:transform")
    if order != ["xformOp:transform"] or not isinstance(value, tuple) or len(value) != 4:
        return None
    return np.array([numbers(row, f"{where}: xformOp:transform", 4) for row in value]).T


def _driven(prim: Prim, key: str) -> str:
    """What else than its default value says what an attribute is: time samples, a connection; empty: nothing."""
    return next((name for name in prim.attributes if name.startswith(f"{key}.")), "")


def _unscaled(T: Array) -> Array:
    """A matrix without the uniform scale of a scene, which moves a camera and leaves its picture as it is."""
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    if not np.isfinite(scale) or scale <= 0 or abs(scale - 1) < _ROUNDED_SCALE:
        return T
    return np.hstack([T[:, :3] / scale, T[:, 3:]])


def _ours(prim: Prim) -> Mapping[str, Any]:
    data = prim.metadata.get("customData")
    ours = data.get("rigcal") if isinstance(data, dict) else None
    return ours if isinstance(ours, dict) else {}


def _lens(prim: Prim, name: str, ours: Mapping[str, Any], where: str) -> Camera | None:
    """The lens in double precision where customData still agrees with what USD shows; None without an image size."""
    if "image_width" not in ours or "image_height" not in ours:
        return None
    width, height = whole(ours["image_width"], f"{where}: image_width"), whole(ours["image_height"], f"{where}: height")
    fx, fy, cx, cy = _film(prim, where).pinhole(width, height)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if "camera_matrix" in ours:
        exact = numbers(ours["camera_matrix"], f"{where}: camera_matrix", 9).reshape(3, 3)
        if np.abs(exact - K).max() < _SAME_PX:
            K = exact
        else:
            logger.warning("{}: its lens was changed since it was written; what USD shows is taken", where)
    model: DistortionModel = ours.get("distortion_model", "plumb_bob")
    distortion = numbers(ours.get("distortion_coefficients", []), f"{where}: distortion_coefficients")
    with placed(where):
        return Camera(name=name, width=width, height=height, K=K, distortion_model=model, distortion=distortion)


def _film(prim: Prim, where: str) -> Film:
    """The lens that USD shows; what is not written has USD's fallback."""

    def told(key: str, fallback: float) -> float:
        if driven := _driven(prim, key):
            raise InputError(f"{where}: its lens is given by {driven}; bake it to one number at one moment first.")
        return number(prim.attributes.get(key, fallback), f"{where}: {key}")

    film = Film(
        focal_length=told("focalLength", 50.0),
        aperture_x=told("horizontalAperture", 20.955),
        aperture_y=told("verticalAperture", 15.2908),
        offset_x=told("horizontalApertureOffset", 0.0),
        offset_y=told("verticalApertureOffset", 0.0),
    )
    if min(film.focal_length, film.aperture_x, film.aperture_y) <= 0:
        raise InputError(f"{where}: focal length and apertures must be positive.")
    return film


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file is USD, text or binary; see Format.recognises."""
    zipped = head.startswith(ZIP_MAGIC) and path.suffix.lower() == ".usdz"
    return head.startswith((MAGIC, BINARY_MAGIC)) or zipped


FORMAT = Format(
    name=NAME,
    suffix=".usda",
    explain=(
        "USD text, one UsdGeom.Camera a camera: camera to world (matrices act on rows), OpenGL cameras (x right, y up, "
        "looking along -z), metres, the world's +Y up where the calibration knows up; focal length and apertures in "
        "tenths of a metre, apertures' offsets for the principal point; lens distortion only as customData."
    ),
    put=write,
    read=read,
    recognises=recognises,
    needs_cameras=True,
)
