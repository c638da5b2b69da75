"""Small rooms of level and upright rectangles, and what depth cameras measure in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aruco.depth_save import CameraDepth
from aruco.pose_math import Array, Pose, exp_so3, make_pose
from rigcal.sim.placement import look_at

# The eyes stand wide apart, so that few large pixels measure as well as the many of a real camera: f B = 84 px m.
WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 320, 180, 175.0, 0.48
K = np.array([[FOCAL_PX, 0.0, 159.5], [0.0, FOCAL_PX, 89.5], [0.0, 0.0, 1.0]])
FOCAL_BASELINE = FOCAL_PX * BASELINE_M


def zoomed(zoom: int) -> Array:
    """K (3, 3) of an image of so many times the size."""
    half = (zoom - 1) / 2
    return np.array([[zoom, 0.0, half], [0.0, zoom, half], [0.0, 0.0, 1.0]]) @ K


@dataclass(frozen=True, slots=True)
class Wall:
    """The rectangle on which one coordinate has a value and the other two lie in ranges [m]."""

    axis: int
    value: float
    low: tuple[float, float] = (-4.0, -4.0)  # of the other two, in the order x, y, z
    high: tuple[float, float] = (4.0, 4.0)


FLOOR = Wall(1, 0.0)
WALLS = tuple(Wall(axis, side) for axis in (0, 2) for side in (-4.0, 4.0))
ROOM = (FLOOR, *WALLS)


def cameras(count: int = 4, *, height_m: float = 1.6, aim_y: float = 0.3) -> dict[str, Pose]:
    """T_world_cam of cameras on a circle that look at its middle; the floor is y = 0 and y points up."""
    angles = 2 * np.pi * np.arange(count) / count + 0.3
    places = [np.array([2.3 * np.cos(a), height_m + 0.1 * k, 2.3 * np.sin(a)]) for k, a in enumerate(angles)]
    return {f"cam{k}": look_at(place, np.array([0.0, aim_y, 0.0])) for k, place in enumerate(places)}


def depth_image(
    T_world_cam: Pose, walls: Sequence[Wall], *, seed: int = 0, disparity_px: float = 0.0, zoom: int = 1
) -> Array:
    """Depth (HEIGHT, WIDTH) [m] along the optical axis, with noise of 0.03 px of disparity, NaN where nothing is met.

    Args:
        T_world_cam: Where the camera is.
        walls: What it may see.
        seed: Of the noise.
        disparity_px: Added to every disparity: too near by z^2 / (f B) for each pixel.
        zoom: So many times the size, with eyes as much nearer together.
    """
    u, v = np.meshgrid(np.arange(zoom * WIDTH), np.arange(zoom * HEIGHT))
    (fx, _, cx), (_, fy, cy), _ = zoomed(zoom)
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(u.shape)], axis=-1)
    turned, centre = rays @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    depth = np.full(u.shape, np.inf)
    for wall in walls:
        others = [axis for axis in range(3) if axis != wall.axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (wall.value - centre[wall.axis]) / turned[..., wall.axis]
            met = z[..., None] * turned[..., others] + centre[others]
            hit = (z > 0) & (met >= wall.low).all(axis=-1) & (met <= wall.high).all(axis=-1)
        depth = np.where(hit & (z < depth), z, depth)
    noise_px = np.random.default_rng(seed).normal(0.0, 0.03, u.shape)
    measured = 1.0 / (1.0 / depth + (noise_px + disparity_px) / FOCAL_BASELINE)
    return np.where(np.isfinite(depth), measured, np.nan).astype(np.float32)


def depth_of(
    T_world_cam: Mapping[str, Pose], walls: Sequence[Wall] = ROOM, *, disparity_px: float = 0.0, zoom: int = 1
) -> dict[str, CameraDepth]:
    """Every camera's depth, as a store keeps it."""
    return {
        name: CameraDepth(
            depth=depth_image(T, walls, seed=k, disparity_px=disparity_px, zoom=zoom).astype(np.float32),
            K=zoomed(zoom),
            n_frames=20,
            baseline_m=BASELINE_M / zoom,
        )
        for k, (name, T) in enumerate(T_world_cam.items())
    }


def nudged(
    T_world_cam: Mapping[str, Pose], *, degrees: float = 0.6, mm: float = 12.0, seed: int = 0
) -> dict[str, Pose]:
    """Poses of which each is turned about a level axis through its centre and raised or lowered, by about so much."""
    rng = np.random.default_rng(seed)
    return {name: tilted(T, rng.normal(0, degrees, 2), rng.normal(0, 1e-3 * mm)) for name, T in T_world_cam.items()}


def tilted(T_world_cam: Pose, degrees: Sequence[float] | Array, rise_m: float = 0.0) -> Pose:
    """A pose turned about x and z of the world through its centre, and raised."""
    a, b = np.radians(degrees)
    R = exp_so3(np.array([a, 0.0, b]))
    return make_pose(R @ T_world_cam[:3, :3], T_world_cam[:3, 3] + [0.0, rise_m, 0.0])


def floor_errors(T_true: Mapping[str, Pose], T_found: Mapping[str, Pose]) -> dict[str, tuple[float, float]]:
    """Camera -> tilt [deg] and height [mm] by which a pose misses the truth, whatever its yaw, x and z."""
    errors = {}
    for name, T in T_found.items():
        up_true, up_found = T_true[name][1, :3], T[1, :3]  # the world's up in the camera's axes
        tilt = np.degrees(np.arcsin(min(1.0, float(np.linalg.norm(np.cross(up_true, up_found))))))
        errors[name] = (float(tilt), 1e3 * float(T[1, 3] - T_true[name][1, 3]))
    return errors
