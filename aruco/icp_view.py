"""What of one camera's depth may be used for registration, in small squares, and how well each is known.

Owns      masks, taking out the given bias, noise of a square and of a correlation cell, what bias may still do to it.
Leaves    surfaces to icp_surface, choosing samples to icp_cloud.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from aruco.depth_bias import DepthBias
from aruco.depth_mask import mask_edges
from aruco.depth_noise import (
    CORRELATION_PX,
    DEFAULT_FOCAL_BASELINE,
    TEMPORAL_CORRELATION_PX,
    DepthNoise,
    bias_prior,
)
from aruco.floor_plane import Mask
from aruco.floor_view import LEAN_PX, MAX_SIGMA_M, FloorSamples, depth_and_intrinsics, untrusted
from aruco.icp_surface import Squares, mean_squares
from aruco.pose_math import Array

# Windows may reach over what is dropped at an edge, but not to what is measured beyond: the mask's margin on both
# sides of the jump, less some pixels for jumps that are not straight.
_BEYOND_EDGE_PX = 10.0
# No bias is measured so well that this part of what is usual is not left: depth wanders with the temperature, and with
# none at all, or a correlation of one, equations have no solution.
LEAST_BIAS = 0.005
# Independent measurements of the changing noise in a correlation cell of the fixed one.
_PER_CELL = (CORRELATION_PX / TEMPORAL_CORRELATION_PX) ** 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """The usable depth of one camera, given bias taken out."""

    shape: tuple[int, int]
    K: Array  # (3, 3)
    squares: Squares
    samples: FloorSamples  # the same, as level planes are searched in
    sigma_m: Array  # (n,) of a correlation cell's depth
    slopes: Array  # (4, n) of depth by scale, inverse depth or offset, lean along x, lean along y
    bias_covariance: Array  # (4, 4) of these
    given_bias: DepthBias | None
    n_frames: int
    focal_baseline: float | None


def usable_view(camera: str, data: Mapping[str, Any], stride: int, bias: DepthBias | None) -> View:
    """What of a camera's data may be used; see icp_cloud.cloud_of.

    Raises:
        InputError: They are no depth image with intrinsics of its own.
    """
    where = f"camera {camera}"
    depth, K = depth_and_intrinsics(data, where)
    bias = data.get("bias") if bias is None else bias
    baseline = data.get("baseline")
    known = None if bias is None else bias.focal_baseline
    focal_baseline = float(K[0, 0]) * float(baseline) if baseline else known
    edges = mask_edges(depth, focal_baseline=focal_baseline, focal_px=float(K[0, 0]))
    drop = edges | untrusted(data.get("confidence"), depth.shape, where)
    n_frames = max(1, int(data.get("n_frames") or 1))
    squares = _squares(np.where(drop, np.nan, depth), K, stride, bias or DepthBias(), edges)
    noise = DepthNoise(focal_baseline=focal_baseline)
    squares = squares.only(noise.averaged_sigma_m(1.0 / squares.inverse, n_frames) <= MAX_SIGMA_M)
    true = 1.0 / squares.inverse
    by_bias = (bias or DepthBias()).derivative(measured_depth(bias or DepthBias(), true))
    unit = 1.0 / (focal_baseline or DEFAULT_FOCAL_BASELINE)
    prior = bias_prior(focal_baseline, "stereo" if bias is None else bias.model)
    covariance = np.diag([0.0, 0.0, (LEAN_PX * unit) ** 2, (LEAN_PX * unit) ** 2])
    covariance[:2, :2] = prior if bias is None or bias.covariance is None else bias.covariance + LEAST_BIAS**2 * prior
    samples = FloorSamples(
        camera=camera,
        pixels=squares.pixels,
        rays=squares.rays,
        inverse=squares.inverse,
        sigma=noise.averaged_sigma_m(true, n_frames) / true**2,
        bias_slope=-by_bias / true**2,
        bias_covariance=covariance[:2, :2],
        lean_sigma=LEAN_PX * unit,
        stride=stride,
    )
    return View(
        shape=(depth.shape[0], depth.shape[1]),
        K=K,
        squares=squares,
        samples=samples,
        sigma_m=noise.averaged_sigma_m(true, n_frames * _PER_CELL),
        slopes=np.concatenate([by_bias, true**2 * squares.rays[:, :2].T]),
        bias_covariance=covariance,
        given_bias=bias,
        n_frames=n_frames,
        focal_baseline=focal_baseline,
    )


def measured_depth(bias: DepthBias, true_m: Array) -> Array:
    """What a camera with this bias measures at true depth (n,) [m]: the inverse of DepthBias.corrected."""
    if bias.model == "offset":
        return (true_m - bias.offset_m) / (1.0 + bias.scale)
    return (1.0 + bias.scale) / (1.0 / true_m + bias.inverse_depth)


def _squares(depth: Array, K: Array, stride: int, bias: DepthBias, edges: Mask) -> Squares:
    room = cv2.distanceTransform((~edges).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
    inverse = 1.0 / bias.corrected(depth)
    return mean_squares(inverse, K, stride, np.minimum(room, max(depth.shape)) + _BEYOND_EDGE_PX)
