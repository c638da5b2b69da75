"""What one depth camera sees of level surfaces, and how well it knows them.

Owns      floor samples of a depth image, its level planes, their covariance from noise and bias.
Leaves    planes in arbitrary points to floor_plane, which of them is the floor to floor_consensus.

A plane ``n . X + d = 0`` of the camera's frame is linear in inverse depth along rays r = X / z: ``1 / z = a . r``
with ``a = -n / d``. There the disparity noise of a stereo camera is the same everywhere and has no bias, and its
systematic error ``1 / z_true = (1 + s) / z - e`` only scales and shifts a. What rectification leaves grows across the
image: this lean ``l . (x, y)`` in inverse depth adds to a what a turn of the camera would (see depth_fusion).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.depth_bias import DepthBias
from aruco.depth_image import check_depth
from aruco.depth_mask import mask_edges, mask_grazing
from aruco.depth_noise import DEFAULT_FOCAL_BASELINE, DepthNoise, bias_prior, independent_count
from aruco.depth_pool import WORST_CONFIDENCE
from aruco.errors import InputError
from aruco.floor_plane import (
    MAX_TILT_DEG,
    FloorPlane,
    Mask,
    depth_samples,
    pixel_rays,
    plane_axes,
    ransac_plane,
)
from aruco.pose_math import Array, Pose

# Growth of the disparity's error across the image [px a unit of the ray], one sigma: what 0.07 mrad of rectification
# make at f = 700 px. Estimated biases do not have it either.
LEAN_PX = 0.05
# Depth noise that no longer tells a floor from a carpet's edge.
MAX_SIGMA_M = 0.1
# Real floors and lenses bend; half a slab is never thinner than this.
MIN_BAND_M = 0.01
BAND_SIGMAS = 3.0
MAX_PLANES = 4
# Of all samples; smaller level patches are boxes and steps, or too few to trust.
MIN_SHARE = 0.02
MIN_INLIERS = 200
# Tiles in which the surface's direction is measured before chance is asked; walls then need no trials.
_TILE_PX = 40
_MIN_IN_TILE = 12
_TILE_TILT_DEG = 35.0
# Blocks of pixels whose residuals are summed before they are squared: errors shared within a block count once.
_BLOCK_PX = 64
_WIDEN = (4.0, 3.0, 2.0, 1.5, 1.25, 1.0, 1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloorSamples:
    """The usable depth of one camera, bias taken out, every few pixels."""

    camera: str
    pixels: Array  # (n, 2)
    rays: Array  # (n, 3), z = 1
    inverse: Array  # (n,) inverse depth [1/m]
    sigma: Array  # (n,) its standard deviation
    bias_slope: Array  # (2, n) its derivative by the bias's two parameters
    bias_covariance: Array  # (2, 2) what is not known of these
    lean_sigma: float  # of what is not known of the growth of the inverse depth's error along x and y of the ray [1/m]
    stride: int

    @property
    def points(self) -> Array:
        """(n, 3) [m], camera frame."""
        return self.rays / self.inverse[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenPlane:
    """A level surface as one camera sees it: ``1 / z = a . r``."""

    a: Array  # (3,) [1/m], camera frame
    noise: Array  # (3, 3) covariance of a from noise that neighbours share
    bias: Array  # (3, 3) covariance of a from what is not known of the depth's bias
    inliers: NDArray[np.intp]  # indices into the samples
    rms_m: float  # of their distances from the plane
    share: float  # of the camera's samples

    @property
    def covariance(self) -> Array:
        """(3, 3) of a."""
        return self.noise + self.bias

    @property
    def normal(self) -> Array:
        """(3,) unit, camera frame, on the camera's side."""
        return -self.a / float(np.linalg.norm(self.a))

    @property
    def distance_m(self) -> float:
        """Of the camera's centre from the plane, positive."""
        return 1.0 / float(np.linalg.norm(self.a))

    def in_world(self, T_world_cam: Pose) -> FloorPlane:
        """The plane in the world."""
        n, h = self.normal, self.distance_m
        # a = -n / h: a turn of n by its axes moves a by -axes / h, and dh moves it by n / h^2.
        J = np.vstack([-h * plane_axes(n), h**2 * n])
        plane = FloorPlane(n, h, J @ self.covariance @ J.T, self.rms_m, len(self.inliers))
        return plane.moved(T_world_cam)


def floor_samples(camera: str, data: Mapping[str, Any], stride: int) -> FloorSamples:
    """The usable depth of one camera's data; see ground_plane.refine_ground_from_depth for what these hold.

    Raises:
        InputError: They are no depth image with intrinsics of its own.
    """
    where = f"camera {camera}"
    depth, K = depth_and_intrinsics(data, where)
    _check_stride(stride, depth.shape, where)
    baseline = data.get("baseline")
    bias = data.get("bias") or DepthBias()
    focal_baseline = float(K[0, 0]) * float(baseline) if baseline else bias.focal_baseline
    noise = DepthNoise(focal_baseline=focal_baseline)
    drop = mask_edges(depth, focal_baseline=focal_baseline, focal_px=float(K[0, 0])) | mask_grazing(depth, K)
    drop |= untrusted(data.get("confidence"), depth.shape, where)
    pixels, z = depth_samples(depth, K, stride, mask=~drop)
    true = bias.corrected(z)
    sigma_z = noise.averaged_sigma_m(z, int(data.get("n_frames") or 1))
    good = np.isfinite(true) & (sigma_z <= MAX_SIGMA_M)
    pixels, z, true, sigma_z = pixels[good], z[good], true[good], sigma_z[good]
    return FloorSamples(
        camera=camera,
        pixels=pixels,
        rays=pixel_rays(K, pixels),
        inverse=1.0 / true,
        sigma=sigma_z / true**2,
        bias_slope=-bias.derivative(z) / true**2,
        bias_covariance=bias_prior(focal_baseline, bias.model) if bias.covariance is None else bias.covariance,
        lean_sigma=LEAN_PX / (focal_baseline or DEFAULT_FOCAL_BASELINE),
        stride=stride,
    )


def depth_and_intrinsics(data: Mapping[str, Any], where: str) -> tuple[Array, Array]:
    """Depth (h, w) [m] and its camera matrix (3, 3) from one camera's data; InputError where they are none."""
    if "depth" not in data or "K" not in data:
        raise InputError(
            f"{where}: want its depth and the K of that depth, got {', '.join(sorted(data)) or 'nothing'}."
        )
    depth = check_depth(data["depth"], where)
    return depth, _checked_intrinsics(data["K"], depth.shape, where)


def _checked_intrinsics(K: Any, shape: tuple[int, ...], where: str) -> Array:
    """The camera matrix (3, 3) of a depth image of this shape; InputError where it is none or of another size."""
    matrix = np.array(K, dtype=np.float64)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
        raise InputError(f"{where}: K is not a camera matrix [[fx, s, cx], [0, fy, cy], [0, 0, 1]].")
    height, width = shape
    if not (0 < matrix[0, 2] < width and 0 < matrix[1, 2] < height):
        raise InputError(
            f"{where}: K has its centre at ({matrix[0, 2]:.0f}, {matrix[1, 2]:.0f}), outside of a depth image of "
            f"{width} x {height}; give the K of the depth image's own size."
        )
    return matrix


def _check_stride(stride: int, shape: tuple[int, ...], where: str) -> None:
    height, width = shape
    left = math.ceil(height / stride) * math.ceil(width / stride)
    if left < MIN_INLIERS <= height * width:
        raise InputError(
            f"{where}: a stride of {stride} leaves {left} pixels of its depth of {width} x {height}, too few for a "
            "floor; give a smaller --stride."
        )


def untrusted(confidence: Any, shape: tuple[int, ...], where: str) -> Mask:
    """Pixels (h, w) whose confidence is too poor; none where there is no confidence."""
    if confidence is None:
        return np.zeros(shape, dtype=bool)
    confidence = np.asarray(confidence)
    if confidence.shape != shape:
        raise InputError(f"{where}: confidence of shape {confidence.shape} for depth of shape {shape}.")
    return confidence > WORST_CONFIDENCE


def level_planes(
    samples: FloorSamples,
    up_cam: Array,
    *,
    threshold_m: float | None,
    rng: np.random.Generator,
    height_range: tuple[float, float] | None = None,
    centre_height_m: float = 0.0,
) -> list[SeenPlane]:
    """The near-level planes below a camera, each on samples of its own, the largest first.

    Args:
        samples: What it sees.
        up_cam: (3,) unit, roughly up, camera frame. Turned over: the planes above the camera.
        threshold_m: How far a point may be from a plane; None: by the depth's noise.
        rng: Chance.
        height_range: Lowest and highest height in the world [m] of points that count.
        centre_height_m: The camera's own height in the world, for that range.
    """
    points = samples.points
    heights = points @ up_cam
    free = _level_tiles(samples, up_cam)
    # Whatever bounds a room from below lies below its cameras.
    free &= heights < 0
    if height_range is not None:
        free &= (heights + centre_height_m >= height_range[0]) & (heights + centre_height_m <= height_range[1])
    band = plane_bands(samples, np.abs(heights), threshold_m)
    planes: list[SeenPlane] = []
    least = max(MIN_INLIERS, MIN_SHARE * len(points))
    for _ in range(MAX_PLANES):
        index = np.nonzero(free)[0]
        found = ransac_plane(points[index], band[index], up_cam, rng=rng)
        if found is None:
            break
        near = free & (np.abs(found.distances(points)) <= band)
        plane = fitted_plane(samples, band, near, free)
        if plane is None or len(plane.inliers) < least:
            break
        # Noise has tails: what is left of a surface must not be found as another one.
        free &= np.abs(points @ plane.normal + plane.distance_m) > 2 * band
        if plane.normal @ up_cam >= math.cos(math.radians(MAX_TILT_DEG)):
            planes.append(plane)
    return sorted(planes, key=lambda plane: -len(plane.inliers))


def plane_bands(samples: FloorSamples, below_m: Array, threshold_m: float | None) -> Array:
    """How far (n,) [m] samples may be from a plane that is ``below_m`` (n,) from the camera, along its normal."""
    if threshold_m is not None:
        return np.full(len(samples.inverse), threshold_m)
    # Depth noise of a level surface moves a point off its plane by sigma_z times the ray's slope towards it.
    return np.maximum(MIN_BAND_M, BAND_SIGMAS * samples.sigma / samples.inverse * below_m)


def _level_tiles(samples: FloorSamples, up_cam: Array) -> Mask:
    """Samples (n,) in tiles of the image whose surface is roughly level."""
    if not len(samples.inverse):
        return np.zeros(0, dtype=bool)
    label = squares(samples.pixels, _TILE_PX)
    n = int(label.max()) + 1
    r, w = samples.rays, samples.inverse
    moments = [np.bincount(label, r[:, i] * r[:, j], n) for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
    M = np.stack([moments[k] for k in (0, 1, 2, 1, 3, 4, 2, 4, 5)], axis=1).reshape(n, 3, 3)
    b = np.stack([np.bincount(label, r[:, i] * w, n) for i in range(3)], axis=1)
    full = (np.bincount(label, minlength=n) >= _MIN_IN_TILE) & (np.linalg.cond(M) < 1e10)
    a = np.zeros((n, 3))
    a[full] = np.linalg.solve(M[full], b[full][..., None])[..., 0]
    level = full & (-(a @ up_cam) >= math.cos(math.radians(_TILE_TILT_DEG)) * np.linalg.norm(a, axis=1))
    return np.asarray(level[label])


def squares(pixels: Array, side_px: int) -> NDArray[np.intp]:
    """The number (n,) of the square of the image that each pixel (n, 2) lies in, counted from zero."""
    square = (pixels // side_px).astype(np.int64)
    return np.unique(square[:, 1] * 100_000 + square[:, 0], return_inverse=True)[1].ravel()


def fitted_plane(samples: FloorSamples, band_m: Array, near: Mask, free: Mask) -> SeenPlane | None:
    """The weighted least-squares plane on the free samples within the band of it, by fixed-point iteration.

    Three points leave the far end of a floor centimetres off: the band starts wider than it ends.
    """
    a = np.zeros(3)
    for widen in _WIDEN:
        if int(near.sum()) < MIN_INLIERS:
            return None
        W = 1.0 / samples.sigma[near] ** 2
        rays = samples.rays[near]
        information = (rays * W[:, None]).T @ rays
        if np.linalg.cond(information) > 1e12:
            return None
        a = np.linalg.solve(information, rays.T @ (W * samples.inverse[near]))
        near = free & (np.abs(plane_distances(samples, a)) <= widen * band_m)
    index = np.nonzero(near)[0]
    if len(index) < MIN_INLIERS:
        return None
    noise, bias = _covariances(samples, a, index)
    return SeenPlane(
        a=a,
        noise=noise,
        bias=bias,
        inliers=index,
        rms_m=float(np.sqrt(np.mean(plane_distances(samples, a)[index] ** 2))),
        share=len(index) / len(samples.inverse),
    )


def plane_distances(samples: FloorSamples, a: Array) -> Array:
    """Signed distances (n,) of the samples from a plane [m], positive on the camera's side."""
    return (samples.inverse - samples.rays @ a) / (samples.inverse * float(np.linalg.norm(a)))


def _covariances(samples: FloorSamples, a: Array, index: NDArray[np.intp]) -> tuple[Array, Array]:
    """(3, 3) each of a fitted ``a``: noise shared by neighbours, as modelled or as seen, and what bias may do."""
    rays, sigma = samples.rays[index], samples.sigma[index]
    W = 1.0 / sigma**2
    inverse_information = np.linalg.inv((rays * W[:, None]).T @ rays)
    modelled = inverse_information * len(index) / independent_count(len(index), stride=samples.stride)
    # Sandwich, clustered by blocks (Liang and Zeger, 1986): what residuals share within a block, whatever the model.
    score = rays * (W * (samples.inverse[index] - rays @ a))[:, None]
    label = squares(samples.pixels[index], _BLOCK_PX)
    sums = np.stack([np.bincount(label, score[:, i]) for i in range(3)], axis=1)
    seen = inverse_information @ (sums.T @ sums) @ inverse_information
    grown = max(1.0, float(np.trace(np.linalg.solve(modelled, seen))) / 3.0)
    slope = inverse_information @ (rays.T @ (W * samples.bias_slope[:, index]).T)
    lean = np.diag([samples.lean_sigma**2, samples.lean_sigma**2, 0.0])
    return grown * modelled, slope @ samples.bias_covariance @ slope.T + lean
