"""Intrinsics that the user gives in a file: which of its cameras is meant, and whether it fits the images.

Owns      names and sizes of such cameras against those of a recording.
Leaves    reading the file to the reader that comes in with the options.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from aruco.errors import InputError
from aruco.model import Camera


def meant(cameras: Mapping[str, Camera], name: str, *, only: bool) -> Camera | None:
    """The camera of that name; with ``only`` a file's only camera is meant whatever it is called."""
    if name in cameras:
        return cameras[name]
    return next(iter(cameras.values())) if only and len(cameras) == 1 else None


def fitting(camera: Camera, path: Path, images: str, size: tuple[int, int] | None) -> Camera:
    """The camera, if it is of images of that size.

    Args:
        camera: Out of the file.
        path: The file.
        images: What the images are called in the complaint.
        size: (width, height) of these; None: not known.

    Raises:
        InputError: It is not; the message names both sizes.
    """
    if size is None or (camera.width, camera.height) == size:
        return camera
    if (camera.height, camera.width) == size:
        advice = "they are of turned images, and these stay as stored: calibrate with images as stored"
    else:
        advice = "give the intrinsics of this resolution"
    raise InputError(
        f"{path}: the intrinsics are of images of {camera.width} x {camera.height}, but {images} has "
        f"{size[0]} x {size[1]}; {advice}."
    )


def listed(cameras: Mapping[str, Camera]) -> str:
    """The names of a file's cameras; only so many that a message remains readable."""
    names = sorted(cameras)
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "") if names else "no camera"
