"""The usable depth of one camera as a cloud of surface samples.

Owns      Cloud: which samples take part, how well they are known, which of them share errors.
Leaves    surfaces to icp_surface, large planes to icp_planes, which samples meet to icp_match.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.depth_bias import DepthBias
from aruco.depth_noise import CORRELATION_PX
from aruco.floor_plane import FloorPlane, Mask
from aruco.floor_view import SeenPlane, squares
from aruco.icp_planes import Planes, find_planes
from aruco.icp_surface import Surfaces, fit_surfaces, near_crease
from aruco.icp_types import ICPConfig
from aruco.icp_view import View, usable_view
from aruco.pose_math import Array, Pose, transform_points

# Directions that are less well known pretend to know: their noise looks like structure, and is shared over a window.
MAX_SIGMA_RAD = math.radians(6.0)
# Walls and sides of things, with what noise does to their normals.
_UPRIGHT_SINE = math.sin(math.radians(30.0))
# Surfaces seen more from the side than this are not worth measuring; see depth_mask.mask_grazing.
_MOST_GRAZING_DEG = 80.0
# What lies under the floor by noise or bias belongs to the band above it.
_BELOW_M = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """Samples of the surfaces that one camera sees, given bias taken out; one each few pixels, in its frame."""

    camera: str
    shape: tuple[int, int]  # of the depth image
    K: Array  # (3, 3)
    stride: int
    grid: NDArray[np.int32]  # (ceil(h / stride), ceil(w / stride)) sample of a square of stride pixels, or -1
    pixels: Array  # (n, 2)
    rays: Array  # (n, 3), z = 1
    depth_m: Array  # (n,)
    sigma_m: Array  # (n,) along z, of one correlation cell: what its samples share
    slopes: Array  # (4, n) of depth by (scale, inverse depth or offset, lean x, lean y): true = depth_m + slopes.T @ b
    bias_covariance: Array  # (4, 4) of b, whose mean is zero
    normals: Array  # (n, 3) unit, towards the camera
    normal_sigma: Array  # (n,) [rad]; 0 where the normal is a large plane's
    cell: NDArray[np.intp]  # (n,) square of depth_noise.CORRELATION_PX, numbered from 0: its samples share errors
    is_floor: Mask  # (n,)
    given_bias: DepthBias | None
    focal_baseline: float | None
    floor: SeenPlane | None = None  # the floor as the camera itself sees it; its inliers do not index the samples

    def __len__(self) -> int:
        """How many samples."""
        return len(self.depth_m)

    @property
    def points(self) -> Array:
        """(n, 3) [m], camera frame."""
        return self.rays * self.depth_m[:, None]


def cloud_of(
    camera: str,
    data: Mapping[str, Any],
    config: ICPConfig,
    *,
    T_world_cam: Pose,
    floor: FloorPlane | None,
    bias: DepthBias | None = None,
) -> Cloud:
    """The cloud of one camera.

    Args:
        camera: Its name, for messages.
        data: ``depth`` (h, w) [m] and its ``K`` (3, 3); optional ``confidence`` (h, w), ``baseline`` [m], ``n_frames``
            that were pooled, ``bias``.
        config: Region, voxel size, stride, seed and up.
        T_world_cam: Pose, which tells up from level; a few degrees do not matter.
        floor: The rig's floor, world. Heights count from the plane that the camera itself sees near it; None: there is
            no floor, and everything takes part.
        bias: Is taken out; default: that of the data.

    Raises:
        InputError: The data are no depth image with intrinsics of its own.
    """
    view = usable_view(camera, data, config.stride, bias)
    up = np.asarray(config.up, dtype=np.float64) if floor is None else floor.normal
    surfaces = fit_surfaces(view.squares, float(view.K[0, 0]), view.samples.sigma)
    planes = find_planes(
        view.samples,
        view.squares,
        surfaces,
        T_world_cam=T_world_cam,
        floor=floor,
        up=up,
        rng=np.random.default_rng([config.seed, zlib.crc32(camera.encode())]),
    )
    normals, normal_sigma = _directions(surfaces, planes)
    is_floor = (planes.label == 0) & planes.has_floor
    keep = (surfaces.sound | (planes.label >= 0)) & ~planes.stray
    keep &= _faces_the_camera(view.samples.rays, normals) & (normal_sigma <= MAX_SIGMA_RAD)
    keep &= ~near_crease(view.squares, normals, keep)
    if floor is not None:
        heights = _heights(view.samples.points, planes.floor, floor, T_world_cam)
        upright = np.abs(normals @ (T_world_cam[:3, :3].T @ up)) <= _UPRIGHT_SINE
        keep &= is_floor | _in_region(heights, upright, config)
    chosen, grid = _thinned(view, keep, config.voxel_size)
    pixels = view.samples.pixels[chosen]
    return Cloud(
        camera=camera,
        shape=view.shape,
        K=view.K,
        stride=config.stride,
        grid=grid,
        rays=view.samples.rays[chosen],
        depth_m=1.0 / view.samples.inverse[chosen],
        sigma_m=surfaces.noise_scale * view.sigma_m[chosen],
        slopes=view.slopes[:, chosen],
        bias_covariance=view.bias_covariance,
        normals=normals[chosen],
        normal_sigma=normal_sigma[chosen],
        pixels=pixels,
        cell=squares(pixels, int(CORRELATION_PX)),
        is_floor=is_floor[chosen],
        given_bias=view.given_bias,
        focal_baseline=view.focal_baseline,
        floor=planes.floor,
    )


def _directions(surfaces: Surfaces, planes: Planes) -> tuple[Array, Array]:
    """Normals (n, 3) and their sigmas (n,): a plane's where there is one."""
    flat = planes.label >= 0
    normals, sigma = surfaces.normals, surfaces.normal_sigma.copy()
    if flat.any():
        normals[flat] = np.array([plane.normal for plane in planes.seen])[planes.label[flat]]
        sigma[flat] = planes.normal_sigma[planes.label[flat]]
    return normals, sigma


def _faces_the_camera(rays: Array, normals: Array) -> Mask:
    """Samples (n,) whose surface is not seen nearly from the side."""
    with np.errstate(invalid="ignore"):
        return -(rays * normals).sum(axis=1) >= math.cos(math.radians(_MOST_GRAZING_DEG)) * np.linalg.norm(rays, axis=1)


def _heights(points: Array, own: SeenPlane | None, floor: FloorPlane, T_world_cam: Pose) -> Array:
    """Heights (n,) above the floor that the camera sees, or above the rig's."""
    if own is None:
        return floor.distances(transform_points(T_world_cam, points))
    return points @ own.normal + own.distance_m


def _in_region(heights: Array, upright: Mask, config: ICPConfig) -> Mask:
    """Samples (n,) that take part."""
    if config.region == "full":
        return np.ones(len(heights), dtype=bool)
    band = (heights >= -_BELOW_M) & (heights <= config.band_height)
    return band | upright if config.region == "hybrid" else band


def _thinned(view: View, keep: Mask, voxel_m: float) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """Samples (m,) to keep, the first of each voxel in the order of the image, and the grid that leads to them.

    The nearest of a voxel would be the one whose noise is towards the camera.
    """
    index = np.flatnonzero(keep)
    voxel = np.floor(view.samples.points[index] / voxel_m).astype(np.int64)
    voxel -= voxel.min(axis=0, initial=0)
    size = voxel.max(axis=0, initial=0) + 1
    key = (voxel[:, 0] * size[1] + voxel[:, 1]) * size[2] + voxel[:, 2]
    _, first, member = np.unique(key, return_index=True, return_inverse=True)
    order = np.argsort(first)  # voxels by their first sample, so that samples stay in the order of the image
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    grid = np.full(view.squares.grid, -1, dtype=np.int32)
    grid[view.squares.row[index], view.squares.column[index]] = rank[member.ravel()]
    return index[first[order]], grid
