from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from aruco.errors import InputError
from aruco.pose_math import Array
from rigcal.formats import rotations as rot

ANGLES = st.floats(-np.pi, np.pi)


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), angle=st.sampled_from([np.pi, np.pi - 1e-9, 1.0, 1e-6, 1e-12, 0.0]))
def test_quaternions_are_those_of_scipy(seed: int, angle: float):
    axis = np.random.default_rng(seed).normal(size=3)
    theirs = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    ours = rot.xyzw_of_rotation(theirs.as_matrix())
    assert ours[3] >= 0.0
    # Both signs are the same rotation; at half a turn either may come.
    assert abs(abs(ours @ theirs.as_quat()) - 1.0) < 1e-14
    assert np.abs(rot.rotation_of_xyzw(ours, "x") - theirs.as_matrix()).max() < 1e-14
    assert np.abs(rot.rotation_of_xyzw(-ours, "x") - theirs.as_matrix()).max() < 1e-14


@settings(max_examples=100, deadline=None)
@given(roll=ANGLES, pitch=ANGLES, yaw=ANGLES)
def test_rpy_turns_about_fixed_axes_as_scipy_does(roll: float, pitch: float, yaw: float):
    theirs = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()  # lower case: fixed axes
    assert np.abs(rot.rotation_of_rpy(np.array([roll, pitch, yaw])) - theirs).max() < 1e-14
    back = rot.rpy_of_rotation(theirs)
    assert abs(back[1]) <= np.pi / 2
    assert np.abs(rot.rotation_of_rpy(back) - theirs).max() < 1e-14


@pytest.mark.parametrize("off", [0.0, 1e-16, 1e-13, 1e-12, 1e-9, 1e-7, 1e-4])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_rpy_survives_gimbal_lock(off: float, side: float):
    for roll, yaw in np.random.default_rng(3).uniform(-np.pi, np.pi, size=(50, 2)):
        R = Rotation.from_euler("xyz", [roll, side * (np.pi / 2 - off), yaw]).as_matrix()
        assert np.abs(rot.rotation_of_rpy(rot.rpy_of_rotation(R)) - R).max() < 1e-14


def test_the_naive_roll_misses_in_gimbal_lock():
    R = Rotation.from_euler("xyz", [0.3, np.pi / 2, 1.1]).as_matrix()
    naive = np.array([np.arctan2(R[2, 1], R[2, 2]), np.arcsin(-R[2, 0]), np.arctan2(R[1, 0], R[0, 0])])
    assert np.abs(rot.rotation_of_rpy(naive) - R).max() > 0.1


def test_rounded_matrices_become_the_nearest_rotation():
    for R in Rotation.from_quat(np.random.default_rng(5).normal(size=(200, 4))).as_matrix():
        snapped = rot.nearest_rotation(np.round(R, 6), "x")
        assert np.abs(snapped @ snapped.T - np.eye(3)).max() < 1e-14
        assert np.abs(snapped - R).max() < 1e-6  # what six decimals leave
        assert rot.nearest_rotation(R, "x") is R  # an exact one is left alone, to the bit


@pytest.mark.parametrize("R", [np.diag([1.0, 1.0, -1.0]), 1.01 * np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan)])
def test_what_is_no_rotation_is_refused(R: Array):
    with pytest.raises(InputError, match="somewhere: its rotation"):
        rot.nearest_rotation(R, "somewhere")


def test_what_is_no_rigid_matrix_is_refused():
    for T in (np.eye(3), np.full((4, 4), np.inf), np.diag([1.0, 1.0, 1.0, 2.0])):
        with pytest.raises(InputError, match="somewhere: not the 4 x 4"):
            rot.rigid_pose(T, "somewhere")


@pytest.mark.parametrize("q", [np.zeros(4), np.ones(4), np.full(4, np.nan)])
def test_quaternions_of_another_length_are_refused(q: Array):
    with pytest.raises(InputError, match="somewhere: the quaternion's length"):
        rot.rotation_of_xyzw(q, "somewhere")


def test_numbers_in_words_read_back_and_never_underflow():
    assert rot.words([0.1 + 0.2, -0.0, 5e-324, -1e-40, -1.5e-7]) == [
        "0.30000000000000004",
        "0.0",
        "0.0",
        "0.0",
        "-1.5e-07",
    ]
