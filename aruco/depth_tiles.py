"""Depth of flat surfaces, averaged over small squares of the image.

Owns      cutting a surface's pixels into tiles, what one tile says, how sure it is.
Leaves    what all tiles together say to depth_fusion, which pixels belong to a surface to its callers.

Neighbouring pixels of a stereo matcher share their errors, so a square of them is about one measurement. Inverse depth
of a plane is linear in a pixel's ray (x, y, 1), and so is a stereo camera's bias: in inverse depth the mean over a
tile obeys the same equation as a pixel, without any error of averaging.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from aruco.depth_noise import CORRELATION_PX, TEMPORAL_CORRELATION_PX, DepthNoise
from aruco.depth_patches import FaceDepth
from aruco.pose_math import Array, Pose, invert_transform

# Side of a tile: a little less than errors reach, so that a marker at the far end of a room still is a tile of its own.
TILE_PX = 24
# Tiles that are tested together against others: neighbours share errors, squares of this side only at their borders.
BLOCK_PX = 96
# A tile at the rim of a surface has fewer pixels than TILE_PX^2; fewer than this make no median.
MIN_PIXELS = 16
# Pixels this many robust standard deviations off their tile's median do not belong to the surface.
CLIP = 3.5
# A tile that is this many times as rough as usual lies across two surfaces.
MAX_ROUGHNESS = 3.0
# Index of the surface that all cameras see and no marker measures.
FLOOR = -1
# Floors are laid to a few millimetres over two metres, prints bulge by one.
FLOOR_UNEVEN_M = 0.002
FACE_UNEVEN_M = 0.001
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tiles:
    """n tiles of flat surfaces, in the depth images of some cameras."""

    camera: NDArray[np.int64]  # (n,) index
    target: NDArray[np.int64]  # (n,) index of the target's pose that the surface belongs to, or FLOOR
    normal: Array  # (n, 3) unit, target frame; zero on the floor
    offset_m: Array  # (n,) normal . X of the surface
    ray: Array  # (n, 3) mean of (x, y, 1)
    inverse: Array  # (n,) mean of 1 / measured depth [1/m]
    sigma: Array  # (n,) its standard deviation [1/m], without the camera's bias
    block: NDArray[np.int64]  # (n,) which part of the image it lies in, for tests on what was not used

    def __len__(self) -> int:
        """How many there are."""
        return len(self.inverse)

    def only(self, keep: NDArray[np.bool_]) -> Tiles:
        """The tiles where a mask (n,) is true."""
        return Tiles(**{field.name: getattr(self, field.name)[keep] for field in fields(self)})


def joined(parts: Sequence[Tiles]) -> Tiles:
    """All tiles of several."""
    if not parts:
        return _nothing()
    return Tiles(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Tiles)})


def _nothing() -> Tiles:
    index, number, vector = np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, 3))
    return Tiles(
        camera=index,
        target=index,
        normal=vector,
        offset_m=number,
        ray=vector,
        inverse=number,
        sigma=number,
        block=index,
    )


def plane_in_camera(normal: Array, offset_m: float, T_cam_frame: Pose) -> Array:
    """The vector q (3,) with ``1 / z = q . (x, y, 1)`` for the plane normal . X = offset_m of a frame."""
    n = T_cam_frame[:3, :3] @ normal
    return n / (offset_m + float(n @ T_cam_frame[:3, 3]))


def face_tiles(
    faces: Sequence[FaceDepth],
    camera: int,
    targets: Sequence[int],
    T_cam_target: Sequence[Pose],
    K: Array,
    noise: DepthNoise,
) -> Tiles:
    """The tiles of a camera's faces.

    Args:
        faces: Of one camera.
        camera: Its index.
        targets: Frames with a pose of the target; faces of others are left out.
        T_cam_target: The poses of these, near the truth.
        K: (3, 3) of the depth image.
        noise: Of this camera.
    """
    number = {frame: k for k, frame in enumerate(targets)}
    parts: list[Tiles] = []
    for face in faces:
        k = number.get(face.frame)
        if k is None:
            continue
        q = plane_in_camera(face.normal_target, face.offset_m, T_cam_target[k])
        trusted = face.trusted
        tiles = surface_tiles(
            face.pixels[trusted],
            face.measured_m[trusted],
            q,
            K,
            noise,
            n_averaged=face.n_averaged,
            uneven_m=FACE_UNEVEN_M,
        )
        ones = np.ones(len(tiles))
        parts.append(
            replace(
                tiles,
                camera=np.full(len(tiles), camera),
                target=np.full(len(tiles), k),
                normal=ones[:, None] * face.normal_target,
                offset_m=ones * face.offset_m,
            )
        )
    return joined(parts)


def floor_tiles(
    pixels: Array,
    measured_m: Array,
    camera: int,
    floor: tuple[Array, float],
    T_world_cam: Pose,
    K: Array,
    noise: DepthNoise,
    *,
    n_averaged: float,
    stride: int,
) -> Tiles:
    """The tiles of what a camera sees of the floor.

    Args:
        pixels: (n, 2) in the depth image, every stride-th in both directions.
        measured_m: (n,) depth there [m].
        camera: Its index.
        floor: Normal (3,) and normal . X of the floor, world.
        T_world_cam: The camera's pose.
        K: (3, 3) of the depth image.
        noise: Of this camera.
        n_averaged: Depth images that were pooled.
        stride: See pixels.
    """
    q = plane_in_camera(*floor, invert_transform(T_world_cam))
    tiles = surface_tiles(
        pixels, measured_m, q, K, noise, n_averaged=n_averaged, uneven_m=FLOOR_UNEVEN_M, stride=stride
    )
    return replace(tiles, camera=np.full(len(tiles), camera))


def surface_tiles(
    pixels: Array,
    measured_m: Array,
    q: Array,
    K: Array,
    noise: DepthNoise,
    *,
    n_averaged: float,
    uneven_m: float,
    stride: int = 1,
) -> Tiles:
    """Tiles of one flat surface, of camera 0 and on the floor until the caller says otherwise.

    Args:
        pixels: (n, 2) on the surface.
        measured_m: (n,) depth there [m].
        q: (3,) the surface as it is expected, ``1 / z = q . (x, y, 1)``: only differences within a tile are asked.
        K: (3, 3) of the depth image.
        noise: Of one pixel.
        n_averaged: Depth images that were pooled.
        uneven_m: How flat the surface is [m].
        stride: The pixels are every stride-th in both directions.
    """
    if len(pixels) < MIN_PIXELS:
        return _nothing()
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    inverse = 1.0 / measured_m
    column, row = (pixels // TILE_PX).astype(np.int64).T
    tile = row * (int(column.max()) + 1) + column
    off = inverse - rays @ q
    keep, rough = _belongs(off, tile, _pixel_sigma(measured_m, noise))
    rays, inverse, measured_m, tile, pixels = rays[keep], inverse[keep], measured_m[keep], tile[keep], pixels[keep]
    labels, first, index, count = np.unique(tile, return_index=True, return_inverse=True, return_counts=True)
    enough = (count >= max(MIN_PIXELS, (TILE_PX // stride) ** 2 // 8)) & ~np.isin(labels, rough)
    mean_ray = np.stack([np.bincount(index, x) for x in rays.T], axis=1) / count[:, None]
    mean = np.bincount(index, inverse) / count
    n_tiles = max(int(enough.sum()), 1)
    sigma = tile_sigma(1.0 / mean, count * float(stride**2), n_tiles, noise, n_averaged=n_averaged, uneven_m=uneven_m)
    block = (pixels[first] // BLOCK_PX).astype(np.int64)
    n = len(labels)
    tiles = Tiles(
        camera=np.zeros(n, dtype=np.int64),
        target=np.full(n, FLOOR),
        normal=np.zeros((n, 3)),
        offset_m=np.zeros(n),
        ray=mean_ray,
        inverse=mean,
        sigma=sigma,
        block=block[:, 1] * 4096 + block[:, 0],
    )
    return tiles.only(enough)


def tile_sigma(
    depth_m: Array, area_px: Array, n_tiles: int, noise: DepthNoise, *, n_averaged: float, uneven_m: float
) -> Array:
    """Standard deviation (n,) of a tile's mean inverse depth [1/m].

    Tiles are treated as independent. They are not, where they are smaller than what shares one error; so each of
    many is taken for as uncertain as makes the mean over all of them right.

    Args:
        depth_m: (n,) of the tiles.
        area_px: (n,) pixels of the image that they cover.
        n_tiles: Of the same surface.
        noise: Of one pixel.
        n_averaged: Depth images that were pooled.
        uneven_m: How flat the surface is [m].
    """
    fixed = noise.fixed_sigma_m(depth_m)
    changing2 = np.maximum(noise.sigma_m(depth_m) ** 2 - fixed**2, 0.0) / n_averaged
    sharing = np.clip(CORRELATION_PX**2 / area_px, 1.0, n_tiles)
    variance = (fixed**2 + uneven_m**2) * sharing + changing2 * np.minimum(TEMPORAL_CORRELATION_PX**2 / area_px, 1.0)
    return np.sqrt(variance) / depth_m**2


def _pixel_sigma(measured_m: Array, noise: DepthNoise) -> Array:
    """Of inverse depth [1/m]."""
    return noise.sigma_m(measured_m) / measured_m**2


def _belongs(off: Array, tile: NDArray[np.int64], sigma: Array) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which pixels (n,) lie on the surface that most of their tile lies on, and the tiles without such a surface."""
    labels, index = np.unique(tile, return_inverse=True)
    distance = np.abs(off - _medians(off, index)[index])
    spread = _MAD_TO_SIGMA * _medians(distance, index)
    roughness = spread / _medians(sigma, index)
    rough = roughness > MAX_ROUGHNESS * max(float(np.median(roughness)), 1e-9)
    return distance <= np.maximum(CLIP * spread, 1e-9)[index], labels[rough]


def _medians(values: Array, group: NDArray[np.intp]) -> Array:
    """The median (k,) of the values (n,) of each group; groups are numbered without gaps."""
    order = np.lexsort((values, group))
    sizes = np.bincount(group)
    start = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    ordered = values[order]
    return (ordered[start + (sizes - 1) // 2] + ordered[start + sizes // 2]) / 2
