"""A camera's intrinsics as ROS writes them (camera_info YAML), read and written.

Owns      the keys of camera_info.yaml, and what is wrong with a file that cannot be used.
Leaves    whether the numbers can be a camera's to aruco.model.Camera.

``depth_scale``, ``depth_camera_matrix`` and ``baseline`` are additions to what ROS defines. The rectification and
projection matrices are written for other readers (the identity and ``[K | 0]``) and not read: images are as recorded.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.model import MAX_IMAGE_SIDE_PX, Camera, DistortionModel
from aruco.pose_math import Array

FILE_NAME = "camera_info.yaml"
REQUIRED = ("image_width", "image_height", "camera_matrix", "distortion_model", "distortion_coefficients")
# A camera_info has about 2 kB; the parser takes a second for this much.
MAX_FILE_BYTES = 64 * 2**10
_SIDES, _COUNTS = range(1, MAX_IMAGE_SIDE_PX + 1), range(MAX_FILE_BYTES)


def load_camera_info(path: Path, name: str) -> Camera:
    """Read one camera's intrinsics.

    Args:
        path: The YAML file.
        name: What the camera is called; the file's ``camera_name`` is not used.

    Returns:
        The camera, checked.

    Raises:
        InputError: The file cannot be read, lacks a key or holds what cannot be a camera; the message names the file.
    """
    content = _parsed(path)
    missing = [key for key in REQUIRED if key not in content]
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}; export the camera's calibration again.")
    try:
        return Camera(
            name=name,
            width=_whole(content["image_width"], "image_width", _SIDES),
            height=_whole(content["image_height"], "image_height", _SIDES),
            K=_matrix(content, "camera_matrix", (3, 3)),
            distortion_model=cast(DistortionModel, _word(content["distortion_model"], "distortion_model")),
            distortion=_matrix(content, "distortion_coefficients", None).ravel(),
            depth_K=_matrix(content, "depth_camera_matrix", (3, 3)) if "depth_camera_matrix" in content else None,
            depth_scale=_number(content.get("depth_scale", "0.001"), "depth_scale"),
            baseline_m=_number(content["baseline"], "baseline") if "baseline" in content else None,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def dump_camera_info(camera: Camera) -> str:
    """The text of a camera's camera_info.yaml; reading it gives the same camera to the last bit."""
    content: dict[str, Any] = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": camera.name,
        "camera_matrix": _listed(camera.K),
        "distortion_model": camera.distortion_model,
        "distortion_coefficients": _listed(camera.distortion[None, :]),
        "rectification_matrix": _listed(np.eye(3)),
        "projection_matrix": _listed(np.hstack([camera.K, np.zeros((3, 1))])),
        "depth_scale": float(camera.depth_scale),
    }
    if camera.depth_K is not None:
        content["depth_camera_matrix"] = _listed(camera.depth_K)
    if camera.baseline_m is not None:
        content["baseline"] = float(camera.baseline_m)
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True, width=120)


def _parsed(path: Path) -> Mapping[str, Any]:
    if path.exists() and not path.is_file():  # opening a pipe would wait for ever
        raise InputError(f"{path}: is not a file; a camera's folder needs {FILE_NAME} beside image/.")
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise InputError(f"{path}: over {MAX_FILE_BYTES >> 10} KiB, which is not a camera_info file.")
        # The base loader makes no objects at all: safer than the safe one, and YAML 1.1's idea that 1e-05, as ROS
        # writes it, is a word and 010 is eight does not matter.
        content = yaml.load(path.read_text(encoding="utf-8-sig"), Loader=yaml.BaseLoader)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or error}); a camera's folder needs {FILE_NAME} beside image/."
        ) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{path}: not a readable YAML file ({reason}); export the calibration again.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no keys; a camera_info file begins with image_width.")
    return content


def _word(value: object, key: str) -> str:
    # Not shown: references let a short file hold a value that prints without end.
    if not isinstance(value, str):
        raise InputError(f"{key} must be a single value, not a {type(value).__name__}.")
    return value


def _whole(value: object, key: str, allowed: range) -> int:
    word = _word(value, key)
    if not re.fullmatch("[0-9]{1,9}", word) or int(word) not in allowed:
        raise InputError(f"{key} must be a whole number from {allowed[0]} to {allowed[-1]}, got {word[:40]!r}.")
    return int(word)


def _number(value: object, key: str) -> float:
    word = _word(value, key)
    try:
        return float(word)
    except ValueError:
        raise InputError(f"{key} must hold ordinary numbers, got {word[:40]!r}.") from None


def _matrix(content: Mapping[str, Any], key: str, shape: tuple[int, int] | None) -> Array:
    """The matrix under a key, of the shape wanted; None: a single row of any length."""
    entry = content[key]
    if not isinstance(entry, dict) or not isinstance(entry.get("data"), list):
        raise InputError(f"{key} must have rows, cols and data, a list of numbers.")
    data = np.array([_number(value, key) for value in entry["data"]], dtype=np.float64)
    rows, cols = shape or (1, len(data))
    stated = tuple(
        _whole(entry.get(word, str(size)), f"{key}: {word}", _COUNTS) for word, size in (("rows", rows), ("cols", cols))
    )
    if stated != (rows, cols) or len(data) != rows * cols:
        raise InputError(
            f"{key} must have {rows} rows and {cols} cols of data, got {stated[0]} rows, {stated[1]} cols and "
            f"{len(data)} numbers."
        )
    return data.reshape(rows, cols)


def _listed(matrix: NDArray[Any]) -> dict[str, Any]:
    rows, cols = matrix.shape
    return {"rows": rows, "cols": cols, "data": [float(value) for value in matrix.ravel()]}
