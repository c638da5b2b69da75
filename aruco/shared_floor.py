"""A level surface that several cameras see: where it is roughly, and which pixels of their depth show it.

Owns      the vote over heights, the plane through what was voted for, the pixels near it.
Leaves    levelling on the floor to ground_plane; what its depth tells of poses and biases to depth_fusion.

Any level surface serves to compare depth with depth, so the one that most of the cameras see most of is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.depth_bias import DepthBias
from aruco.depth_noise import DepthNoise
from aruco.depth_tiles import plane_in_camera
from aruco.pose_math import Array, Pose, invert_transform, transform_points

# Squares of the image whose depth is a plane of its own. Its normal is good to some degrees at 3 m.
SQUARE_PX = 32
STRIDE_PX = 2
MAX_TILT_DEG = 15.0
MIN_FILLED = 0.6
# Half the width of the slab that is voted for: a biased camera puts the floor 4 cm off at 4 m.
SLAB_M = 0.08
# More of a camera's vote than this does not count: one camera before a large table must not decide.
ENOUGH_M2 = 1.0
MIN_AREA_M2 = 0.15
# A marker target that rests on the floor is level to a degree or two.
MAX_OFF_UP_DEG = 5.0
ROUNDS = 8
# Pixels this many standard deviations of noise and unknown bias off the plane belong to something else.
BAND = 3.0
BAND_M = 0.03
# Within the band a wall is floor up to its first few centimetres, which are 5 px at 6 m.
MARGIN_PX = 14


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthView:
    """One camera's depth, without what is masked, and its place."""

    depth_m: Array  # (h, w) along the optical axis, NaN where unknown or not to be used
    K: Array  # (3, 3)
    T_world_cam: Pose
    noise: DepthNoise
    bias_prior: Array  # (2, 2)
    model: DepthBias  # none as yet: which model its errors follow


@dataclass(frozen=True, slots=True, eq=False)
class _Squares:
    """Level squares of all cameras."""

    camera: NDArray[np.int64]  # (n,)
    points: Array  # (n, 3) their middles, world [m]
    area_m2: Array  # (n,)
    weight: Array  # (n,)


def find_shared_floor(views: Sequence[DepthView], up: Array) -> tuple[Array, float] | None:
    """The level surface that most cameras see most of.

    Args:
        views: Depth of all cameras.
        up: (3,) unit, away from gravity, world, good to a degree or two.

    Returns:
        Its normal, which points up, and ``normal . X`` of its points, world; None if there is none.
    """
    squares = _joined([_level_squares(view, c, up) for c, view in enumerate(views)])
    if not len(squares.camera):
        return None
    heights = squares.points @ up
    votes = np.array([_vote(squares, np.abs(heights - h) < SLAB_M) for h in heights])
    best = int(np.argmax(votes))
    if votes[best] < MIN_AREA_M2:
        return None
    return _through(squares, up, float(heights[best]))


def floor_pixels(view: DepthView, floor: tuple[Array, float]) -> tuple[Array, Array]:
    """Pixels (n, 2), every STRIDE_PX-th, that show a plane of the world, and their depth (n,) [m]."""
    rows, columns = np.mgrid[0 : view.depth_m.shape[0] : STRIDE_PX, 0 : view.depth_m.shape[1] : STRIDE_PX]
    z = np.asarray(view.depth_m[rows, columns], dtype=np.float64)
    pixels = np.stack([columns, rows], axis=-1).astype(np.float64)
    rays = np.concatenate([pixels, np.ones((*z.shape, 1))], axis=-1) @ np.linalg.inv(view.K).T
    expected = rays @ plane_in_camera(*floor, invert_transform(view.T_world_cam))
    with np.errstate(divide="ignore", invalid="ignore"):
        off_m = z - 1.0 / expected
        J = view.model.derivative(z.ravel())
        unknown = np.einsum("in,ij,jn->n", J, view.bias_prior, J).reshape(z.shape)
        near = np.abs(off_m) < BAND_M + BAND * np.sqrt(view.noise.sigma_m(z) ** 2 + unknown)
    near &= expected > 0
    near &= ~_near_other_things(np.isfinite(z) & ~near)
    return pixels[near], z[near]


def _near_other_things(other: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels beside surfaces that are not the floor: their feet lie within its band."""
    solid = cv2.morphologyEx(other.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    size = 2 * (MARGIN_PX // STRIDE_PX) + 1
    return cv2.dilate(solid, np.ones((size, size), np.uint8)).astype(bool)


def _level_squares(view: DepthView, camera: int, up: Array) -> _Squares:
    """Squares of the image on which depth is a plane that is about level."""
    height, width = (n // SQUARE_PX for n in view.depth_m.shape)
    z = np.asarray(view.depth_m[: height * SQUARE_PX, : width * SQUARE_PX], dtype=np.float64)
    rows, columns = np.mgrid[0 : z.shape[0], 0 : z.shape[1]]
    rays = np.stack([columns, rows, np.ones(z.shape)], axis=-1) @ np.linalg.inv(view.K).T
    good = np.isfinite(z) & (z > 0)
    inverse = np.where(good, 1.0 / np.where(good, z, 1.0), 0.0)
    r = _in_squares(rays * good[..., None], height, width)  # (s, p, 3)
    w = _in_squares(inverse[..., None], height, width)
    count = _in_squares(good[..., None].astype(np.float64), height, width).sum(axis=(1, 2))
    filled = count >= MIN_FILLED * SQUARE_PX**2
    r, w, count = r[filled], w[filled], count[filled]
    q = np.linalg.solve(r.transpose(0, 2, 1) @ r, r.transpose(0, 2, 1) @ w)[..., 0]
    middle = r.sum(axis=1) / count[:, None]
    depth = 1.0 / np.maximum((q * middle).sum(axis=1), 1e-6)
    # q points away from the camera; a floor's upper side is seen against it.
    normal = -(q / np.linalg.norm(q, axis=1, keepdims=True)) @ view.T_world_cam[:3, :3].T
    level = normal @ up > np.cos(np.radians(MAX_TILT_DEG))
    points = transform_points(view.T_world_cam, depth[:, None] * middle)
    facing = np.maximum(np.abs(q @ np.array([0.0, 0.0, 1.0])) / np.linalg.norm(q, axis=1), 0.05)
    area = count * depth**2 / (view.K[0, 0] * view.K[1, 1]) / facing
    sigma = view.noise.sigma_m(depth)
    n = int(level.sum())
    return _Squares(np.full(n, camera), points[level], area[level], 1.0 / sigma[level] ** 2)


def _in_squares(values: Array, height: int, width: int) -> Array:
    """(H, W, k) as (squares, pixels, k)."""
    k = values.shape[2]
    parts = values.reshape(height, SQUARE_PX, width, SQUARE_PX, k).transpose(0, 2, 1, 3, 4)
    return parts.reshape(height * width, SQUARE_PX**2, k)


def _joined(parts: Sequence[_Squares]) -> _Squares:
    if not parts:
        return _Squares(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty(0), np.empty(0))
    columns = zip(*((p.camera, p.points, p.area_m2, p.weight) for p in parts))
    return _Squares(*(np.concatenate(column) for column in columns))


def _vote(squares: _Squares, inside: NDArray[np.bool_]) -> float:
    """Area in a slab, of each camera no more than enough."""
    areas = np.bincount(squares.camera[inside], squares.area_m2[inside])
    return float(np.minimum(areas, ENOUGH_M2).sum())


def _through(squares: _Squares, up: Array, height: float) -> tuple[Array, float] | None:
    """The plane through the squares near a height, found in rounds; None if it is not level."""
    normal, offset, slab = up, height, 2 * SLAB_M
    for _ in range(ROUNDS):
        off = squares.points @ normal - offset
        near = np.abs(off) < slab
        if near.sum() < 3:
            return None
        w = squares.weight[near] / (1.0 + (off[near] / (0.5 * slab)) ** 2)
        middle = (w @ squares.points[near]) / w.sum()
        centred = squares.points[near] - middle
        scatter = (centred.T * w) @ centred
        values, vectors = np.linalg.eigh(scatter)
        if values[1] <= 4 * values[0]:
            return None
        normal = vectors[:, 0] * np.sign(vectors[:, 0] @ up)
        offset, slab = float(normal @ middle), max(0.75 * slab, SLAB_M)
    return (normal, offset) if normal @ up > np.cos(np.radians(MAX_OFF_UP_DEG)) else None
