"""Depth of flat surfaces, averaged over small squares of the image.

Owns      cutting a surface's pixels into tiles, what one tile says, how sure it is.
Leaves    what all tiles together say to depth_fusion, which pixels belong to a surface to its callers.

Neighbouring pixels of a stereo matcher share their errors, so a square of them is about one measurement. Inverse depth
of a plane is linear in a pixel's ray (x, y, 1), and so is a stereo camera's bias: in inverse depth the mean over a
tile obeys the same equation as a pixel, without any error of averaging.

What is fixed of a pixel's error belongs to the camera: whatever lies there in another frame has it again. A target that
is waved in one place is not measured anew in each frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

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
MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Tiles:
    """n tiles of flat surfaces, in the depth images of some cameras."""

    camera: NDArray[np.int64]  # (n,) index
    target: NDArray[np.int64]  # (n,) index of the target's pose that the surface belongs to, or FLOOR
    normal: Array  # (n, 3) unit, target frame; zero on the floor
    offset_m: Array  # (n,) normal . X of the surface
    ray: Array  # (n, 3) mean of (x, y, 1)
    inverse: Array  # (n,) mean of 1 / measured depth [1/m]
    sigma: Array  # (n,) its standard deviation [1/m], without the camera's bias; makes the mean over all tiles right
    alone: Array  # (n,) that of a tile by itself, which its residual is to be compared with; at most sigma
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
        alone=number,
        block=index,
    )


def plane_in_camera(normal: Array, offset_m: float, T_cam_frame: Pose) -> Array:
    """The vector q (3,) with ``1 / z = q . (x, y, 1)`` for the plane normal . X = offset_m of a frame."""
    n = T_cam_frame[:3, :3] @ normal
    return n / (offset_m + float(n @ T_cam_frame[:3, 3]))


def predicted_inverse(tiles: Tiles, T_cam_target: Sequence[Pose]) -> Array:
    """Inverse depth (n,) [1/m] that tiles of one camera's faces should have, with its poses of the targets."""
    T = np.asarray(T_cam_target, dtype=np.float64).reshape(-1, 4, 4)[tiles.target]
    n = np.einsum("nij,nj->ni", T[:, :3, :3], tiles.normal)
    return (n * tiles.ray).sum(axis=1) / (tiles.offset_m + (n * T[:, :3, 3]).sum(axis=1))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Surface:
    """What is known of a flat surface beside its depth."""

    camera: int = 0
    target: int = FLOOR
    normal: Array = field(default_factory=lambda: np.zeros(3))
    offset_m: float = 0.0
    n_averaged: float = 1.0
    uneven_m: float = 0.0
    nearness: float = 0.0  # one over the camera's distance from its plane [1/m]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Squares:
    """Squares of the image on one surface."""

    cell: NDArray[np.int64]  # (n, 2) column and row, in tiles
    area_px: Array  # (n,) pixels of the image that took part
    ray: Array  # (n, 3) mean of (x, y, 1)
    inverse: Array  # (n,) mean of 1 / measured depth [1/m]


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
        faces: Of one camera; all of them at once, or what they share is not seen.
        camera: Its index.
        targets: Frames with a pose of the target; faces of others are left out.
        T_cam_target: The poses of these, near the truth.
        K: (3, 3) of the depth image.
        noise: Of this camera.
    """
    number = {frame: k for k, frame in enumerate(targets)}
    found: list[tuple[_Surface, _Squares]] = []
    for face in faces:
        k = number.get(face.frame)
        if k is None:
            continue
        q = plane_in_camera(face.normal_target, face.offset_m, T_cam_target[k])
        trusted = face.trusted
        surface = _Surface(
            camera=camera,
            target=k,
            normal=face.normal_target,
            offset_m=face.offset_m,
            n_averaged=face.n_averaged,
            uneven_m=FACE_UNEVEN_M,
            nearness=float(np.linalg.norm(q)),
        )
        found.append((surface, _squares(face.pixels[trusted], face.measured_m[trusted], q, K, noise)))
    return _as_tiles(found, noise)


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
    nearness = float(np.linalg.norm(q))
    surface = _Surface(camera=camera, n_averaged=n_averaged, uneven_m=FLOOR_UNEVEN_M, nearness=nearness)
    return _as_tiles([(surface, _squares(pixels, measured_m, q, K, noise, stride=stride))], noise)


def surface_tiles(
    pixels: Array, measured_m: Array, q: Array, K: Array, noise: DepthNoise, *, n_averaged: float, uneven_m: float
) -> Tiles:
    """Tiles of one flat surface that belongs to nothing: as if camera 0 had seen it on the floor.

    Args:
        pixels: (n, 2) on the surface.
        measured_m: (n,) depth there [m].
        q: (3,) the surface as it is expected, ``1 / z = q . (x, y, 1)``: only differences within a tile are asked.
        K: (3, 3) of the depth image.
        noise: Of one pixel.
        n_averaged: Depth images that were pooled.
        uneven_m: How flat the surface is [m].
    """
    surface = _Surface(n_averaged=n_averaged, uneven_m=uneven_m, nearness=float(np.linalg.norm(q)))
    return _as_tiles([(surface, _squares(pixels, measured_m, q, K, noise))], noise)


def _squares(pixels: Array, measured_m: Array, q: Array, K: Array, noise: DepthNoise, *, stride: int = 1) -> _Squares:
    """Squares of a surface that is expected at q; pixels (n, 2) are every stride-th in both directions."""
    if len(pixels) < MIN_PIXELS:
        empty = np.empty(0)
        return _Squares(cell=np.empty((0, 2), dtype=np.int64), area_px=empty, ray=np.empty((0, 3)), inverse=empty)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    inverse = 1.0 / measured_m
    column, row = (pixels // TILE_PX).astype(np.int64).T
    width = int(column.max()) + 1
    tile = row * width + column
    keep, rough = _belongs(inverse - rays @ q, tile, _pixel_sigma(measured_m, noise))
    labels, index, count = np.unique(tile[keep], return_inverse=True, return_counts=True)
    enough = (count >= max(MIN_PIXELS, (TILE_PX // stride) ** 2 // 8)) & ~np.isin(labels, rough)
    mean_ray = np.stack([np.bincount(index, x) for x in rays[keep].T], axis=1) / count[:, None]
    return _Squares(
        cell=np.stack([labels % width, labels // width], axis=1)[enough],
        area_px=count[enough] * float(stride**2),
        ray=mean_ray[enough],
        inverse=(np.bincount(index, inverse[keep]) / count)[enough],
    )


def _as_tiles(found: Sequence[tuple[_Surface, _Squares]], noise: DepthNoise) -> Tiles:
    """What the squares of one camera's surfaces say, and how sure they are together."""
    sizes = [len(squares.inverse) for _, squares in found]
    if not sum(sizes):
        return _nothing()
    cell, area_px, ray, inverse = (
        np.concatenate([getattr(squares, name) for _, squares in found])
        for name in ("cell", "area_px", "ray", "inverse")
    )
    camera, target, normal, offset_m, n_averaged, uneven_m, nearness = (
        np.repeat(np.array([getattr(surface, f.name) for surface, _ in found]), sizes, axis=0) for f in fields(_Surface)
    )
    sharing = _sharing(cell, target, area_px)
    block = cell // (BLOCK_PX // TILE_PX)
    model = {"n_averaged": n_averaged, "uneven_m": uneven_m, "nearness": nearness}
    return Tiles(
        camera=camera,
        target=target,
        normal=normal,
        offset_m=offset_m,
        ray=ray,
        inverse=inverse,
        sigma=tile_sigma(1.0 / inverse, area_px, sharing, noise, **model),
        alone=tile_sigma(1.0 / inverse, area_px, 1.0, noise, **model),
        block=block[:, 1] * 4096 + block[:, 0],
    )


def _sharing(cell: NDArray[np.int64], target: NDArray[np.int64], area_px: Array) -> Array:
    """Among how many tiles (n,) each one's fixed error is divided.

    Tiles are treated as independent. They are not, where they are smaller than what shares one error, and where
    several frames see the same part of the image; so each is taken for as uncertain as makes the mean over all right.
    No more can share an error than lie in the same cell or beside it.

    Args:
        cell: (n, 2) column and row.
        target: (n,) the moment.
        area_px: (n,) pixels.
    """
    place = cell - cell.min(axis=0) + 1
    shape = tuple(place.max(axis=0) + 2)
    number, moments = np.zeros(shape), np.zeros(shape)
    np.add.at(number, tuple(place.T), 1.0)
    np.add.at(moments, tuple(np.unique(np.column_stack([place, target]), axis=0)[:, :2].T), 1.0)
    # A border of nothing goes around them, so that nothing comes back on the other side.
    near = sum(np.roll(number, (i, j), axis=(0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1))
    here = tuple(place.T)
    return np.clip(moments[here] * CORRELATION_PX**2 / area_px, 1.0, np.asarray(near)[here])


def tile_sigma(
    depth_m: ArrayLike,
    area_px: ArrayLike,
    sharing: ArrayLike,
    noise: DepthNoise,
    *,
    n_averaged: ArrayLike,
    uneven_m: ArrayLike,
    nearness: ArrayLike | None = None,
) -> Array:
    """Standard deviation (n,) of a tile's mean inverse depth [1/m].

    A bump u of a plane at the distance o from the camera changes ``1 / z`` by ``u / (z o)``: under a grazing look
    by more than by u along the optical axis.

    Args:
        depth_m: (n,) of the tiles.
        area_px: (n,) pixels of the image that they cover.
        sharing: (n,) tiles that have the same fixed error; below one, parts of a tile with errors of their own.
        noise: Of one pixel.
        n_averaged: Depth images that were pooled.
        uneven_m: How flat the surface is, across itself [m].
        nearness: One over the distance of the camera from its plane [1/m]; None: it is looked at face on.
    """
    z, area, shared, uneven = (np.asarray(x, dtype=np.float64) for x in (depth_m, area_px, sharing, uneven_m))
    bump_m = uneven * (1.0 if nearness is None else z * np.asarray(nearness, dtype=np.float64))
    fixed2 = noise.fixed_sigma_m(z) ** 2
    changing2 = np.maximum(noise.averaged_sigma_m(z, n_averaged) ** 2 - fixed2, 0.0)
    variance = (fixed2 + bump_m**2) * shared + changing2 * np.minimum(TEMPORAL_CORRELATION_PX**2 / area, 1.0)
    return np.sqrt(variance) / z**2


def face_sigma_m(depth_m: float, n_pixels: int, n_averaged: int, noise: DepthNoise) -> float:
    """Standard deviation [m] of the typical error of one face, or of a part of it that shares no error with another."""
    parts = CORRELATION_PX**2 / max(n_pixels, CORRELATION_PX**2)
    sigma = tile_sigma(depth_m, n_pixels, parts, noise, n_averaged=n_averaged, uneven_m=FACE_UNEVEN_M)
    return float(sigma) * depth_m**2


def _pixel_sigma(measured_m: Array, noise: DepthNoise) -> Array:
    """Of inverse depth [1/m]."""
    return noise.sigma_m(measured_m) / measured_m**2


def _belongs(off: Array, tile: NDArray[np.int64], sigma: Array) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which pixels (n,) lie on the surface that most of their tile lies on, and the tiles without such a surface."""
    labels, index = np.unique(tile, return_inverse=True)
    distance = np.abs(off - _medians(off, index)[index])
    spread = MAD_TO_SIGMA * _medians(distance, index)
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
