"""Clouds before and after registration, ready to be drawn: points of each camera, and which of them stand upright.

Owns      which points are shown, and where a wall is a line when seen from above.
Leaves    drawing to icp_page, figures to icp_table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from aruco.pose_math import Array, Pose, transform_points
from rigcal.report.floor_views import depth_grid, grid_step

# A wall 1 m long at 3 m then has some 30 points: enough to see how two cameras' lines meet.
WIDTH_PX = 320
# Normals are taken over so many steps of the grid to each side: 10 cm at 3 m, where depth noise is 10 mm.
_REACH = 3
# A surface whose normal is this near level is a wall, a side of a box, a leg of a table.
UPRIGHT_DEG = 30.0
# What is lower is the floor's own noise, what is higher a lamp.
PLAN_HEIGHTS_M = (0.05, 2.2)
MARGIN_SHARE = 0.06  # of the larger side of what is shown
_MIDDLE = (0.01, 0.99)  # shares of a camera's points between which its cloud reaches
LOW_SHARE = 0.05  # of a camera's own height: before a desk things are smaller, and noise is


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudView:
    """One camera's cloud in the levelled world, before and after."""

    camera: str
    before: Array  # (n, 3) [m], with the bias known before taken out
    after: Array  # (n, 3) the same pixels, with the bias known now taken out
    is_upright: NDArray[np.bool_]  # (n,)
    centre_before: Array  # (3,) of the camera
    centre_after: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Extent:
    """Where clouds can be compared: a rectangle of the floor [m]."""

    x: tuple[float, float]
    z: tuple[float, float]

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Which of points (n, 3) lie above it."""
        inside_x = (points[:, 0] >= self.x[0]) & (points[:, 0] <= self.x[1])
        return inside_x & (points[:, 2] >= self.z[0]) & (points[:, 2] <= self.z[1])


def common_extent(views: Sequence[CloudView]) -> Extent:
    """The cameras, and what two of them see; what one alone sees in the distance makes a rig a dot."""
    boxes = [np.quantile(view.before[:, [0, 2]], _MIDDLE, axis=0) for view in views if len(view.before)]
    places = np.array([view.centre_before[[0, 2]] for view in views])
    shared = [np.array([np.maximum(a[0], b[0]), np.minimum(a[1], b[1])]) for a, b in combinations(boxes, 2)]
    shared = [both for both in shared if (both[0] < both[1]).all()]
    corners = np.concatenate([places, *(shared or boxes)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = MARGIN_SHARE * max(float((high - low).max()), 0.1)
    (x0, z0), (x1, z1) = (low - margin).tolist(), (high + margin).tolist()
    return Extent(x=(x0, x1), z=(z0, z1))


def cloud_view(
    camera: str,
    depth_before: Array,
    depth_after: Array,
    K: Array,
    *,
    T_before_cam: Pose,
    T_after_cam: Pose,
) -> CloudView:
    """What is shown of one camera.

    Args:
        camera: Its name.
        depth_before: (H, W) [m], NaN where unknown or not to be trusted, without the bias known before.
        depth_after: The same without the bias known now.
        K: (3, 3) of the depth image.
        T_before_cam: Its levelled pose.
        T_after_cam: Its pose with clouds registered.
    """
    step = grid_step(depth_before, WIDTH_PX)
    rays, z_before = depth_grid(depth_before, K, step)
    z_after = depth_grid(depth_after, K, step)[1]
    before, after = rays * z_before[..., None], rays * z_after[..., None]
    seen = np.isfinite(z_before) & np.isfinite(z_after)
    return CloudView(
        camera=camera,
        before=transform_points(T_before_cam, before[seen]),
        after=transform_points(T_after_cam, after[seen]),
        is_upright=_is_upright(transform_points(T_before_cam, before))[seen],
        centre_before=T_before_cam[:3, 3],
        centre_after=T_after_cam[:3, 3],
    )


def _is_upright(points_world: Array) -> NDArray[np.bool_]:
    """Points (h, w) of a grid (h, w, 3) on a surface whose normal is near level; NaN is not."""
    upright = np.zeros(points_world.shape[:2], dtype=np.bool_)
    if min(upright.shape) <= 2 * _REACH:
        return upright
    inner = slice(_REACH, -_REACH)
    along_x = points_world[inner, 2 * _REACH :] - points_world[inner, : -2 * _REACH]
    along_y = points_world[2 * _REACH :, inner] - points_world[: -2 * _REACH, inner]
    normals = np.cross(along_x, along_y)
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.abs(normals[..., 1]) / np.linalg.norm(normals, axis=-1)
    upright[inner, inner] = slope < math.sin(math.radians(UPRIGHT_DEG))
    return upright
