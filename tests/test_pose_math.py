from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aruco.pose_math import (
    Array,
    Pose,
    adjoint,
    checked_pose,
    exp_se3,
    exp_so3,
    invert_transform,
    log_se3,
    log_so3,
    make_pose,
    matrix_to_rvec_tvec,
    pose_distance,
    rotation_angle,
    rvec_tvec_to_matrix,
    skew,
    swing_twist,
    transform_points,
)

# A few dozen roundings of numbers of size one to ten.
ROUNDING = 1e-13

# Everyday angles, and the places where formulas lose digits: zero, every threshold between, and half a turn.
angles = st.one_of(
    st.floats(0.0, math.pi),
    st.sampled_from([0.0, 1e-300, 1e-12, 1e-8, 1e-6, 0.99e-4, 1.01e-4, 1e-3, 0.0999, 0.1001, 1.0]),
    st.sampled_from([0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3]).map(lambda gap: math.pi - gap),
)
seeds = st.integers(0, 2**32 - 1)
AXES = [np.eye(3)[k] * sign for k in range(3) for sign in (1.0, -1.0)]
units = st.one_of(
    st.sampled_from(AXES),
    seeds.map(lambda seed: (v := np.random.default_rng(seed).normal(size=3)) / np.linalg.norm(v)),
)
rvecs = st.builds(lambda unit, angle: unit * angle, units, angles)
vectors = seeds.map(lambda seed: np.random.default_rng(seed).normal(size=3))
twists = st.builds(lambda rvec, rho: np.concatenate([rvec, rho]), rvecs, vectors)
poses = st.builds(lambda rvec, t: make_pose(Rotation.from_rotvec(rvec).as_matrix(), t), rvecs, vectors)

many = settings(max_examples=300, deadline=None)


def series_exp(A: Array) -> Array:
    """The matrix exponential by its series, in extended precision: slow, and with no special cases."""
    total = np.eye(len(A), dtype=np.longdouble)
    term = total.copy()
    for k in range(1, 60):
        term = term @ A.astype(np.longdouble) / k
        total = total + term
    return total.astype(np.float64)


def hat(xi: Array) -> Array:
    A = np.zeros((4, 4))
    A[:3, :3], A[:3, 3] = skew(xi[:3]), xi[3:]
    return A


# --- the group ---------------------------------------------------------------------------------------------------


@many
@given(T_a_b=poses, T_b_c=poses, T_c_d=poses)
def test_poses_form_a_group(T_a_b: Pose, T_b_c: Pose, T_c_d: Pose) -> None:
    np.testing.assert_allclose((T_a_b @ T_b_c) @ T_c_d, T_a_b @ (T_b_c @ T_c_d), atol=ROUNDING)
    np.testing.assert_allclose(T_a_b @ invert_transform(T_a_b), np.eye(4), atol=ROUNDING)
    np.testing.assert_allclose(invert_transform(T_a_b) @ T_a_b, np.eye(4), atol=ROUNDING)
    np.testing.assert_allclose(
        invert_transform(T_a_b @ T_b_c), invert_transform(T_b_c) @ invert_transform(T_a_b), atol=ROUNDING
    )
    checked_pose(T_a_b @ T_b_c, "product")


@many
@given(T_a_b=poses, T_b_c=poses, seed=seeds)
def test_points_follow_the_frames_of_the_names(T_a_b: Pose, T_b_c: Pose, seed: int) -> None:
    points_c = np.random.default_rng(seed).normal(size=(2, 5, 3))
    np.testing.assert_allclose(
        transform_points(T_a_b, transform_points(T_b_c, points_c)),
        transform_points(T_a_b @ T_b_c, points_c),
        atol=1e-12,
    )
    one = transform_points(T_a_b, points_c[0, 0])
    np.testing.assert_allclose(one, (T_a_b @ np.append(points_c[0, 0], 1.0))[:3], atol=ROUNDING)


def test_a_pose_maps_the_origin_of_b_to_its_translation() -> None:
    T_a_b = make_pose(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(transform_points(T_a_b, np.array([[0.0, 0, 0], [1, 0, 0]])), [[1, 2, 3], [1, 3, 3]])


# --- exponential and logarithm -----------------------------------------------------------------------------------


@many
@given(rvec=rvecs)
def test_so3_exponential_is_the_series_and_scipys(rvec: Array) -> None:
    R = exp_so3(rvec)
    np.testing.assert_allclose(R, series_exp(skew(rvec)), atol=4e-15)
    np.testing.assert_allclose(R, Rotation.from_rotvec(rvec).as_matrix(), atol=4e-15)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=4e-15)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=4e-15)


@many
@given(xi=twists)
def test_se3_exponential_is_the_series(xi: Array) -> None:
    # Small angles too: (1 - cos a) / a^2 taken literally is off by 1e-12 at a = 1e-4.
    np.testing.assert_allclose(exp_se3(xi), series_exp(hat(xi)), atol=1e-14)


@many
@given(rvec=rvecs)
def test_logarithm_undoes_exponential(rvec: Array) -> None:
    log = log_so3(exp_so3(rvec))
    assert np.linalg.norm(log) <= math.pi + 1e-15
    if np.linalg.norm(rvec) > math.pi - 1e-9 and log @ rvec < 0:
        log = -log  # half turns one way and the other are the same rotation
    # Near half a turn rounding may carry the angle across pi, to where the other vector is the shorter one.
    np.testing.assert_allclose(log, rvec, atol=1e-14)


@many
@given(angle=st.sampled_from([1e-300, 1e-100, 1e-20, 1e-12, 1e-9]), unit=units)
def test_tiny_rotations_keep_their_digits(angle: float, unit: Array) -> None:
    np.testing.assert_allclose(log_so3(exp_so3(angle * unit)), angle * unit, rtol=1e-12, atol=1e-28)


@many
@given(T=poses)
def test_exponential_undoes_logarithm(T: Pose) -> None:
    np.testing.assert_allclose(exp_se3(log_se3(T)), T, atol=ROUNDING)
    np.testing.assert_allclose(exp_so3(log_so3(T[:3, :3])), T[:3, :3], atol=ROUNDING)


@many
@given(xi=twists)
def test_se3_logarithm_undoes_exponential(xi: Array) -> None:
    assume(np.linalg.norm(xi[:3]) < math.pi - 1e-6)
    np.testing.assert_allclose(log_se3(exp_se3(xi)), xi, atol=ROUNDING)


@pytest.mark.parametrize("axis", [*AXES, np.array([1.0, 1, 0]) / math.sqrt(2), np.array([-1.0, 2, 2]) / 3])
def test_half_turns_have_a_logarithm(axis: Array) -> None:
    half_turn = 2.0 * np.outer(axis, axis) - np.eye(3)
    log = log_so3(half_turn)
    assert np.linalg.norm(log) == pytest.approx(math.pi, abs=1e-15)
    np.testing.assert_allclose(np.abs(log @ axis), math.pi, atol=1e-14)


@given(seed=seeds)
@settings(max_examples=20, deadline=None)
def test_exponential_takes_stacks(seed: int) -> None:
    stack = np.random.default_rng(seed).normal(size=(2, 3, 3))
    stack[0, 0] = 0.0
    together = exp_so3(stack)
    for i in np.ndindex(2, 3):
        np.testing.assert_array_equal(together[i], exp_so3(stack[i]))


@many
@given(v=vectors, w=vectors)
def test_skew_is_the_cross_product(v: Array, w: Array) -> None:
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w), atol=ROUNDING)
    np.testing.assert_array_equal(skew(np.stack([v, w]))[1], skew(w))


@many
@given(rvec=rvecs, t=vectors)
def test_opencvs_vectors_go_there_and_back(rvec: Array, t: Array) -> None:
    T = rvec_tvec_to_matrix(rvec.reshape(3, 1), t.reshape(3, 1))
    np.testing.assert_allclose(T, make_pose(Rotation.from_rotvec(rvec).as_matrix(), t), atol=4e-15)
    back_rvec, back_t = matrix_to_rvec_tvec(T)
    np.testing.assert_allclose(rvec_tvec_to_matrix(back_rvec, back_t), T, atol=ROUNDING)
    back_t[:] = 0.0
    np.testing.assert_array_equal(T[:3, 3], t)  # what is returned is a copy


# --- adjoint -----------------------------------------------------------------------------------------------------


@many
@given(T=poses, xi=twists, T_b_c=poses)
def test_adjoint_carries_twists_between_frames(T: Pose, xi: Array, T_b_c: Pose) -> None:
    conjugate = T @ exp_se3(xi) @ invert_transform(T)
    # A translation of several metres times rotations: a few more roundings than elsewhere.
    np.testing.assert_allclose(exp_se3(adjoint(T) @ xi), conjugate, atol=1e-12)
    np.testing.assert_allclose(adjoint(T @ T_b_c), adjoint(T) @ adjoint(T_b_c), atol=1e-12)


# --- swing and twist ---------------------------------------------------------------------------------------------


@many
@given(rvec=rvecs, axis=units)
def test_swing_and_twist_make_the_rotation_again(rvec: Array, axis: Array) -> None:
    R = exp_so3(rvec)
    swing, twist = swing_twist(R, axis)
    np.testing.assert_allclose(swing @ twist, R, atol=1e-14)
    np.testing.assert_allclose(twist @ axis, axis, atol=1e-14)
    np.testing.assert_allclose(swing @ swing.T, np.eye(3), atol=1e-14)
    # Nearly half a turn of swing leaves the twist to rounding; the sum still holds.
    if rotation_angle(swing) < math.pi - 1e-6:
        assert abs(log_so3(swing) @ axis) < 1e-9  # rounding 1e-15 over the distance from half a turn


@many
@given(axis=units, other=units, swing_angle=st.floats(0.0, 3.0), twist_angle=st.floats(-3.1, 3.1))
def test_swing_and_twist_are_found_again(axis: Array, other: Array, swing_angle: float, twist_angle: float) -> None:
    across = np.cross(axis, other)
    assume(np.linalg.norm(across) > 1e-3)
    true_swing = exp_so3(swing_angle * across / np.linalg.norm(across))
    swing, twist = swing_twist(true_swing @ exp_so3(twist_angle * axis), axis)
    # cos(1.5) = 0.07: the twist's sine and cosine lose a factor 14 at the largest swing.
    np.testing.assert_allclose(swing, true_swing, atol=1e-13)
    np.testing.assert_allclose(twist, exp_so3(twist_angle * axis), atol=1e-13)


def test_a_half_turn_of_swing_leaves_no_twist() -> None:
    half_turn = np.diag([1.0, -1.0, -1.0])
    swing, twist = swing_twist(half_turn, np.array([0.0, 1.0, 0.0]))
    np.testing.assert_array_equal(swing, half_turn)
    np.testing.assert_array_equal(twist, np.eye(3))


def test_pure_twist_has_no_swing() -> None:
    y = np.array([0.0, 1.0, 0.0])
    for R in (np.eye(3), exp_so3(0.3 * y), np.diag([-1.0, 1.0, -1.0])):
        swing, twist = swing_twist(R, y)
        np.testing.assert_allclose(swing, np.eye(3), atol=1e-15)
        np.testing.assert_allclose(twist, R, atol=1e-15)


# --- distances ---------------------------------------------------------------------------------------------------


@many
@given(T=poses, xi=twists, T_common=poses)
def test_distance_ignores_the_common_frame(T: Pose, xi: Array, T_common: Pose) -> None:
    other = make_pose(exp_so3(xi[:3]), xi[3:]) @ T
    angle, distance = pose_distance(T, other)
    assert angle == pytest.approx(float(np.linalg.norm(xi[:3])), abs=1e-13)
    again = pose_distance(T_common @ T, T_common @ other)
    assert again == pytest.approx((angle, distance), abs=1e-12)
    assert pose_distance(other, T) == pytest.approx((angle, distance), abs=1e-12)
    assert pose_distance(T, T) == pytest.approx((0.0, 0.0), abs=1e-15)


# --- what a pose is ----------------------------------------------------------------------------------------------


def test_a_checked_pose_is_a_read_only_copy() -> None:
    given_pose = np.eye(4)
    pose = checked_pose(given_pose, "T")
    given_pose[0, 3] = 9.0
    assert pose[0, 3] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        pose[0, 3] = 1.0


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (np.eye(3), "shape"),
        (np.full((4, 4), np.nan), "finite"),
        (np.diag([1.0, 1.0, 1.0, 2.0]), "rigid"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "proper rotation"),
        (np.diag([1.0, 1.0, 1.001, 1.0]), "proper rotation"),
        (np.diag([0.0, 0.0, 0.0, 1.0]), "proper rotation"),
        (None, "shape"),
    ],
)
def test_what_is_no_pose_is_refused_by_name(bad: object, reason: str) -> None:
    with pytest.raises(ValueError, match=f"cam7.*{reason}"):
        checked_pose(bad, "cam7")
