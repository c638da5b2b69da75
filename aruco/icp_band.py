"""Which points take part, and which clouds can meet: the band above the floor and the overlap from above.

Owns      extract_near_floor_band, compute_overlap_xz.
Leaves    choosing pairs and regions to icp_match and icp_cloud, registration to icp_graph and icp_solve.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from aruco.errors import InputError
from aruco.pose_math import Array

# Columns of points that lie in the floor, in a world whose y axis is vertical.
_LEVEL_AXES = [0, 2]
# Sums of decimals fall short of the end they mean (-0.1 + 0.3 < 0.2); a nanometre mends that and changes nothing else.
_END_M = 1e-9


def extract_near_floor_band(points_world: Array, floor_y: float, band_height: float, floor_normal: Array) -> Array:
    """The points between the floor and a height above it, both ends included.

    Args:
        points_world: (n, 3) [m]; points that are not finite are left out.
        floor_y: The floor's height along its normal [m], which is ``-d`` of its plane. A caller that wants the noise
            below the plane too lowers it.
        band_height: How far above the floor a point still counts [m].
        floor_normal: (3,) normal of the floor, up; its length does not matter.

    Returns:
        (m, 3) points with ``floor_y <= p . normal <= floor_y + band_height``, in the order given; (0, 3) for none.

    Raises:
        InputError: Points, normal, height or band are not usable.
    """
    points = _checked_points(points_world, "points_world")
    normal = np.asarray(floor_normal, dtype=np.float64)
    length = float(np.linalg.norm(normal)) if normal.shape == (3,) else math.nan
    if not (math.isfinite(length) and length > 0):
        raise InputError(f"floor_normal: want (3,) numbers other than zero, got {normal.tolist()}.")
    if not (math.isfinite(floor_y) and math.isfinite(band_height) and band_height >= 0):
        raise InputError(f"want a finite floor_y and a band_height from 0 m, got {floor_y} and {band_height}.")
    heights = points @ (normal / length)
    return points[(heights >= floor_y - _END_M) & (heights <= floor_y + band_height + _END_M)]


def compute_overlap_xz(points_a: Array, points_b: Array, margin: float) -> float:
    """How much floor two clouds share: the area in which their boxes along x and z overlap.

    Args:
        points_a: (n, 3) in a world whose y axis is vertical [m]; points that are not finite are left out.
        points_b: (m, 3), likewise.
        margin: How far each box is extended on each of its sides [m]; negative shrinks it.

    Returns:
        The area [m^2]; 0.0 where the boxes are disjoint or a cloud is empty.

    Raises:
        InputError: The clouds are not (n, 3), or the margin is not finite.
    """
    a, b = _checked_points(points_a, "points_a"), _checked_points(points_b, "points_b")
    if not math.isfinite(margin):
        raise InputError(f"margin: want finite metres, got {margin}.")
    if not len(a) or not len(b):
        return 0.0
    low_a, high_a = _box_xz(a, margin)
    low_b, high_b = _box_xz(b, margin)
    # An extent below zero, of a shrunk box or of a gap, must not multiply with another one to an area.
    sides = np.minimum(high_a, high_b) - np.maximum(low_a, low_b)
    return float(np.prod(np.maximum(sides, 0.0)))


def _box_xz(points: Array, margin: float) -> tuple[Array, Array]:
    level = points[:, _LEVEL_AXES]
    return level.min(axis=0) - margin, level.max(axis=0) + margin


def _checked_points(points: Any, name: str) -> Array:
    """Finite points (n, 3) of what a caller gave."""
    array = np.asarray(points, dtype=np.float64)
    if array.size == 0:
        return np.empty((0, 3))
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name}: want (n, 3) metres, got shape {array.shape}.")
    return array[np.isfinite(array).all(axis=1)]
