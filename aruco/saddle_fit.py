"""Sub-pixel chessboard corners: fit a blurred saddle to the pixels around every inner corner.

Owns      the saddle model, its batched Gauss-Newton fit, corners and their standard deviations.
Leaves    finding boards and deciding which corners survive to board_detector.

Two straight edges cross at a chessboard corner. With ``S(x)`` the step from -1 to 1, blurred by a Gaussian of width
``s`` and averaged over a pixel (``2 F(x, s) - 1`` in the words of corner_fit), and ``x1``, ``x2`` the signed distances
of a pixel from the two edges,

    I = middle + half S(x1) S(x2) + shade . (p - corner)

Near the corner itself the average over a pixel is no longer a product, but what is neglected is the same on opposite
sides of the corner and cannot move it. All pixels along the edges take part, unresampled, up to the next corners and
as far to the sides as the markers in the white squares allow. With a lens that bends lines the pixels are straightened
first (``lens.straighten``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.corner_fit import BLUR_MAX_PX, BLUR_MIN_PX, BLUR_PRIOR_PX, MIN_NOISE_GREY, OUTLIER_SIGMAS, SIGMA_FLOOR_PX
from aruco.model import Camera
from aruco.pose_math import Array

# Pixels farther than this from both edges see no edge, and tell nothing of where it is.
HALF_BAND_PX = 3.5
# Longer edges are bent by lens and paper more than their length helps.
MAX_REACH_PX = 12.0
# The blur of a neighbouring corner, and of a marker's border, reaches this far.
CORNER_GUARD_PX, MARKER_GUARD_PX = 1.5, 1.0
# So much of the white square is looked at however close the marker is: robust weights cope with its border.
MIN_WHITE_BAND_PX = 0.7
BLUR_START_PX = 0.7
MAX_STEP_PX, MAX_TURN_RAD = 1.0, 0.1
# Fewer pixels than this many times the unknowns are no measurement: a corner at the border, or tiny squares.
MIN_PIXELS_PER_UNKNOWN = 3
UNKNOWNS = 9  # corner (2), directions of two edges, blur, middle, half contrast, shade (2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SaddleFit:
    """n chessboard corners, with what the pixels say about them."""

    corners_px: Array  # (n, 2) recorded pixels
    sigma_px: Array  # (n,) standard deviation of a coordinate
    misfit: Array  # (n,) residual as a share of the contrast; infinite where there was nothing to fit
    shift_px: Array  # (n,) how far the corner moved from its start
    contrast: Array  # (n,) grey levels of white above black; negative where they are exchanged


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Saddles:
    """Where chessboard corners should be, and what lies around them; all in the image of a pinhole camera."""

    corners_px: Array  # (n, 2), right to about 2 px
    axes_px: Array  # (n, 2, 2) from the corner to its next ones along the board's x ([:, 0]) and y ([:, 1])
    white_first: NDArray[np.bool_]  # (n,) whether the square between +x and +y is white
    margin: float  # between the edge of a white square and its marker, as a share of the square


@dataclass(frozen=True, slots=True)
class _Pass:
    """How one round of fitting goes about it."""

    reach_px: float
    steps: int  # of Gauss-Newton
    damping: float  # share of the diagonal


FIND = _Pass(reach_px=8.0, steps=5, damping=1e-2)
MEASURE = _Pass(reach_px=MAX_REACH_PX, steps=3, damping=1e-4)


def fit_saddles(image: NDArray[np.uint8], saddles: Saddles, camera: Camera | None = None) -> SaddleFit:
    """Refine chessboard corners to a few hundredths of a pixel.

    Args:
        image: (h, w) grey.
        saddles: n of them. A corner that is NaN or not in the image comes back with an infinite misfit.
        camera: Its lens, so that bent edges are fitted straight; None for a pinhole.
    """
    n = len(saddles.corners_px)
    theta = _start(saddles)
    misfit, variance = np.full(n, np.inf), np.full(n, np.nan)
    usable = np.isfinite(theta).all(axis=1) & (np.abs(np.linalg.det(saddles.axes_px)) > 1.0)
    if usable.any():
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            theta[usable], _, _ = _fit(image, _only(saddles, usable), theta[usable], camera, FIND)
            theta[usable], misfit[usable], variance[usable] = _fit(
                image, _only(saddles, usable), theta[usable], camera, MEASURE
            )
    corners, starts = (_bend(camera, points) for points in (theta[:, :2], saddles.corners_px))
    shift = np.linalg.norm(corners - starts, axis=1)
    misfit[~np.isfinite(misfit + variance + shift)] = np.inf
    sign = np.where(saddles.white_first, 2.0, -2.0)
    return SaddleFit(
        corners_px=corners,
        sigma_px=np.sqrt(variance + SIGMA_FLOOR_PX**2),
        misfit=misfit,
        shift_px=shift,
        contrast=sign * theta[:, 6],
    )


def _only(saddles: Saddles, keep: NDArray[np.bool_]) -> Saddles:
    return Saddles(
        corners_px=saddles.corners_px[keep],
        axes_px=saddles.axes_px[keep],
        white_first=saddles.white_first[keep],
        margin=saddles.margin,
    )


def _start(saddles: Saddles) -> Array:
    """State (n, 9): corner, angles of the edges along x and y, blur, middle, half contrast, shade."""
    theta = np.zeros((len(saddles.corners_px), UNKNOWNS))
    theta[:, :2] = saddles.corners_px
    theta[:, 2:4] = np.arctan2(saddles.axes_px[..., 1], saddles.axes_px[..., 0])
    theta[:, 4] = BLUR_START_PX
    return theta


def _bend(camera: Camera | None, points: Array) -> Array:
    return points if camera is None else lens.bend(camera, points)


class _Window:
    """The pixels that tell where a corner is: straightened places p, values, and weights of 0 or 1."""

    def __init__(
        self, image: NDArray[np.uint8], saddles: Saddles, corners: Array, camera: Camera | None, reach_px: float
    ) -> None:
        reach = int(np.ceil(reach_px))
        steps = np.arange(-reach, reach + 1)
        offsets = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
        offsets = offsets[(offsets**2).sum(axis=1) <= reach_px**2]
        centre = _bend(camera, corners)
        h, w = image.shape
        # A corner far outside of the image has no pixels; clipped, its numbers stay small enough to be one.
        middle = np.rint(np.clip(np.nan_to_num(centre, nan=-1e4), -1e4, 1e6))
        pixel: Array = middle[:, None] + offsets.astype(np.float64)
        inside = ((pixel >= 0) & (pixel < [w, h])).all(axis=2)
        places = self._straight(camera, pixel) - corners[:, None]
        use = inside & np.isfinite(places).all(axis=2) & _telling(saddles, np.nan_to_num(places))
        # The pixels in use first, and as few columns as the fullest row needs.
        order = np.argsort(~use, axis=1, kind="stable")[:, : max(int(use.sum(axis=1).max()), 1)]
        self.p = np.nan_to_num(np.take_along_axis(places, order[..., None], axis=1)) + corners[:, None]
        self.weight = np.take_along_axis(use, order, axis=1).astype(np.float64)
        u, v = np.take_along_axis(pixel, order[..., None], axis=1).astype(np.int64).transpose(2, 0, 1)
        self.value = image[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1)].astype(np.float64)

    @staticmethod
    def _straight(camera: Camera | None, pixel: Array) -> Array:
        if camera is None:
            return pixel
        return lens.straighten(camera, pixel.reshape(-1, 2)).reshape(pixel.shape)


def _telling(saddles: Saddles, places: Array) -> NDArray[np.bool_]:
    """Which places (n, P, 2) relative to the corners lie near its edges and see neither markers nor other corners."""
    to_board = np.linalg.inv(saddles.axes_px.transpose(0, 2, 1))
    squares = places @ to_board.transpose(0, 2, 1)
    # One square's width across its edges: x is constant along the board's y axis.
    width = 1.0 / np.linalg.norm(to_board, axis=2)[:, None]
    away = np.abs(squares) * width  # from the edge along y, and from the edge along x
    free = (away < width - CORNER_GUARD_PX).all(axis=2) & (away <= HALF_BAND_PX).any(axis=2)
    white = (squares[..., 0] * squares[..., 1] > 0) == saddles.white_first[:, None]
    band = np.maximum(saddles.margin * width - MARKER_GUARD_PX, MIN_WHITE_BAND_PX)
    marker = white & (away > band).all(axis=2)
    return free & ~marker


def _fit(
    image: NDArray[np.uint8], saddles: Saddles, theta: Array, camera: Camera | None, how: _Pass
) -> tuple[Array, Array, Array]:
    """One round from a state (n, 9): the new state, the misfit (n,) and the variance (n,) of a coordinate."""
    window = _Window(image, saddles, theta[:, :2], camera, how.reach_px)
    theta = theta.copy()
    theta[:, 5:] = _start_levels(window, saddles, theta)
    # On which side of its edge the board's other axis points.
    side = np.sign(np.linalg.det(saddles.axes_px))
    H, noise = np.zeros((len(theta), UNKNOWNS, UNKNOWNS)), np.zeros(len(theta))
    for _ in range(how.steps):
        H, g, noise = _normal_equations(window, theta, side)
        change = _solve(H, g, how.damping)
        change[:, :2] = np.clip(change[:, :2], -MAX_STEP_PX, MAX_STEP_PX)
        change[:, 2:4] = np.clip(change[:, 2:4], -MAX_TURN_RAD, MAX_TURN_RAD)
        theta -= change
        theta[:, 4] = np.clip(theta[:, 4], BLUR_MIN_PX, BLUR_MAX_PX)
    covariance = noise[:, None, None] ** 2 * _inverse(H)[:, :2, :2]
    misfit = noise / np.maximum(2 * np.abs(theta[:, 6]), 1e-9)
    misfit[window.weight.sum(axis=1) < MIN_PIXELS_PER_UNKNOWN * UNKNOWNS] = np.inf
    return theta, misfit, np.trace(covariance, axis1=1, axis2=2) / 2


def _start_levels(window: _Window, saddles: Saddles, theta: Array) -> Array:
    """Middle, half contrast and no shade (n, 4), from the mean of the white and of the black squares."""
    squares = (window.p - theta[:, None, :2]) @ np.linalg.inv(saddles.axes_px)
    same = squares[..., 0] * squares[..., 1] > 0
    means = []
    for side in (same, ~same):
        weight = window.weight * side
        means.append((weight * window.value).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0))
    nothing = np.zeros(len(theta))
    return np.stack([(means[0] + means[1]) / 2, (means[0] - means[1]) / 2, nothing, nothing], axis=1)


def _residuals(window: _Window, theta: Array, side: Array) -> tuple[Array, Array]:
    """Model minus pixels (n, P), and its Jacobian (n, 9, P)."""
    du, dv = (window.p - theta[:, None, :2]).transpose(2, 0, 1)
    blur, middle, half, shade_u, shade_v = (theta[:, k, None] for k in range(4, UNKNOWNS))
    # Distances from the edge along x, positive towards +y of the board, and from the edge along y, towards +x.
    signs = (side[:, None], -side[:, None])
    S, d_S, d_blur, normal, d_angle = [], [], [], [], []
    for angle, sign in zip((theta[:, 2, None], theta[:, 3, None]), signs):
        nu, nv = -sign * np.sin(angle), sign * np.cos(angle)
        step, slope, spread = _step(nu * du + nv * dv, blur)
        S.append(step)
        d_S.append(slope)
        d_blur.append(spread)
        normal.append((nu, nv))
        d_angle.append(-sign * (np.cos(angle) * du + np.sin(angle) * dv))
    across = (half * d_S[0] * S[1], half * S[0] * d_S[1])
    J = np.stack(
        [
            -across[0] * normal[0][0] - across[1] * normal[1][0] - shade_u,
            -across[0] * normal[0][1] - across[1] * normal[1][1] - shade_v,
            across[0] * d_angle[0],
            across[1] * d_angle[1],
            half * (d_blur[0] * S[1] + S[0] * d_blur[1]),
            np.ones_like(du),
            S[0] * S[1],
            du,
            dv,
        ],
        axis=1,
    )
    return middle + half * J[:, 6] + shade_u * du + shade_v * dv - window.value, J


def _step(x: Array, blur: Array) -> tuple[Array, Array, Array]:
    """The blurred step S from -1 to 1, averaged over a pixel, and its derivatives in x and blur."""
    from scipy.special import ndtr

    upper, lower = (x + 0.5) / blur, (x - 0.5) / blur
    Phi_u, Phi_l = ndtr(upper), ndtr(lower)
    d_blur = (np.exp(-0.5 * upper**2) - np.exp(-0.5 * lower**2)) / np.sqrt(2 * np.pi)
    F = (x + 0.5) * Phi_u - (x - 0.5) * Phi_l + blur * d_blur
    return 2 * F - 1, 2 * (Phi_u - Phi_l), 2 * d_blur


def _normal_equations(window: _Window, theta: Array, side: Array) -> tuple[Array, Array, Array]:
    """Weighted H (n, 9, 9), gradient (n, 9) and robust noise (n,) [grey levels] at a state (n, 9)."""
    r, J = _residuals(window, theta, side)
    noise = _noise(window, r)
    weight = window.weight / (1.0 + (r / (OUTLIER_SIGMAS * noise[:, None])) ** 2)
    weighted = J * weight[:, None]
    H = weighted @ J.transpose(0, 2, 1)
    g = np.einsum("nkp,np->nk", weighted, r)
    prior = (noise / BLUR_PRIOR_PX) ** 2
    H[:, 4, 4] += prior
    g[:, 4] += prior * (theta[:, 4] - BLUR_START_PX)
    return H, g, noise


def _noise(window: _Window, r: Array) -> Array:
    """Robust standard deviation (n,) [grey levels] of the residuals: what most pixels of a corner agree on."""
    size = np.sort(np.where(window.weight > 0, np.abs(r), np.inf), axis=1)
    middle = (window.weight.sum(axis=1) / 2).astype(np.int64)
    return np.maximum(1.4826 * size[np.arange(len(r)), np.minimum(middle, r.shape[1] - 1)], MIN_NOISE_GREY)


def _solve(H: Array, g: Array, damping: float) -> Array:
    return np.linalg.solve(_damped(H, damping), g[..., None])[..., 0]


def _inverse(H: Array) -> Array:
    return np.linalg.inv(_damped(H, 1e-9))


def _damped(H: Array, damping: float) -> Array:
    scale = np.maximum(np.einsum("nkk->nk", H), 1e-9)
    return np.nan_to_num(H, posinf=0.0, neginf=0.0) + np.where(np.isfinite(scale), damping * scale, 1.0)[
        :, :, None
    ] * np.eye(H.shape[1])
