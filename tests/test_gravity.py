"""Up by accelerometers: exact truth, noise, odd ones, contradictions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aruco.alignment import turn_upright
from aruco.gravity import AGREE_DEG, angle_deg, up_by_accelerometers
from aruco.pose_math import Array, Pose, exp_so3, make_pose

DOWNWARDS = np.array([0.0, -1.0, 0.0])


def rig(n: int, seed: int = 0) -> tuple[dict[str, Pose], Array]:
    """Cameras turned at random, and up in their world."""
    rng = np.random.default_rng(seed)
    up = rng.normal(size=3)
    poses = {f"c{k}": make_pose(exp_so3(rng.normal(size=3)), rng.normal(size=3)) for k in range(n)}
    return poses, up / np.linalg.norm(up)


def measured(
    poses: dict[str, Pose], up: Array, off_deg: dict[str, float] | None = None, seed: int = 1
) -> dict[str, Array]:
    """What accelerometers of given errors say."""
    rng = np.random.default_rng(seed)
    found = {}
    for name, T in poses.items():
        axis = np.cross(up, rng.normal(size=3))
        wrong = exp_so3(axis / np.linalg.norm(axis) * np.radians((off_deg or {}).get(name, 0.0)))
        found[name] = T[:3, :3].T @ wrong @ up
    return found


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 6), st.integers(0, 1000))
def test_exact_accelerometers_give_the_exact_up(n: int, seed: int):
    poses, up = rig(n, seed)
    heard = up_by_accelerometers(poses, measured(poses, up))
    assert heard is not None
    assert heard.up_world is not None
    # Rounding of a handful of products.
    assert float(angle_deg(heard.up_world, up)) < 1e-6
    assert heard.odd == ()
    assert max(heard.disagreement_deg.values()) == heard.spread_deg < 1e-6
    upright = turn_upright(poses, heard.up_world)
    assert np.allclose(upright.R_align @ up, [0, 1, 0], atol=1e-9)
    down = turn_upright(poses, heard.up_world, up_axis="-y")
    assert np.allclose(down.R_align @ up, [0, -1, 0], atol=1e-9)


def test_the_length_of_what_was_measured_does_not_matter():
    poses, up = rig(3)
    heard = up_by_accelerometers(poses, {name: 9.81 * v for name, v in measured(poses, up).items()})
    assert heard is not None
    assert heard.up_world is not None
    assert float(angle_deg(heard.up_world, up)) < 1e-6
    assert all(abs(np.linalg.norm(v) - 1) < 1e-12 for v in heard.up_cam.values())


@pytest.mark.parametrize("odd_deg", [10.0, 90.0, 180.0])
def test_one_odd_accelerometer_is_named_and_costs_nothing(odd_deg: float):
    poses, up = rig(4)
    readings = measured(poses, up, {"c0": 0.5, "c1": 0.5, "c2": 0.5, "c3": odd_deg})
    heard = up_by_accelerometers(poses, readings)
    assert heard is not None
    assert heard.up_world is not None
    assert heard.odd == ("c3",)
    assert abs(heard.disagreement_deg["c3"] - odd_deg) < 1.5
    # Each of three is half a degree off.
    assert float(angle_deg(heard.up_world, up)) < 0.5
    if odd_deg == 90:  # The tolerance bites: the plain mean is tens of degrees off.
        mean = np.sum([poses[n][:3, :3] @ v for n, v in readings.items()], axis=0)
        assert float(angle_deg(mean / np.linalg.norm(mean), up)) > 10


def test_nobody_knows_where_two_contradict_or_two_groups_are_equal():
    poses, up = rig(2)
    heard = up_by_accelerometers(poses, measured(poses, up, {"c1": 8.0}))
    assert heard is not None
    assert heard.up_world is None
    assert heard.odd == ("c0", "c1")
    assert np.isnan(heard.spread_deg)
    assert abs(heard.disagreement_deg["c0"] - 8.0) < 1e-6
    assert heard.turned(np.eye(3)).up_world is None
    poses, up = rig(4)
    readings = measured(poses, up)
    tilted = exp_so3(np.radians([20.0, 0, 0]))
    readings |= {n: poses[n][:3, :3].T @ tilted @ poses[n][:3, :3] @ readings[n] for n in ("c2", "c3")}
    heard = up_by_accelerometers(poses, readings)
    assert heard is not None
    assert heard.up_world is None


def test_two_of_three_and_more_decide():
    poses, up = rig(5)
    heard = up_by_accelerometers(poses, measured(poses, up, {"c2": 20.0, "c3": 40.0, "c4": 60.0}))
    assert heard is not None
    assert heard.odd == ("c2", "c3", "c4")


def test_uncalibrated_accelerometers_do_not_contradict_each_other():
    # One degree each, in any direction: none is odd, and the mean of eight is better than one.
    for seed in range(50):
        poses, up = rig(8, seed)
        heard = up_by_accelerometers(poses, measured(poses, up, dict.fromkeys(poses, 1.0), seed + 1000))
        assert heard is not None
        assert heard.up_world is not None
        assert heard.odd == ()
        assert float(angle_deg(heard.up_world, up)) < 1.0
        assert heard.spread_deg < AGREE_DEG


def test_cameras_without_pose_and_vectors_that_are_none_are_passed_over():
    poses, up = rig(3)
    readings = measured(poses, up) | {"lost": np.array([0.0, 0, 1]), "c1": np.zeros(3), "c2": np.array([np.nan, 0, 0])}
    heard = up_by_accelerometers(poses, readings)
    assert heard is not None
    assert list(heard.up_cam) == ["c0"]
    assert up_by_accelerometers(poses, {}) is None
    assert up_by_accelerometers(poses, {"lost": np.array([0.0, 0, 1])}) is None


def test_a_turned_world_turns_its_up():
    poses, up = rig(2)
    heard = up_by_accelerometers(poses, measured(poses, up))
    assert heard is not None
    R = exp_so3(np.array([0.3, -1.0, 0.2]))
    turned = heard.turned(R).up_world
    assert turned is not None
    assert float(angle_deg(turned, R @ up)) < 1e-6


def test_angles_are_exact_at_both_ends():
    a = np.array([1.0, 0, 0])
    assert float(angle_deg(a, np.array([np.cos(1e-8), np.sin(1e-8), 0]))) == pytest.approx(np.degrees(1e-8), rel=1e-6)
    assert float(angle_deg(a, -a)) == 180.0
