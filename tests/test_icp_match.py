"""Which samples of two clouds meet, and by how much they miss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from floor_rooms import FLOOR, ROOM, WALLS, Wall, cameras, depth_image
from icp_rooms import LEVEL, camera_data, clouds_of

from aruco.icp_cloud import Cloud, cloud_of
from aruco.icp_match import Matches, match, overlapping_pairs, shared_areas
from aruco.icp_types import ICPConfig
from aruco.pose_math import Array, Pose, exp_so3, invert_transform, make_pose, transform_points
from rigcal.sim.placement import look_at

RIG = cameras()
FULL = ICPConfig(region="full", stride=2)
REACH_M = 0.03


@pytest.fixture(scope="module")
def clouds() -> dict[str, Cloud]:
    return clouds_of(RIG)


@pytest.fixture(scope="module")
def bare() -> dict[str, Cloud]:
    return clouds_of(RIG, [FLOOR])


def fitness(found: Matches) -> float:
    return len(found) / found.n_candidates


def rmse(found: Matches) -> float:
    return float(np.sqrt(np.mean(found.gap_m**2)))


def between(T_world_cam: dict[str, Pose], a: str, b: str) -> Pose:
    return invert_transform(T_world_cam[b]) @ T_world_cam[a]


def moved(T: Pose, turn_rad: Array | None = None, shift_m: Array | None = None) -> Pose:
    """A pose turned about its centre and shifted, in world axes."""
    R = np.eye(3) if turn_rad is None else exp_so3(np.asarray(turn_rad, dtype=np.float64))
    return make_pose(R @ T[:3, :3], T[:3, 3] + (0.0 if shift_m is None else np.asarray(shift_m)))


def cloud_at(T: Pose, walls: list[Wall], name: str = "cam") -> Cloud:
    return cloud_of(name, camera_data(depth_image(T, walls)), FULL, T_world_cam=T, floor=LEVEL)


@pytest.mark.parametrize(("a", "b"), [("cam0", "cam1"), ("cam0", "cam2"), ("cam3", "cam0")])
def test_at_the_true_poses_nearly_all_that_can_meet_does(clouds: dict[str, Cloud], a: str, b: str):
    found = match(clouds[a], clouds[b], between(RIG, a, b), REACH_M)
    assert len(found) > 1000
    # Of what is seen by both, a few samples fall on an edge or between two walls.
    assert fitness(found) > 0.97
    p = transform_points(RIG[a], clouds[a].points[found.i])
    q = transform_points(RIG[b], clouds[b].points[found.j])
    normal = clouds[b].normals[found.j] @ RIG[b][:3, :3].T
    assert found.gap_m == pytest.approx(((p - q) * normal).sum(axis=1), abs=1e-12)


def test_gaps_are_as_large_as_the_noise_and_lean_to_no_side(clouds: dict[str, Cloud]):
    source, target, T = clouds["cam0"], clouds["cam1"], between(RIG, "cam0", "cam1")
    found = match(source, target, T, REACH_M)
    n = target.normals[found.j]
    along = ((source.rays[found.i] @ T[:3, :3].T * n).sum(axis=1), (target.rays[found.j] * n).sum(axis=1))
    # The rooms' noise is 0.015 px a square, of which the clouds promise 0.06.
    sigma = 0.25 * np.hypot(source.sigma_m[found.i] * along[0], target.sigma_m[found.j] * along[1])
    z = found.gap_m / sigma
    assert np.median(np.abs(z)) == pytest.approx(0.6745, rel=0.1)
    assert abs(np.median(z)) < 0.1
    assert (np.abs(z) > 6).mean() < 0.002


def test_a_raised_camera_shows_in_the_gaps_of_the_floor(bare: dict[str, Cloud]):
    raised = RIG | {"cam0": moved(RIG["cam0"], shift_m=np.array([0.0, 0.008, 0.0]))}
    there = match(bare["cam0"], bare["cam1"], between(raised, "cam0", "cam1"), REACH_M)
    back = match(bare["cam1"], bare["cam0"], between(raised, "cam1", "cam0"), REACH_M)
    # Normals point up: cam0's floor lies 8 mm above cam1's, and the other way round. Medians of 10 mm in thousands.
    assert np.median(there.gap_m) == pytest.approx(0.008, abs=0.0005)
    assert np.median(back.gap_m) == pytest.approx(-0.008, abs=0.0005)


def test_a_floor_does_not_say_where_one_stands_on_it(bare: dict[str, Cloud]):
    target = bare["cam1"]
    at = match(bare["cam0"], target, between(RIG, "cam0", "cam1"), REACH_M)
    slid = RIG | {"cam0": moved(RIG["cam0"], np.array([0.0, 0.03, 0.0]), np.array([0.05, 0.0, -0.04]))}
    there = match(bare["cam0"], target, between(slid, "cam0", "cam1"), REACH_M)
    # Gaps differ by what the floors' own tilt (0.01 degrees) makes over 6 cm, and by which samples are met.
    assert np.median(there.gap_m) == pytest.approx(np.median(at.gap_m), abs=1e-4)
    assert rmse(there) == pytest.approx(rmse(at), rel=0.03)
    # With a normal of its own each sample would feel the slide.
    shift = between(slid, "cam0", "cam1")[:3, 3] - between(RIG, "cam0", "cam1")[:3, 3]
    wobble = np.random.default_rng(0).normal(0, np.radians(2.0), (len(there), 3)) @ shift
    assert np.abs(wobble).mean() > 5e-4


def test_what_lies_behind_a_surface_is_hidden_and_what_lies_before_it_contradicts():
    eye = look_at(np.array([0.0, 1.5, -2.0]), np.array([0.0, 1.5, 0.0]))
    near, far = (cloud_at(eye, [Wall(2, z)], str(z)) for z in (1.0, 1.5))
    hidden = match(far, near, np.eye(4), REACH_M)
    assert (len(hidden), hidden.n_candidates) == (0, 0)
    contradicting = match(near, far, np.eye(4), REACH_M)
    assert len(contradicting) == 0
    assert contradicting.n_candidates > 1000


def test_the_two_sides_of_a_thin_wall_do_not_meet():
    panel = [Wall(2, 0.0, (-1.0, 0.0), (1.0, 2.0))]
    poses = {side: look_at(np.array([0.0, 1.0, z]), np.array([0.0, 1.0, 0.0])) for side, z in (("a", -2.0), ("b", 2.0))}
    a, b = (cloud_at(T, panel, name) for name, T in poses.items())
    found = match(a, b, between(poses, "a", "b"), REACH_M)
    assert len(a) > 500
    assert len(found) == 0
    assert len(match(a, b, between(poses, "a", "b"), REACH_M, max_angle_deg=180.0)) > 500


def test_nothing_is_met_behind_a_camera_or_beside_its_image(clouds: dict[str, Cloud]):
    back = make_pose(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    aside = make_pose(exp_so3(np.array([0.0, 1.7, 0.0])), np.zeros(3))
    for T in (back, aside):
        found = match(clouds["cam0"], clouds["cam0"], T, REACH_M)
        assert (len(found), found.n_candidates) == (0, 0)


def test_a_cloud_meets_itself_exactly(clouds: dict[str, Cloud]):
    cloud = clouds["cam2"]
    found = match(cloud, cloud, np.eye(4), REACH_M)
    same = found.i == found.j
    # Means over squares of which some pixels are missing may fall into the next one.
    assert same.mean() > 0.99
    assert (found.gap_m[same] == 0.0).all()


def test_an_empty_cloud_meets_nothing(clouds: dict[str, Cloud]):
    far = cloud_at(RIG["cam0"], [Wall(1, -30.0, (-500, -500), (500, 500))])
    assert len(far) == 0
    for a, b in ((far, clouds["cam0"]), (clouds["cam0"], far), (far, far)):
        assert len(match(a, b, np.eye(4), REACH_M)) == 0
    assert overlapping_pairs({"a": far, "b": clouds["cam0"]}, {"a": np.eye(4), "b": RIG["cam0"]}, FULL) == {}


def test_far_surfaces_meet_within_their_noise_not_within_the_distance_asked():
    data = [depth_image(RIG["cam0"], ROOM, seed=k, disparity_px=d) for k, d in enumerate((0.0, 0.15))]
    near, far = (cloud_of("c", camera_data(depth), FULL, T_world_cam=RIG["cam0"], floor=LEVEL) for depth in data)
    found = match(near, far, np.eye(4), 0.001)
    # Walls 6 m away miss each other by 64 mm for 0.15 px, and sigma of the difference is 0.085 px.
    assert fitness(found) > 0.9
    assert np.abs(found.gap_m).max() > 0.04


def test_every_so_many_samples_are_a_sample_of_all(clouds: dict[str, Cloud]):
    T = between(RIG, "cam0", "cam1")
    every = match(clouds["cam0"], clouds["cam1"], T, REACH_M)
    some = match(clouds["cam0"], clouds["cam1"], T, REACH_M, every=8)
    chosen = every.i % 8 == 0
    assert np.array_equal(some.i, every.i[chosen])
    assert np.array_equal(some.j, every.j[chosen])
    assert np.array_equal(some.gap_m, every.gap_m[chosen])


def test_pairs_share_floor_and_surfaces(clouds: dict[str, Cloud]):
    pairs = overlapping_pairs(clouds, RIG, FULL)
    assert set(pairs) == {(f"cam{a}", f"cam{b}") for a in range(4) for b in range(a + 1, 4)}
    # All see most of a room of 8 m by 8 m, with a margin of half a metre.
    assert all(20.0 < area <= 81.0 for area in pairs.values())
    assert overlapping_pairs(clouds, RIG, replace(FULL, min_overlap_area=100.0)) == {}


def test_stray_points_do_not_widen_boxes():
    T = {"a": RIG["cam0"], "b": RIG["cam1"]}
    room = [Wall(1, 0.0, (-1.0, -1.0), (1.0, 1.0))]
    stray = Wall(2, 4.0, (-0.2, 0.0), (0.2, 0.4))
    alone, with_stray = ({n: cloud_at(pose, walls, n) for n, pose in T.items()} for walls in (room, [*room, stray]))
    config = replace(FULL, overlap_margin=0.0)
    a, b = (overlapping_pairs(clouds, T, config)["a", "b"] for clouds in (alone, with_stray))
    assert b == pytest.approx(a, rel=0.03)


def test_cameras_in_two_rooms_are_no_pair():
    wall = [Wall(0, 0.0), FLOOR, *WALLS]
    poses = {
        "left": look_at(np.array([-2.0, 1.5, 0.0]), np.array([0.0, 1.0, 0.0])),
        "right": look_at(np.array([2.0, 1.5, 0.0]), np.array([0.0, 1.0, 0.0])),
        "right2": look_at(np.array([2.0, 1.5, 0.5]), np.array([0.0, 1.0, 0.0])),
    }
    clouds = {name: cloud_at(T, wall, name) for name, T in poses.items()}
    # The boxes overlap by their margins; what they hold is on two sides of a wall.
    assert set(overlapping_pairs(clouds, poses, FULL)) == {("right", "right2")}
    areas = shared_areas(clouds, poses, FULL)
    assert list(areas) == [("left", "right"), ("left", "right2"), ("right", "right2")]
    assert min(areas.values()) > FULL.min_overlap_area
