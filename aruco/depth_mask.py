"""What to leave out of a sound depth image: pixels near jumps of depth, and surfaces seen nearly from the side.

Owns      mask_edges, mask_grazing.
Leaves    noise and bias to depth_noise and depth_bias.

A stereo matcher compares windows: where two surfaces meet in one, the nearer covers the farther by half a window, and
depth there is wrong by as much as the surfaces are apart. Everything is judged in inverse depth w = 1 / z, which is
disparity up to a factor: noise is the same everywhere, and a plane is linear in the pixel.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.depth_image import Depth, Mask
from aruco.depth_noise import DEFAULT_FOCAL_BASELINE
from aruco.pose_math import Array

# Surfaces steeper than this to the line of sight are not worth measuring: see mask_grazing.
_STEEPEST = math.tan(math.radians(80.0))
# A focal length for images whose own is not given, as share of the width: a field of view of 80 degrees.
_USUAL_FOCAL = 0.6
# Jumps are smeared over a few pixels by matching windows and by filters.
_SMEAR_PX = 4
# Over a window of this half size the slope of a floor is known to a few degrees even in a single noisy image.
_NORMAL_RADIUS_PX = 10


def mask_edges(
    depth: Depth,
    *,
    focal_baseline: float | None = None,
    focal_px: float | None = None,
    margin_px: int = 7,
    step_px: float = 1.0,
) -> Mask:
    """Pixels (H, W) to drop because a jump of depth is near; also where holes part the two sides of the jump.

    A jump is more than ``step_px`` of disparity beyond what a surface 80 degrees from the line of sight rises by:
    w tan(80 degrees) / f from pixel to pixel.

    Args:
        depth: (H, W) metres, NaN = none.
        focal_baseline: f B [px m] of the depth image; None: depth_noise.DEFAULT_FOCAL_BASELINE.
        focal_px: Focal length of the depth image; None: that of a field of view of 80 degrees.
        margin_px: How far from a jump, in all directions.
        step_px: Jumps of disparity below this are none. Smaller jumps cannot do more harm than that.
    """
    step = step_px / (DEFAULT_FOCAL_BASELINE if focal_baseline is None else focal_baseline)
    slope = _STEEPEST / (_USUAL_FOCAL * depth.shape[1] if focal_px is None else focal_px)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = (1.0 / depth).astype(np.float32)
    inverse[~np.isfinite(inverse)] = np.nan
    jumps = _jumps_in_rows(inverse, step, slope) | _jumps_in_rows(np.ascontiguousarray(inverse.T), step, slope).T
    size = 2 * margin_px + 1
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return cv2.dilate(jumps.astype(np.uint8), window, borderType=cv2.BORDER_CONSTANT, borderValue=0).astype(bool)


def _jumps_in_rows(inverse: NDArray[np.float32], step: float, slope: float) -> Mask:
    """Both sides of each jump between neighbours with nothing measured between them, and the middle of smeared ones."""
    height, width = inverse.shape
    columns = np.arange(width, dtype=np.int32)
    last = np.maximum.accumulate(np.where(np.isfinite(inverse), columns, np.int32(-1)), axis=1)
    left = last[:, :-1]
    there = np.take_along_axis(inverse, np.maximum(left, 0), axis=1)
    jumps = np.zeros((height, width), dtype=bool)
    jumps[:, 1:] = _is_jump(inverse[:, 1:], there, columns[1:] - left, step, slope) & (left >= 0)
    rows, found = np.nonzero(jumps[:, 1:])
    jumps[rows, left[rows, found]] = True
    smeared = _is_jump(inverse[:, _SMEAR_PX:], inverse[:, :-_SMEAR_PX], _SMEAR_PX, step, slope)
    jumps[:, _SMEAR_PX // 2 : _SMEAR_PX // 2 + smeared.shape[1]] |= smeared
    return jumps


def _is_jump(
    a: NDArray[np.float32], b: NDArray[np.float32], gap_px: NDArray[np.int32] | int, step: float, slope: float
) -> Mask:
    """Whether inverse depths [1/m] so many pixels apart are of two surfaces; False for NaN."""
    with np.errstate(invalid="ignore"):
        return np.abs(a - b) > step + slope * gap_px * np.minimum(a, b)


def mask_grazing(depth: Depth, K: Array, *, max_angle_deg: float = 80.0) -> Mask:
    """Pixels (H, W) to drop because their surface is seen nearly from the side, or is too small to have a direction.

    A plane n . X = d has w = 1 / z = n . (x, y, 1) / d at the ray (x, y, 1), so (dw/dx, dw/dy, w - x dw/dx - y dw/dy)
    points along its normal. The slopes are least-squares fits over a window.

    Args:
        depth: (H, W) metres, NaN = none.
        K: (3, 3) of the depth image.
        max_angle_deg: Between the line of sight and the normal. Lateral errors of a pixel grow by its tangent; 80
            degrees is a floor 6 m away from a camera 1.1 m high.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = (1.0 / depth).astype(np.float32)
    valid = np.isfinite(inverse)
    per_column, per_row, enough = _slopes(np.where(valid, inverse, np.float32(0.0)), valid)
    height, width = depth.shape
    x = (np.arange(width) - K[0, 2]) / K[0, 0]
    y = ((np.arange(height) - K[1, 2]) / K[1, 1])[:, None]
    a, b = per_column * K[0, 0], per_row * K[1, 1]
    normal_length = np.sqrt(a**2 + b**2 + (inverse - a * x - b * y) ** 2)
    ray_length = np.sqrt(x**2 + y**2 + 1.0)
    with np.errstate(invalid="ignore"):
        steep = inverse < np.cos(np.deg2rad(max_angle_deg)) * normal_length * ray_length
    return valid & (steep | ~enough)


def _slopes(values: NDArray[np.float32], valid: Mask) -> tuple[Array, Array, Mask]:
    """Least-squares slopes (H, W) of valid values along columns and rows in a window, and where there are enough."""
    size = 2 * _NORMAL_RADIUS_PX + 1
    one = np.ones(size)
    ramp = np.arange(size) - float(_NORMAL_RADIUS_PX)
    weight = valid.astype(np.float32)

    def moment(image: NDArray[np.float32], along_x: Array, along_y: Array) -> Array:
        return np.asarray(
            cv2.sepFilter2D(image, cv2.CV_64F, along_x, along_y, borderType=cv2.BORDER_CONSTANT), np.float64
        )

    n = np.maximum(moment(weight, one, one), 1.0)
    u, v, w = moment(weight, ramp, one) / n, moment(weight, one, ramp) / n, moment(values, one, one) / n
    uu = moment(weight, ramp**2, one) / n - u * u
    vv = moment(weight, one, ramp**2) / n - v * v
    uv = moment(weight, ramp, ramp) / n - u * v
    uw, vw = moment(values, ramp, one) / n - u * w, moment(values, one, ramp) / n - v * w
    determinant = uu * vv - uv * uv
    # A third of the window in each direction, and a quarter of its pixels: what less spans is a sliver.
    enough = (n >= size**2 / 4) & (determinant > (size**2 / 12 / 9) ** 2)
    safe = np.where(enough, determinant, 1.0)
    return (vv * uw - uv * vw) / safe, (uu * vw - uv * uw) / safe, enough
