"""Camera files of aniposelib and caliscope (TOML).

Owns      the keys of both, writing the little TOML that they need, what of it Anipose cannot hold.
Leaves    parsing to tomllib.

aniposelib has a table a camera with its ``name``; caliscope has ``[cameras.<id>]``, older versions ``[cam_<id>]``. In
all of them ``rotation`` (Rodrigues) and ``translation`` map the world into the camera.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from loguru import logger

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.model import Camera
from aruco.pose_math import Pose, exp_so3, invert_transform, make_pose, matrix_to_rvec_tvec
from rigcal.formats.reading import matrix, numbers, placed, read_text, size, word
from rigcal.formats.rig import (
    UP_WORDS,
    ExportOptions,
    Format,
    Rig,
    listed,
    pinhole_of,
    refuse_distortion,
)
from rigcal.formats.rotations import nearest_rotation, words

WHAT = "a camera file of aniposelib or caliscope (TOML)"
MAX_FILE_BYTES = 2**20
# A camera's keys have three parts; tomllib's time and memory grow with the square of their number.
MAX_KEY_PARTS = 16
# Texts and comments are passed over as wholes; what follows a quote without an end is no TOML anyway.
_TOKEN = re.compile(
    r"""
    (?P<text> \"{3}(?:[^\\]|\\.)*?\"{3,5} | '{3}.*?'{3,5} | "(?:[^"\\\n]|\\.)*" | '[^'\n]*' )
  | (?P<rest> ["'].* )
  | (?P<comment> \#[^\n]* )
  | (?P<dot> [ \t]*\.[ \t]* )
  | (?P<word> [A-Za-z0-9_-]+ )
  | (?P<other> [ \t]+ | . )
    """,
    re.VERBOSE | re.DOTALL,
)


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write a table a camera, in the order of their names.

    Raises:
        InputError: A lens has more than five coefficients.
        OutputError: The file cannot be written.
    """
    digits = len(str(len(rig.T_world_cam) - 1))  # aniposelib sorts tables by their names as words
    tables = [
        _table(f"cam_{index:0{digits}d}", T, rig.cameras[n]) for index, (n, T) in enumerate(rig.T_world_cam.items())
    ]
    lines = ["[metadata]", "adjusted = false", "error = 0.0", 'units = "m"']
    metadata = "\n".join([*lines, *([f'world_up = "{rig.up}"'] if rig.up else [])])
    write_whole(out, "\n\n".join([*tables, metadata, ""]).encode())


def _table(key: str, T_world_cam: Pose, camera: Camera) -> str:
    pinhole_of(camera, "aniposelib")
    fisheye = camera.distortion_model == "equidistant"
    if not fisheye and any(camera.distortion[5:]):
        raise refuse_distortion(camera, "aniposelib", "k1, k2, p1, p2, k3 or four of a fisheye lens only")
    rvec, tvec = matrix_to_rvec_tvec(invert_transform(T_world_cam))
    return "\n".join(
        [
            f"[{key}]",
            f"name = {json.dumps(camera.name, ensure_ascii=False)}",
            f"size = [{camera.width}, {camera.height}]",
            f"matrix = [{', '.join(_row(row) for row in camera.K)}]",
            f"distortions = {_row(camera.distortion[: 4 if fisheye else 5])}",
            f"rotation = {_row(rvec)}",
            f"translation = {_row(tvec)}",
            f"fisheye = {'true' if fisheye else 'false'}",
        ]
    )


def _row(values: Iterable[float]) -> str:
    return f"[{', '.join(words(values))}]"


def read(path: Path) -> Rig:
    """The cameras that have a pose.

    Raises:
        InputError: The file cannot be read, or a camera is not what it should be, or none has a pose.
    """
    content = _parsed(path)
    tables = _tables(content, path)
    placed_ones = {name: table for name, table in tables.items() if isinstance(table.get("rotation"), list)}
    if not placed_ones:
        raise InputError(f"{path}: no camera has a rotation and a translation; calibrate their extrinsics first.")
    if without := tables.keys() - placed_ones.keys():
        logger.warning("{}: camera {} has no rotation there and is left out", path, listed(without))
    metadata = content.get("metadata")
    metadata = metadata if isinstance(metadata, dict) else {}
    if metadata.get("units") != "m":
        logger.warning("{}: its lengths are taken for metres; aniposelib's are in the unit of its board", path)
    return Rig(
        T_world_cam={name: _pose(table, f"{path}: camera {name}") for name, table in placed_ones.items()},
        up=UP_WORDS.get(word(metadata.get("world_up"))),
        cameras=_cameras(placed_ones, path),
    )


def read_cameras(path: Path) -> Mapping[str, Camera]:
    """Intrinsics of all cameras, with a pose or without."""
    return _cameras(_tables(_parsed(path), path), path)


def _parsed(path: Path) -> dict[str, Any]:
    text = read_text(path, WHAT, MAX_FILE_BYTES)
    if (parts := _most_key_parts(text)) > MAX_KEY_PARTS:
        raise InputError(f"{path}: has a key of {parts} parts, parted by dots; give {WHAT}.")
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: not readable as TOML ({' '.join(str(error).split())[:200]}); give {WHAT}."
        ) from error


def _most_key_parts(text: str) -> int:
    """The largest number of words that dots join."""
    most = dots = 0
    for found in _TOKEN.finditer(text):
        if found.lastgroup == "dot":
            dots += 1
            most = max(most, dots)
        elif found.lastgroup not in ("word", "text"):
            dots = 0
    return most + 1


def _tables(content: Mapping[str, Any], path: Path) -> dict[str, dict[str, Any]]:
    """Camera's name -> table, of those that have a lens."""
    nested = content.get("cameras")
    given = {f"cam_{key}": value for key, value in nested.items()} if isinstance(nested, dict) else content
    lenses = {
        k: table for k, table in given.items() if isinstance(table, dict) and isinstance(table.get("matrix"), list)
    }
    if ignored := [word(table.get("name")) or key for key, table in lenses.items() if table.get("ignore") is True]:
        logger.warning("{}: camera {} has ignore = true there and is left out", path, listed(ignored))
    tables: dict[str, dict[str, Any]] = {}
    for key, table in lenses.items():
        if table.get("ignore") is not True:
            name = word(table.get("name")) or key
            if name in tables:
                raise InputError(f"{path}: two cameras are called {name[:80]!r}; rename one of them.")
            tables[name] = table
    if not tables:
        raise InputError(f"{path}: has no camera with a matrix; give {WHAT}.")
    return tables


def _cameras(tables: Mapping[str, Mapping[str, Any]], path: Path) -> dict[str, Camera]:
    return {name: _camera(name, table, f"{path}: camera {name}") for name, table in tables.items()}


def _camera(name: str, table: Mapping[str, Any], where: str) -> Camera:
    width, height = size(table.get("size"), f"{where}: size")
    K = matrix(table.get("matrix"), f"{where}: matrix", (3, 3))
    distortion = numbers(_flat(table.get("distortions")), f"{where}: distortions")
    with placed(where):
        return Camera(
            name=name,
            width=width,
            height=height,
            K=K,
            distortion_model="equidistant" if table.get("fisheye") is True else _model(len(distortion)),
            distortion=distortion,
        )


def _model(count: int) -> Any:
    return "rational_polynomial" if count > 5 else "plumb_bob"


def _pose(table: Mapping[str, Any], where: str) -> Pose:
    """T_world_cam; the rotation is a vector, or in older files of caliscope a matrix."""
    translation = numbers(_flat(table.get("translation")), f"{where}: translation", 3)
    given = _flat(table.get("rotation"))
    if len(given) == 9:
        R = nearest_rotation(numbers(given, f"{where}: rotation").reshape(3, 3), where)
    else:
        R = exp_so3(numbers(given, f"{where}: rotation", 3))
    return invert_transform(make_pose(R, translation))


def _flat(value: object) -> list[Any]:
    """A list of numbers, or of rows of such, in one; distortions and translations are written both ways."""
    rows = value if isinstance(value, list) else []
    return [item for row in rows for item in (row if isinstance(row, list) else [row])]


def recognises(path: Path, head: bytes) -> bool:
    """TOML with a lens in a table."""
    return b"matrix" in head and b"distortions" in head and b"[" in head and b"size" in head and not _other(head)


def _other(head: bytes) -> bool:
    return head.lstrip()[:1] in (b"{", b"<", b"%")


FORMAT = Format(
    name="aniposelib",
    suffix=".toml",
    explain=(
        "aniposelib TOML (caliscope's is read too): rotation (Rodrigues vector, radians) and translation (metres) map "
        "world to camera, the inverse of T_world_cam, OpenCV camera axes, the calibration's own world; matrix, "
        "distortions and size as OpenCV has them; foreign files are taken to be in metres."
    ),
    put=write,
    read=read,
    recognises=recognises,
    read_cameras=read_cameras,
    needs_cameras=True,
)
