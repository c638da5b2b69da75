"""Small rooms of rectangles with exact depth, for tests of the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from aruco.pose_math import Array, Pose, exp_so3, make_pose

WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 320, 180, 175.0, 0.48
K = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1]])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rectangle:
    """A level rectangle at a height, or all of the plane."""

    height: float
    centre: tuple[float, float] = (0.0, 0.0)  # x, z
    half: tuple[float, float] = (1e3, 1e3)


FLOOR = Rectangle(height=0.0)
ROOM_HALF_M = 4.0


def camera_at(place: Sequence[float], look_at: Sequence[float] = (0.0, 0.0, 0.0)) -> Pose:
    """A camera without roll in a world whose y axis points up."""
    z = np.asarray(look_at, dtype=np.float64) - np.asarray(place)
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return make_pose(np.column_stack([x, np.cross(z, x), z]), np.asarray(place, dtype=np.float64))


def ring(n: int = 4, *, radius_m: float = 2.5, heights_m: Sequence[float] = (1.2, 1.6, 2.0, 1.4)) -> dict[str, Pose]:
    """Cameras around the origin, looking at it."""
    angles = 2 * np.pi * np.arange(n) / n + 0.3
    return {
        f"cam{k}": camera_at((radius_m * np.cos(a), heights_m[k % len(heights_m)], radius_m * np.sin(a)))
        for k, a in enumerate(angles)
    }


def depth_of(T_world_cam: Pose, surfaces: Sequence[Rectangle] = (FLOOR,), *, walls: bool = True) -> Array:
    """Depth (HEIGHT, WIDTH) along the optical axis of the nearest surface, NaN where there is none."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T @ T_world_cam[:3, :3].T
    origin = T_world_cam[:3, 3]
    depth = np.full((HEIGHT, WIDTH), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for surface in surfaces:
            z = (surface.height - origin[1]) / rays[..., 1]
            at = origin + z[..., None] * rays
            inside = np.abs(at[..., [0, 2]] - surface.centre) <= surface.half
            depth = np.where(inside.all(axis=-1) & (z > 0) & (z < depth), z, depth)
        for axis in (0, 2) if walls else ():
            z = (np.sign(rays[..., axis]) * ROOM_HALF_M - origin[axis]) / rays[..., axis]
            depth = np.where((z > 0) & (z < depth), z, depth)
    return np.where(np.isfinite(depth), depth, np.nan)


def noisy(
    depth: Array, rng: np.random.Generator, *, sigma_px: float = 0.06, scale: float = 0.0, disparity_px: float = 0.0
) -> Array:
    """Depth of a stereo camera, whose neighbouring pixels share their errors in blocks of 8."""
    blocks = rng.standard_normal((HEIGHT // 8 + 1, WIDTH // 8 + 1))
    error_px = disparity_px + sigma_px * np.kron(blocks, np.ones((8, 8)))[:HEIGHT, :WIDTH]
    return (1.0 + scale) / (1.0 / depth + error_px / (FOCAL_PX * BASELINE_M))


def data_of(depths: Mapping[str, Array]) -> dict[str, dict[str, Any]]:
    """What refine_ground_from_depth reads."""
    return {name: {"depth": depth, "K": K, "baseline": BASELINE_M} for name, depth in depths.items()}


def disturbed(
    poses: Mapping[str, Pose], rng: np.random.Generator, *, turn_deg: float, shift_m: float
) -> dict[str, Pose]:
    """Poses turned about their centres and shifted, by normal errors about and along each axis."""
    return {
        name: make_pose(
            exp_so3(np.radians(turn_deg) * rng.standard_normal(3)) @ T[:3, :3],
            T[:3, 3] + shift_m * rng.standard_normal(3),
        )
        for name, T in poses.items()
    }
