"""Covariances in other worlds, at the camera, and in words, beside samples that went the same way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from target_views import any_pose

from aruco.pose_math import Array, exp_se3, exp_so3, invert_transform, log_se3, log_so3, make_pose
from aruco.uncertainty import CameraSigma, at_camera, camera_sigma, carried, least_known


def any_covariance(rng: np.random.Generator, sigma: float = 1e-3) -> Array:
    A = rng.standard_normal((6, 6))
    return sigma**2 * A @ A.T


def samples(rng: np.random.Generator, S: Array, n: int) -> Array:
    return rng.multivariate_normal(np.zeros(6), S, n, method="cholesky")


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_carried_covariance_is_that_of_carried_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    C, T = any_pose(rng), any_pose(rng)
    # A twist goes to Ad(C) of it, so a covariance of one twist goes to that of its image.
    xi = 1e-3 * rng.standard_normal(6)
    moved = log_se3(C @ exp_se3(xi) @ T @ invert_transform(C @ T))
    # Rounding of poses of order one, beside twists of 1e-3.
    np.testing.assert_allclose(carried(np.outer(xi, xi), C), np.outer(moved, moved), atol=1e-15)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_carrying_there_and_back_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    S, C = any_covariance(rng), any_pose(rng)
    np.testing.assert_allclose(carried(carried(S, C), invert_transform(C)), S, atol=1e-12 * np.abs(S).max() * 100)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_at_the_camera_a_twist_is_a_turn_and_a_shift_of_its_centre(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = any_pose(rng, shift_m=3.0)
    xi = 1e-6 * rng.standard_normal(6)
    moved = exp_se3(xi) @ T
    R = T[:3, :3]
    seen = np.concatenate([R.T @ log_so3(moved[:3, :3] @ R.T), R.T @ (moved[:3, 3] - T[:3, 3])])
    # To first order: twists of 1e-6 leave a share of 1e-6 times the distance of a few metres.
    np.testing.assert_allclose(at_camera(np.outer(xi, xi), T), np.outer(seen, seen), atol=1e-4 * float(seen @ seen))


def test_standard_deviations_are_those_of_samples() -> None:
    rng = np.random.default_rng(0)
    T, S = any_pose(rng, shift_m=3.0), any_covariance(rng)
    errors = []
    for xi in samples(rng, S, 4000):
        moved = exp_se3(xi) @ T
        turn = log_so3(T[:3, :3].T @ moved[:3, :3])
        errors.append(np.concatenate([turn, T[:3, :3].T @ (moved[:3, 3] - T[:3, 3])]))
    sigma = camera_sigma(S, T)
    # 4000 samples know a standard deviation to 1.1 %: four times that.
    np.testing.assert_allclose(np.concatenate([sigma.rotation_rad, sigma.centre_m]), np.std(errors, axis=0), rtol=0.045)
    # The tolerance bites: the translation part of the twist is not the centre's error.
    naive = np.sqrt(np.diag(T[:3, :3].T @ S[3:, 3:] @ T[:3, :3]))
    assert np.abs(naive / sigma.centre_m - 1).max() > 0.2


def test_standard_deviations_do_not_depend_on_the_world() -> None:
    rng = np.random.default_rng(1)
    T, S, C = any_pose(rng), any_covariance(rng), any_pose(rng, shift_m=5.0)
    here, there = camera_sigma(S, T), camera_sigma(carried(S, C), C @ T)
    np.testing.assert_allclose(there.rotation_rad, here.rotation_rad, rtol=1e-9)
    np.testing.assert_allclose(there.centre_m, here.centre_m, rtol=1e-9)


def test_totals_are_roots_of_summed_variances() -> None:
    sigma = CameraSigma(rotation_rad=np.array([3e-3, 4e-3, 0.0]), centre_m=np.array([0.0, 0.05, 0.12]))
    assert sigma.total_rad == pytest.approx(5e-3)
    assert sigma.total_m == pytest.approx(0.13)


def test_no_covariance_is_no_deviation() -> None:
    sigma = camera_sigma(np.zeros((6, 6)), any_pose(np.random.default_rng(2)))
    assert sigma.total_rad == sigma.total_m == 0.0


@pytest.mark.parametrize(("axis", "word"), [(0, "pitch"), (1, "yaw"), (2, "roll")])
def test_the_least_known_turn_is_named_about_the_camera_axes(axis: int, word: str) -> None:
    T = make_pose(exp_so3(np.array([0.4, -1.0, 0.3])), np.array([1.0, 2.0, 3.0]))
    # A turn about the camera's own axis, in place: the twist's translation keeps the centre where it is.
    omega = T[:3, axis] * math.radians(0.4)
    xi = np.concatenate([omega, -np.cross(omega, T[:3, 3])])
    sentence = least_known("3", camera_sigma(np.outer(xi, xi), T), reach_m=2.0)
    assert sentence == f"{word} of camera 3 is known only to 0.4 degrees"


@pytest.mark.parametrize(("axis", "words"), [(0, "sideways"), (1, "up and down"), (2, "along its optical axis")])
def test_the_least_known_shift_is_named_along_the_camera_axes(axis: int, words: str) -> None:
    T = make_pose(exp_so3(np.array([0.4, -1.0, 0.3])), np.array([1.0, 2.0, 3.0]))
    xi = np.concatenate([np.zeros(3), 0.0123 * T[:3, axis]])
    sentence = least_known("left", camera_sigma(np.outer(xi, xi), T), reach_m=2.0)
    assert sentence == f"the place of camera left {words} is known only to 12 mm"


def test_a_turn_counts_by_what_it_moves_at_the_target() -> None:
    sigma = CameraSigma(rotation_rad=np.array([1e-3, 0.0, 0.0]), centre_m=np.array([0.0, 0.0, 3e-3]))
    assert "along its optical axis" in least_known("a", sigma, reach_m=2.9)
    assert "pitch" in least_known("a", sigma, reach_m=3.1)
