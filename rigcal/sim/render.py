"""Pictures of a scene, by casting rays.

Owns      visibility, light, the exact average of brightness over a pixel, exact depth.
Leaves    what a sensor makes of it to noise.

A pixel is the mean over its square, [-0.5, 0.5] around its centre. One ray a pixel finds out where the picture is
smooth; near edges more rays find out which pixels an edge crosses, and those are averaged over many rays. Which
panel a ray meets is Open3D's answer; where it meets it, and so every depth and every cell of a print, is computed
here in float64.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.model import Camera
from aruco.pose_math import Array, Pose, invert_transform, transform_points
from rigcal.sim.rays import rays_inside, row_rays
from rigcal.sim.scene import BLACK_ALBEDO, WHITE_ALBEDO, Light, Panel, Print, Scene
from rigcal.sim.texture import TILE_PERIOD_M, texture_tile

# Rays in flight at once: about 100 bytes each, so a band stays below 100 MB whatever the picture's size.
_RAYS_AT_ONCE = 600_000
# The fractional part of the golden ratio: multiples of it fill an interval most evenly.
_GOLDEN = (5**0.5 - 1) / 2
# How the rays of a pixel (u, v) are shifted against those of pixel (0, 0): evenly along rows and along columns.
_SHIFTS = np.array([[0.7548776662466927, _GOLDEN], [_GOLDEN, 0.5698402909980532]])


@dataclass(frozen=True, slots=True, eq=False)
class _SeenPrint:
    panel: int
    # Position on the print in cells, divided by depth, as a linear function of (x, y, 1) and of inverse depth.
    to_cells: Array  # (2, 3)
    shift: Array  # (2,)
    white: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A scene in the frame of one camera; the last entry of each table stands for 'no panel'."""

    caster: Any  # open3d.t.geometry.RaycastingScene
    panel_of_triangle: NDArray[np.intp]
    inverse_depth: Array  # (3, n + 1): 1 / z = inverse_depth . (x, y, 1)
    paint_axes: Array  # (2, 3, n + 1): texture coordinates [m] are z * (paint_axes . (x, y, 1)) + paint_shift
    paint_shift: Array  # (2, n + 1)
    albedo: NDArray[np.float32]  # (n + 1,)
    contrast: NDArray[np.float32]  # (n + 1,)
    lamp_distance: NDArray[np.float32]  # (n + 1,) of the lamp from the panel's plane, on the camera's side; else 0
    prints: tuple[_SeenPrint, ...]
    light: Light
    lamp_cam: Array  # (3,)


def render_image(scene: Scene, camera: Camera, T_world_cam: Pose, *, rays_per_pixel: int = 55) -> NDArray[np.float32]:
    """The noise-free picture of a scene.

    Args:
        scene: What there is.
        camera: Intrinsics; distortion is honoured.
        T_world_cam: Where the camera is.
        rays_per_pixel: Rays for a pixel that an edge crosses; Fibonacci numbers spread best.

    Returns:
        (h, w) linear brightness, where 1 is a white surface in full light.
    """
    view = _look(scene, T_world_cam)
    image = np.empty((camera.height, camera.width), dtype=np.float32)
    keys = np.empty((camera.height, camera.width), dtype=np.int32)
    for rows in _bands(camera):
        image[rows], keys[rows] = _shade(view, *row_rays(camera, rows))
    _average_edges(view, camera, image, keys, rays_per_pixel)
    return image


def render_depth(scene: Scene, camera: Camera, T_world_cam: Pose) -> NDArray[np.float32]:
    """The exact depth along the optical axis at each pixel's centre.

    Args:
        scene: What there is.
        camera: Intrinsics; depth images are rectified, so this is a pinhole with ``depth_K`` (or ``K``).
        T_world_cam: Where the camera is.

    Returns:
        (h, w) metres, NaN where nothing is.
    """
    view = _look(scene, T_world_cam)
    K = camera.K_depth
    rectified = Camera(name=camera.name, width=camera.width, height=camera.height, K=K)
    depth_m = np.empty((camera.height, camera.width), dtype=np.float32)
    for rows in _bands(camera):
        x, y = row_rays(rectified, rows)
        panel = _first_panel(view, x, y)
        with np.errstate(divide="ignore"):
            z = 1.0 / _linear(view.inverse_depth, panel, x, y)
        depth_m[rows] = np.where(panel == len(view.albedo) - 1, np.nan, z)
    return depth_m


def _bands(camera: Camera) -> Iterator[slice]:
    height = max(1, _RAYS_AT_ONCE // camera.width)
    for top in range(0, camera.height, height):
        yield slice(top, min(top + height, camera.height))


def _look(scene: Scene, T_world_cam: Pose) -> _View:
    import open3d as o3d

    T_cam_world = invert_transform(T_world_cam)
    polygons = [transform_points(T_cam_world, panel.vertices) for panel in scene.panels]
    lamp_cam = transform_points(T_cam_world, np.array(scene.light.lamp_at_m))
    n = len(polygons)
    vertices = np.concatenate([*polygons, np.zeros((0, 3))]).astype(np.float32)
    triangles, owners = _fans([len(polygon) for polygon in polygons])
    caster = o3d.t.geometry.RaycastingScene()
    caster.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))
    inverse_depth, axes, shift = np.zeros((3, n + 1)), np.zeros((2, 3, n + 1)), np.zeros((2, n + 1))
    inverse_depth[2, n] = 1.0
    lamp_distance = np.zeros(n + 1, dtype=np.float32)
    for k, polygon in enumerate(polygons):
        inverse_depth[:, k], u, v, side = _plane(polygon)
        axes[:, :, k], shift[:, k] = (u, v), (-u @ polygon[0], -v @ polygon[0])
        lamp_distance[k] = max(0.0, (lamp_cam - polygon[0]) @ side)
    return _View(
        caster=caster,
        panel_of_triangle=owners,
        inverse_depth=inverse_depth,
        paint_axes=axes,
        paint_shift=shift,
        albedo=np.array([p.albedo for p in scene.panels] + [scene.background], dtype=np.float32),
        contrast=np.array([p.contrast for p in scene.panels] + [0.0], dtype=np.float32),
        lamp_distance=lamp_distance,
        prints=tuple(_seen_prints(scene.panels, T_cam_world)),
        light=scene.light,
        lamp_cam=lamp_cam,
    )


def _fans(sizes: list[int]) -> tuple[NDArray[np.uint32], NDArray[np.intp]]:
    """Triangles (m, 3) of polygons listed one after the other, and the polygon of each triangle (m,)."""
    triangles, owners, first = [], [], 0
    for k, size in enumerate(sizes):
        triangles += [(first, first + i, first + i + 1) for i in range(1, size - 1)]
        owners += [k] * (size - 2)
        first += size
    return np.array(triangles, dtype=np.uint32).reshape(-1, 3), np.array(owners, dtype=np.intp)


def _plane(polygon: Array) -> tuple[Array, Array, Array, Array]:
    """Inverse depth of a polygon's plane, its two axes, and its unit normal towards the camera, each (3,)."""
    u = _unit(polygon[1] - polygon[0])
    normal = _unit(np.cross(u, polygon[-1] - polygon[0]).astype(np.float64))
    distance = float(normal @ polygon[0])
    towards = -normal if distance > 0 else normal
    # A plane through the camera's centre is seen edge-on: no ray meets it.
    return normal / (distance if distance != 0 else np.inf), u, np.cross(normal, u), towards


def _unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def _seen_prints(panels: tuple[Panel, ...], T_cam_world: Pose) -> Iterator[_SeenPrint]:
    for k, panel in enumerate(panels):
        for printed in panel.prints:
            corners = transform_points(T_cam_world, printed.corners)
            right, down = corners[1] - corners[0], corners[3] - corners[0]
            if np.cross(right, down) @ corners[0] > 0:
                yield _seen_print(k, printed, corners[0], right, down)


def _seen_print(panel: int, printed: Print, corner: Array, right: Array, down: Array) -> _SeenPrint:
    # The dual basis: right . to_right = 1, down . to_right = 0, and the reverse for the other one.
    rows, columns = printed.white.shape
    dual = np.asarray(np.linalg.pinv(np.stack([right, down], axis=1)) * [[columns], [rows]], dtype=np.float64)
    return _SeenPrint(panel=panel, to_cells=dual, shift=-dual @ corner, white=printed.white)


def _linear(table: Array, panel: NDArray[np.intp], x: Array, y: Array) -> Array:
    total = table[0].take(panel)
    total *= x
    second = table[1].take(panel)
    second *= y
    total += second
    total += table[2].take(panel)
    return total


def _first_panel(view: _View, x: Array, y: Array) -> NDArray[np.intp]:
    """Index of the panel that each ray (x, y, 1) meets first; the number of panels where it meets none."""
    import open3d as o3d

    rays = np.zeros((*x.shape, 6), dtype=np.float32)
    rays[..., 3], rays[..., 4], rays[..., 5] = x, y, 1.0
    lost = ~np.isfinite(x)  # outside of what the lens can see
    rays[lost] = 0.0
    triangle = view.caster.cast_rays(o3d.core.Tensor(rays))["primitive_ids"].numpy()
    triangle[lost] = o3d.t.geometry.RaycastingScene.INVALID_ID
    owners = np.append(view.panel_of_triangle, len(view.albedo) - 1)
    return owners.take(triangle, mode="clip")  # the number of "no triangle" is larger than any


def _shade(view: _View, x: Array, y: Array) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Brightness along rays (x, y, 1) of shape (r, c), and a number that differs where the paint differs."""
    panel = _first_panel(view, x, y)
    if np.isnan(x).any():  # rays outside of the lens, which met no panel
        x, y = np.nan_to_num(x), np.nan_to_num(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = 1.0 / _linear(view.inverse_depth, panel, x, y)
    albedo = view.albedo.take(panel)
    if view.contrast.any():
        albedo *= 1.0 + view.contrast.take(panel) * _texture(view, panel, x, y, z)
    key = panel.astype(np.int32) * 4
    for printed in view.prints:
        _lay_print(printed, panel, x, y, z, albedo, key)
    return albedo * _irradiance(view, panel, x, y, z), key


def _texture(view: _View, panel: NDArray[np.intp], x: Array, y: Array, z: Array) -> NDArray[np.float32]:
    tile = texture_tile()
    per_m = len(tile) / TILE_PERIOD_M
    u, v = (
        ((_linear(axes, panel, x, y) * z + shift.take(panel)) * per_m).astype(np.float32)
        for axes, shift in zip(view.paint_axes, view.paint_shift)
    )
    return np.asarray(cv2.remap(tile, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), dtype=np.float32)


def _lay_print(
    printed: _SeenPrint,
    panel: NDArray[np.intp],
    x: Array,
    y: Array,
    z: Array,
    albedo: NDArray[np.float32],
    key: NDArray[np.int32],
) -> None:
    """Paint one print over the albedo, in place; keys get 1 on the margin, 2 on white and 3 on black cells."""
    at = np.nonzero(panel == printed.panel)
    if not len(at[0]):
        return
    rays = np.stack([x[at], y[at], np.ones(len(at[0]))])
    column, row = np.floor((printed.to_cells @ rays) * z[at] + printed.shift[:, None]).astype(np.int64)
    n_rows, n_columns = printed.white.shape
    inside = (column >= 0) & (column < n_columns) & (row >= 0) & (row < n_rows)
    # The margin never covers a neighbour's cells.
    margin = (column >= -1) & (column <= n_columns) & (row >= -1) & (row <= n_rows) & ~inside & (key[at] % 4 == 0)
    white = np.zeros_like(inside)
    white[inside] = printed.white[row[inside], column[inside]]
    ink = np.select([margin, white, inside], [1, 2, 3], default=0)
    key[at] = np.where(ink > 0, panel[at] * 4 + ink, key[at])
    albedo[at] = np.select([ink == 3, ink > 0], [np.float32(BLACK_ALBEDO), np.float32(WHITE_ALBEDO)], albedo[at])


def _irradiance(view: _View, panel: NDArray[np.intp], x: Array, y: Array, z: Array) -> NDArray[np.float32]:
    """Lambert's law for a point lamp: cos / distance^2, where cos = (distance from the plane) / distance."""
    if view.light.lamp == 0:
        return np.where(panel == len(view.albedo) - 1, np.float32(1.0), np.float32(view.light.ambient))
    near = np.float32(view.light.lamp * view.light.lamp_at_m[1] ** 2)
    x_lamp, y_lamp, z_lamp = view.lamp_cam.astype(np.float32)
    t = z.astype(np.float32)
    squared = (x.astype(np.float32) * t - x_lamp) ** 2 + (y.astype(np.float32) * t - y_lamp) ** 2 + (t - z_lamp) ** 2
    lit = view.lamp_distance.take(panel)
    lit *= near
    lit /= squared * np.sqrt(squared)
    lit += np.float32(view.light.ambient)
    lit[panel == len(view.albedo) - 1] = 1.0
    return lit


def _average_edges(view: _View, camera: Camera, image: NDArray[np.float32], keys: NDArray[np.int32], rays: int) -> None:
    """Replace, in place, each pixel that an edge crosses by the mean of many rays."""
    # Filters want a type that they know; 2^24 numbers fit a float32 exactly.
    square, key = np.ones((3, 3), np.uint8), keys.astype(np.float32)
    rows, columns = np.nonzero(cv2.dilate(key, square) != cv2.erode(key, square))
    # A straight edge through a pixel parts its corners; the middles of the sides catch the tips of surfaces too.
    u, v = np.meshgrid([-0.5, 0.0, 0.5], [-0.5, 0.0, 0.5])
    outline = np.stack([u.ravel(), v.ravel()], axis=1)
    crossed = np.zeros(len(rows), dtype=bool)
    for part in _parts(len(rows), len(outline)):
        pixels = np.stack([columns[part], rows[part]], axis=1).astype(np.float64)
        _, found = _shade(view, *rays_inside(camera, pixels, np.broadcast_to(outline, (len(pixels), 9, 2))))
        crossed[part] = (found != keys[rows[part], columns[part], None]).any(axis=1)
    rows, columns = rows[crossed], columns[crossed]
    lattice = _lattice(rays)
    for part in _parts(len(rows), rays):
        pixels = np.stack([columns[part], rows[part]], axis=1).astype(np.float64)
        # Another shift in each pixel makes the mean along an edge unbiased, whatever the edge's direction.
        offsets = (lattice + (pixels @ _SHIFTS)[:, None, :]) % 1.0 - 0.5
        value, _ = _shade(view, *rays_inside(camera, pixels, offsets))
        image[rows[part], columns[part]] = value.mean(axis=1)


def _parts(count: int, rays: int) -> Iterator[slice]:
    # OpenCV interpolates textures in images of fewer than 2^15 rows.
    step = min(max(1, _RAYS_AT_ONCE // rays), 2**15 - 2)
    for first in range(0, count, step):
        yield slice(first, first + step)


def _lattice(n: int) -> Array:
    """Points (n, 2) that fill the unit square, seen as a torus, most evenly: Korobov's lattice of golden ratio."""
    step = next(k for k in range(max(1, round(n * _GOLDEN)), n + 1) if math.gcd(k, n) == 1)
    index = np.arange(n)
    return np.stack([index / n, index * step % n / n], axis=1)
