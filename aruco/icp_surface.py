"""Surfaces in a depth image: what small squares of it measure, and the plane through the surroundings of each.

Owns      means over squares of pixels, plane fits in inverse depth over windows of a given size in the world.
Leaves    masks to depth_mask, planes that are larger than a window to icp_planes.

A plane is linear in inverse depth along rays, 1 / z = a . r, and disparity noise is the same everywhere there and has
no bias; see floor_view. Sums over windows come from summed-area tables, so each window may have a size of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.depth_noise import CORRELATION_PX
from aruco.floor_plane import Mask, pixel_rays
from aruco.pose_math import Array

# Half side of the window that a normal is fitted in. Over less, noise turns normals at 3 m and more by several degrees.
RADIUS_M = 0.12
# Nearer than a metre that is most of a small thing, and noise asks for no more.
MOST_RADIUS_PX = 96.0
# A fit must explain its window this well, in noise as it is typical of the image: else it spans an edge or a curve, and
# a smaller window is tried.
_MISFIT = 1.5
_SHRINK = (1.0, 0.6, 0.0, 0.0)
_LEAST_RADIUS_PX = (CORRELATION_PX / 2, CORRELATION_PX / 2, CORRELATION_PX / 2, 9.0)
# Of a window's squares; what less fill has no direction.
_LEAST_SHARE = 0.25
# Squares that lie farther off the plane of their surroundings are chance hits of the matcher.
_OUTLIER = 4.0
# A window reaches across a crease before its misfit shows it: beside a surface that faces elsewhere nothing is
# taken, 5 px at the focal length of 720p: such normals are wrong alike in many samples, which no weight makes good.
# A wider strip would leave too little of small things.
_CREASE_RAD = 5.0 / 700.0
_CREASE_COSINE = math.cos(math.radians(25.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Squares:
    """Mean measurements of the squares of ``stride`` pixels that an image is divided in, where there are any."""

    row: NDArray[np.intp]  # (n,)
    column: NDArray[np.intp]  # (n,)
    grid: tuple[int, int]  # rows and columns of squares
    pixels: Array  # (n, 2) mean of the pixels that measure something
    rays: Array  # (n, 3), z = 1
    inverse: Array  # (n,) their mean inverse depth [1/m]
    room_px: Array  # (n,) half size of the largest window that reaches across no edge
    stride: int
    pixel_area: float  # on the plane of rays

    def __len__(self) -> int:
        """How many."""
        return len(self.inverse)

    def only(self, keep: Mask | NDArray[np.intp]) -> Squares:
        """Some of them."""
        return replace(
            self,
            row=self.row[keep],
            column=self.column[keep],
            pixels=self.pixels[keep],
            rays=self.rays[keep],
            inverse=self.inverse[keep],
            room_px=self.room_px[keep],
        )

    def largest_patch(self, members: Mask) -> Mask:
        """Of some of them (n,) those that hang together in the image and are most; gaps of one square do not part."""
        image = np.zeros(self.grid, dtype=np.uint8)
        image[self.row[members], self.column[members]] = 1
        patch = cv2.connectedComponents(cv2.dilate(image, np.ones((3, 3), dtype=np.uint8)))[1]
        mine = np.where(members, patch[self.row, self.column], 0)
        sizes = np.bincount(mine, minlength=2)
        return members & (mine == 1 + int(np.argmax(sizes[1:])))

    def beside(self, members: Mask, reach_px: float) -> Mask:
        """Which of them (n,) lie within so many pixels of some of them, along rows and columns."""
        image = np.zeros(self.grid, dtype=np.uint8)
        image[self.row[members], self.column[members]] = 1
        side = 2 * max(1, round(reach_px / self.stride)) + 1
        return cv2.dilate(image, np.ones((side, side), dtype=np.uint8))[self.row, self.column] > 0


def near_crease(squares: Squares, normals: Array, among: Mask) -> Mask:
    """Squares (n,) beside which another surface begins: their plane and depth may be a mixture of both.

    Args:
        squares: What is measured.
        normals: (n, 3) unit.
        among: (n,) squares that count.
    """
    image = np.zeros((*squares.grid, 3))
    image[squares.row[among], squares.column[among]] = normals[among]
    reach = max(1, round(_CREASE_RAD / squares.pixel_area**0.5 / squares.stride))
    padded = np.pad(image, [(reach, reach), (reach, reach), (0, 0)])
    row, column = squares.row[among], squares.column[among]
    found = np.zeros(len(row), dtype=bool)
    for down in range(2 * reach + 1):
        for right in range(2 * reach + 1):
            beside = padded[row + down, column + right]
            found |= beside.any(axis=1) & ((beside * normals[among]).sum(axis=1) < _CREASE_COSINE)
    near = np.zeros(len(squares), dtype=bool)
    near[among] = found
    return near


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surfaces:
    """The plane ``1 / z = a . r`` through each square's surroundings."""

    a: Array  # (n, 3) [1/m]
    normal_sigma: Array  # (n,) of its direction [rad]
    sound: Mask  # (n,) there is such a plane, and the square lies on it
    noise_scale: float  # how many times larger noise is than promised, never below one

    @property
    def normals(self) -> Array:
        """(n, 3) unit, towards the camera."""
        with np.errstate(invalid="ignore"):
            return -self.a / np.linalg.norm(self.a, axis=1, keepdims=True)

    def only(self, keep: Mask | NDArray[np.intp]) -> Surfaces:
        """Some of them."""
        return Surfaces(
            a=self.a[keep], normal_sigma=self.normal_sigma[keep], sound=self.sound[keep], noise_scale=self.noise_scale
        )


def mean_squares(inverse: Array, K: Array, stride: int, room_px: Array) -> Squares:
    """The squares of which a quarter and more is measured.

    Args:
        inverse: (h, w) true inverse depth [1/m], NaN where nothing is measured.
        K: (3, 3) of the image.
        stride: Side of a square [px].
        room_px: (h, w) half size of a window that reaches across no edge.
    """
    good = np.isfinite(inverse)
    v, u = np.arange(inverse.shape[0], dtype=np.float64)[:, None], np.arange(inverse.shape[1], dtype=np.float64)
    count = _square_sums(good.astype(np.float64), stride)
    row, column = np.nonzero(count >= max(1.0, stride**2 / 4))
    n = count[row, column]
    mean = [_square_sums(np.where(good, x, 0.0), stride)[row, column] / n for x in (u, v, inverse)]
    pixels = np.stack(mean[:2], axis=1)
    middle = np.rint(pixels).astype(np.intp)
    return Squares(
        row=row,
        column=column,
        grid=(count.shape[0], count.shape[1]),
        pixels=pixels,
        rays=pixel_rays(K, pixels),
        inverse=mean[2],
        room_px=room_px[middle[:, 1], middle[:, 0]],
        stride=stride,
        pixel_area=1.0 / float(K[0, 0] * K[1, 1]),
    )


def _square_sums(image: Array, stride: int) -> Array:
    height, width = (-(-n // stride) for n in image.shape)
    padded = np.pad(image, [(0, height * stride - image.shape[0]), (0, width * stride - image.shape[1])])
    return padded.reshape(height, stride, width, stride).sum(axis=(1, 3))


def fit_surfaces(squares: Squares, focal_px: float, sigma: Array) -> Surfaces:
    """The plane through every square's surroundings, over a window as large as edges and curves allow.

    Args:
        squares: What is measured.
        focal_px: Of the image.
        sigma: (n,) standard deviation of a square's inverse depth [1/m].
    """
    n = len(squares)
    tables = _tables(squares)
    wanted = np.clip(focal_px * RADIUS_M * squares.inverse, CORRELATION_PX / 2, MOST_RADIUS_PX)
    wanted = np.minimum(wanted, np.maximum(squares.room_px, CORRELATION_PX / 2))
    a, normal_sigma, misfit = np.zeros((n, 3)), np.full(n, np.inf), np.full(n, np.inf)
    todo, typical = np.arange(n), 1.0
    for share, radius_px in zip(_SHRINK, _LEAST_RADIUS_PX):
        if not len(todo):
            break
        least = max(1.0, np.rint(radius_px / squares.stride - 0.5))
        half = np.maximum(np.rint(share * (wanted[todo] / squares.stride - 0.5)), least).astype(np.intp)
        a[todo], normal_sigma[todo], misfit[todo] = _fits(tables, squares, todo, half, sigma)
        if share == 1.0 and np.isfinite(misfit).any():
            typical = max(1.0, float(np.median(misfit[np.isfinite(misfit)])))
        todo = np.flatnonzero(misfit > _MISFIT * typical)
    off = np.abs(squares.inverse - (squares.rays * a).sum(axis=1))
    sound = (misfit <= _MISFIT * typical) & (off <= _OUTLIER * typical * sigma) & (a.any(axis=1))
    return Surfaces(a=a, normal_sigma=typical * normal_sigma, sound=sound, noise_scale=typical)


def _tables(squares: Squares) -> Array:
    """Summed-area tables (rows + 1, columns + 1, 10) of 1, x, y, xx, xy, yy, w, xw, yw, ww."""
    x, y, w = squares.rays[:, 0], squares.rays[:, 1], squares.inverse
    image = np.zeros((squares.grid[0] + 1, squares.grid[1] + 1, 10))
    image[squares.row + 1, squares.column + 1] = np.stack(
        [np.ones_like(w), x, y, x * x, x * y, y * y, w, x * w, y * w, w * w], axis=1
    )
    return image.cumsum(axis=0).cumsum(axis=1)


def _fits(
    tables: Array, squares: Squares, index: NDArray[np.intp], half: NDArray[np.intp], sigma: Array
) -> tuple[Array, Array, Array]:
    """Planes (m, 3), sigma of their directions (m,), and misfit (m,) in sigmas, infinite where there is no plane."""
    top, left = np.maximum(squares.row[index] - half, 0), np.maximum(squares.column[index] - half, 0)
    bottom = np.minimum(squares.row[index] + half + 1, squares.grid[0])
    right = np.minimum(squares.column[index] + half + 1, squares.grid[1])
    sums = tables[bottom, right] - tables[top, right] - tables[bottom, left] + tables[top, left]
    n = np.maximum(sums[:, 0], 1.0)
    x, y, xx, xy, yy, w, xw, yw, ww = (sums[:, 1:] / n[:, None]).T
    xx, xy, yy, xw, yw, ww = xx - x * x, xy - x * y, yy - y * y, xw - x * w, yw - y * w, ww - w * w
    determinant = xx * yy - xy * xy
    # The window's own spread, were it full; a third of it in each direction is no sliver.
    full = ((2 * half + 1) * squares.stride) ** 2 / 12.0
    enough = (n >= np.maximum(4.0, _LEAST_SHARE * (2 * half + 1) ** 2)) & (
        determinant > (full * squares.pixel_area / 9.0) ** 2
    )
    safe = np.where(enough, determinant, 1.0)
    slope_x, slope_y = (yy * xw - xy * yw) / safe, (xx * yw - xy * xw) / safe
    a = np.stack([slope_x, slope_y, w - slope_x * x - slope_y * y], axis=1)
    s = sigma[index]
    misfit = np.sqrt(np.maximum(ww - slope_x * xw - slope_y * yw, 0.0)) / s
    alone = np.maximum(1.0, n * (squares.stride / CORRELATION_PX) ** 2)
    covariance = np.stack([yy, -xy, xx], axis=1) * (s**2 / alone / safe)[:, None]
    turn = _direction_sigma(a, squares.rays[index], covariance)
    return np.where(enough[:, None], a, 0.0), np.where(enough, turn, np.inf), np.where(enough, misfit, np.inf)


def _direction_sigma(a: Array, rays: Array, covariance: Array) -> Array:
    """Standard deviation (m,) [rad] of normals from the covariance (m, 3: xx, xy, yy) of both slopes, root mean square.

    A plane that turns about its point on the ray r has ``da = (dx, dy, -r . (dx, dy))``; only what is across the normal
    turns it, by ``|da| / |a|``.
    """
    length = np.linalg.norm(a, axis=1)
    n = a / np.where(length > 0, length, 1.0)[:, None]
    x, y = rays[:, 0], rays[:, 1]
    along_x, along_y = n[:, 0] - x * n[:, 2], n[:, 1] - y * n[:, 2]
    across = ((1 + x * x - along_x**2), (x * y - along_x * along_y), (1 + y * y - along_y**2))
    trace = across[0] * covariance[:, 0] + 2 * across[1] * covariance[:, 1] + across[2] * covariance[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(length > 0, np.sqrt(np.maximum(trace, 0.0) / 2.0) / length, np.inf)
