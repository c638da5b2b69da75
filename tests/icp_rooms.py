"""Clouds of small analytic rooms: rectangles of floor_rooms, seen by their cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from floor_rooms import BASELINE_M, FLOOR, FOCAL_PX, WALLS, K, Wall, depth_image

from aruco.floor_model import centre_jacobian
from aruco.floor_plane import FloorPlane
from aruco.icp_cloud import Cloud, cloud_of
from aruco.icp_types import ICPConfig
from aruco.pose_math import Array, Pose

LEVEL = FloorPlane(np.array([0.0, 1.0, 0.0]), 0.0)


def box(low: Sequence[float], high: Sequence[float]) -> tuple[Wall, ...]:
    """The six sides of an upright box between two corners."""
    sides = []
    for axis in range(3):
        a, b = (k for k in range(3) if k != axis)
        sides += [
            Wall(axis, value, (low[a], low[b]), (high[a], high[b])) for value in (float(low[axis]), float(high[axis]))
        ]
    return tuple(sides)


BOX = box((-0.5, 0.0, -0.3), (0.4, 0.7, 0.5))
# Small boxes at several places, of which several cameras see the same sides: something to hold yaw, x and z by.
BOXES = (
    FLOOR,
    *WALLS,
    *box((-0.9, 0.0, -0.3), (-0.2, 0.8, 0.3)),
    *box((0.2, 0.0, 0.4), (0.9, 0.5, 1.0)),
    *box((0.1, 0.0, -1.1), (0.8, 0.9, -0.4)),
)
TABLE = (Wall(1, 0.7, (-0.6, -0.6), (0.6, 0.6)),)
FURNISHED = (FLOOR, *WALLS, *BOX)


def covariance(T_world_cam: Pose, turn_deg: float, shift_mm: float) -> Array:
    """(6, 6) left perturbation of a pose that is off by so much about and along each axis at its centre, one sigma."""
    J = centre_jacobian(T_world_cam[:3, 3], inverse=True)
    return J @ np.diag([np.radians(turn_deg) ** 2] * 3 + [(1e-3 * shift_mm) ** 2] * 3) @ J.T


def camera_data(depth: Array, *, n_frames: int = 20) -> dict[str, Any]:
    """What a camera of these rooms hands in."""
    return {"depth": depth, "K": K, "baseline": BASELINE_M, "n_frames": n_frames}


def clouds_of(
    T_world_cam: Mapping[str, Pose], walls: Sequence[Wall] = FURNISHED, config: ICPConfig | None = None
) -> dict[str, Cloud]:
    """Every camera's cloud."""
    return {
        name: cloud_of(
            name,
            camera_data(depth_image(T, walls, seed=k)),
            ICPConfig(region="full", stride=2) if config is None else config,
            T_world_cam=T,
            floor=LEVEL,
        )
        for k, (name, T) in enumerate(T_world_cam.items())
    }


def distances(points_world: Array, walls: Sequence[Wall]) -> Array:
    """Distance (n,) [m] of points (n, 3) from the nearest rectangle."""
    nearest = np.full(len(points_world), np.inf)
    for wall in walls:
        others = [axis for axis in range(3) if axis != wall.axis]
        off = np.abs(points_world[:, wall.axis] - wall.value)
        beside = np.maximum(np.maximum(wall.low - points_world[:, others], points_world[:, others] - wall.high), 0.0)
        nearest = np.minimum(nearest, np.sqrt(off**2 + (beside**2).sum(axis=1)))
    return nearest


def fattened(depth: Array, px: int) -> Array:
    """Depth in which nearer surfaces cover what lies so many pixels beside them, as a stereo matcher makes it."""
    window = np.ones((2 * px + 1, 2 * px + 1), dtype=np.uint8)
    near = cv2.erode(depth.astype(np.float32), window)
    return np.where(1.0 / near - 1.0 / depth > 2.0 / (FOCAL_PX * BASELINE_M), near, depth)


def cylinder_data(radius_m: float, distance_m: float, *, seed: int = 0) -> dict[str, Any]:
    """Depth of an upright cylinder before a wall 1 m behind its axis; noise of 0.1 px of disparity, f B = 84 px m."""
    focal_px, (height, width) = 600.0, (360, 640)
    K = np.array([[focal_px, 0.0, 319.5], [0.0, focal_px, 179.5], [0.0, 0.0, 1.0]])
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    x = (u - K[0, 2]) / focal_px
    # Points (x z, z) of the level plane lie on the circle around (0, distance).
    a, b, c = 1 + x**2, -2 * distance_m, distance_m**2 - radius_m**2
    root = b * b - 4 * a * c
    near = (-b - np.sqrt(np.maximum(root, 0.0))) / (2 * a)
    depth = np.where((root > 0) & (np.abs(v - K[1, 2]) < 140), near, distance_m + 1.0)
    noise_px = np.random.default_rng(seed).normal(0.0, 0.1, u.shape)
    measured = 1.0 / (1.0 / depth + noise_px / 84.0)
    return {"depth": measured.astype(np.float32), "K": K, "baseline": 84.0 / focal_px, "n_frames": 20}
