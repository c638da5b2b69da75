"""Corners are measured to hundredths of a pixel, without a preferred direction, and the fit knows how well."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from marker_pictures import LENSES, WHITE_GREY, Picture, outward_px, take_picture

from aruco import corner_fit
from aruco.corner_fit import CornerFit, fit_corners
from aruco.detector import MAX_MISFIT
from aruco.model import Camera
from aruco.pose_math import Array

CELLS = 8
SMALL, LARGE = (60.0, 110.0), (110.0, 200.0)
LARGE_PICTURE = (1600, 1200)
# The acceptance of the whole tool. Noise of 5 grey levels at a contrast of 190 alone gives 0.02 px on the smallest.
MEDIAN_PX, RMS_PX = 0.03, 0.10
# An offset common to all corners acts like a shifted principal point. The mean of 100 corners that each scatter by
# 0.02 px is known to 0.002 px: five sigma.
OFFSET_PX = 0.01


def starts(picture: Picture, seed: int = 0) -> Array:
    """Where plain ArUco puts corners, roughly: 0.6 px inward, with half a pixel of scatter."""
    true = picture.corners_px
    inward = true.mean(axis=1, keepdims=True) - true
    inward *= 0.6 / np.linalg.norm(inward, axis=2, keepdims=True)
    return true + inward + np.random.default_rng(seed).uniform(-0.5, 0.5, true.shape)


def fit(picture: Picture, image: np.ndarray | None = None, *, camera: Camera | None = None, seed: int = 0) -> CornerFit:
    return fit_corners(picture.taken() if image is None else image, starts(picture, seed), CELLS, camera)


def distances(fitted: CornerFit, picture: Picture) -> Array:
    return np.linalg.norm(fitted.corners_px - picture.corners_px, axis=2)


def bars_across(picture: Picture, share: float, *, inside: float, outside: float, at: float = 0.5) -> list[Array]:
    """A bar at a place along the edge c1 - c2 of every marker, over a share of its length [parts of the edge]."""
    bars = []
    for corners in picture.corners_px:
        a, b = corners[1], corners[2]
        along = b - a
        out = np.array([along[1], -along[0]])
        first, last = a + (at - share / 2) * along, a + (at + share / 2) * along
        bars.append(np.array([first + outside * out, last + outside * out, last - inside * out, first - inside * out]))
    return bars


# --- the model of an edge -------------------------------------------------------------------------------------------


def band_of(picture: Picture) -> corner_fit._Band:
    edges = corner_fit._edges(picture.corners_px[:2])
    return corner_fit._Band(picture.taken(1.0, 3.0), edges, CELLS, None, corner_fit.MEASURE)


def a_state(n: int) -> Array:
    rng = np.random.default_rng(4)
    state = np.array([0.2, -0.1, 0.8, 20.0, 3.0, 210.0, -8.0])
    return state + 0.1 * rng.standard_normal((n, 7))


def test_the_jacobian_of_the_edge_model_is_its_derivative() -> None:
    band = band_of(take_picture(SMALL))
    theta = a_state(len(band.value))
    _, J = corner_fit._residuals(band, theta)
    for k in range(7):
        h = 1e-5 * np.eye(7)[k]
        numeric = (corner_fit._residuals(band, theta + h)[0] - corner_fit._residuals(band, theta - h)[0]) / 2e-5
        # Central differences of values near 200 with a step of 1e-5 round at 200 * 2e-16 / 1e-5, and cut off at h^2.
        assert np.abs(J[:, k] - numeric).max() < 1e-6


@pytest.mark.parametrize("blur_px", [0.2, 0.7, 2.0])
def test_the_edge_model_is_a_blurred_step_averaged_over_a_pixel(blur_px: float) -> None:
    from scipy.special import ndtr

    band = band_of(take_picture(SMALL))
    n = len(band.value)
    theta = np.tile([0.0, 0.0, blur_px, 0.0, 0.0, 1.0, 0.0], (n, 1))
    model = corner_fit._residuals(band, theta)[0] + band.value
    # Midpoints of 400 strips of the pixel: right to 1e-6 for a curvature of 1 / (0.2 px)^2.
    strip = (np.arange(400) + 0.5) / 400 - 0.5
    pick = slice(0, 200)
    exact = ndtr((band.x0[0, pick, None] + strip) / blur_px).mean(axis=1)
    np.testing.assert_allclose(model[0, pick], exact, atol=2e-6)


# --- accuracy -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [0.0, 2.0, 5.0])
@pytest.mark.parametrize("blur_px", [0.5, 0.7, 1.0])
@pytest.mark.parametrize(("side_px", "size_px"), [(SMALL, (1280, 720)), (LARGE, LARGE_PICTURE)])
def test_corners_are_right_to_hundredths_of_a_pixel(
    side_px: tuple[float, float], size_px: tuple[int, int], blur_px: float, noise: float
) -> None:
    picture = take_picture(side_px, size_px=size_px)
    fitted = fit(picture, picture.taken(blur_px, noise))
    error = distances(fitted, picture)
    assert np.median(error) <= MEDIAN_PX
    assert np.sqrt(np.mean(error**2)) <= RMS_PX
    errors_px = fitted.corners_px - picture.corners_px
    assert np.abs(errors_px.mean(axis=(0, 1))).max() < OFFSET_PX
    # Nor inward, which would act as a scale of the target.
    assert abs(outward_px(errors_px, picture.corners_px).mean()) < OFFSET_PX


def test_the_tolerance_bites() -> None:
    # The same pictures, and the corners where the fit began.
    picture = take_picture(SMALL)
    errors_px = starts(picture) - picture.corners_px
    assert np.median(np.linalg.norm(errors_px, axis=2)) > MEDIAN_PX
    assert abs(outward_px(errors_px, picture.corners_px).mean()) > OFFSET_PX


@pytest.mark.parametrize("model", [name for name in LENSES if name != "pinhole"])
def test_a_lens_that_bends_edges_costs_no_accuracy_when_it_is_known(model: str) -> None:
    picture = take_picture((60.0, 150.0), lens_model=model)
    image = picture.taken(0.7, 2.0)
    known, unknown = fit(picture, image, camera=picture.camera), fit(picture, image)
    assert np.median(distances(known, picture)) <= MEDIAN_PX
    assert np.sqrt(np.mean(distances(known, picture) ** 2)) <= RMS_PX
    # The bend is there: fitted as straight, the same edges miss the tolerance.
    assert np.median(distances(unknown, picture)) > 3 * MEDIAN_PX


def test_the_result_does_not_depend_on_the_start() -> None:
    picture = take_picture(SMALL)
    a, b = fit(picture, seed=1), fit(picture, seed=2)
    # The band of pixels follows the start by up to half a pixel at its ends, where the model is nearly constant.
    assert np.abs(a.corners_px - b.corners_px).max() < 0.02
    far = fit_corners(picture.taken(), picture.corners_px + np.array([1.5, -1.2]), CELLS)
    assert np.abs(far.corners_px - a.corners_px).max() < 0.02


def test_contrast_may_be_inverted() -> None:
    picture = take_picture(SMALL)
    image = picture.taken(0.7, 3.0)
    # Only rounding of sums differs, enlarged by a few steps of a converged fit.
    np.testing.assert_allclose(fit(picture, 255 - image).corners_px, fit(picture, image).corners_px, atol=1e-6)


def test_light_that_changes_over_the_marker_does_not_pull() -> None:
    picture = take_picture(SMALL)
    h, w = picture.clean.shape
    ramp = np.float32(0.35) + np.float32(0.65) * np.abs(np.linspace(-1, 1, w, dtype=np.float32))
    lit = Picture(clean=(picture.clean * ramp).astype(np.float32), corners_px=picture.corners_px, camera=picture.camera)
    assert lit.clean.shape == (h, w)
    fitted = fit(lit)
    assert np.median(distances(fitted, lit)) <= MEDIAN_PX
    assert np.abs((fitted.corners_px - lit.corners_px).mean(axis=(0, 1))).max() < OFFSET_PX


# --- how sure the fit is --------------------------------------------------------------------------------------------


def test_sigma_predicts_the_scatter_over_repeated_noise() -> None:
    picture = take_picture(SMALL)
    repeats = [fit(picture, picture.taken(0.8, 5.0, seed)) for seed in range(30)]
    scatter = np.std([r.corners_px for r in repeats], axis=0, ddof=1).mean(axis=2)
    promised = np.mean([r.sigma_px for r in repeats], axis=0)
    ratio = scatter / promised
    # A standard deviation from 2 x 30 values is itself known to 10 %; the model counts pixels that an oblique edge
    # meets twice double (up to 1.4 in variance), robust weights and the floor of 0.01 px make up for it.
    assert 0.6 < np.median(ratio) < 1.5
    assert ratio.min() > 0.4
    assert ratio.max() < 2.5


def test_sigma_grows_with_the_noise() -> None:
    picture = take_picture(SMALL)
    quiet, loud = (np.median(fit(picture, picture.taken(0.8, noise)).sigma_px) for noise in (2.0, 8.0))
    floor = corner_fit.SIGMA_FLOOR_PX
    grown = np.sqrt(loud**2 - floor**2) / np.sqrt(quiet**2 - floor**2)
    assert grown == pytest.approx(4.0, rel=0.25)  # the blur is fitted too, and rounding adds 0.3 grey levels


# A bar over 15 % of one edge, near its end: smeared ink in the quiet zone, or a label that reaches over the edge. The
# corner stays within four times what is asked of the median of clean ones.
DIRT_PX = 4 * MEDIAN_PX


@pytest.mark.parametrize(("grey", "inside", "outside"), [(0.05, 0.0, 0.03), (0.5, 0.02, 0.1), (0.8, 0.02, 0.1)])
def test_dirt_hardly_moves_corners(grey: float, inside: float, outside: float, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = take_picture(SMALL)
    bars = bars_across(picture, 0.15, inside=inside, outside=outside, at=0.25)
    dirty = picture.painted(bars, grey * WHITE_GREY)
    image = dirty.taken(0.7, 2.0)
    fitted = fit(dirty, image)
    assert (fitted.misfit <= MAX_MISFIT).all()
    assert distances(fitted, dirty).max() < DIRT_PX
    # It bites: least squares without robust weights follows the dirt.
    monkeypatch.setattr(corner_fit, "OUTLIER_SIGMAS", 1e6)
    assert np.median(distances(fit(dirty, image), dirty).max(axis=1)) > DIRT_PX


@pytest.mark.parametrize("grey", [0.05 * WHITE_GREY, 0.5 * WHITE_GREY, 0.95 * WHITE_GREY])
def test_an_edge_covered_by_half_is_seen_to_be_no_edge(grey: float) -> None:
    picture = take_picture(SMALL)
    covered = picture.painted(bars_across(picture, 0.5, inside=0.12, outside=0.12), grey)
    assert (fit(covered).misfit > MAX_MISFIT).all()
    assert (fit(picture).misfit < 0.1).all()


# --- what is no marker ----------------------------------------------------------------------------------------------

QUAD = np.array([[20.0, 20.0], [60.0, 20.0], [60.0, 60.0], [20.0, 60.0]])
BAD_QUADS = {
    "nan": np.full((4, 2), np.nan),
    "one nan": np.where(np.arange(4)[:, None] == 2, np.nan, QUAD),
    "collapsed": np.full((4, 2), 30.0),
    "collinear": np.array([[20.0, 20.0], [40.0, 20.0], [60.0, 20.0], [80.0, 20.0]]),
    "outside": QUAD + 500.0,
    "far outside": QUAD - 1e7,
    "tiny": 30.0 + 0.02 * QUAD,
}


@pytest.mark.parametrize("kind", BAD_QUADS)
def test_a_bad_quad_is_lost_without_harm_to_its_neighbours(kind: str) -> None:
    image = np.full((100, 100), 200, np.uint8)
    image[20:61, 20:61] = 10
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), dtype=np.uint8)
    good = QUAD[None] + np.array([-0.5, -0.5]) + np.array([0.0, 1.0])[[0, 0, 1, 1]][:, None]
    alone = fit_corners(image, good, CELLS)
    both = fit_corners(image, np.concatenate([good, BAD_QUADS[kind][None]]), CELLS)
    assert not both.misfit[1] <= MAX_MISFIT
    # Rows of one batch are padded alike, which only changes the order of sums.
    np.testing.assert_allclose(both.corners_px[0], alone.corners_px[0], atol=1e-9)
    assert alone.misfit[0] < 0.05
    assert not fit_corners(image, BAD_QUADS[kind][None], CELLS).misfit[0] <= MAX_MISFIT


def test_a_flat_image_has_no_edges() -> None:
    assert fit_corners(np.full((100, 100), 128, np.uint8), QUAD[None], CELLS).misfit[0] > MAX_MISFIT


def test_no_quads_give_no_corners() -> None:
    nothing = fit_corners(np.zeros((10, 10), np.uint8), np.empty((0, 4, 2)), CELLS)
    assert nothing.corners_px.shape == (0, 4, 2)
    assert nothing.sigma_px.shape == (0, 4)
    assert len(nothing.misfit) == len(nothing.shift_px) == 0


def test_a_marker_where_the_lens_has_no_inverse_is_lost() -> None:
    picture = take_picture(SMALL)
    K = np.array([[300.0, 0.0, 640.0], [0.0, 300.0, 360.0], [0.0, 0.0, 1.0]])
    barrel = Camera(name="b", width=1280, height=720, K=K, distortion=np.array([-0.3, 0.02, 0.0, 0.0, 0.0]))
    fitted = fit(picture, camera=barrel)
    seen = np.isfinite(fitted.misfit)
    assert seen.any()
    assert not seen.all()
