"""rigcal's own extrinsics file: JSON, one entry a camera, everything about the run under ``_meta``.

Owns      writing and reading the layout that docs/conventions.md describes.
Leaves    other people's formats to their own files.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.model import Calibration, CameraPose, UpAxis
from aruco.pose_math import Pose, pose_text
from rigcal.formats.rotations import rigid_pose

FORMAT, VERSION = "rigcal.extrinsics", 1
# A hundred cameras that all share frames take 0.8 MB, 260 of them 4.7 MB: pairs grow with the square. Python's objects
# take thirty times as much as a file that is made for it.
MAX_FILE_BYTES = 16 * 2**20
WHAT = "an extrinsics file"
UP_VECTORS: dict[UpAxis, list[int]] = {"+y": [0, 1, 0], "-y": [0, -1, 0]}


def document(calibration: Calibration) -> dict[str, Any]:
    """The content of an extrinsics file."""
    world = {"up": UP_VECTORS[calibration.up] if calibration.up else None, "origin": calibration.origin}
    meta = {"format": FORMAT, "version": VERSION, "world": world, **calibration.notes}
    for key, of_camera in calibration.kept_meta.items():
        if of_camera:
            meta[key] = dict(sorted({**meta.get(key, {}), **of_camera}.items()))
    fresh = {c.camera: c.covariance for c in calibration.cameras if c.covariance is not None and not c.kept}
    known = {name: [float(x) for x in covariance.ravel()] for name, covariance in fresh.items()}
    if known:
        meta["covariance"] = dict(sorted({**meta.get("covariance", {}), **known}.items()))
    if calibration.lost:
        meta["without_pose"] = dict(calibration.lost)
    if calibration.idle:
        meta["took_no_part"] = dict(calibration.idle)
    if calibration.parts:
        meta["parts"] = [document(part) for part in calibration.parts]
    cameras = {c.camera: _entry(c, calibration.kept.get(c.camera, {})) for c in calibration.cameras}
    return {**dict(sorted({**calibration.kept, **cameras}.items())), "_meta": meta}


def _entry(camera: CameraPose, kept: Mapping[str, Any]) -> dict[str, Any]:
    """A camera's entry; of one that was kept what its file says, beside what is new."""
    return {
        **kept,
        # The text, not the numbers: what is kept is kept to the bit, signs of zeros among it.
        "pose": kept.get("pose", pose_text(camera.T_world_cam)),
        "frames": camera.n_frames,
        "markers": camera.n_markers,
        "rms_px": camera.rms_px,
        "spread_mm": 1e3 * camera.spread_m,
        "spread_deg": math.degrees(camera.spread_rad),
        **({"least_known": camera.least_known} if camera.least_known else {}),
        **({"kept": True} if camera.kept else {}),
        "warnings": list(camera.warnings),
    }


def write_extrinsics(path: Path, calibration: Calibration) -> None:
    """Write a calibration whole or not at all.

    Raises:
        OutputError: The file cannot be written.
    """
    write_json(path, document(calibration))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON whole or not at all; the same content gives the same bytes.

    Raises:
        OutputError: The file cannot be written.
    """
    write_whole(path, json_bytes(content))


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """What write_json writes."""
    return (json.dumps(content, indent=2, allow_nan=False) + "\n").encode()


def read_poses(path: Path) -> dict[str, Pose]:
    """Camera -> T_world_cam of an extrinsics file; unknown keys are ignored, rounded poses set to the nearest rotation.

    Raises:
        InputError: The file cannot be read or an entry has no rigid pose; the message names file and camera.
    """
    return poses_of(read_json(path), path)


def poses_of(content: Mapping[str, Any], path: Path) -> dict[str, Pose]:
    """The same, of a file that was read; see read_poses."""
    check_version(content, path)
    cameras = _cameras(content, path)
    if not any(isinstance(entry, dict) and "pose" in entry for entry in cameras.values()):
        _refuse_other_formats(path)
    return {name: _pose(entry, f"{path}: camera {name}") for name, entry in cameras.items()}


def check_version(content: Mapping[str, Any], path: Path) -> None:
    """See that what an extrinsics file says of its own layout is what is read here; it may say nothing.

    Raises:
        InputError: It is another layout, or a newer one, whose poses may mean something else.
    """
    meta = content.get("_meta")
    said = meta if isinstance(meta, dict) else {}
    layout, version = said.get("format", FORMAT), said.get("version", VERSION)
    if layout != FORMAT:
        raise InputError(
            f"{path}: says that it is {str(layout)[:40]!r} (_meta.format), not {FORMAT}; give an extrinsics file."
        )
    if version != VERSION or isinstance(version, bool):
        raise InputError(
            f"{path}: is an extrinsics file of version {repr(version)[:40]}, and this program reads {VERSION}; update "
            "it."
        )


def read_json(path: Path, what: str = WHAT) -> dict[str, Any]:
    """The object at the root of a JSON file; ``what`` it should be, for messages.

    Raises:
        InputError: There is no such file, it is too large, or it holds something else, numbers that are none among it.
    """
    return read_json_and_digest(path, what)[0]


def read_json_and_digest(path: Path, what: str = WHAT) -> tuple[dict[str, Any], str]:
    """The same, and the SHA-256 of the bytes that were read."""
    raw = b""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(f"{path}: over {MAX_FILE_BYTES >> 20} MiB, which is not {what}.")
        raw = path.read_bytes()
        content = json.loads(
            raw.decode("utf-8-sig"), parse_constant=_finite, parse_float=_finite, object_pairs_hook=_untwinned
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path.") from error
    except _NoNumberError as error:
        raise InputError(f"{path}: {_place_of(raw)}: {error}; mend or remove it.") from error
    except _TwinsError as error:
        raise InputError(f"{path}: {error} is there twice in one object; rename or remove one of them.") from error
    except (ValueError, RecursionError) as error:
        if what == WHAT and not raw.lstrip().startswith(b"{"):
            _refuse_other_formats(path)
        raise InputError(f"{path}: not a JSON file ({error}); give {what}.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: not {what}: its root is not an object.")
    return content, hashlib.sha256(raw).hexdigest()


def _refuse_other_formats(path: Path) -> None:
    """Say of what is no extrinsics file what it is, if it is a calibration, or empty.

    Raises:
        InputError: It is.
    """
    from rigcal.formats import registry  # which reads every format, ours among them

    try:
        known = registry.detect(path).name if path.is_file() else "native"
    except registry.UnknownFormatError:
        return
    if known != "native":
        raise InputError(
            f"{path}: is a calibration in another format ({known}); make an extrinsics file of it: rigcal convert "
            f"{path} --to native -o extrinsics.json."
        )


def _finite(text: str) -> float:
    """A number; JSON has neither NaN nor Infinity, and Python would read 1e999 as the latter."""
    value = float(text)
    if not math.isfinite(value):
        raise _NoNumberError(f"{text} is not a finite number")
    return value


class _NoNumberError(ValueError):
    """NaN, or what is like it."""


def _untwinned(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of which no member would silently be lost."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise _TwinsError(repr(key[:80]))
        found[key] = value
    return found


class _TwinsError(ValueError):
    """Two members of one name."""


def _place_of(raw: bytes) -> str:
    """Where a file holds its first number that is none."""
    try:
        content = json.loads(raw.decode("utf-8-sig"))
    except (ValueError, RecursionError):
        return "it"
    todo: list[tuple[str, Any]] = [("", content)]
    while todo:
        place, node = todo.pop()
        if isinstance(node, float) and not math.isfinite(node):
            return place
        inner = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
        todo += reversed([(f"{place}.{key}" if place else str(key), value) for key, value in inner])
    return "it"


def _cameras(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    cameras = {name: entry for name, entry in content.items() if not name.startswith("_")}
    if not cameras:
        raise InputError(f"{path}: holds no camera; every key that does not start with _ is one.")
    return cameras


def _pose(entry: Any, where: str) -> Pose:
    text = entry.get("pose") if isinstance(entry, dict) else None
    if not isinstance(text, str):
        raise InputError(f"{where} has no pose; it wants sixteen numbers, row by row.")
    try:
        T = np.array([float(word) for word in text.split()]).reshape(4, 4)
    except ValueError as error:
        raise InputError(
            f"{where} has no sixteen numbers of a rigid transform ({error}); mend its pose or leave the camera out."
        ) from error
    with np.errstate(over="ignore", invalid="ignore"):  # 1e308 makes a pose that is not rigid, and is refused as such
        return rigid_pose(T, where)
