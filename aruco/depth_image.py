"""What is a depth image, and what is none.

Owns      the types, telling holes from faults, the refusals.
Leaves    what to leave out of a sound image to depth_mask.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.errors import InputError

Depth = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]

# No depth camera of a rig has most of its scene beyond this; most of it beyond this many millimetres is usual.
FARTHEST_MEDIAN_M = 100.0


def check_depth(depth: Any, where: str) -> Depth:
    """A depth image in metres with NaN for holes; a copy only where something was to be replaced.

    Zeros and NaN are holes, and so are infinite values beside measurements: cameras mark with them what was too near
    or too far. Floating types are kept, others become float32.

    Args:
        depth: (H, W) along the optical axis.
        where: File and camera, for the message.

    Raises:
        InputError: It is no image, holds no measurement, negative depth, or millimetres.
    """
    image = with_holes(depth, where)
    if not np.isfinite(image).any():
        raise InputError(f"{where}: {_emptiness(np.asarray(depth))}; nothing can be measured with it: record it again.")
    return image


def with_holes(depth: Any, where: str) -> Depth:
    """Like check_depth, but an image without any measurement passes: in a recording it can happen to a frame."""
    image = np.asarray(depth)
    if image.ndim != 2 or not image.size or image.dtype.kind not in "fiu":
        raise InputError(f"{where}: depth must be an image of numbers (H, W), got {image.dtype} of {image.shape}.")
    if image.dtype not in (np.float32, np.float64):
        image = image.astype(np.float32)
    negative = np.count_nonzero((image < 0) & np.isfinite(image))
    if negative:
        raise InputError(
            f"{where}: {negative} pixels hold negative depth; mark holes with NaN or 0, and check the sign."
        )
    measured = (image > 0) & np.isfinite(image)
    if 2 * np.count_nonzero(measured & (image > FARTHEST_MEDIAN_M)) > np.count_nonzero(measured):
        typical = float(np.median(image[measured]))
        raise InputError(
            f"{where}: half of the depth is beyond {typical:.0f}, which looks like millimetres and must be metres; "
            "divide it by 1000, or set depth_scale in the recording's camera_info and pool it again."
        )
    return (
        image if np.array_equal(measured, ~np.isnan(image)) else np.where(measured, image, np.nan).astype(image.dtype)
    )


def _emptiness(image: NDArray[Any]) -> str:
    """What an image without measurements is full of."""
    if not image.any():
        return "depth is zero everywhere"
    if np.isnan(image.astype(np.float64)).all():
        return "depth is NaN everywhere"
    if np.isinf(image.astype(np.float64)).all():
        return "depth is infinite everywhere"
    return "depth holds no finite positive value"
