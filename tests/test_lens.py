from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aruco.lens import bend, distort, project, straighten, undistort
from aruco.model import Camera, DistortionModel
from aruco.pose_math import Array

seeds = st.integers(0, 2**32 - 1)


def camera(
    model: DistortionModel, distortion: list[float], *, width: int = 1280, height: int = 720, f_px: float = 700.0
) -> Camera:
    K = np.array([[f_px, 0.0, width / 2 - 3.2], [0.0, 1.01 * f_px, height / 2 + 4.7], [0.0, 0.0, 1.0]])
    return Camera(name="c", width=width, height=height, K=K, distortion_model=model, distortion=np.array(distortion))


# Coefficients of the size that calibrations of such cameras have; every pixel has an inverse.
LENSES = {
    "none": camera("plumb_bob", []),
    "depth camera": camera("plumb_bob", [-0.17, 0.025, 0.0003, -0.0002, 0.0]),
    "webcam": camera("plumb_bob", [0.05, -0.12, 0.001, -0.002, 0.02], f_px=900),
    "barrel": camera("plumb_bob", [-0.30, 0.12, 0.0005, 0.0004, -0.02], f_px=900),
    "pincushion": camera("plumb_bob", [0.25, 0.05, 0.0, 0.0, 0.0]),
    "wide rational": camera("rational_polynomial", [-1.1, 2.5, 0.0002, 0.0001, 0.55, -1.05, 2.35, 0.85], f_px=530),
    "time of flight": camera(
        "rational_polynomial", [0.4457, -2.6247, 0.0006, -0.0002, 1.5349, 0.3232, -2.4428, 1.4587], f_px=610
    ),
    "fisheye": camera("equidistant", [0.02, -0.005, 0.001, -0.0005], f_px=500),
    "fisheye, plain": camera("equidistant", [0.0, 0.0, 0.0, 0.0], f_px=500),
    "fisheye, steep": camera("equidistant", [0.3, 0.1, 0.02, 0.0], f_px=500),
    "fisheye, tracker": camera("equidistant", [-0.008, 0.045, -0.042, 0.0078], width=848, height=480, f_px=345),
}
# A strong barrel and a broken rational model: their formulas fold back before the corner of the image.
FOLDED = {
    "barrel": camera("plumb_bob", [-0.28, 0.10, 0.0, 0.0, -0.02], f_px=600),
    "rational": camera("rational_polynomial", [0.5, -2.7, 0.0005, -0.0003, 1.5, 0.39, -2.5, 1.45], f_px=610),
    "fisheye": camera("equidistant", [-0.02, 0.01, -0.01, 0.002], width=1280, height=1280, f_px=430),
}


def pixel_grid(c: Camera, n: int = 40) -> Array:
    u, v = np.meshgrid(np.linspace(-0.5, c.width - 0.5, n), np.linspace(-0.5, c.height - 0.5, n))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@pytest.mark.parametrize("name", LENSES)
def test_jacobian_is_the_derivative(name: str) -> None:
    lens = LENSES[name]
    x = np.concatenate([undistort(lens, pixel_grid(lens, 12)), [[0.0, 0.0], [1e-9, 0.0], [1e-6, -1e-6]]])
    _, J = distort(lens, x)
    h = 1e-5
    for k in range(2):
        step = h * np.eye(2)[k]
        numeric = (distort(lens, x + step)[0] - distort(lens, x - step)[0]) / (2 * h)
        # Central differences: h^2 times third derivatives of up to a few hundred, and 1e-16 / h of rounding.
        np.testing.assert_allclose(J[:, :, k], numeric, atol=3e-8)


@pytest.mark.parametrize("name", LENSES)
def test_undistort_is_the_inverse_of_distort_for_every_pixel(name: str) -> None:
    lens = LENSES[name]
    pixels = pixel_grid(lens)
    x = undistort(lens, pixels)
    assert np.isfinite(x).all()
    # Newton's method ends at rounding: 1e-13 times a thousand pixels.
    np.testing.assert_allclose(distort(lens, x)[0] @ lens.K[:2, :2].T + lens.K[:2, 2], pixels, atol=1e-9)
    np.testing.assert_allclose(bend(lens, straighten(lens, pixels)), pixels, atol=1e-9)


@settings(max_examples=100, deadline=None)
@given(
    name=st.sampled_from(sorted(LENSES)),
    seed=seeds,
    scale=st.floats(0.2, 1.2),
)
def test_undistort_finds_where_a_ray_came_from(name: str, seed: int, scale: float) -> None:
    base = LENSES[name]
    lens = Camera(
        name="c",
        width=base.width,
        height=base.height,
        K=base.K,
        distortion_model=base.distortion_model,
        # A rational lens is a near cancellation: its parts may only shrink together.
        distortion=base.distortion * (1.0 if base.distortion_model == "rational_polynomial" else scale),
    )
    x = np.random.default_rng(seed).uniform(-0.7, 0.7, (20, 2))
    pixels = distort(lens, x)[0] @ lens.K[:2, :2].T + lens.K[:2, 2]
    np.testing.assert_allclose(undistort(lens, pixels), x, atol=1e-10)


@pytest.mark.parametrize("name", FOLDED)
def test_where_the_formula_folds_back_there_is_no_inverse(name: str) -> None:
    lens = FOLDED[name]
    pixels = pixel_grid(lens, 60)
    x = undistort(lens, pixels)
    lost = np.isnan(x).any(axis=1)
    assert 0.0 < lost.mean() < 0.5
    # Newton's method alone leaps across the centre or beyond the fold, to a solution that is no ray of this pixel.
    outwards = np.einsum("ij,ij->i", x[~lost], pixels[~lost] - lens.K[:2, 2])
    assert (outwards >= 0).all()
    angle = np.arctan(np.linalg.norm(x[~lost], axis=1))
    radius_px = np.linalg.norm(pixels[~lost] - lens.K[:2, 2], axis=1)
    assert np.degrees(angle[radius_px < 100]).max() < 15
    # What has an inverse lies inside what has none.
    assert radius_px.min() < np.linalg.norm(pixels[lost] - lens.K[:2, 2], axis=1).min()
    J = distort(lens, x[~lost])[1]
    assert (np.linalg.det(J) > 0).all()
    assert (np.trace(J, axis1=1, axis2=2) > 0).all()
    np.testing.assert_allclose(distort(lens, x[~lost])[0] @ lens.K[:2, :2].T + lens.K[:2, 2], pixels[~lost], atol=1e-5)


@pytest.mark.parametrize("name", [*LENSES])
def test_pixels_far_outside_the_image_never_raise(name: str) -> None:
    lens = LENSES[name]
    x = undistort(lens, np.array([[1e4, 1e4], [-5000.0, 300.0], [1e6, 0.0], [np.nan, 1.0], [640.0, 360.0]]))
    assert np.isnan(x[3]).any()
    assert np.isfinite(x[4]).all()
    assert undistort(lens, np.empty((0, 2))).shape == (0, 2)


def test_a_fisheye_cannot_see_beyond_ninety_degrees() -> None:
    lens = LENSES["fisheye, plain"]
    centre = lens.K[:2, 2]
    radius_px = lens.K[0, 0] * np.radians([89.9, 90.1, 45.0, 0.0])
    x = undistort(lens, centre + radius_px[:, None] * np.array([1.0, 0.0]))
    assert np.degrees(np.arctan(x[0, 0])) == pytest.approx(89.9, abs=1e-9)
    assert np.isnan(x[1]).all()
    assert x[2, 0] == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_array_equal(x[3], [0.0, 0.0])


# --- agreement with OpenCV ---------------------------------------------------------------------------------------


def points_in_view(lens: Camera, seed: int, n: int = 50) -> Array:
    """(n, 3) points in front of the camera that lie inside its image."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([0, 0], [lens.width, lens.height], (n, 2))
    rays = np.concatenate([undistort(lens, pixels), np.ones((n, 1))], axis=1)
    return rays * rng.uniform(0.3, 6.0, (n, 1))


@settings(max_examples=60, deadline=None)
@given(name=st.sampled_from(sorted(n for n in LENSES if "fisheye" not in n)), seed=seeds)
def test_projection_agrees_with_opencv(name: str, seed: int) -> None:
    lens = LENSES[name]
    points = points_in_view(lens, seed)
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.K, lens.distortion)
    np.testing.assert_allclose(project(lens, points), expected.reshape(-1, 2), atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(name=st.sampled_from(sorted(n for n in LENSES if "fisheye" in n)), seed=seeds)
def test_fisheye_projection_agrees_with_opencv(name: str, seed: int) -> None:
    lens = LENSES[name]
    points = points_in_view(lens, seed)
    expected, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), lens.K, lens.distortion)
    np.testing.assert_allclose(project(lens, points), expected.reshape(-1, 2), atol=1e-9)


def _undistort(pixels: np.ndarray, lens: Camera, criteria: tuple[int, int, float]) -> np.ndarray:
    iterate: Any = getattr(cv2, "undistortPointsIter", None) or cv2.undistortPoints  # OpenCV 4 and 5
    return iterate(pixels[:, None], lens.K, lens.distortion, R=np.eye(3), P=lens.K, criteria=criteria)


@pytest.mark.parametrize("name", LENSES)
def test_straightening_agrees_with_opencv(name: str) -> None:
    lens = LENSES[name]
    pixels = pixel_grid(lens, 15)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    if lens.distortion_model == "equidistant":
        pixels = pixels[np.linalg.norm((pixels - lens.K[:2, 2]) / lens.K[0, 0], axis=1) < 1.2]
        expected = cv2.fisheye.undistortPoints(
            pixels[:, None], lens.K, lens.distortion, R=np.eye(3), P=lens.K, criteria=criteria
        )
    else:
        # OpenCV's fixed-point iteration converges slowly, or not at all, in the corners of wide lenses.
        pixels = pixels[np.linalg.norm((pixels - lens.K[:2, 2]) / lens.K[0, 0], axis=1) < 0.5]
        expected = _undistort(pixels, lens, criteria)
    np.testing.assert_allclose(straighten(lens, pixels), expected.reshape(-1, 2), atol=1e-5)


def test_distortion_matters() -> None:
    # The tolerances above can be missed: a pinhole is tens of pixels off at the corner of an ordinary lens.
    lens = LENSES["depth camera"]
    corner = np.array([[0.0, 0.0]])
    assert np.linalg.norm(straighten(lens, corner) - corner) > 30
    np.testing.assert_array_equal(straighten(LENSES["none"], corner), corner)
    np.testing.assert_array_equal(bend(LENSES["none"], corner), corner)


# --- edges -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", LENSES)
def test_points_not_in_front_of_the_camera_have_no_pixel(name: str) -> None:
    lens = LENSES[name]
    pixels = project(lens, np.array([[0.0, 0.0, 1.0], [0.1, 0.2, 0.0], [0.1, 0.2, -1.0], [0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(pixels[0], lens.K[:2, 2], atol=1e-12)
    assert np.isnan(pixels[1:]).all()


def test_skewed_pixels_go_there_and_back() -> None:
    K = np.array([[700.0, 5.0, 640.0], [0.0, 710.0, 360.0], [0.0, 0.0, 1.0]])
    lens = Camera(name="c", width=1280, height=720, K=K, distortion=np.array([-0.1, 0.02, 0.0, 0.0, 0.0]))
    pixels = pixel_grid(lens, 10)
    np.testing.assert_allclose(bend(lens, straighten(lens, pixels)), pixels, atol=1e-9)
    rays = np.concatenate([undistort(lens, pixels), np.ones((len(pixels), 1))], axis=1)
    np.testing.assert_allclose(project(lens, 2.0 * rays), pixels, atol=1e-9)


def test_the_input_is_left_alone() -> None:
    for lens in LENSES.values():
        pixels = pixel_grid(lens, 5)
        before = pixels.copy()
        for function in (undistort, straighten, bend):
            function(lens, pixels)
        np.testing.assert_array_equal(pixels, before)
