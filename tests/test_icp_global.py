"""A camera that was bumped is found again by what it sees; nothing is proposed where nothing tells places apart."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from floor_scenes import FLOOR, Rectangle, camera_at, data_of, depth_of, noisy, ring

from aruco.floor_plane import FloorPlane
from aruco.icp_agreement import Witness, agreement, first_of_voxels, witness
from aruco.icp_cloud import cloud_of
from aruco.icp_features import distinct_spots, matched_spots
from aruco.icp_global import global_start
from aruco.icp_types import ICPConfig
from aruco.icp_votes import Bounds, voted_poses
from aruco.pose_math import Array, Pose, exp_so3, make_pose, pose_distance, transform_points
from benchmarks.levelled_rigs import depth_rig

UP = np.array([0.0, 1.0, 0.0])
PLANE = FloorPlane(UP, 0.0)
# How far the camera was bumped, bounds that allow for it, and how well it is to be found again.
BUMP_DEG, BUMP_M = 20.0, 0.4
ALLOWED = ICPConfig(region="full", stride=6, max_rotation_deg=30.0, max_translation_m=0.6)
FOUND_DEG, FOUND_M = 2.0, 0.05


def _bumped(T: Pose, axis: Array, direction: Array) -> Pose:
    """Turned about its own centre, and shifted."""
    turn = math.radians(BUMP_DEG) * axis / np.linalg.norm(axis)
    return make_pose(exp_so3(turn) @ T[:3, :3], T[:3, 3] + BUMP_M * direction / np.linalg.norm(direction))


def _clouds(data: Mapping[str, Any], poses: Mapping[str, Pose]) -> dict[str, Witness]:
    return {
        name: witness(cloud_of(name, data[name], ALLOWED, T_world_cam=poses[name], floor=PLANE))
        for name in sorted(data)
    }


def _errors(T: Pose, truth: Pose) -> tuple[float, float]:
    angle, distance = pose_distance(T, truth)
    return math.degrees(angle), distance


# --------------------------------------------------------------------------------------------------- the whole of it


class Furnished:
    """Four cameras in a furnished room of the simulator, and what they see."""

    def __init__(self) -> None:
        rig = depth_rig(1, biased=False)
        self.truth: dict[str, Pose] = rig.T_world_cam
        self.data = rig.camera_data
        self.clouds = _clouds(self.data, self.truth)

    def found(self, name: str, T_given: Pose, config: ICPConfig = ALLOWED) -> Pose | None:
        """What is proposed of a camera that is said to stand elsewhere."""
        poses = {**self.truth, name: T_given}
        source = _clouds({name: self.data[name]}, poses)[name]
        return global_start(source, list(self.clouds.values()), poses, config)


@pytest.fixture(scope="module")
def furnished() -> Furnished:
    return Furnished()


@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (1.0, -0.7, 0.5)])
def test_a_bumped_camera_is_found(furnished: Furnished, axis: tuple[float, float, float]) -> None:
    name = sorted(furnished.truth)[0]
    T_given = _bumped(furnished.truth[name], np.array(axis), np.array([0.6, 0.1, -0.8]))
    T = furnished.found(name, T_given)
    assert T is not None
    degrees, metres = _errors(T, furnished.truth[name])
    assert degrees < FOUND_DEG
    assert metres < FOUND_M
    # By the same seed the same bytes; features know no chance.
    again = furnished.found(name, T_given)
    assert again is not None
    assert again.tobytes() == T.tobytes()


def test_a_camera_that_was_bumped_by_little_is_found_nearby(furnished: Furnished) -> None:
    name, truth = sorted(furnished.truth)[0], furnished.truth[sorted(furnished.truth)[0]]
    nudged = make_pose(exp_so3(np.radians(4.0) * UP) @ truth[:3, :3], truth[:3, 3] + [0.05, 0.0, -0.05])
    T = furnished.found(name, nudged)
    assert T is not None
    degrees, metres = _errors(T, truth)
    assert degrees < FOUND_DEG
    assert metres < FOUND_M


def test_nothing_is_proposed_for_a_camera_that_stands_well(furnished: Furnished) -> None:
    name = sorted(furnished.truth)[1]
    assert furnished.found(name, furnished.truth[name]) is None
    # Nor for one that is as far off as markers leave it: that is the adjustment's to mend.
    nudged = make_pose(exp_so3(0.01 * UP) @ furnished.truth[name][:3, :3], furnished.truth[name][:3, 3] + 0.01)
    assert furnished.found(name, nudged) is None


def test_what_lies_out_of_bounds_is_not_proposed(furnished: Furnished) -> None:
    name = sorted(furnished.truth)[0]
    T_given = _bumped(furnished.truth[name], UP, np.array([0.6, 0.1, -0.8]))
    # The default bounds, 5 degrees and 0.1 m, do not reach the truth.
    assert furnished.found(name, T_given, ICPConfig(region="full", stride=6)) is None


def test_nothing_is_proposed_on_a_bare_floor() -> None:
    truth, rng = ring(3), np.random.default_rng(0)
    data = data_of({name: noisy(depth_of(T, (FLOOR,), walls=False), rng) for name, T in truth.items()})
    clouds = _clouds(data, truth)
    bumped = _bumped(truth["cam1"], UP, np.array([1.0, 0.0, 0.0]))
    for T_given in (truth["cam1"], bumped):
        poses = {**truth, "cam1": T_given}
        source = _clouds({"cam1": data["cam1"]}, poses)["cam1"]
        assert len(source.cloud) > 1000
        assert global_start(source, list(clouds.values()), poses, ALLOWED) is None


def test_nothing_is_proposed_without_others() -> None:
    truth = {"cam": camera_at((2.5, 1.5, 0.0))}
    cloud = _clouds(data_of({"cam": depth_of(truth["cam"])}), truth)["cam"]
    assert global_start(cloud, [], truth, ALLOWED) is None
    assert global_start(cloud, [cloud], truth, ALLOWED) is None


# ---------------------------------------------------------------------------------------------------------- its parts


def _step(rng: np.random.Generator, n: int = 8000) -> tuple[Array, Array]:
    """A floor with a wall and a box in the middle: points and normals."""
    u, v = rng.uniform(-1, 1, (2, n))
    zero, one = np.zeros(n), np.ones(n)
    floor = np.stack([2 * u, zero, 2 * v], axis=1)
    top = np.stack([0.3 * u, 0.4 * one, 0.3 * v], axis=1)[: n // 20]
    front = np.stack([0.3 * u, 0.2 + 0.2 * v, 0.3 * one], axis=1)[: n // 20]
    normals = np.repeat([[0, 1, 0], [0, 1, 0], [0, 0, 1.0]], [len(floor), len(top), len(front)], axis=0)
    return np.concatenate([floor, top, front]), normals


def test_a_plane_has_no_distinct_spots_and_a_box_on_it_has() -> None:
    rng = np.random.default_rng(0)
    flat = np.stack([*rng.uniform(-2, 2, (2, 8000)), np.zeros(8000)], axis=1)[:, [0, 2, 1]]
    assert len(distinct_spots(flat, np.tile(UP, (len(flat), 1)), 500)) == 0
    assert len(distinct_spots(np.zeros((0, 3)), np.zeros((0, 3)), 500)) == 0
    spots = distinct_spots(*_step(rng), 500)
    assert len(spots) > 50
    # Features reach 0.3 m, so nothing farther than that from the box is distinct.
    assert np.abs(spots.points[:, [0, 2]]).max() < 0.3 + 0.3
    assert len(distinct_spots(*_step(rng), 20)) == 20


def test_spots_are_matched_within_reach_only() -> None:
    points, normals = _step(np.random.default_rng(0))
    spots = distinct_spots(points, normals, 200)
    i, j = matched_spots(spots, spots, np.full(len(spots), 0.1), 1.0)
    off = spots.points[i] - spots.points[j]
    assert np.linalg.norm(off, axis=1).max() <= 0.1
    # Each is most like itself.
    assert set(zip(i.tolist(), j.tolist())) >= {(k, k) for k in range(len(spots))}
    _, j = matched_spots(spots, spots, np.full(len(spots), 5.0), 0.01)
    assert len(j) > 0


def test_votes_find_a_turn_and_a_shift_among_nineteen_wrong_matches_in_twenty() -> None:
    rng = np.random.default_rng(0)
    T_level = camera_at((2.0, 1.5, 0.0))
    turn, shift = math.radians(-17.0), np.array([0.25, 0.05, -0.3])
    n = 1000
    p = rng.uniform([-2, 0, -2], [2, 1.5, 2], (n, 3))
    centre = T_level[:3, 3]
    q = (p - centre) @ exp_so3(turn * UP).T + centre + shift
    wrong = rng.permutation(n)[: n * 19 // 20]
    q[wrong] = rng.uniform([-2, 0, -2], [2, 1.5, 2], (len(wrong), 3))
    bounds = Bounds(turn_rad=math.radians(30), shift_m=0.6)
    truth = make_pose(exp_so3(turn * UP) @ T_level[:3, :3], centre + shift)
    best, *others = voted_poses(p, q, T_level, bounds, np.random.default_rng(1), 20)
    degrees, metres = _errors(best, truth)
    # Half a bin and a little: 2 degrees and 10 cm wide.
    assert degrees < 1.5
    assert metres < 0.08
    assert len(others) <= 19
    for T in (best, *others):
        assert _errors(T, T_level)[0] <= 30 + 1e-9
        assert _errors(T, T_level)[1] <= 0.6 + 1e-9
    # Where all matches are wrong, the truth is not among the first.
    q = rng.uniform([-2, 0, -2], [2, 1.5, 2], (n, 3))
    missed = voted_poses(p, q, T_level, bounds, np.random.default_rng(1), 1)
    assert not missed or _errors(missed[0], truth)[1] > 0.1
    assert voted_poses(p[:1], q[:1], T_level, bounds, rng, 20) == []


TABLE = Rectangle(height=0.7, centre=(0.3, 0.2), half=(0.6, 0.4))


def test_agreement_is_best_at_the_truth() -> None:
    truth = {"a": camera_at((2.5, 1.6, 0.0)), "b": camera_at((1.5, 1.6, 2.0))}
    data = data_of({name: depth_of(T, (FLOOR, TABLE)) for name, T in truth.items()})
    a, b = (_clouds(data, truth)[name] for name in "ab")
    places = [truth["a"]]
    for step in ((0.3, 0, 0), (-0.3, 0, 0), (0, 0, 0.3), (0, 0, -0.3)):
        places.append(make_pose(truth["a"][:3, :3], truth["a"][:3, 3] + step))
    for angle in (-0.15, 0.15):
        places.append(make_pose(exp_so3(angle * UP) @ truth["a"][:3, :3], truth["a"][:3, 3]))
    fit = agreement(a, [b], truth, places, 0.05)
    # A table and two walls are all that tell: half of what meets still does after 0.3 m.
    assert fit[0] > 1.5 * fit[1:].max()


def test_agreement_knows_free_space() -> None:
    truth = {"a": camera_at((2.5, 1.6, 0.0)), "b": camera_at((1.5, 1.6, 2.0))}
    rooms = {"a": (FLOOR, TABLE), "b": (FLOOR,)}
    data = data_of({name: depth_of(T, rooms[name], walls=False) for name, T in truth.items()})
    a, b = (_clouds(data, truth)[name] for name in "ab")
    # Floor meets floor, and counts nothing; b looks through a's table.
    assert agreement(a, [b], truth, [truth["a"]], 0.05)[0] < -5
    alike = data_of({name: depth_of(T, (FLOOR,), walls=False) for name, T in truth.items()})
    a, b = (_clouds(alike, truth)[name] for name in "ab")
    assert agreement(a, [b], truth, [truth["a"]], 0.05)[0] == 0


def test_of_each_voxel_the_first_point_counts() -> None:
    points = np.array([[0.01, 0, 0], [0.02, 0, 0], [-0.01, 0, 0], [0.15, 0, 0], [0.04, 0, 0]])
    np.testing.assert_array_equal(first_of_voxels(points, 0.1), [0, 2, 3])
    assert len(first_of_voxels(np.zeros((0, 3)), 0.1)) == 0
    moved = transform_points(make_pose(np.eye(3), np.array([0.2, 0.0, 0.0])), points)
    np.testing.assert_array_equal(first_of_voxels(moved, 0.1), [0, 2, 3])
