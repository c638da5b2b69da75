"""The mean of many poses is their mean, outliers do not move it, and weights count."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from target_views import any_pose, pose_error

from aruco.pose_averaging import average_poses
from aruco.pose_math import Array, Pose, adjoint, exp_se3, invert_transform, log_se3, make_pose, pose_distance


def scattered(T: Pose, rng: np.random.Generator, n: int, turn_rad: float, shift_m: float) -> list[Pose]:
    sigma = np.array([turn_rad] * 3 + [shift_m] * 3)
    return [exp_se3(sigma * rng.standard_normal(6)) @ T for _ in range(n)]


def plain_mean(poses: list[Pose]) -> Pose:
    """What one would write down first: the mean of rotation matrices made orthogonal, and of translations."""
    U, _, Vt = np.linalg.svd(np.mean([T[:3, :3] for T in poses], axis=0))
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return make_pose(R, np.mean([T[:3, 3] for T in poses], axis=0))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 7))
def test_the_mean_of_equal_poses_is_that_pose(seed: int, n: int) -> None:
    T = any_pose(np.random.default_rng(seed))
    average = average_poses([T] * n)
    # Converged to 1e-12, near a half turn with a few more digits of rounding.
    np.testing.assert_allclose(average.T, T, atol=1e-10)
    assert average.n_inliers == n
    assert average.spread_rad < 1e-7  # the angle of a rotation matrix is known to the root of its rounding
    assert average.spread_m < 1e-9
    np.testing.assert_allclose(average.information, n * np.eye(6))


@pytest.mark.parametrize("axis", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.0, 0.8]])
def test_rotations_on_both_sides_of_a_half_turn_have_their_mean_between_them(axis: list[float]) -> None:
    axis_ = np.array(axis)
    poses = [exp_se3(np.append((np.pi + delta) * axis_, np.zeros(3))) for delta in (-0.02, -0.01, 0.01, 0.02)]
    expected = exp_se3(np.append(np.pi * axis_, np.zeros(3)))
    turn_rad, _ = pose_distance(average_poses(poses).T, expected)
    assert turn_rad < 1e-7
    # The mean of their rotation vectors, which jump from +pi to -pi, is no such thing.
    naive = np.mean([log_se3(T)[:3] for T in poses], axis=0)
    assert pose_distance(exp_se3(np.append(naive, np.zeros(3))), expected)[0] > 1.0


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_mean_moves_with_the_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = scattered(any_pose(rng), rng, 9, 0.01, 0.005)
    T = any_pose(rng)
    left = average_poses([T @ pose for pose in poses], [_carried(np.eye(6), T)] * 9).T
    # Distances of poses do not depend on the left frame, so inliers are the same; the mean converges to 1e-12.
    np.testing.assert_allclose(left, T @ average_poses(poses, [np.eye(6)] * 9).T, atol=1e-9)


def _carried(information: Array, T: Pose) -> Array:
    A = adjoint(invert_transform(T))
    return A.T @ information @ A


def test_averaging_makes_the_error_smaller_by_the_root() -> None:
    rng, n = np.random.default_rng(1), 100
    errors = [pose_error(average_poses(scattered(np.eye(4), rng, n, 0.01, 0.01)).T, np.eye(4)) for _ in range(20)]
    expected_mm = 10.0 * np.sqrt(3 / n)
    # 60 coordinates tell a standard deviation to 9 %: four sigma.
    assert np.sqrt(np.mean(np.square(errors), axis=0))[1] == pytest.approx(expected_mm, rel=0.36)


def test_spread_is_the_scatter_of_the_inliers() -> None:
    rng = np.random.default_rng(2)
    average = average_poses(scattered(any_pose(rng), rng, 400, 0.01, 0.005))
    assert average.n_inliers >= 396  # four sigma cut next to none
    assert average.spread_rad == pytest.approx(0.01 * np.sqrt(3), rel=0.1)
    # A turn of the left frame also shifts: by the turn times the distance from the origin.
    assert average.spread_m > 0.005 * np.sqrt(3) * 0.9


TOLERANCE_MM, TOLERANCE_DEG = 5.0, 0.5  # 60 good ones of 10 mm and 1 degree: 2.2 mm and 0.22 degrees


@pytest.mark.parametrize("seed", range(5))
def test_forty_percent_of_outliers_do_not_move_the_mean(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T = make_pose(any_pose(rng)[:3, :3], np.array([0.3, -0.2, 0.4]))
    good = [
        make_pose(exp_se3(np.append(rng.normal(0, np.radians(1.0), 3), np.zeros(3)))[:3, :3] @ T[:3, :3], t)
        for t in T[:3, 3] + rng.normal(0, 0.01, (60, 3))
    ]
    poses = good + [any_pose(rng) for _ in range(40)]
    order = rng.permutation(100)
    average = average_poses([poses[k] for k in order])
    turn_deg, shift_mm = pose_error(average.T, T)
    assert turn_deg < TOLERANCE_DEG
    assert shift_mm < TOLERANCE_MM
    assert not average.inliers[order >= 60].any()
    assert average.inliers[order < 60].sum() >= 55
    # They bite: the mean of all is far off.
    turn_deg, shift_mm = pose_error(plain_mean(poses), T)
    assert turn_deg > TOLERANCE_DEG
    assert shift_mm > TOLERANCE_MM


def test_outliers_that_agree_with_each_other_are_rejected_too() -> None:
    rng = np.random.default_rng(3)
    T, other = any_pose(rng), any_pose(rng)
    poses = scattered(other, rng, 40, 0.002, 0.002) + scattered(T, rng, 60, 0.002, 0.002)
    average = average_poses(poses)
    assert average.inliers[40:].sum() >= 57
    assert not average.inliers[:40].any()


def test_weights_count() -> None:
    rng = np.random.default_rng(4)
    # 3 measurements that are good to 1 mm and 12 that are good to 10 mm, told apart only by their information.
    sigmas = np.array([1e-3] * 3 + [1e-2] * 12)
    information = [np.eye(6) / sigma**2 for sigma in sigmas]
    weighted, unweighted = [], []
    for _ in range(40):
        poses = [exp_se3(sigma * rng.standard_normal(6)) for sigma in sigmas]
        weighted.append(pose_error(average_poses(poses, information).T, np.eye(4))[1])
        unweighted.append(pose_error(average_poses(poses).T, np.eye(4))[1])
    # The best possible: 1 / sqrt(3 / 1 + 12 / 100) = 0.57 mm a coordinate, 0.98 mm in space; unweighted it is 3.6 mm.
    tolerance_mm = 1.3
    assert np.sqrt(np.mean(np.square(weighted))) < tolerance_mm
    assert np.sqrt(np.mean(np.square(unweighted))) > tolerance_mm


def test_information_may_know_one_direction_better_than_another() -> None:
    a, b = make_pose(np.eye(3), np.array([0.01, 0.0, 0.0])), make_pose(np.eye(3), np.array([0.0, 0.02, 0.0]))
    sees_x, sees_y = np.diag([1.0, 1, 1, 1e6, 1, 1]), np.diag([1.0, 1, 1, 1, 1e6, 1])
    T = average_poses([a, b], [sees_x, sees_y]).T
    np.testing.assert_allclose(T[:3, 3], [0.01, 0.02, 0.0], atol=1e-6)


def test_one_pose_is_its_own_mean_and_has_no_spread() -> None:
    T = any_pose(np.random.default_rng(5))
    average = average_poses([T])
    np.testing.assert_allclose(average.T, T, atol=1e-12)
    assert (average.n_inliers, average.spread_m) == (1, pytest.approx(0.0, abs=1e-12))


def test_two_poses_meet_in_the_middle_however_far_apart() -> None:
    for shift_m in (1e-3, 0.5, 10.0):
        a, b = np.eye(4), exp_se3(np.array([0.2, 0.0, 0.0, 0.0, shift_m, 0.0]))
        average = average_poses([a, b])
        assert average.n_inliers == 2
        to_a, to_b = (pose_distance(average.T, T) for T in (a, b))
        np.testing.assert_allclose(to_a, to_b, rtol=1e-6)


def test_of_three_the_two_that_agree_win() -> None:
    a, b, far = np.eye(4), make_pose(np.eye(3), np.array([1e-3, 0, 0])), make_pose(np.eye(3), np.array([0.5, 0, 0]))
    for order in ([a, b, far], [far, a, b], [b, far, a]):
        assert average_poses(order).T[0, 3] == pytest.approx(5e-4)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_order_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = scattered(any_pose(rng), rng, 12, 0.01, 0.01) + [any_pose(rng) for _ in range(4)]
    order = rng.permutation(16)
    a, b = average_poses(poses), average_poses([poses[k] for k in order])
    np.testing.assert_allclose(a.T, b.T, atol=1e-9)
    assert (a.inliers[order] == b.inliers).all()


def test_hundreds_of_poses_are_averaged_like_few() -> None:
    rng = np.random.default_rng(6)
    poses = scattered(np.eye(4), rng, 700, 0.01, 0.01) + [any_pose(rng) for _ in range(300)]
    average = average_poses(poses)
    assert pose_error(average.T, np.eye(4))[1] < 3.0  # 10 mm over the root of 700, in space: 0.65 mm
    assert average.inliers[:700].sum() > 690
    assert average.inliers[700:].sum() < 5


def test_no_poses_are_refused() -> None:
    with pytest.raises(ValueError, match="no poses"):
        average_poses([])
