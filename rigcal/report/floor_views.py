"""The floor as each camera sees it, ready to be drawn and told: points, heights before and after, figures.

Owns      which points of a depth image are shown as floor, and how high they stand before and after.
Leaves    finding and correcting to aruco.ground_plane, drawing to floor_page, the terminal to floor_table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.ground_plane import FloorCorrection, FloorPlane
from aruco.pose_math import Array, Pose, pose_distance, transform_points

# What lies this near the camera's own floor, and further by so many sigmas of its noise, is shown as floor.
BAND_M = 0.02
BAND_SIGMAS = 3.0
# A height map of this width shows every ripple of a floor, and four cameras make a small page.
WIDTH_PX = 160
LEAST_LIMIT_MM = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloorView:
    """One camera's depth on a coarse grid, and its pose before and after its own correction."""

    camera: str
    points_cam: Array  # (h, w, 3) [m], NaN where there is no depth
    is_floor: NDArray[np.bool_]  # (h, w)
    corner_rays: Array  # (4, 3) to the corners of the image, z = 1, clockwise
    step_px: int  # of the grid, in pixels of the depth image
    T_before_cam: Pose  # in the levelled world, as if only the whole rig had been moved
    T_after_cam: Pose  # in the levelled world

    def heights_m(self, T_world_cam: Pose, up_y: int, floor_y: float) -> Array:
        """Heights (h, w) of the floor's points above y = floor_y [m], NaN elsewhere."""
        height = up_y * (transform_points(T_world_cam, self.points_cam)[..., 1] - floor_y)
        return np.where(self.is_floor, height, np.nan)

    def before_m(self, up_y: int, floor_y: float) -> Array:
        """Heights before this camera's own correction."""
        return self.heights_m(self.T_before_cam, up_y, floor_y)

    def after_m(self, up_y: int, floor_y: float) -> Array:
        """Heights after it."""
        return self.heights_m(self.T_after_cam, up_y, floor_y)


def floor_view(
    camera: str,
    depth_m: Array,
    K: Array,
    *,
    T_before_cam: Pose,
    T_after_cam: Pose,
    floor: FloorPlane | None,
    sigma_m: Callable[[Array], Array],
) -> FloorView:
    """What is shown of one camera.

    Args:
        camera: Its name.
        depth_m: (H, W) without bias, NaN where unknown or not to be trusted.
        K: (3, 3) of the depth image.
        T_before_cam: Its pose as if only the whole rig had been moved.
        T_after_cam: Its final pose.
        floor: Its floor in the world of the final poses; None if it sees none.
        sigma_m: Standard deviation [m] of depth [m].
    """
    step = grid_step(depth_m, WIDTH_PX)
    rays, z = depth_grid(depth_m, K, step)
    points = rays * z[..., None]
    K_inv = np.linalg.inv(K)
    bottom, right = (size - 1 for size in depth_m.shape)
    corners = np.array([[0, 0, 1], [right, 0, 1], [right, bottom, 1], [0, bottom, 1]]) @ K_inv.T
    if floor is None:
        is_floor = np.zeros(z.shape, dtype=np.bool_)
    else:
        noise_m = sigma_m(z) * np.abs(rays @ T_after_cam[:3, :3].T @ floor.normal)
        away_m = floor.distances(transform_points(T_after_cam, points))
        is_floor = np.abs(away_m) <= BAND_M + BAND_SIGMAS * noise_m  # NaN is not
    return FloorView(
        camera=camera,
        points_cam=points,
        is_floor=is_floor,
        corner_rays=corners,
        step_px=step,
        T_before_cam=T_before_cam,
        T_after_cam=T_after_cam,
    )


def grid_step(depth_m: Array, width_px: int) -> int:
    """Every so many pixels make a grid that is no wider than this."""
    return max(1, math.ceil(depth_m.shape[1] / width_px))


def depth_grid(depth_m: Array, K: Array, step: int) -> tuple[Array, Array]:
    """Rays (h, w, 3) with z = 1 and depth (h, w) [m], NaN where there is none, of every step-th pixel each way."""
    rows, columns = (np.arange(step // 2, size, step) for size in depth_m.shape)
    z = np.asarray(depth_m[np.ix_(rows, columns)], dtype=np.float64)
    z = np.where(np.isfinite(z) & (z > 0), z, np.nan)
    rays = np.stack([*np.meshgrid(columns, rows), np.ones_like(z)], axis=-1) @ np.linalg.inv(K).T
    return rays, z


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorFigures:
    """One camera's floor against the common one, and what was done about it; NaN where it sees none."""

    camera: str
    tilt_before_deg: float
    tilt_after_deg: float
    height_before_mm: float  # of its floor above the common one, where the camera looks
    height_after_mm: float
    turned_deg: float
    raised_mm: float
    outcome: str  # in a word or two
    reason: str = ""  # why it was not levelled on its own floor, or why that is doubtful

    @property
    def told(self) -> str:
        """Outcome and reason."""
        return f"{self.outcome}: {self.reason}" if self.reason else self.outcome


def floor_figures(
    camera: str,
    T_before_cam: Pose,
    T_after_cam: Pose,
    correction: FloorCorrection | None,
    *,
    reason: str,
    up_y: int,
    doubtful: bool = False,
) -> FloorFigures:
    """The figures of one camera.

    Args:
        camera: Its name.
        T_before_cam: Its pose as if only the whole rig had been moved.
        T_after_cam: Its final pose.
        correction: What its floor asked for; None if it sees none.
        reason: Why it was not levelled on its own floor, or why that is doubtful; else empty.
        up_y: 1 if y points up, -1 if down.
        doubtful: Whether its floor contradicts its pose.
    """
    turned_rad, _ = pose_distance(T_before_cam, T_after_cam)
    seen = correction or FloorCorrection()
    return FloorFigures(
        camera=camera,
        tilt_before_deg=seen.tilt_before_deg,
        tilt_after_deg=seen.tilt_after_deg,
        height_before_mm=1e3 * seen.height_before_m,
        height_after_mm=1e3 * seen.height_after_m,
        turned_deg=math.degrees(turned_rad),
        raised_mm=1e3 * up_y * float(T_after_cam[1, 3] - T_before_cam[1, 3]),
        outcome=_outcome(correction, doubtful=doubtful),
        reason=reason,
    )


def _outcome(correction: FloorCorrection | None, *, doubtful: bool) -> str:
    if correction is None:
        return "whole rig only"
    if not correction.accepted:
        return "rejected"
    word = "kept" if correction.is_kept else "levelled"
    return f"{word}, doubtful" if doubtful else word


def told(value: float, form: str, unit: str = "") -> str:
    """A number for a table; what rounds to zero has no sign, NaN is a dash."""
    if math.isnan(value):
        return "-"
    text = f"{value:{form}}"
    return (text if float(text) else text.lstrip("+-")) + unit


def common_limit_mm(views: Sequence[FloorView], up_y: int, floor_y: float) -> float:
    """A symmetric colour scale that suits heights before and after of all cameras."""
    maps = [heights for view in views for heights in (view.before_m(up_y, floor_y), view.after_m(up_y, floor_y))]
    heights = np.abs(np.concatenate([np.zeros(1), *(h[np.isfinite(h)] for h in maps)]))
    # Far noise has a tail; a scale that ends at the farthest point shows nothing else.
    return max(LEAST_LIMIT_MM, math.ceil(1e3 * float(np.quantile(heights, 0.98))))
