"""Cameras of ROS's CameraInfo messages.

Owns      which of a message's matrices belong to an image, and distortion models' names.
Leaves    messages to ros_messages, whether the numbers can be a camera's to aruco.model.Camera.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np
from loguru import logger

from aruco.errors import InputError
from aruco.model import COEFFICIENTS, Camera, DistortionModel
from aruco.pose_math import Array
from rigcal.sources.ros_messages import CameraInfo

# Names of drivers in small letters -> ours. librealsense's coefficients are k1 k2 p1 p2 k3.
_MODELS: dict[str, DistortionModel] = {
    "": "plumb_bob",
    "none": "plumb_bob",
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "brown conrady": "plumb_bob",
    "modified brown conrady": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala brandt4": "equidistant",
}


def camera_of(info: CameraInfo, name: str, *, is_rectified: bool, size: tuple[int, int] | None) -> Camera:
    """The camera of an image.

    Args:
        info: Its CameraInfo.
        name: What the camera is called.
        is_rectified: The image is rectified: P holds its intrinsics, and it has no distortion.
        size: (width, height) of the image; None: not known.

    Raises:
        InputError: The message is empty, of another size, or of a model that is not known.
    """
    info = _of_size(info, name, size)
    if is_rectified:
        # A driver that rectifies and leaves P empty puts the same into K.
        K, distortion, model = _square(info.P[:, :3] if info.P.any() else info.K), np.zeros(5), "plumb_bob"
    else:
        K, model, distortion = _square(info.K), *_lens(info, name)
    if not K[:2, :2].any():
        raise InputError(
            f"camera {name}: its CameraInfo is empty (K is zero), so the driver did not know a calibration; give its "
            "intrinsics with --intrinsics FILE, or calibrate the camera and record again."
        )
    return Camera(
        name=name,
        width=info.width,
        height=info.height,
        K=K,
        distortion_model=cast(DistortionModel, model),
        distortion=distortion,
    )


def baseline_of(right: CameraInfo) -> float | None:
    """Metres between the eyes, from the right eye's P; None where it does not tell."""
    fx, shift = float(right.P[0, 0]), float(right.P[0, 3])
    baseline = abs(shift / fx) if fx > 0 and np.isfinite(shift) else 0.0
    return baseline if baseline > 0 else None


def _square(K: Array) -> Array:
    """Drivers leave the last element zero."""
    return np.vstack([K[:2], [0.0, 0.0, 1.0]])


def _lens(info: CameraInfo, name: str) -> tuple[DistortionModel, Array]:
    if not info.D.any() and info.model.lower() not in ("equidistant", "fisheye", "kannala brandt4"):
        return "plumb_bob", np.zeros(5)
    stated = info.model.lower().replace("inverse brown conrady", "brown conrady")
    if stated != info.model.lower():
        # librealsense's formula for it goes the other way; its ROS wrapper publishes the numbers as plumb_bob, too.
        logger.warning("camera {}: the distortion model {!r} is taken for plumb_bob", name, info.model)
    model = _MODELS.get(stated)
    if model is None:
        raise InputError(
            f"camera {name}: the distortion model {info.model[:40]!r} is not known; known: {', '.join(COEFFICIENTS)}; "
            "record rectified images, or give --intrinsics FILE."
        )
    distortion = info.D
    if model == "equidistant" and len(distortion) > 4 and not distortion[4:].any():
        distortion = distortion[:4]
    return model, distortion


def _of_size(info: CameraInfo, name: str, size: tuple[int, int] | None) -> CameraInfo:
    """The intrinsics of the pixels in the image: binned and of a region of interest, as the message says."""
    if size is None or size == (info.width, info.height):
        return info
    (bx, by), (left, top) = info.binning, info.roi
    if (bx, by, left, top) == (1, 1, 0, 0) or size[0] * bx + left > info.width or size[1] * by + top > info.height:
        raise InputError(
            f"camera {name}: images are {size[0]} x {size[1]}, but its CameraInfo says {info.width} x {info.height}; "
            "name the CameraInfo that belongs to the images with --topics, or give --intrinsics FILE."
        )
    # As ROS's image_geometry: the region is cut out of the full image, then binned.
    shrink, shift = np.diag([1 / bx, 1 / by, 1.0]), np.array([[1.0, 0, -left], [0, 1, -top], [0, 0, 1]])
    return replace(info, width=size[0], height=size[1], K=shrink @ shift @ info.K, P=shrink @ shift @ info.P)
