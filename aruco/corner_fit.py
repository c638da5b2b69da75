"""Sub-pixel marker corners: fit the blurred step of every border edge to the pixels, intersect the lines.

Owns      the edge model, its batched Gauss-Newton fit, corners and their standard deviations.
Leaves    finding markers and deciding which survive to detector.

A pixel whose centre lies ``x`` px outside an edge sees the step blurred by a Gaussian of width ``s`` and averaged over
its own area. With ``G(u) = u Phi(u/s) + s phi(u/s)``, the integral of the normal distribution function, that is

    F(x, s) = G(x + 1/2) - G(x - 1/2),        I = dark(t) + (light(t) - dark(t)) F(x(t), s)

where ``t`` runs along the edge and the two levels may change linearly with it. All pixels of a band around the edge
take part, unresampled, so the estimate is the least-squares one and has no offset towards either side. With a lens
that bends lines, edges are straight in the pinhole image (``lens.straighten``), and are fitted there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.model import Camera
from aruco.pose_math import Array

# The band reaches this far to both sides of an edge: beyond the blur, but not into the next cell of the pattern.
MAX_HALF_BAND_PX = 4.0
MIN_HALF_BAND_PX = 1.3
# Pixels this close to a corner also see the neighbouring edge.
MAX_CORNER_MARGIN_PX = 3.0
CORNER_MARGIN_CELLS = 0.6
BLUR_START_PX, BLUR_MIN_PX, BLUR_MAX_PX = 0.7, 0.15, 3.0
# The blur of lenses is known roughly; this keeps it in hand where a band is too narrow to tell.
BLUR_PRIOR_PX = 0.6
MIN_NOISE_GREY = 1.0
# Cauchy weights: dirt, print and shadows that reach into the band must not pull the edge.
OUTLIER_SIGMAS = 2.5
MAX_STEP_PX = 1.0  # a Gauss-Newton step farther than the blur reaches is a guess
# What no fit of pixels can promise: unmodelled shading, ink and lens errors.
SIGMA_FLOOR_PX = 0.01
# Shorter sides are no marker's: such a quad has collapsed.
MIN_SIDE_PX = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CornerFit:
    """Corners of n markers, with what their edges say about them."""

    corners_px: Array  # (n, 4, 2) recorded pixels
    sigma_px: Array  # (n, 4) standard deviation of a corner's coordinate
    misfit: Array  # (n,) residual of the worst edge, as a share of its contrast
    noise_grey: Array  # (n,) residual of the worst edge, in grey levels
    shift_px: Array  # (n,) how far the farthest edge moved across itself from its start


@dataclass(frozen=True, slots=True)
class _Pass:
    """How one round of fitting goes about it."""

    half_band_cells: float
    samples_along: int
    steps: int  # of Gauss-Newton
    damping: float  # share of the diagonal


# First a wide band and few samples find the edge; then a narrow band, centred on it, measures it.
FIND = _Pass(half_band_cells=0.75, samples_along=24, steps=4, damping=1e-2)
MEASURE = _Pass(half_band_cells=0.6, samples_along=64, steps=3, damping=1e-4)


# Takes the place of a quad that has collapsed or lies where the lens has no inverse, so that the others go on.
_STAND_IN = 10.0 * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@dataclass(slots=True)
class _Edges:
    """E edges in the pinhole image: points ``middle + t * half * along``, t in [-1, 1]; ``out`` points outward."""

    middle: Array  # (E, 2)
    along: Array  # (E, 2) unit
    half: Array  # (E,) px
    out: Array  # (E, 2) unit


def fit_corners(image: NDArray[np.uint8], quads_px: Array, cells: int, camera: Camera | None = None) -> CornerFit:
    """Refine marker corners to a few hundredths of a pixel.

    Args:
        image: (h, w) grey.
        quads_px: (n, 4, 2) corners to within about 2 px, clockwise in the image (ArUco order).
        cells: Cells along a marker's side, both borders included.
        camera: Its lens, so that bent edges are fitted straight; None for a pinhole.

    Returns:
        The corners; a marker that leaves the image or does not converge has an infinite misfit.
    """
    if not len(quads_px):
        none = np.empty(0)
        return CornerFit(corners_px=quads_px, sigma_px=np.empty((0, 4)), misfit=none, noise_grey=none, shift_px=none)
    start = _straighten(camera, quads_px)
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        corners, _, _, _ = _measure(image, start, cells, camera, FIND)
        corners, variance, misfit, noise = _measure(image, corners, cells, camera, MEASURE)
        shift = _across(start, corners)
    bent = _bend(camera, corners)
    lost = ~np.isfinite(shift + misfit + variance.sum(axis=1) + bent.sum(axis=(1, 2)))
    misfit[lost] = shift[lost] = np.inf
    sigma = np.sqrt(variance + SIGMA_FLOOR_PX**2)
    return CornerFit(corners_px=bent, sigma_px=sigma, misfit=misfit, noise_grey=noise, shift_px=shift)


def _across(start: Array, refined: Array) -> Array:
    """How far the middle of the farthest edge moved across itself (n,): corners of oblique markers move farther."""
    edges = _edges(start)
    middle = (refined + np.roll(refined, -1, axis=1)).reshape(-1, 2) / 2
    return np.abs(np.einsum("ei,ei->e", middle - edges.middle, edges.out)).reshape(-1, 4).max(axis=1)


def _measure(
    image: NDArray[np.uint8], corners: Array, cells: int, camera: Camera | None, how: _Pass
) -> tuple[Array, Array, Array, Array]:
    """One round: corners (n, 4, 2) in the pinhole image, their variance (n, 4), misfit and noise of the worst edge."""
    side = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).min(axis=1)
    usable = np.isfinite(corners).all(axis=(1, 2)) & (side >= MIN_SIDE_PX)
    edges = _edges(np.where(usable[:, None, None], corners, _STAND_IN))
    lines = _fit_steps(_Band(image, edges, cells, camera, how), how)
    refined, variance = _intersect(edges, lines)
    refined[~usable] = np.nan
    worst = [values.reshape(-1, 4).max(axis=1) for values in (lines.noise / lines.contrast, lines.noise)]
    return refined, variance, worst[0], worst[1]


def _straighten(camera: Camera | None, points: Array) -> Array:
    return points if camera is None else lens.straighten(camera, points.reshape(-1, 2)).reshape(points.shape)


def _bend(camera: Camera | None, points: Array) -> Array:
    return points if camera is None else lens.bend(camera, points.reshape(-1, 2)).reshape(points.shape)


def _edges(corners: Array) -> _Edges:
    first = corners.reshape(-1, 2)
    second = np.roll(corners, -1, axis=1).reshape(-1, 2)
    length = np.linalg.norm(second - first, axis=1)
    along = (second - first) / length[:, None]
    # Corners run clockwise in the image (y down), so outward is to the left of the walk.
    out = np.stack([along[:, 1], -along[:, 0]], axis=1)
    return _Edges((first + second) / 2, along, length / 2, out)


class _Band:
    """The pixels around every edge: value, distance outward x0, position along t, and a weight of 0 or 1."""

    def __init__(self, image: NDArray[np.uint8], edges: _Edges, cells: int, camera: Camera | None, how: _Pass) -> None:
        cell = _width(edges) / cells
        half_band = np.clip(how.half_band_cells * cell, MIN_HALF_BAND_PX, MAX_HALF_BAND_PX)
        margin = np.clip(CORNER_MARGIN_CELLS * cell, 1.0, MAX_CORNER_MARGIN_PX)
        reach = np.maximum(edges.half - margin, 0.0)

        # Sample points along the line at most one per pixel, then the pixels across it at each of them.
        count = np.clip(2 * reach, 2, how.samples_along).astype(np.int64)
        k = np.arange(int(count.max()))
        used = k < count[:, None]
        along = reach[:, None] * (2 * (k + 0.5) / count[:, None] - 1)  # px from the middle
        along = np.where(used, along, 0.0)
        line = edges.middle[:, None] + along[..., None] * edges.along[:, None]  # (E, C, 2)
        on_image, to_straight = _local_lens(camera, line)
        steep = np.abs(edges.along[:, 1]) > np.abs(edges.along[:, 0])  # across is x for steep edges, else y
        across = np.where(steep[:, None], [1.0, 0.0], [0.0, 1.0])
        # An edge at 45 degrees needs sqrt(2) times as many pixels across to reach as far outward.
        offsets = np.arange(-int(np.ceil(half_band.max() * 1.5)), int(np.ceil(half_band.max() * 1.5)) + 1)
        start = np.rint(np.nan_to_num(on_image))
        pixel = start[:, :, None] + offsets[:, None] * across[:, None, None]  # (E, C, O, 2)
        delta = np.einsum("ecij,ecoj->ecoi", to_straight, pixel - on_image[:, :, None])
        point = line[:, :, None] - edges.middle[:, None, None] + delta
        self.x0 = np.einsum("ecoi,ei->eco", point, edges.out).reshape(len(count), -1)
        self.t = (np.einsum("ecoi,ei->eco", point, edges.along) / edges.half[:, None, None]).reshape(len(count), -1)
        h, w = image.shape
        u, v = pixel[..., 0].astype(np.int64), pixel[..., 1].astype(np.int64)
        inside = (u >= 0) & (v >= 0) & (u < w) & (v < h) & used[:, :, None]
        self.value = image[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1)].astype(np.float64).reshape(len(count), -1)
        near = np.abs(self.x0) <= half_band[:, None]
        self.weight = (inside.reshape(len(count), -1) & near).astype(np.float64)


def _width(edges: _Edges) -> Array:
    """How far each edge's opposite is from it [px], (E,): foreshortening makes cells narrow across, not along."""
    middle = edges.middle.reshape(-1, 4, 2)
    across = np.einsum("nki,nki->nk", middle - np.roll(middle, 2, axis=1), edges.out.reshape(-1, 4, 2))
    return np.maximum(across, 1.0).ravel()


def _local_lens(camera: Camera | None, line: Array) -> tuple[Array, Array]:
    """Where points (E, C, 2) of the pinhole image are recorded, and the (E, C, 2, 2) Jacobian back."""
    if camera is None or not camera.has_distortion:
        return line, np.broadcast_to(np.eye(2), (*line.shape[:2], 2, 2))
    flat = line.reshape(-1, 2)
    K = camera.K[:2, :2]
    x = (flat - camera.K[:2, 2]) @ np.linalg.inv(K).T
    distorted, J = lens.distort(camera, x)
    J_back = K @ np.linalg.inv(J) @ np.linalg.inv(K)
    return (distorted @ K.T + camera.K[:2, 2]).reshape(line.shape), J_back.reshape(*line.shape[:2], 2, 2)


@dataclass(slots=True)
class _Lines:
    """Fitted edges: true line at ``x0 = offset + slope * t``, their (E, 2, 2) covariance, noise and contrast [grey]."""

    offset: Array
    slope: Array
    covariance: Array
    noise: Array
    contrast: Array


def _fit_steps(band: _Band, how: _Pass) -> _Lines:
    """Gauss-Newton on (offset, slope, blur, dark, d_dark, light, d_light) of every edge at once."""
    n = len(band.value)
    theta = np.zeros((n, 7))
    theta[:, 2] = BLUR_START_PX
    theta[:, 3], theta[:, 5] = _start_levels(band)
    H, noise = np.zeros((n, 7, 7)), np.zeros(n)
    for _ in range(how.steps):
        H, g, noise = _normal_equations(band, theta)
        change = _solve(H, g, how.damping)
        change[:, :2] = np.clip(change[:, :2], -MAX_STEP_PX, MAX_STEP_PX)
        theta -= change
        theta[:, 2] = np.clip(theta[:, 2], BLUR_MIN_PX, BLUR_MAX_PX)
    covariance = noise[:, None, None] ** 2 * _inverse(H)[:, :2, :2]
    contrast = np.maximum(np.abs(theta[:, 5] - theta[:, 3]), 1e-9)
    return _Lines(theta[:, 0], theta[:, 1], covariance, noise, contrast)


def _normal_equations(band: _Band, theta: Array) -> tuple[Array, Array, Array]:
    """Weighted H (E, 7, 7), gradient (E, 7) and robust noise (E,) [grey levels] at a state (E, 7)."""
    r, J = _residuals(band, theta)
    noise = _noise(band, r)
    weight = band.weight / (1.0 + (r / (OUTLIER_SIGMAS * noise[:, None])) ** 2)
    weighted = J * weight[:, None]
    H = weighted @ J.transpose(0, 2, 1)
    g = np.einsum("ekp,ep->ek", weighted, r)
    prior = (noise / BLUR_PRIOR_PX) ** 2
    H[:, 2, 2] += prior
    g[:, 2] += prior * (theta[:, 2] - BLUR_START_PX)
    return H, g, noise


def _noise(band: _Band, r: Array) -> Array:
    """Robust standard deviation (E,) [grey levels] of the residuals (E, P): what most pixels of an edge agree on."""
    size = np.sort(np.where(band.weight > 0, np.abs(r), np.inf), axis=1)
    middle = (band.weight.sum(axis=1) / 2).astype(np.int64)
    return np.maximum(1.4826 * size[np.arange(len(r)), middle], MIN_NOISE_GREY)


def _start_levels(band: _Band) -> tuple[Array, Array]:
    inner = band.weight * (band.x0 < -0.7)
    outer = band.weight * (band.x0 > 0.7)
    dark = (inner * band.value).sum(axis=1) / np.maximum(inner.sum(axis=1), 1.0)
    light = (outer * band.value).sum(axis=1) / np.maximum(outer.sum(axis=1), 1.0)
    return dark, light


def _residuals(band: _Band, theta: Array) -> tuple[Array, Array]:
    """Model minus pixels (E, P), and its Jacobian (E, 7, P)."""
    from scipy.special import ndtr

    offset, slope, blur, dark, d_dark, light, d_light = (theta[:, k, None] for k in range(7))
    t = band.t
    x = band.x0 - offset - slope * t
    upper, lower = (x + 0.5) / blur, (x - 0.5) / blur
    Phi_u, Phi_l = ndtr(upper), ndtr(lower)
    phi_u, phi_l = np.exp(-0.5 * upper**2), np.exp(-0.5 * lower**2)
    d_blur = (phi_u - phi_l) / np.sqrt(2 * np.pi)
    F = (x + 0.5) * Phi_u - (x - 0.5) * Phi_l + blur * d_blur
    step = (light + d_light * t) - (dark + d_dark * t)
    d_x = -step * (Phi_u - Phi_l)
    J = np.stack([d_x, d_x * t, step * d_blur, 1 - F, (1 - F) * t, F, F * t], axis=1)
    r = dark + d_dark * t + step * F - band.value
    return r, J


def _solve(H: Array, g: Array, damping: float) -> Array:
    scale = np.maximum(np.einsum("ekk->ek", H), 1e-9)
    damped = H + damping * scale[:, :, None] * np.eye(7)
    return np.linalg.solve(damped, g[..., None])[..., 0]


def _inverse(H: Array) -> Array:
    scale = np.maximum(np.einsum("ekk->ek", H), 1e-9)
    return np.linalg.inv(H + 1e-9 * scale[:, :, None] * np.eye(7))


def _intersect(edges: _Edges, lines: _Lines) -> tuple[Array, Array]:
    """Corners (n, 4, 2) of the pinhole image where neighbouring lines meet, and their mean variance (n, 4)."""
    turned = edges.out - (lines.slope / edges.half)[:, None] * edges.along
    normal = turned.reshape(-1, 4, 2)
    level = (np.einsum("ei,ei->e", turned, edges.middle) + lines.offset).reshape(-1, 4)
    # Corner k lies where edge k - 1 ends (t = 1) and edge k begins (t = -1).
    N = np.stack([np.roll(normal, 1, axis=1), normal], axis=2)  # (n, 4, 2, 2)
    N_inv = _inverse_2x2(N)
    corners = np.einsum("nkij,nkj->nki", N_inv, np.stack([np.roll(level, 1, axis=1), level], axis=2))
    ends = np.array([[1.0, 1.0], [1.0, -1.0]])  # at t = +1 and t = -1
    at_end, at_start = np.einsum("si,eij,sj->se", ends, lines.covariance, ends).reshape(2, -1, 4)
    variances = np.stack([np.roll(at_end, 1, axis=1), at_start], axis=2)
    return corners, np.einsum("nkij,nkj->nk", N_inv**2, variances) / 2


def _inverse_2x2(N: Array) -> Array:
    determinant = N[..., 0, 0] * N[..., 1, 1] - N[..., 0, 1] * N[..., 1, 0]
    determinant = np.where(np.abs(determinant) < 1e-3, np.nan, determinant)
    adjugate = np.stack([np.stack([N[..., 1, 1], -N[..., 0, 1]], -1), np.stack([-N[..., 1, 0], N[..., 0, 0]], -1)], -2)
    return adjugate / determinant[..., None, None]
