"""COLMAP's text model and rig configuration: a folder of cameras.txt, images.txt, points3D.txt and rig_config.json.

Owns      the lines of these files; the rig in the frame of its first camera.
Leaves    camera models to colmap_lens.

images.txt maps the world into the camera, scalar first. rig_config.json (COLMAP 3.12 and newer, ``rig_configurator``)
finds a camera's images by their folder, so images are called ``<camera>/...``.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from loguru import logger

from aruco.errors import InputError
from aruco.model import Camera
from aruco.pose_math import Pose, invert_transform, make_pose, pose_distance
from rigcal.formats import native
from rigcal.formats.colmap_lens import camera_of_model, colmap_model
from rigcal.formats.image_names import image_name
from rigcal.formats.reading import number, read_text, warn_of_cut, whole
from rigcal.formats.rig import CAMERA_WORD, ExportOptions, Format, Rig, check_name, filled, listed
from rigcal.formats.rotations import rotation_of_xyzw, words, xyzw_of_rotation
from rigcal.formats.whole_folder import write_folder

CAMERAS, IMAGES, POINTS, RIG = "cameras.txt", "images.txt", "points3D.txt", "rig_config.json"
DEFAULT_PATTERN = "{camera}/image.png"
NAME = "colmap"
WHAT = "a folder with COLMAP's text model"
# Images of one camera at rest: the same pose but for rounding.
SAME_M, SAME_RAD = 1e-6, 1e-6


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write the model; see Format.write, which has checked the rig."""
    pattern = options.image_name or DEFAULT_PATTERN
    prefix = _prefix(pattern)
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for n, (name, T_world_cam) in enumerate(rig.T_world_cam.items(), start=1):
        image = image_name(pattern, name, NAME)
        if any(sign.isspace() for sign in image):
            raise InputError(f"camera {name!r}: image {image!r} has a blank, at which COLMAP ends a name; rename it.")
        camera, T_cam_world = rig.cameras[name], invert_transform(T_world_cam)
        model, parameters = colmap_model(camera)
        cameras.append(f"{n} {model} {camera.width} {camera.height} {' '.join(words(parameters))}")
        images += [f"{n} {' '.join(words([*_wxyz(T_cam_world), *T_cam_world[:3, 3]]))} {n} {image}", ""]
    rigs = [{"cameras": list(_rig_cameras(rig, prefix))}]
    files = {
        CAMERAS: "\n".join(cameras) + "\n",
        IMAGES: "\n".join(images) + "\n",
        POINTS: "# no points: cameras only\n",
        RIG: json.dumps(rigs, indent=2, allow_nan=False) + "\n",
    }
    write_folder(out, files, mark=POINTS)  # a reconstruction has points


def _prefix(pattern: str) -> str:
    """What a camera's images share, and nobody else's: their folder.

    Raises:
        InputError: The pattern gives a camera's images no folder, or one that the cameras do not share the rest of.
    """
    at = pattern.find(f"{CAMERA_WORD}/")
    prefix = pattern[: at + len(CAMERA_WORD) + 1]
    if at < 0 or pattern[:at].rpartition("/")[2] or CAMERA_WORD in pattern[len(prefix) :]:
        raise InputError(
            f"--image-name {pattern!r}: COLMAP finds a camera's images by their folder and the images of one moment by "
            f"the rest of their names; give one like {DEFAULT_PATTERN}."
        )
    return prefix


def _rig_cameras(rig: Rig, prefix: str) -> Iterator[dict[str, Any]]:
    """The cameras in the frame of the first one."""
    (reference, T_world_ref), *_ = rig.T_world_cam.items()
    for name, T_world_cam in rig.T_world_cam.items():
        entry: dict[str, Any] = {"image_prefix": filled(prefix, name)}
        if name == reference:
            entry["ref_sensor"] = True
        else:
            T_cam_ref = invert_transform(T_world_cam) @ T_world_ref
            entry["cam_from_rig_rotation"] = _wxyz(T_cam_ref)
            entry["cam_from_rig_translation"] = [float(x) for x in T_cam_ref[:3, 3]]
        model, parameters = colmap_model(rig.cameras[name])
        yield {**entry, "camera_model_name": model, "camera_params": [float(x) for x in parameters]}


def _wxyz(T: Pose) -> list[float]:
    return [float(x) + 0.0 for x in np.roll(xyzw_of_rotation(T[:3, :3]), 1)]


def read(path: Path) -> Rig:
    """Read a model whose cameras are at rest; see Format.read."""
    if not (path / CAMERAS).is_file() and (path / "cameras.bin").is_file():
        raise InputError(
            f"{path}: COLMAP's binary model; write it as text first: colmap model_converter --input_path {path} "
            "--output_path FOLDER --output_type TXT."
        )
    lenses = dict(_lens_lines(path / CAMERAS))
    prefixes = _prefixes(path / RIG)
    poses: dict[str, Pose] = {}
    cameras: dict[str, Camera] = {}
    first: dict[str, str] = {}
    used: set[int] = set()
    for where, image, camera_id, T_cam_world in _image_lines(path / IMAGES):
        name, T_world_cam = _camera_name(image, prefixes, where), invert_transform(T_cam_world)
        if name in poses and not _same(poses[name], T_world_cam):
            raise InputError(
                f"{where}: {first[name][:80]!r} and {image[:80]!r} stand in different places and are both taken for "
                f"camera {name}, by the last folder of their names; give every camera a folder of its own, and one "
                "moment only."
            )
        if camera_id not in lenses:
            raise InputError(f"{where}: camera {camera_id} is not in {CAMERAS}.")
        line, width, height, model, parameters = lenses[camera_id]
        poses[name] = T_world_cam
        used.add(camera_id)
        first.setdefault(name, image)
        cameras[name] = camera_of_model(name, model, width, height, parameters, line)
    if not poses:
        raise InputError(f"{path / IMAGES}: holds no image; give {WHAT}.")
    known = {_last(prefix) for prefix in prefixes}
    _say_missing(path, known - poses.keys(), lenses.keys() - used)
    if known and (others := listed(poses.keys() - known)):
        logger.warning(
            "{}: camera {}, called after the folder of its images, is not in {}; if {} was cut short, copy it again",
            path / IMAGES,
            others,
            RIG,
            IMAGES,
        )
    return Rig(T_world_cam=poses, cameras=cameras)


def _say_missing(path: Path, names: Iterable[str], ids: Iterable[int]) -> None:
    """Say which cameras of the other files have no image, by name where the rig configuration knows it."""
    if missing := listed(names):
        where = RIG
    elif missing := listed(f"with id {camera_id}" for camera_id in ids):
        where = CAMERAS
    else:
        return
    logger.warning(
        "{}: has no image of camera {}, which is in {} and left out; if the file was cut short, copy it again",
        path / IMAGES,
        missing,
        where,
    )


def _same(T_a: Pose, T_b: Pose) -> bool:
    angle, distance = pose_distance(T_a, T_b)
    return angle < SAME_RAD and distance < SAME_M


_Lens = tuple[str, int, int, str, list[float]]


def _lens_lines(path: Path) -> Iterator[tuple[int, _Lens]]:
    """Camera id -> where it stands, width, height, model, parameters."""
    for n, line in enumerate(_lines(path), start=1):
        words, where = line.split(), f"{path}, line {n}"
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5:
            raise InputError(f"{where}: wants CAMERA_ID MODEL WIDTH HEIGHT PARAMS, got {len(words)} words.")
        width, height = whole(words[2], f"{where}: width"), whole(words[3], f"{where}: height")
        yield whole(words[0], f"{where}: id"), (where, width, height, words[1], [number(w, where) for w in words[4:]])


def _image_lines(path: Path) -> Iterator[tuple[str, str, int, Pose]]:
    """Where it stands, image name, camera id, T_cam_world; an image's second line lists points and is passed over."""
    lines = iter(enumerate(_lines(path), start=1))
    for n, line in lines:
        words, where = line.split(maxsplit=9), f"{path}, line {n}"
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 10:
            raise InputError(f"{where}: wants IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, got {len(words)} words.")
        q, t = (np.array([number(w, where) for w in words[a:b]]) for a, b in ((1, 5), (5, 8)))
        yield (
            where,
            words[9].strip(),
            whole(words[8], f"{where}: camera id"),
            make_pose(rotation_of_xyzw(np.roll(q, -1), where), t),
        )
        next(lines, None)


def _lines(path: Path) -> list[str]:
    text = read_text(path, WHAT)
    warn_of_cut(text, path)
    return text.splitlines()


def _prefixes(path: Path) -> list[str]:
    """The folders that the rig configuration knows cameras by, longest first; none where there is no such file."""
    if not path.is_file():
        return []
    try:
        content = json.loads(read_text(path, "COLMAP's rig configuration", native.MAX_FILE_BYTES))
        found = [str(camera["image_prefix"]) for rig in content for camera in rig["cameras"]]
    except (ValueError, RecursionError, KeyError, TypeError) as error:
        raise InputError(f"{path}: not COLMAP's rig configuration ({error!r}); mend or remove it.") from error
    return sorted((prefix for prefix in found if prefix.strip("/")), key=len, reverse=True)


def _camera_name(image: str, prefixes: list[str], where: str) -> str:
    """The camera that took an image: by its folder, also where the rig configuration has none such.

    Raises:
        InputError: It lies in no folder, where a rig configuration says that cameras have some.
    """
    folder = next((prefix for prefix in prefixes if image.startswith(prefix)), image.rpartition("/")[0])
    if prefixes and not _last(folder):
        raise InputError(
            f"{where}: image {image[:80]!r} is of no camera in {RIG}, which has {listed(map(_last, prefixes))}; copy "
            f"the folder again if {IMAGES} was cut short, else mend or remove {RIG}."
        )
    name = _last(folder) or Path(image).stem
    check_name(name, where)
    return name


def _last(folder: str) -> str:
    return folder.strip("/").rpartition("/")[2]


def recognises(path: Path, head: bytes) -> bool:
    """Whether a folder is COLMAP's; see Format.recognises."""
    if head:
        return False
    return any((path / f"cameras{end}").is_file() and (path / f"images{end}").is_file() for end in (".txt", ".bin"))


FORMAT = Format(
    name=NAME,
    suffix="",
    explain=(
        "Folder with COLMAP's text model: images.txt maps the world into OpenCV cameras (w x y z quaternion, metres), "
        "principal points count from the pixel's corner (ours + 0.5); the calibration's world is kept; rig_config.json "
        "holds the rig in the frame of its first camera, whose images are found by their folder."
    ),
    put=write,
    read=read,
    recognises=recognises,
    needs_cameras=True,
    takes=frozenset({"image_name"}),
)
