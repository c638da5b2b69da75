from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from floor_scenes import BASELINE_M, FLOOR, K, Rectangle, camera_at, data_of, depth_of, disturbed, noisy, ring
from hypothesis import given, settings
from hypothesis import strategies as st

from aruco.depth_bias import DepthBias
from aruco.errors import CalibrationError, InputError
from aruco.floor_doubts import floor_doubts
from aruco.floor_model import DEFAULT_TURN_RAD, FloorState, centre_jacobian, predicted_plane
from aruco.floor_view import LEAN_PX, floor_samples
from aruco.ground_plane import (
    FloorCorrection,
    FloorPlane,
    GroundPlaneConfig,
    compute_floor_correction,
    detect_floor_plane,
    refine_ground_from_depth,
    unproject_depth_to_points,
)
from aruco.pose_math import (
    Array,
    Pose,
    exp_so3,
    invert_transform,
    make_pose,
    pose_distance,
    swing_twist,
    transform_points,
)
from rigcal.quality.truth import pair_errors

UP = np.array([0.0, 1.0, 0.0])
HALF_TURN = make_pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))  # +Y up to -Y up
# Rounding, and where iteration stops.
EXACT = 1e-6
CONFIG = GroundPlaneConfig(stride=2)
TABLE = Rectangle(height=0.72, centre=(0.0, 0.0), half=(0.9, 0.9))

seeds = st.integers(0, 2**32 - 1)


def tilt_deg(T_a: Pose, T_b: Pose, up: Array = UP) -> float:
    """Angle between up in two cameras' frames."""
    return math.degrees(float(np.arcsin(np.linalg.norm(np.cross(T_a[:3, :3].T @ up, T_b[:3, :3].T @ up)))))


def covariances_of(poses: Mapping[str, Pose], turn_deg: float, shift_m: float) -> dict[str, Array]:
    S = np.diag([math.radians(turn_deg) ** 2] * 3 + [shift_m**2] * 3)
    back = {name: centre_jacobian(T[:3, 3], inverse=True) for name, T in poses.items()}
    return {name: J @ S @ J.T for name, J in back.items()}


def noisy_data(
    poses: Mapping[str, Pose], seed: int = 0, surfaces: Any = (FLOOR,), **bias: Any
) -> dict[str, dict[str, Any]]:
    rng = np.random.default_rng(seed)
    return data_of({name: noisy(depth_of(T, surfaces), rng, **bias) for name, T in poses.items()})


# --- planes


@given(seeds)
def test_a_moved_plane_holds_the_moved_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plane = FloorPlane(rng.normal(size=3), float(rng.normal()))
    T = make_pose(exp_so3(rng.normal(size=3)), rng.normal(size=3))
    points = rng.normal(size=(5, 3))
    np.testing.assert_allclose(
        plane.moved(T).distances(transform_points(T, points)), plane.distances(points), atol=1e-9
    )


def test_a_plane_has_a_unit_normal_and_a_height() -> None:
    plane = FloorPlane(normal=np.array([0, 2, 0]), d=-3.0)
    np.testing.assert_allclose(plane.normal, [0, 1, 0])
    assert plane.height == pytest.approx(1.5)
    with pytest.raises(InputError, match="normal"):
        FloorPlane(np.zeros(3), 0.0)


def test_the_covariance_of_a_plane_follows_a_change_of_frame() -> None:
    rng = np.random.default_rng(0)
    T = make_pose(exp_so3(rng.normal(size=3)), rng.normal(size=3))
    covariance = np.diag([1e-6, 4e-6, 9e-6])
    plane = FloorPlane(np.array([0.1, 1.0, 0.2]), -0.3, covariance=covariance)
    there = plane.moved(T)
    back = there.moved(invert_transform(T))
    assert back.covariance is not None
    np.testing.assert_allclose(back.covariance, covariance, atol=1e-12)


def test_points_of_depth_lie_on_their_rays_in_metres() -> None:
    depth = np.full((4, 6), 2.0)
    depth[0, 0], depth[1, 1], depth[2, 2] = np.nan, 0.0, -1.0
    points = unproject_depth_to_points(depth, np.array([[2.0, 0, 1], [0, 4.0, 2], [0, 0, 1]]))
    assert points.shape == (21, 3)
    np.testing.assert_allclose(points[0], [2.0 * (1 - 1) / 2, 2.0 * (0 - 2) / 4, 2.0])
    assert unproject_depth_to_points(depth, np.eye(3), 2).shape == (4, 3)
    assert unproject_depth_to_points(depth, np.eye(3), max_depth_m=1.0).shape == (0, 3)
    with pytest.raises(InputError, match="stride"):
        unproject_depth_to_points(depth, np.eye(3), 0)
    with pytest.raises(InputError, match="depth"):
        unproject_depth_to_points(depth[0], np.eye(3))


def test_depth_of_the_floor_unprojects_onto_the_floor() -> None:
    T = camera_at((2.0, 1.5, 0.5))
    points = unproject_depth_to_points(depth_of(T, walls=False), K, 3, T_world_cam=T)
    np.testing.assert_allclose(points[:, 1], 0.0, atol=EXACT)


def test_the_floor_is_found_among_walls_and_strays() -> None:
    rng = np.random.default_rng(1)
    floor = np.column_stack([rng.uniform(-2, 2, 2000), rng.normal(0.1, 0.004, 2000), rng.uniform(-2, 2, 2000)])
    wall = np.column_stack([rng.uniform(-2, 2, 3000), rng.uniform(0, 2.5, 3000), rng.normal(2, 0.004, 3000)])
    strays = rng.uniform(-2, 2, (500, 3))
    plane = detect_floor_plane(np.vstack([floor, wall, strays]), seed=3)
    assert plane is not None
    # 2000 points of 4 mm noise over 4 m: 0.1 mm and 0.1 mrad; strays within the slab add a few times that.
    assert plane.height == pytest.approx(0.1, abs=1e-3)
    assert math.degrees(math.acos(plane.normal @ UP)) < 0.05
    assert plane.rms_m == pytest.approx(0.004, rel=0.3)
    assert plane.n_inliers > 1900


def test_the_same_seed_finds_the_same_plane() -> None:
    points = np.random.default_rng(0).normal(size=(500, 3)) * [1, 0.02, 1]
    a, b = detect_floor_plane(points, seed=5), detect_floor_plane(points, seed=5)
    assert a is not None
    assert b is not None
    np.testing.assert_array_equal(a.normal, b.normal)


def test_where_there_is_no_floor_none_is_found() -> None:
    rng = np.random.default_rng(2)
    wall = np.column_stack([rng.uniform(-2, 2, 900), rng.uniform(0, 2.5, 900), np.full(900, 2.0)])
    assert detect_floor_plane(wall) is None
    assert detect_floor_plane(np.zeros((0, 3))) is None
    assert detect_floor_plane(np.full((10, 3), np.nan)) is None
    assert detect_floor_plane(np.zeros((500, 3))) is None


def test_a_height_range_chooses_between_table_and_floor() -> None:
    rng = np.random.default_rng(3)
    table = rng.uniform(-1, 1, (3000, 3)) * [1, 0, 1] + [0, 0.7, 0]
    floor = rng.uniform(-2, 2, (1000, 3)) * [1, 0, 1]
    points = np.vstack([table, floor])
    high, low = detect_floor_plane(points), detect_floor_plane(points, height_range=(-0.2, 0.2))
    assert high is not None
    assert low is not None
    assert high.height == pytest.approx(0.7, abs=EXACT)
    assert low.height == pytest.approx(0.0, abs=EXACT)


def test_noisy_points_weigh_less() -> None:
    rng = np.random.default_rng(4)
    near = np.column_stack([rng.uniform(-1, 1, 800), rng.normal(0, 0.001, 800), rng.uniform(-1, 1, 800)])
    # Far points that are all 10 mm too high, as bias would make them, and known to be bad.
    far = np.column_stack([rng.uniform(-1, 1, 800), np.full(800, 0.01), rng.uniform(2, 4, 800)])
    sigma = np.r_[np.full(800, 0.001), np.full(800, 0.02)]
    points = np.vstack([near, far])
    weighted, plain = detect_floor_plane(points, sigma_m=sigma), detect_floor_plane(points)
    assert weighted is not None
    assert plain is not None
    # Weights of 400 to 1; unweighted the tilt is 10 mm over 3 m, 0.2 degrees.
    assert math.degrees(math.acos(weighted.normal @ UP)) < 0.03
    assert math.degrees(math.acos(plain.normal @ UP)) > 0.15


# --- corrections


@given(seeds)
def test_a_correction_levels_the_plane_about_the_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    centre = rng.normal(size=3)
    plane = FloorPlane(UP + rng.uniform(-0.03, 0.03, 3), float(rng.uniform(-0.02, 0.02)))
    correction = compute_floor_correction(plane, 0.25, max_rotation_deg=10, max_translation_m=1, centre=centre)
    assert correction.accepted
    after = plane.moved(correction.T_world_new_old)
    np.testing.assert_allclose(after.normal, UP, atol=1e-9)
    assert after.height == pytest.approx(0.25, abs=1e-9)
    moved = transform_points(correction.T_world_new_old, centre)
    np.testing.assert_allclose((moved - centre)[[0, 2]], 0.0, atol=1e-9)
    np.testing.assert_allclose(swing_twist(correction.T_world_new_old[:3, :3], UP)[1], np.eye(3), atol=1e-9)


@pytest.mark.parametrize(("tilt_deg_", "height", "word"), [(6.0, 0.0, "turn"), (1.0, 0.2, "height")])
def test_a_correction_beyond_its_bounds_is_rejected_with_a_reason(tilt_deg_: float, height: float, word: str) -> None:
    plane = FloorPlane(exp_so3(np.array([math.radians(tilt_deg_), 0, 0])) @ UP, -height)
    correction = compute_floor_correction(plane)
    assert not correction.accepted
    assert word in correction.reason
    np.testing.assert_array_equal(correction.T_world_new_old, np.eye(4))


def test_the_derivatives_of_the_equations_are_right() -> None:
    rng = np.random.default_rng(0)
    T = camera_at((2.0, 1.5, 0.5))
    x, c = np.array([0.03, -0.02, 0.1]), np.zeros(3)
    state = FloorState(up=UP, pivot=rng.normal(size=3), floor=x, corrections=np.zeros((1, 3)))
    _, by_floor, by_camera = predicted_plane(T, state, c)
    step = 1e-6
    for k, e in enumerate(np.eye(3) * step):
        a, b = (predicted_plane(T, replace(state, floor=x + s * e), c)[0] for s in (1, -1))
        np.testing.assert_allclose((a - b) / (2 * step), by_floor[:, k], atol=1e-8)
        a, b = (predicted_plane(T, state, c + s * e)[0] for s in (1, -1))
        np.testing.assert_allclose((a - b) / (2 * step), by_camera[:, k], atol=1e-8)


# --- levelling


def test_a_common_tilt_and_height_are_taken_out_beyond_the_bounds() -> None:
    truth = ring()
    T_world_true = make_pose(exp_so3(np.radians([2.0, 0.0, -3.0])), np.array([0.0, -0.6, 0.0]))
    given_poses = {name: T_world_true @ T for name, T in truth.items()}
    data = data_of({name: depth_of(T) for name, T in truth.items()})
    new, metrics = refine_ground_from_depth(data, given_poses, CONFIG)
    assert metrics.success
    for name, T in truth.items():
        # Exact depth, but the lowest centimetre of the walls counts as floor.
        assert tilt_deg(new[name], T) < 0.01
        assert new[name][1, 3] == pytest.approx(T[1, 3], abs=5e-4)
        # The common motion turns about the world's origin, without yaw.
        np.testing.assert_allclose(metrics.T_level_world @ given_poses[name], new[name], atol=5e-4)
        assert metrics.camera_planes[name].height == pytest.approx(0.0, abs=5e-4)
        np.testing.assert_allclose(metrics.camera_planes[name].normal, UP, atol=5e-4)
    assert max(distance for _, distance in pair_errors(new, truth).values()) < 5e-4
    np.testing.assert_allclose(metrics.T_level_world[[0, 2], 3], 0.0)
    assert metrics.floor_before is not None
    assert metrics.floor_before.distances(T_world_true[:3, 3]) == pytest.approx(0.0, abs=5e-4)


@pytest.mark.parametrize("with_covariances", [True, False])
def test_rough_poses_become_level(with_covariances: bool) -> None:
    truth = ring()
    start = disturbed(truth, np.random.default_rng(1), turn_deg=0.6, shift_m=0.012)
    known = covariances_of(start, 0.6, 0.012) if with_covariances else None
    data = noisy_data(truth)
    new, metrics = refine_ground_from_depth(data, start, CONFIG, covariances=known)
    assert metrics.success
    # What the pose is believed is some 5 percent of 1 degree, and a fifth of 15 mm; depth noise adds 0.02 degrees.
    assert max(tilt_deg(new[name], truth[name]) for name in truth) < 0.1
    assert max(abs(new[name][1, 3] - truth[name][1, 3]) for name in truth) < 0.004
    # The tolerance can be missed: by the poses as they were.
    assert max(tilt_deg(start[name], truth[name]) for name in truth) > 0.5
    assert max(abs(start[name][1, 3] - truth[name][1, 3]) for name in truth) > 0.01
    for name, move in metrics.corrections.items():
        assert move.accepted
        assert move.gain > 0.5
        assert move.rms_after_m < move.rms_before_m
        assert metrics.camera_planes[name].rms_m < 0.02


def test_single_corrections_change_neither_yaw_nor_place() -> None:
    truth = ring()
    start = disturbed(truth, np.random.default_rng(2), turn_deg=0.6, shift_m=0.012)
    new, metrics = refine_ground_from_depth(noisy_data(truth), start, CONFIG)
    for name in truth:
        common = metrics.T_level_world @ start[name]
        np.testing.assert_allclose(new[name][[0, 2], 3], common[[0, 2], 3], atol=EXACT)
        turn = new[name][:3, :3] @ common[:3, :3].T
        np.testing.assert_allclose(swing_twist(turn, UP)[1], np.eye(3), atol=EXACT)
        np.testing.assert_allclose(metrics.corrections[name].T_world_new_old @ common, new[name], atol=EXACT)


def test_a_world_whose_y_points_down_is_levelled_alike() -> None:
    truth = ring()
    start = disturbed(truth, np.random.default_rng(3), turn_deg=0.6, shift_m=0.012)
    data = noisy_data(truth)
    up, metrics_up = refine_ground_from_depth(data, start, replace(CONFIG, target_floor_y=0.3))
    turned = {name: HALF_TURN @ T for name, T in start.items()}
    down_config = replace(CONFIG, up=(0, -1, 0), target_floor_y=-0.3)
    down, metrics_down = refine_ground_from_depth(data, turned, down_config)
    for name in truth:
        np.testing.assert_allclose(HALF_TURN @ down[name], up[name], atol=EXACT)
        assert down[name][1, 3] == pytest.approx(-0.3 - truth[name][1, 3], abs=0.004)
        assert metrics_down.camera_planes[name].normal[1] < -0.99
        assert metrics_down.corrections[name].gain == pytest.approx(metrics_up.corrections[name].gain, abs=1e-4)


@pytest.mark.parametrize("with_covariances", [True, False])
def test_biased_depth_does_not_spoil_good_poses(with_covariances: bool) -> None:
    ratios, naive = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = ring(heights_m=rng.uniform(1.0, 2.2, 4).tolist())
        start = disturbed(truth, rng, turn_deg=0.03, shift_m=0.002)
        data: dict[str, dict[str, Any]] = {}
        for name, T in truth.items():
            scale, disparity_px = rng.standard_normal(2) * [0.003, 0.15]
            data |= data_of({name: noisy(depth_of(T), rng, scale=scale, disparity_px=disparity_px)})
        known = covariances_of(start, 0.03, 0.002) if with_covariances else None
        new, metrics = refine_ground_from_depth(data, start, CONFIG, covariances=known)
        before = np.median([distance for _, distance in pair_errors(start, truth).values()])
        after = np.median([distance for _, distance in pair_errors(new, truth).values()])
        ratios.append(after / before)
        assert after < max(1.05 * before, before + 0.001)
        # What each camera's own plane asks for, done without weighing.
        whole = {
            name: compute_floor_correction(plane, centre=new[name][:3, 3]).T_world_new_old @ new[name]
            for name, plane in metrics.camera_planes.items()
        }
        naive.append(np.median([distance for _, distance in pair_errors(whole, truth).values()]) / before)
    # The mean over 8 rigs of a ratio that scatters by 5 percent.
    assert np.mean(ratios) < 1.03
    assert np.mean(naive) > 1.3


def test_depth_that_errs_across_the_image_does_not_spoil_good_poses() -> None:
    before, after = [], []
    x, y = ((index - middle) / K[0, 0] for index, middle in zip(np.indices((180, 320))[::-1], K[:2, 2]))
    for seed in range(8):
        rng = np.random.default_rng(seed)
        truth = ring()
        start = disturbed(truth, rng, turn_deg=0.012, shift_m=0.0005)
        data: dict[str, dict[str, Any]] = {}
        for name, T in truth.items():
            lean_px = LEAN_PX * rng.standard_normal(2)
            leant = 1.0 / (1.0 / depth_of(T) + (lean_px[0] * x + lean_px[1] * y) / (K[0, 0] * BASELINE_M))
            data |= data_of({name: noisy(leant, rng)})
        known = covariances_of(start, 0.012, 0.0005)
        new, _ = refine_ground_from_depth(data, start, CONFIG, covariances=known)
        for poses, errors in ((start, before), (new, after)):
            errors.append(np.median([distance for _, distance in pair_errors(poses, truth).values()]))
    # 1.0; 1.9 where depth is thought to have no lean.
    assert np.mean(np.array(after) / before) < 1.1


def test_a_known_bias_is_taken_out_and_then_believed() -> None:
    truth = ring()
    start = disturbed(truth, np.random.default_rng(4), turn_deg=0.1, shift_m=0.005)
    bias = DepthBias(
        scale=0.01, inverse_depth=0.3 / 84.0, focal_baseline=84.0, covariance=np.diag([0.0003**2, (0.01 / 84.0) ** 2])
    )
    data = noisy_data(truth, scale=0.01, disparity_px=0.3)
    biased, unsure = refine_ground_from_depth(data, start, CONFIG, covariances=covariances_of(start, 0.1, 0.005))
    for entry in data.values():
        entry["bias"] = bias
    new, metrics = refine_ground_from_depth(data, start, CONFIG, covariances=covariances_of(start, 0.1, 0.005))
    # The bias is known to 0.3 permille and 0.01 px: 0.5 mm and 0.01 degrees; noise is as large.
    assert max(tilt_deg(new[name], truth[name]) for name in truth) < 0.05
    assert max(abs(new[name][1, 3] - truth[name][1, 3]) for name in truth) < 0.002
    assert max(abs(biased[name][1, 3] - truth[name][1, 3]) for name in truth) > 0.004
    for name, move in metrics.corrections.items():
        assert move.gain > unsure.corrections[name].gain + 0.1


def test_one_bumped_camera_is_corrected_and_the_good_ones_stay() -> None:
    truth = ring(5, heights_m=(1.2, 1.6, 2.0, 1.4, 1.8))
    start = disturbed(truth, np.random.default_rng(5), turn_deg=0.02, shift_m=0.001)
    start["cam2"] = make_pose(exp_so3(np.radians([2.0, 0, 1.0])) @ start["cam2"][:3, :3], start["cam2"][:3, 3])
    new, metrics = refine_ground_from_depth(
        noisy_data(truth), start, CONFIG, covariances=covariances_of(start, 0.02, 0.001)
    )
    assert metrics.corrections["cam2"].gain > 0.9
    assert tilt_deg(new["cam2"], truth["cam2"]) < 0.15  # noise and bias prior of one camera
    assert metrics.pose_scales["cam2"] > 10
    assert max(metrics.pose_scales[name] for name in truth if name != "cam2") < 3
    assert max(tilt_deg(new[name], truth[name]) for name in truth if name != "cam2") < 0.05


def test_a_bumped_camera_does_not_make_the_others_doubted_and_spoilt_by_bias() -> None:
    before, after = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        truth = ring()
        start = disturbed(truth, rng, turn_deg=0.03, shift_m=0.002)
        known = covariances_of(start, 0.03, 0.002)
        turn = exp_so3(np.radians([3.0, 0.0, 0.0]))
        start["cam1"] = make_pose(turn @ start["cam1"][:3, :3], start["cam1"][:3, 3] + 0.06 * UP)
        data: dict[str, dict[str, Any]] = {}
        for name, T in truth.items():
            scale, disparity_px = rng.standard_normal(2) * [0.003, 0.15]
            data |= data_of({name: noisy(depth_of(T), rng, scale=scale, disparity_px=disparity_px)})
        new, metrics = refine_ground_from_depth(data, start, replace(CONFIG, stride=4), covariances=known)
        assert list(metrics.doubts.odd) == ["cam1"]
        assert not metrics.doubts.shared
        good = {name: T for name, T in truth.items() if name != "cam1"}
        for found, errors in ((start, before), (new, after)):
            poses = {name: found[name] for name in good}
            errors.append(np.median([distance for _, distance in pair_errors(poses, good).values()]))
    # On 40 simulated rigs the mean ratio is 1.02 (0.02); where the odd camera has a part in the others' scale, 1.7.
    assert np.mean(np.array(after) / before) < 1.15


def test_a_near_floor_seen_with_a_wide_lens_is_no_row_of_edges() -> None:
    # Seen at 70 degrees, from 0.35 m: from pixel to pixel more of a step than of lenses of 80 degrees.
    wide = np.array([[60.0, 0, 159.5], [0, 60.0, 89.5], [0, 0, 1]])
    v = np.arange(180)[:, None] + np.zeros(320)
    down = math.radians(20.0)
    depth = 0.35 / (np.sin(down) + np.cos(down) * (v - 89.5) / 60.0)
    depth = np.where((depth > 0) & (depth < 3.0), depth, np.nan)
    seen = floor_samples("cam", {"depth": depth, "K": wide, "baseline": 2.0}, 1)
    assert len(seen.inverse) > 0.8 * np.isfinite(depth).sum()


def test_doubt_needs_an_error_that_is_both_unpromised_and_large() -> None:
    large = FloorCorrection(tilt_before_deg=1.0, height_before_m=0.0)
    small = FloorCorrection(tilt_before_deg=0.1, height_before_m=0.003)
    moves = {"a": large, "b": small, "c": large, "d": large}
    assert floor_doubts(moves, dict.fromkeys("abcd", 3.9), "abcd").factors == {}
    shared = floor_doubts(moves, dict.fromkeys("abcd", 4.1), "abcd")
    assert (sorted(shared.shared), shared.odd) == (["a", "c", "d"], {})
    odd = floor_doubts(moves, {"a": 30.0, "b": 30.0, "c": 1.0, "d": 1.0}, "abcd")
    assert (odd.odd, odd.shared) == ({"a": 30.0}, {})
    # Nobody has said anything of these poses; ten times the default there may be.
    assert floor_doubts(moves, dict.fromkeys("abcd", 9.0), ()).factors == {}
    assert sorted(floor_doubts(moves, dict.fromkeys("abcd", 11.0), ()).factors) == ["a", "c", "d"]
    assert floor_doubts({"a": replace(large, accepted=False)}, {}, "a").factors == {}


def test_a_correction_beyond_the_bounds_is_rejected_and_the_rest_goes_on() -> None:
    truth = ring()
    start = dict(truth)
    start["cam1"] = make_pose(exp_so3(np.radians([4.0, 0, 0.0])) @ truth["cam1"][:3, :3], truth["cam1"][:3, 3])
    config = replace(CONFIG, max_rotation_deg=2.0)
    new, metrics = refine_ground_from_depth(noisy_data(truth), start, config)
    move = metrics.corrections["cam1"]
    assert not move.accepted
    assert "max-rotation-deg" in move.reason
    assert move.rotation_deg == pytest.approx(4.0, abs=0.3)
    np.testing.assert_allclose(new["cam1"], metrics.T_level_world @ start["cam1"], atol=EXACT)
    assert "1 rejected" in metrics.message
    # The rejected camera has no say in the floor.
    assert max(tilt_deg(new[name], truth[name]) for name in truth if name != "cam1") < 0.1


def test_a_camera_without_floor_gets_the_common_motion_only() -> None:
    truth = ring()
    truth["high"] = camera_at((0.0, 2.5, 0.0), (3.0, 2.6, 0.2))  # sees walls
    data = noisy_data(truth)
    truth["blind"] = camera_at((1.0, 1.0, 0.0))
    T_world_true = make_pose(np.eye(3), np.array([0.0, 0.5, 0.0]))
    start = {name: T_world_true @ T for name, T in truth.items()}
    new, metrics = refine_ground_from_depth(data, start, CONFIG)
    assert metrics.success
    assert set(metrics.without_floor) == {"high", "blind"}
    assert "no depth" in metrics.without_floor["blind"]
    assert "no level surface" in metrics.without_floor["high"]
    for name in ("high", "blind"):
        np.testing.assert_allclose(new[name], metrics.T_level_world @ start[name], atol=EXACT)
        assert name not in metrics.corrections
    assert set(metrics.covariances) == set(start)


# --- which surface is the floor


def test_a_table_that_fills_one_camera_does_not_win() -> None:
    truth = ring()
    truth["cam1"] = camera_at((0.5, 1.5, 0.3), (0.0, 0.72, 0.0))
    surfaces = (FLOOR, TABLE)
    data = noisy_data(truth, surfaces=surfaces)
    assert np.nanmedian(depth_of(truth["cam1"], surfaces)) < 1.2  # mostly table
    new, metrics = refine_ground_from_depth(data, truth, CONFIG)
    assert max(abs(new[name][1, 3] - truth[name][1, 3]) for name in truth) < 0.004
    assert "0.72 m above" in metrics.without_floor.get("cam1", "0.72 m above")


def test_of_two_surfaces_that_all_see_the_lower_is_the_floor() -> None:
    truth = ring()
    table = Rectangle(height=0.72, half=(1.2, 1.2))
    data = noisy_data(truth, surfaces=(FLOOR, table))
    new, metrics = refine_ground_from_depth(data, truth, CONFIG)
    assert not metrics.without_floor
    assert max(abs(new[name][1, 3] - truth[name][1, 3]) for name in truth) < 0.004
    on_table, _ = refine_ground_from_depth(data, truth, replace(CONFIG, height_range=(0.5, 1.0)))
    for name in truth:
        assert on_table[name][1, 3] == pytest.approx(truth[name][1, 3] - 0.72, abs=0.004)


def test_a_ceiling_is_no_floor() -> None:
    truth = {f"cam{k}": camera_at((2.5 * np.cos(k), 1.2, 2.5 * np.sin(k)), (0.0, 1.25, 0.0)) for k in range(3)}
    data = noisy_data(truth, surfaces=(FLOOR, Rectangle(height=2.0)))
    new, metrics = refine_ground_from_depth(data, truth, CONFIG)
    assert metrics.success
    assert max(abs(new[name][1, 3] - truth[name][1, 3]) for name in truth) < 0.006


def test_without_any_floor_the_poses_are_returned_as_they_were() -> None:
    poses = {name: camera_at((0.0, 1.5, 0.3 * k), (3.0, 2.6, 0.2)) for k, name in enumerate("ab")}
    new, metrics = refine_ground_from_depth(data_of({n: depth_of(T) for n, T in poses.items()}), poses, CONFIG)
    assert not metrics.success
    assert "No camera sees" in metrics.message
    for name in poses:
        np.testing.assert_array_equal(new[name], poses[name])
        assert metrics.without_floor[name]


def stepped_data(truth: Mapping[str, Pose], heights_m: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Each camera above a floor of its own."""
    rng = np.random.default_rng(0)
    floors = {name: (Rectangle(height=h),) for name, h in zip(truth, heights_m)}
    return data_of({name: noisy(depth_of(T, floors[name]), rng) for name, T in truth.items()})


@pytest.mark.parametrize(("turn_deg", "shift_m", "step_m"), [(0.0, 0.0, 0.06), (0.02, 0.001, 0.06), (0.1, 0.004, 0.15)])
@pytest.mark.parametrize("with_covariances", [True, False])
def test_two_floors_that_equally_many_see_are_an_error(
    turn_deg: float, shift_m: float, step_m: float, with_covariances: bool
) -> None:
    truth = ring()
    start = disturbed(truth, np.random.default_rng(1), turn_deg=turn_deg, shift_m=shift_m)
    known = covariances_of(start, max(turn_deg, 0.02), max(shift_m, 0.001)) if with_covariances else None
    with pytest.raises(CalibrationError, match=r"cameras cam0, cam1 at .* cameras cam2, cam3 at .*--height-range"):
        refine_ground_from_depth(stepped_data(truth, (0.0, 0.0, step_m, step_m)), start, CONFIG, covariances=known)


@pytest.mark.parametrize("with_covariances", [True, False])
def test_a_camera_that_sees_a_platform_has_no_part_in_the_floor(with_covariances: bool) -> None:
    truth = ring()
    start = disturbed(truth, np.random.default_rng(1), turn_deg=0.02, shift_m=0.001)
    known = covariances_of(start, 0.02, 0.001) if with_covariances else None
    new, metrics = refine_ground_from_depth(
        stepped_data(truth, (0.0, 0.0, 0.0, 0.06)), start, CONFIG, covariances=known
    )
    assert "0.06 m above" in metrics.without_floor["cam3"]
    np.testing.assert_allclose(new["cam3"], metrics.T_level_world @ start["cam3"], atol=EXACT)
    # An average of both floors would be 15 mm high, and no camera's.
    assert max(abs(new[name][1, 3] - truth[name][1, 3]) for name in truth) < 0.004


def test_rough_poses_are_no_steps() -> None:
    truth = ring()
    for seed in range(4):
        start = disturbed(truth, np.random.default_rng(seed), turn_deg=0.6, shift_m=0.012)
        _, metrics = refine_ground_from_depth(noisy_data(truth, seed), start, replace(CONFIG, stride=4))
        assert not metrics.without_floor


# --- contradictions


def test_a_mirrored_rig_whose_cameras_roll_is_an_error() -> None:
    truth = {
        name: make_pose(T[:3, :3] @ exp_so3(np.array([0.0, 0.0, math.radians(roll)])), T[:3, 3])
        for (name, T), roll in zip(ring().items(), (3.0, -2.0, 0.5, -3.0))
    }
    M = np.diag([-1.0, 1.0, 1.0, 1.0])
    data = noisy_data(truth)
    with pytest.raises(CalibrationError, match="mirrored"):
        refine_ground_from_depth(data, {name: M @ T @ M for name, T in truth.items()}, CONFIG)
    # Poses that are as much aslant, and not mirrored.
    refine_ground_from_depth(data, disturbed(truth, np.random.default_rng(0), turn_deg=2.0, shift_m=0.0), CONFIG)


def test_the_message_tells_raised_from_lowered() -> None:
    truth = ring()
    data = noisy_data(truth)
    for up, T_up in ((1.0, np.eye(4)), (-1.0, HALF_TURN)):
        config = replace(CONFIG, up=(0.0, up, 0.0))
        for shift_m, word in ((0.2, "lowered by 200 mm"), (-0.2, "raised by 200 mm")):
            shift = make_pose(np.eye(3), np.array([0.0, shift_m, 0.0]))
            _, metrics = refine_ground_from_depth(data, {name: T_up @ shift @ T for name, T in truth.items()}, config)
            assert word in metrics.message.replace("199", "200").replace("201", "200")


def test_a_stride_that_leaves_nothing_is_told() -> None:
    truth = ring(2)
    with pytest.raises(InputError, match="stride of 400 leaves 1 pixels"):
        refine_ground_from_depth(noisy_data(truth), truth, replace(CONFIG, stride=400))


def test_a_world_upside_down_is_an_error() -> None:
    truth = ring()
    data = data_of({name: depth_of(T, walls=False) for name, T in truth.items()})
    with pytest.raises(CalibrationError, match="upside down"):
        refine_ground_from_depth(data, {name: HALF_TURN @ T for name, T in truth.items()}, CONFIG)


def test_a_world_that_is_not_upright_is_an_error() -> None:
    truth = ring()
    T_world_true = make_pose(exp_so3(np.radians([9.0, 0.0, 0.0])), np.zeros(3))
    data = data_of({name: depth_of(T) for name, T in truth.items()})
    with pytest.raises(CalibrationError, match="--auto-align"):
        refine_ground_from_depth(data, {name: T_world_true @ T for name, T in truth.items()}, CONFIG)


def test_mirrored_heights_are_an_error() -> None:
    truth = ring()
    data = data_of({name: depth_of(T) for name, T in truth.items()})
    mirrored = {name: make_pose(T[:3, :3], T[:3, 3] * [1, -1, 1]) for name, T in truth.items()}
    with pytest.raises(CalibrationError, match="mirrored"):
        refine_ground_from_depth(data, mirrored, CONFIG)


def test_a_camera_below_the_floor_is_an_error() -> None:
    truth = ring()
    data = data_of({name: depth_of(T) for name, T in truth.items()})
    poses = truth | {"cellar": camera_at((0.5, -0.4, 0.0))}
    with pytest.raises(CalibrationError, match="Camera cellar stands below"):
        refine_ground_from_depth(data, poses, CONFIG)


def test_a_target_under_the_floor_is_an_error() -> None:
    truth = ring()
    data = data_of({name: depth_of(T) for name, T in truth.items()})
    corners = np.array([[0.2, -0.8, 0.1], [0.3, -0.5, 0.1]])
    with pytest.raises(CalibrationError, match="target"):
        refine_ground_from_depth(data, truth, CONFIG, target_points=corners)
    refine_ground_from_depth(data, truth, CONFIG, target_points=corners + 0.5 * UP)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"depth": np.zeros((180, 320))}, "cam0"),
        ({"depth": np.full((180, 320), np.nan)}, "cam0"),
        ({"depth": np.full((180, 320), np.inf)}, "cam0"),
        ({"depth": np.full((180, 320), -1.0)}, "negative"),
        ({"depth": np.full((180, 320), 2000.0)}, "millimetres"),
        ({"depth": np.ones(5)}, "cam0"),
        ({"K": np.zeros((3, 3))}, "K is not a camera matrix"),
        ({"K": np.array([[700.0, 0, 640], [0, 700.0, 360], [0, 0, 1]])}, "own size"),
        ({"confidence": np.zeros((3, 3))}, "confidence"),
    ],
)
def test_depth_that_cannot_be_used_is_named(change: dict[str, Any], words: str) -> None:
    truth = ring(2)
    data = data_of({name: depth_of(T) for name, T in truth.items()})
    data["cam0"] |= change
    with pytest.raises(InputError, match=words):
        refine_ground_from_depth(data, truth, CONFIG)


def test_missing_depth_and_bad_poses_are_named() -> None:
    truth = ring(2)
    with pytest.raises(InputError, match="camera cam0"):
        refine_ground_from_depth({"cam0": {"K": K}}, truth, CONFIG)
    with pytest.raises(InputError, match="cam1"):
        refine_ground_from_depth({}, truth | {"cam1": np.diag([2.0, 1, 1, 1])}, CONFIG)


@pytest.mark.parametrize(
    "change",
    [
        {"max_rotation_deg": 0.0},
        {"max_rotation_deg": math.nan},
        {"max_translation_m": 1e300},
        {"ransac_threshold_m": 2.0},
        {"target_floor_y": 1e300},
        {"target_floor_y": math.nan},
        {"stride": 0},
        {"height_range": (1.0, 0.0)},
        {"up": (0.0, 0.0, 1.0)},
        {"seed": -1},
    ],
)
def test_an_impossible_configuration_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        GroundPlaneConfig(**change)


def test_untrusted_pixels_are_left_out() -> None:
    truth = ring(3)
    data = noisy_data(truth)
    spoilt = data["cam0"]["depth"].copy()
    confidence = np.zeros(spoilt.shape, np.uint8)
    confidence[120:], spoilt[120:] = 100, spoilt[120:] * 1.03
    data["cam0"] |= {"depth": spoilt, "confidence": confidence}
    new, _ = refine_ground_from_depth(data, truth, CONFIG)
    assert max(abs(new[name][1, 3] - truth[name][1, 3]) for name in truth) < 0.004


# --- what is known afterwards


def test_the_covariances_are_those_of_the_errors() -> None:
    # Errors of turn and rise against the true floor, over draws of pose errors, noise and bias.
    chi2: list[float] = []
    before: list[float] = []
    rows = np.zeros((3, 6))
    rows[0, 0] = rows[1, 2] = rows[2, 4] = 1.0
    for seed in range(25):
        rng = np.random.default_rng(seed)
        truth = ring()
        start = disturbed(truth, rng, turn_deg=0.15, shift_m=0.005)
        data: dict[str, dict[str, Any]] = {}
        for name, T in truth.items():
            scale, disparity_px = rng.standard_normal(2) * [0.003, 0.15]
            data |= data_of({name: noisy(depth_of(T), rng, scale=scale, disparity_px=disparity_px)})
        new, metrics = refine_ground_from_depth(
            data, start, replace(CONFIG, stride=4), covariances=covariances_of(start, 0.15, 0.005)
        )
        for name, T in truth.items():
            J = rows @ centre_jacobian(new[name][:3, 3])
            S = J @ metrics.covariances[name] @ J.T
            turn = (T[:3, :3] @ new[name][:3, :3].T - np.eye(3))[[2, 1], [1, 0]]  # about x, about z
            error = np.array([*turn, T[1, 3] - new[name][1, 3]])
            chi2.append(float(error @ np.linalg.solve(S, error)))
            prior = np.array([start[name][1, 3] - T[1, 3]]) / 0.005
            before.append(float(prior @ prior))
            # Nobody learns from a floor where his camera stands sideways.
            sideways = (
                centre_jacobian(new[name][:3, 3]) @ metrics.covariances[name] @ centre_jacobian(new[name][:3, 3]).T
            )[3, 3]
            assert sideways >= 0.005**2 * 0.99
            assert np.linalg.eigvalsh(metrics.covariances[name]).min() > 0
    # 100 cameras of 3 degrees of freedom, four at a time of one floor: mean 3, standard error 0.25 to 0.5. The scale's
    # upper end is believed, so that the covariances are wide rather than narrow: down to 3 / 1.4^2.
    assert 1.4 < np.mean(chi2) < 4.0
    assert np.mean(before) == pytest.approx(1.0, abs=0.5)


def test_poses_of_unknown_quality_are_told_apart_by_their_floors() -> None:
    truth = ring()
    data = noisy_data(truth)
    scales = []
    for turn_deg, shift_m in ((0.03, 0.002), (0.6, 0.012)):
        start = disturbed(truth, np.random.default_rng(6), turn_deg=turn_deg, shift_m=shift_m)
        _, metrics = refine_ground_from_depth(data, start, CONFIG)
        scales.append(metrics.pose_scales["cam0"] * math.degrees(DEFAULT_TURN_RAD))
    # Four cameras tell a standard deviation to a factor of two or three; of good poses the lower end is taken, of rough
    # ones the upper.
    assert 0.003 < scales[0] < 0.12
    assert 0.3 < scales[1] < 1.8


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_yaw_and_place_of_the_given_world_do_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = ring(3)
    data = {name: entry | {"n_frames": 5} for name, entry in noisy_data(truth).items()}
    C = make_pose(exp_so3(np.array([0, rng.uniform(-3, 3), 0])), np.array([0.0, rng.uniform(-2, 2), 0.0]))
    start = disturbed(truth, np.random.default_rng(7), turn_deg=0.3, shift_m=0.01)
    a, _ = refine_ground_from_depth(data, start, replace(CONFIG, stride=6))
    b, _ = refine_ground_from_depth(data, {name: C @ T for name, T in start.items()}, replace(CONFIG, stride=6))
    T_b_a = b["cam0"] @ invert_transform(a["cam0"])
    for name in truth:
        # The default covariance knows no direction; axes of the equations do, in rounding.
        assert pose_distance(T_b_a @ a[name], b[name])[1] < 1e-5
