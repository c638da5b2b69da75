"""Planes in clouds of points: the floor of one cloud.

Owns      FloorPlane, points of a depth image, the most supported near-level plane, its weighted fit.
Leaves    what a depth camera knows about a plane to floor_view, which plane is the floor of a rig to floor_consensus.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.pose_math import Array, Pose, checked_pose

Vec3 = Array  # (3,)
Mat44 = Array  # (4, 4)
PointsNC = Array  # (n, c)
Mask = NDArray[np.bool_]

UP: tuple[float, float, float] = (0.0, 1.0, 0.0)
# Half the samples floor: a chance of 1 in 8 that three points lie on it. 300 trials miss that once in 10^17, and find
# a floor of one tenth of the samples in 1 - 0.999^300 = 26 %; samples are drawn from near-level surroundings.
TRIALS = 300
# Rigs that are not levelled yet stand within a few degrees of upright; walls are 90 degrees away.
MAX_TILT_DEG = 20.0
DEFAULT_BAND_M = 0.02
MIN_INLIERS = 100
# Points that vote in a trial. The share of inliers is then known to 1 / sqrt(6000) = 1.3 %.
_VOTERS = 6000
_ROUNDS = 4


@dataclass(frozen=True, slots=True, eq=False)
class FloorPlane:
    """Points p with ``normal . p + d = 0`` [m]; the normal points up, so the floor's height along it is ``-d``."""

    normal: Vec3
    d: float
    covariance: Array | None = None  # (3, 3) of (normal along axes[0], along axes[1] [rad], d [m]); see plane_axes
    rms_m: float = math.nan  # of the inliers' distances
    n_inliers: int = 0

    def __post_init__(self) -> None:
        """Make the normal a unit vector of its own; InputError for what is no plane."""
        normal = np.array(self.normal, dtype=np.float64)
        length = float(np.linalg.norm(normal)) if normal.shape == (3,) else math.nan
        if not (math.isfinite(length) and length > 0 and math.isfinite(self.d)):
            raise InputError(f"floor plane: want a normal (3,) other than zero and a finite d, got {normal}, {self.d}.")
        normal /= length
        normal.setflags(write=False)
        object.__setattr__(self, "normal", normal)
        object.__setattr__(self, "d", float(self.d) / length)

    @property
    def height(self) -> float:
        """The floor's height along its normal [m]."""
        return -self.d

    def distances(self, points: PointsNC) -> Array:
        """Signed distances (n,) of points (n, 3) [m], positive above."""
        return np.asarray(points) @ self.normal + self.d

    def moved(self, T_new_old: Pose) -> FloorPlane:
        """The same plane in another frame; the covariance goes along without its part from ``d``'s new origin."""
        normal = T_new_old[:3, :3] @ self.normal
        d = self.d - float(normal @ T_new_old[:3, 3])
        return FloorPlane(normal, d, self._moved_covariance(T_new_old, normal), self.rms_m, self.n_inliers)

    def _moved_covariance(self, T_new_old: Pose, normal: Vec3) -> Array | None:
        if self.covariance is None:
            return None
        R, t = T_new_old[:3, :3], T_new_old[:3, 3]
        J = np.zeros((3, 3))
        J[:2, :2] = plane_axes(normal) @ R @ plane_axes(self.normal).T
        J[2, :2] = -(R @ plane_axes(self.normal).T).T @ t
        J[2, 2] = 1.0
        return J @ self.covariance @ J.T


def plane_axes(normal: Vec3) -> Array:
    """Two unit vectors (2, 3) in a plane, perpendicular to each other and to its unit normal."""
    first = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = first - normal * (first @ normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def unproject_depth_to_points(
    depth: Array,
    K: Array,
    stride: int = 1,
    *,
    min_depth_m: float = 0.0,
    max_depth_m: float = math.inf,
    mask: Mask | None = None,
    T_world_cam: Pose | None = None,
) -> PointsNC:
    """The points that a depth image measures.

    Args:
        depth: (h, w) along the optical axis [m]; NaN, zero or negative: none.
        K: (3, 3) of the depth image.
        stride: Every so many rows and columns.
        min_depth_m: Nearer points are left out.
        max_depth_m: Farther ones too.
        mask: (h, w), true where depth is used; default: everywhere.
        T_world_cam: The camera's pose; default: points in the camera's frame.

    Returns:
        (n, 3) [m], row by row.

    Raises:
        InputError: The arrays are no depth image and no camera matrix, or the stride is not positive.
    """
    pixels, z = depth_samples(depth, K, stride, mask=mask)
    keep = (z >= min_depth_m) & (z <= max_depth_m)
    rays = pixel_rays(K, pixels[keep])
    points = rays * z[keep, None]
    if T_world_cam is None:
        return points
    T = checked_pose(T_world_cam, "T_world_cam")
    return points @ T[:3, :3].T + T[:3, 3]


def depth_samples(depth: Array, K: Array, stride: int, *, mask: Mask | None = None) -> tuple[Array, Array]:
    """Pixels (n, 2) with depth, every ``stride`` rows and columns, and their depth (n,) [m]; see above."""
    depth, K = np.asarray(depth), np.asarray(K)
    if depth.ndim != 2 or K.shape != (3, 3) or not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        raise InputError(f"want depth (h, w) and a camera matrix K (3, 3), got {depth.shape} and {K.tolist()}.")
    if stride < 1:
        raise InputError(f"stride must be at least 1, got {stride}.")
    thin = depth[::stride, ::stride]
    good = np.isfinite(thin) & (thin > 0)
    if mask is not None:
        good &= mask[::stride, ::stride]
    rows, columns = np.nonzero(good)
    return stride * np.stack([columns, rows], axis=1).astype(np.float64), thin[good].astype(np.float64)


def pixel_rays(K: Array, pixels: Array) -> Array:
    """Rays (n, 3), z = 1, through pixels (n, 2)."""
    y = (pixels[:, 1] - K[1, 2]) / K[1, 1]
    x = (pixels[:, 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x, y, np.ones(len(x))], axis=1)


def detect_floor_plane(
    points: PointsNC,
    *,
    up: Sequence[float] | Array = UP,
    threshold_m: float = DEFAULT_BAND_M,
    max_tilt_deg: float = MAX_TILT_DEG,
    height_range: tuple[float, float] | None = None,
    sigma_m: Array | float | None = None,
    min_inliers: int = MIN_INLIERS,
    seed: int | np.random.Generator = 0,
) -> FloorPlane | None:
    """The near-level plane that most points lie on: RANSAC, then a weighted least-squares fit on its inliers.

    Args:
        points: (n, 3) [m]; not finite ones are left out.
        up: (3,) roughly up, in the frame of the points.
        threshold_m: How far from the plane a point still belongs to it.
        max_tilt_deg: Steeper planes are no floor.
        height_range: Lowest and highest height along ``up`` [m] of the points that count.
        sigma_m: Standard deviation of the points' distances from the plane, (n,) or one number; default: all equal.
        min_inliers: Fewer are no plane.
        seed: Of the trials.

    Returns:
        The plane, its normal within ``max_tilt_deg`` of up, or None where there is none.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    sigma = np.broadcast_to(np.asarray(1.0 if sigma_m is None else sigma_m, dtype=np.float64), len(points))
    vertical = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    keep = np.isfinite(points).all(axis=1) & np.isfinite(sigma) & (sigma > 0)
    if height_range is not None:
        heights = np.nan_to_num(points, nan=math.inf) @ vertical
        keep &= (heights >= height_range[0]) & (heights <= height_range[1])
    points, sigma = points[keep], sigma[keep]
    rng = np.random.default_rng(seed)
    band = np.full(len(points), float(threshold_m))
    plane = ransac_plane(points, band, vertical, max_tilt_deg=max_tilt_deg, rng=rng)
    for _ in range(_ROUNDS):
        if plane is None:
            return None
        inliers = np.abs(plane.distances(points)) <= threshold_m
        if int(inliers.sum()) < max(min_inliers, 3):
            return None
        plane = fit_plane(points[inliers], vertical, sigma[inliers])
    if plane is None or plane.normal @ vertical < math.cos(math.radians(max_tilt_deg)):
        return None
    return plane


def ransac_plane(
    points: PointsNC,
    band_m: Array,
    up: Vec3,
    *,
    max_tilt_deg: float = MAX_TILT_DEG,
    rng: np.random.Generator,
    trials: int = TRIALS,
) -> FloorPlane | None:
    """The plane through three of the points that most points lie within ``band_m`` (n,) of; None if none is level.

    Args:
        points: (n, 3) [m].
        band_m: (n,) half the thickness of the slab for each point.
        up: (3,) unit vector; planes count whose normal is within ``max_tilt_deg`` of it.
        max_tilt_deg: See ``up``.
        rng: Chance.
        trials: How many triples are drawn.
    """
    if len(points) < 3:
        return None
    triples = points[rng.integers(0, len(points), (trials, 3))]
    normals = np.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    upward = normals @ up
    level = (lengths > 0) & (np.abs(upward) >= math.cos(math.radians(max_tilt_deg)) * lengths)
    if not level.any():
        return None
    normals = normals[level] * (np.sign(upward[level]) / lengths[level])[:, None]
    offsets = -(normals * triples[level, 0]).sum(axis=1)
    voters = rng.permutation(len(points))[:_VOTERS]
    near = np.abs(points[voters] @ normals.T + offsets) <= band_m[voters, None]
    best = int(np.argmax(near.sum(axis=0)))
    return FloorPlane(normals[best], float(offsets[best]), n_inliers=int(near[:, best].sum()))


def fit_plane(points: PointsNC, up: Vec3, sigma_m: Array | None = None) -> FloorPlane | None:
    """The plane with the least weighted squares of distances to points (n, 3); None where they lie on a line.

    The covariance takes the points' errors as independent.
    """
    weights = np.ones(len(points)) if sigma_m is None else 1.0 / np.asarray(sigma_m, dtype=np.float64) ** 2
    total = float(weights.sum())
    centre = weights @ points / total
    off = points - centre
    values, vectors = np.linalg.eigh((off * weights[:, None]).T @ off / total)
    if values[1] <= 1e-9 * values[2]:
        return None
    normal = vectors[:, 0] * (1.0 if vectors[:, 0] @ up >= 0 else -1.0)
    distances = off @ normal
    # Distances of points from a plane that is turned by a, b about its axes and raised by c: linear in (a, b, c).
    A = np.column_stack([points @ plane_axes(normal).T, np.ones(len(points))])
    information = (A * weights[:, None]).T @ A
    scale = float(weights @ distances**2) / max(len(points) - 3, 1)
    return FloorPlane(
        normal=normal,
        d=-float(normal @ centre),
        covariance=scale * np.linalg.pinv(information, hermitian=True),
        rms_m=float(np.sqrt(np.mean(distances**2))),
        n_inliers=len(points),
    )
