"""Depth corrects poses and learns its own bias, says how sure it is, and keeps out where it does not prove right."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest
from depth_rooms import FLOOR_PLANE, FOCAL_BASELINE, Room, box_room
from joint_rigs import box_rig, rich_box
from numpy.typing import NDArray

from aruco.camera_depth import CameraDepth
from aruco.depth_bias import DepthBias
from aruco.depth_faults import indescribable
from aruco.depth_fusion import (
    KAPPA,
    DepthSensor,
    Estimate,
    _moved,
    _Problem,
    fuse,
    given_estimate,
    residuals,
    start_estimate,
    without_lean,
)
from aruco.depth_noise import DepthNoise, bias_prior
from aruco.depth_refine import inseparable, lean_size, refine
from aruco.depth_tiles import Tiles, surface_tiles
from aruco.depth_trial import HeldOutMarkers, MarkerHalf, on_held_out
from aruco.model import SILENT
from aruco.pose_math import Array, exp_se3, invert_transform, log_se3
from aruco.rig_estimate import RigEstimate
from aruco.shared_floor import DepthView, find_shared_floor, floor_pixels
from rigcal.config import CalibrateConfig, DepthConfig, DetectConfig
from rigcal.depth_pooling import pool_recording
from rigcal.depth_refining import refine_with_depth
from rigcal.depth_samples import face_depths
from rigcal.depth_witness import hear_depth
from rigcal.evidence import Evidence, look
from rigcal.kept import NOTHING_KEPT
from rigcal.marker_equations import camera_covariance, marker_equations
from rigcal.placing import adjust_placed, place_cameras
from rigcal.quality.truth import pair_errors
from rigcal.sim import Simulation, simulate
from rigcal.solve.joint import JointRig, adjust_rig
from rigcal.target import marker_target
from rigcal.validation_case import case_of

# The figures that the project promises for target and floor from 1.5 to 5 m.
SCALE_TOLERANCE = 0.003
DISPARITY_TOLERANCE_PX = 0.1
LEAN_PX = 0.03


def refined(room: Room, **options: float):
    return refine(room.markers, room.halves(), room.tiles, room.sensors, FLOOR_PLANE, **options)


def errors_mm(T_world_cam: Array | list[Array], truth: Array) -> Array:
    return 1e3 * np.linalg.norm(np.asarray(T_world_cam)[:, :3, 3] - truth[:, :3, 3], axis=1)


# --- derivatives ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["stereo", "offset"])
def test_derivatives_are_those_of_finite_differences(model: str) -> None:
    rng = np.random.default_rng(1)
    room = box_room(rng, n_cameras=2)
    sensor = DepthSensor(model=model, focal_baseline=None, prior=bias_prior(None, model))  # pyright: ignore[reportArgumentType]
    tiles = room.tiles.only(rng.random(len(room.tiles)) < 0.1)
    problem = _Problem(room.markers, tiles, (sensor, sensor), 0.1)
    at = start_estimate(room.markers, FLOOR_PLANE)
    at = replace(at, bias=np.array([[0.01, 0.004], [-0.02, 0.003]]), lean=1e-3 * rng.standard_normal((2, 2)))
    _, J = problem.rows(at)
    h = 1e-6
    for k in range(J.shape[1]):
        step = np.zeros(J.shape[1])
        step[k] = h
        up, down = (problem.rows(_moved(at, s * step))[0] for s in (1, -1))
        # Inverse depths are below one: central differences of 1e-6 are good to 1e-9.
        np.testing.assert_allclose(J[:, k], (up - down) / (2 * h), atol=1e-8)


# --- biases ---------------------------------------------------------------------------------------------------------


def test_bias_is_recovered_where_target_and_floor_span_the_ranges() -> None:
    rng = np.random.default_rng(2)
    for _ in range(3):
        room = box_room(rng)
        found = refined(room)
        assert found.accepted, found.reason
        for c, bias in enumerate(found.biases.values()):
            assert abs(bias.scale - room.bias[c, 0]) < SCALE_TOLERANCE
            assert bias.disparity_px is not None
            assert abs(bias.disparity_px - FOCAL_BASELINE * room.bias[c, 1]) < DISPARITY_TOLERANCE_PX


def test_without_the_bias_the_poses_pay_for_it() -> None:
    room = box_room(np.random.default_rng(3))
    start = start_estimate(room.markers, FLOOR_PLANE)
    believed = np.ones((4, 2), dtype=bool)
    naive = fuse(room.markers, room.tiles, room.sensors, start, lean_px=0.0, fixed_bias=believed)
    found = refined(room)
    before = errors_mm(room.markers.T_world_cam, room.truth)
    assert errors_mm(list(found.T_world_cam.values()), room.truth).mean() < before.mean()
    assert errors_mm(naive.T_world_cam, room.truth).mean() > before.mean()


def test_sigmas_are_honest() -> None:
    squares = []
    for seed in range(40):
        room = box_room(np.random.default_rng(100 + seed), n_cameras=2, lean_px=LEAN_PX)
        start = start_estimate(room.markers, FLOOR_PLANE)
        found = fuse(room.markers, room.tiles, room.sensors, start, lean_px=LEAN_PX, scale=1.0)
        assert found.covariance is not None
        off = [log_se3(T @ invert_transform(t)) for T, t in zip(found.T_world_cam, room.truth)]
        e = np.concatenate([*off, (found.bias - room.bias).ravel()])
        known = np.r_[0:12, 18:22]
        squares.append(e @ np.linalg.solve(found.covariance[np.ix_(known, known)], e))
    # The mean of 40 chi-squares of 16 degrees: 16 +- 0.9, of which three.
    assert np.mean(squares) == pytest.approx(16, abs=2.7)


def test_one_range_does_not_tell_scale_from_disparity() -> None:
    room = box_room(np.random.default_rng(5), floor=False)
    z = 1.0 / room.tiles.inverse
    flat = np.zeros(len(z), dtype=bool)
    for c in range(4):
        mine = room.tiles.camera == c
        flat |= mine & (np.abs(z - np.median(z[mine])) < 0.05)
    room = replace(room, tiles=room.tiles.only(flat))
    found = refine(room.markers, room.halves(), room.tiles, room.sensors, None)
    assert found.accepted, found.reason
    assert all("do not tell scale from disparity" in said for said in found.findings.values())
    for c, bias in enumerate(found.biases.values()):
        assert bias.scale == 0.0
        assert bias.covariance is not None
        # What is not known of the scale is known to be unknown, and at this range depth is put right all the same.
        assert bias.covariance[0, 0] == pytest.approx(0.003**2, rel=1e-6)
        here = np.array([1.0 / np.median(room.tiles.inverse[room.tiles.camera == c])])
        truth = DepthBias(scale=room.bias[c, 0], inverse_depth=room.bias[c, 1]).corrected(here)
        # Some ten tiles of 0.06 px, 3 mm each at 2 m, and 0.5 mm of the marker pose: 1.1 mm, of which three.
        np.testing.assert_allclose(bias.corrected(here), truth, atol=3.5e-3)
    # What markers doubt is no news of it.
    along = np.zeros((len(room.markers.H), 1))
    along[3:6, 0] = 0.003 * room.truth[0, :3, 2]
    doubted = replace(room.markers, doubt=along)
    held = np.tile([True, False], (4, 1))
    at = fuse(doubted, room.tiles, room.sensors, start_estimate(doubted, None), lean_px=0.0, fixed_bias=held)
    assert at.covariance is not None
    assert at.covariance[len(at.twist), len(at.twist)] == pytest.approx(0.003**2, rel=1e-6)
    # With the floor both are told.
    whole = refined(box_room(np.random.default_rng(5)))
    assert all("do not tell" not in said for said in whole.findings.values())


def test_a_camera_without_depth_says_so_and_stays() -> None:
    room = box_room(np.random.default_rng(6))
    found = refine(room.markers, room.halves(), room.tiles.only(room.tiles.camera != 2), room.sensors, FLOOR_PLANE)
    assert found.accepted, found.reason
    assert "c2" not in found.biases
    assert "too little depth" in found.findings["c2"]
    np.testing.assert_allclose(found.T_world_cam["c2"], room.markers.T_world_cam[2], atol=1e-9)
    assert found.as_dict()["cameras"]["c2"]["patches_on_floor"] == 0


def test_leans_of_disparity_are_noticed() -> None:
    sizes = {}
    for lean_px in (0.0, 0.2):
        room = box_room(np.random.default_rng(7), lean_px=lean_px)
        sizes[lean_px] = lean_size(room.markers, room.tiles, room.sensors, start_estimate(room.markers, FLOOR_PLANE))
    # The markers' 0.012 degrees, seen from 1.3 m above the floor, are 0.01 px: leans of that size stay possible.
    assert sizes[0.0] < 0.03
    assert 0.1 < sizes[0.2] <= 0.3


def test_leans_that_are_not_thought_of_turn_cameras() -> None:
    room = box_room(np.random.default_rng(8), lean_px=0.2)
    start = start_estimate(room.markers, FLOOR_PLANE)
    naive = fuse(room.markers, room.tiles, room.sensors, start, lean_px=0.0)
    found = refined(room)
    turns = [
        np.degrees(np.mean([np.linalg.norm(log_se3(T @ invert_transform(t))[:3]) for T, t in zip(k, room.truth)]))
        for k in (naive.T_world_cam, list(found.T_world_cam.values()))
    ]
    # Markers know 0.012 degrees about each of three axes.
    assert turns[1] < 0.03 < turns[0]


def test_depth_corrects_what_markers_doubt_only_if_it_shows() -> None:
    room = box_room(np.random.default_rng(18))
    along = np.zeros((len(room.markers.H), 1))
    along[3:6, 0] = 0.03 * room.truth[0, :3, 2]  # edges that look shifted: 3 cm along the optical axis of c0
    told = room.markers.T_world_cam.copy()
    told[0, :3, 3] += along[3:6, 0]
    wrong = replace(room.markers, T_world_cam=told, doubt=along)
    right = replace(room.markers, doubt=along)
    found = {k: refine(m, [], room.tiles, room.sensors, FLOOR_PLANE) for k, m in (("wrong", wrong), ("right", right))}
    off = {k: errors_mm(list(f.T_world_cam.values()), room.truth)[0] for k, f in found.items()}
    assert off["wrong"] < 10
    assert off["right"] < 1.5
    # Without the doubt 3 cm are believed; with it, right or wrong, they are part of what is not known.
    sure = refine(replace(wrong, doubt=None), [], room.tiles, room.sensors, FLOOR_PLANE)
    assert errors_mm(list(sure.T_world_cam.values()), room.truth)[0] > 20
    assert np.sqrt(np.trace(found["right"].covariance["c0"][3:, 3:])) > 5e-3


def test_sigmas_are_honest_beside_poses_that_stay() -> None:
    squares, naive = [], []
    for seed in range(20):
        room = box_room(np.random.default_rng(200 + seed), n_cameras=2)
        start = given_estimate(room.markers, FLOOR_PLANE)
        found = without_lean(room.markers, room.tiles, room.sensors, start, np.zeros((2, 2), dtype=bool))
        sure = replace(room.markers, H=1e6 * room.markers.H)
        blind = without_lean(sure, room.tiles, room.sensors, start, np.zeros((2, 2), dtype=bool))
        for at, into in ((found, squares), (blind, naive)):
            assert at.covariance is not None
            e = (at.bias - room.bias).ravel()
            into.append(e @ np.linalg.solve(at.covariance[18:22, 18:22], e))
    # The mean of 20 chi-squares of 4 degrees: 4 +- 0.63, of which three.
    assert np.mean(squares) == pytest.approx(4, abs=1.9)
    # What is not known of the poses is most of it.
    assert np.mean(naive) > 8


def test_what_is_written_is_best_without_the_leans_that_nobody_writes() -> None:
    room = box_room(np.random.default_rng(19), lean_px=0.5)
    start = start_estimate(room.markers, FLOOR_PLANE)
    size = lean_size(room.markers, room.tiles, room.sensors, start)
    full = fuse(room.markers, room.tiles, room.sensors, start, lean_px=size)
    full = fuse(room.markers, room.tiles, room.sensors, start, lean_px=size, fixed_bias=inseparable(full))
    found = refined(room)
    assert found.poses_accepted, found.reason
    written = np.array([[b.scale, b.inverse_depth] for b in found.biases.values()])
    off: list[float] = []
    for bias in (full.bias, written):
        bare = replace(full, lean=np.zeros_like(full.lean), bias=bias)
        e = residuals(room.tiles, bare, room.sensors, room.markers)
        off.append(float(np.log1p((e / KAPPA) ** 2).sum()))
    assert off[1] < 0.98 * off[0]
    # And they are known to be farther from the truth than an estimate with leans is.
    assert full.covariance is not None
    n = len(full.twist)
    for c, bias in enumerate(found.biases.values()):
        assert bias.covariance is not None
        assert (np.diag(bias.covariance) >= np.diag(full.covariance)[n + 2 * c : n + 2 * c + 2]).all()


# --- faults ---------------------------------------------------------------------------------------------------------


def mirrored(tiles: Tiles, mine: NDArray[np.bool_]) -> Tiles:
    return replace(tiles, ray=np.where(mine[:, None], tiles.ray * [-1.0, 1.0, 1.0], tiles.ray))


def three_percent_too_far(tiles: Tiles, mine: NDArray[np.bool_]) -> Tiles:
    return replace(tiles, inverse=np.where(mine, tiles.inverse / 1.03, tiles.inverse))


@pytest.mark.parametrize("fault", [mirrored, three_percent_too_far])
def test_depth_that_cannot_be_true_is_told_and_does_not_spoil_the_others(
    fault: Callable[[Tiles, NDArray[np.bool_]], Tiles],
) -> None:
    room = box_room(np.random.default_rng(27))
    room = replace(room, tiles=fault(room.tiles, room.tiles.camera == 1))
    found = refined(room)
    assert found.left_out.keys() == {"c1"}
    assert "mirrored" in found.findings["c1"]
    assert found.as_dict()["cameras"]["c1"]["left_out"]
    assert found.bias_accepted, found.reason
    assert found.biases.keys() == {"c0", "c2", "c3"}
    for name, bias in found.biases.items():
        truth = room.bias[int(name[1])]
        assert abs(bias.scale - truth[0]) < SCALE_TOLERANCE
        assert bias.disparity_px is not None
        assert abs(bias.disparity_px - FOCAL_BASELINE * truth[1]) < DISPARITY_TOLERANCE_PX
    # No rig of the usual biases has such a camera.
    assert all(not refined(box_room(np.random.default_rng(k))).left_out for k in (21, 22))


def test_nobody_is_left_where_all_depth_is_of_another_unit() -> None:
    room = box_room(np.random.default_rng(23))
    found = refined(replace(room, tiles=replace(room.tiles, inverse=room.tiles.inverse / 1.2)))
    assert not found.accepted
    assert found.left_out.keys() == set(room.markers.cameras)
    assert found.reason == "no camera's depth can be true"


def test_two_numbers_do_not_stand_for_a_lean() -> None:
    room = box_room(np.random.default_rng(24))
    at = given_estimate(room.markers, FLOOR_PLANE)
    at = replace(at, bias=np.array([[0.006, 0.3 / FOCAL_BASELINE], [-0.02, -0.7 / FOCAL_BASELINE], [0, 0], [0, 0]]))
    told = indescribable(at, room.markers, room.sensors)
    assert told.keys() == {1}
    assert "leans across the image" in told[1]


# --- what is refused ------------------------------------------------------------------------------------------------


def test_moves_beyond_the_bounds_are_refused_with_the_camera_and_the_size() -> None:
    room = box_room(np.random.default_rng(9))
    found = refined(room, max_translation_m=1e-5)
    assert not found.poses_accepted
    assert "camera c0" in found.reason
    assert "0.01 mm" in found.reason
    # Biases do not depend on it.
    assert found.bias_accepted
    assert found.biases.keys() == set(room.markers.cameras)
    assert all((found.T_world_cam[n] == T).all() for n, T in zip(room.markers.cameras, room.markers.T_world_cam))


def test_poses_that_predict_other_markers_worse_are_not_taken() -> None:
    room = box_room(np.random.default_rng(10))

    def only_c2_knows(T_world_cam: Array, T_world_target: Array) -> HeldOutMarkers:
        """Every camera has one marker, and only that of c2 knows where its camera is: where it was."""
        moved = 1e4 * np.abs(T_world_cam[2] - room.markers.T_world_cam[2]).max()
        off = np.zeros((16, 2))
        off[8:12] = moved
        camera = np.repeat(np.arange(4), 4)
        return HeldOutMarkers(camera=camera, marker=camera, off=off, off_px=0.05 * off)

    halves = [replace(half, held_out=only_c2_knows) for half in room.halves()]
    found = refine(room.markers, halves, room.tiles, room.sensors, FLOOR_PLANE)
    assert not found.poses_accepted
    assert "held-out markers of camera c2 (" in found.reason
    assert "are predicted worse with depth" in found.reason
    assert found.held_out is not None
    assert [growth.is_worse for growth in found.held_out.growth.values()] == [False, False, True, False]
    assert found.as_dict()["cameras"]["c2"]["held_out_markers"]["n"] == 2
    # Depth without its biases agrees better all the same, and poses stay to the bit.
    assert found.bias_accepted
    assert "poses stay" in found.reason
    assert found.covariance == {}
    assert all((found.T_world_cam[n] == T).all() for n, T in zip(room.markers.cameras, room.markers.T_world_cam))
    for c, bias in enumerate(found.biases.values()):
        assert abs(bias.scale - room.bias[c, 0]) < SCALE_TOLERANCE
        assert bias.disparity_px is not None
        assert abs(bias.disparity_px - FOCAL_BASELINE * room.bias[c, 1]) < DISPARITY_TOLERANCE_PX
    assert found.held_out.marker_px[1] > found.held_out.marker_px[0]
    # The same depth is believed by markers that agree with it.
    assert refined(room).poses_accepted


def test_a_wrong_move_does_not_hide_behind_the_gain_of_the_biases() -> None:
    room = box_room(np.random.default_rng(25))
    tiles = room.tiles
    # The two halves of every image lean to opposite sides, so what turns cameras in one is wrong in the other.
    odd = (tiles.block // 4096 + tiles.block % 4096) % 2 == 1
    bent = tiles.inverse + (1.2 + np.where(odd, 0.5, -0.5) * tiles.ray[:, 0]) / FOCAL_BASELINE
    tiles, free = replace(tiles, inverse=bent), np.zeros((4, 2), dtype=bool)

    def none_held_out(T_world_cam: Array, T_world_target: Array) -> HeldOutMarkers:
        none = np.empty(0, dtype=np.int64)
        return HeldOutMarkers(camera=none, marker=none, off=np.empty((0, 2)), off_px=np.empty((0, 2)))

    halves = [replace(half, held_out=none_held_out) for half in room.halves()]
    halves = [replace(half, train=replace(half.train, H=1e-2 * half.train.H)) for half in halves]
    trial = on_held_out(halves, tiles, room.sensors, FLOOR_PLANE, free, free, (1.0, 0.0))
    assert trial.against_bias == ""
    assert "no better with moved poses" in trial.against_move
    # Beside depth as it was recorded the move looks well.
    recorded, alone, moved = trial.figures.depth_mm
    assert alone < moved < recorded


def test_what_could_not_be_tested_is_said() -> None:
    room = box_room(np.random.default_rng(26))
    assert "nothing was tested" in refine(room.markers, [], room.tiles, room.sensors, FLOOR_PLANE).reason

    def without_c3(half: MarkerHalf, cameras: list[int]) -> MarkerHalf:
        def held_out(T_world_cam: Array, T_world_target: Array) -> HeldOutMarkers:
            of_all = half.held_out(T_world_cam, T_world_target)
            keep = np.isin(of_all.camera, cameras)
            parts = {f: getattr(of_all, f)[keep] for f in ("camera", "marker", "off", "off_px")}
            return HeldOutMarkers(**parts)

        return replace(half, held_out=held_out)

    reasons = [
        refine(room.markers, [without_c3(h, who) for h in room.halves()], room.tiles, room.sensors, FLOOR_PLANE).reason
        for who in ([0, 1, 2], [])
    ]
    assert reasons[0].startswith("markers and depth that took no part are predicted at least as well")
    assert "no markers of camera c3 could be held out" in reasons[0]
    assert reasons[1] == "depth that took no part is predicted at least as well; no markers could be held out"


def test_cameras_that_must_stay_do_so_to_the_bit() -> None:
    room = box_room(np.random.default_rng(11))
    markers = replace(room.markers, free=np.array([False, True, True, True, False]))
    found = refine(markers, [], room.tiles, room.sensors, FLOOR_PLANE)
    assert found.accepted
    assert (found.T_world_cam["c0"] == room.markers.T_world_cam[0]).all()
    assert (found.T_world_cam["c1"] != room.markers.T_world_cam[1]).any()
    assert found.covariance.keys() == {"c1", "c2", "c3"}
    assert found.biases.keys() == {"c0", "c1", "c2", "c3"}


def test_no_depth_at_all_is_a_reason_not_an_error() -> None:
    room = box_room(np.random.default_rng(12))
    nothing = room.tiles.only(np.zeros(len(room.tiles), dtype=bool))
    found = refine(room.markers, room.halves(), nothing, room.sensors, FLOOR_PLANE)
    assert not found.accepted
    assert "no camera has depth" in found.reason
    assert found.as_dict()["held_out"] is None


def test_data_decide_which_parameters_are_told_apart() -> None:
    at = Estimate(
        T_world_cam=np.eye(4)[None],
        T_world_target=np.empty((0, 4, 4)),
        twist=np.zeros(6),
        bias=np.zeros((3, 2)),
        lean=np.zeros((3, 2)),
        floor=None,
        known=np.array([[2.0, 50.0], [0.5, 50.0], [0.0, 0.3]]),
    )
    assert inseparable(at).tolist() == [[False, False], [True, False], [True, True]]


# --- tiles ----------------------------------------------------------------------------------------------------------

K = np.array([[700.0, 0.0, 320.0], [0.0, 700.0, 240.0], [0.0, 0.0, 1.0]])


def plane_pixels(q: Array, size: int = 96) -> tuple[Array, Array]:
    """Pixels of a square of the image, and the depth of a plane there."""
    pixels = np.stack(np.meshgrid(np.arange(200, 200 + size), np.arange(100, 100 + size)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    return pixels.astype(np.float64), 1.0 / (rays @ q)


def test_a_tile_is_exact_on_a_plane_and_clean_of_what_lies_on_it() -> None:
    q, noise = np.array([0.1, 0.4, 0.3]), DepthNoise(focal_baseline=FOCAL_BASELINE)
    pixels, z = plane_pixels(q)
    rng = np.random.default_rng(13)
    z = 1.0 / (1.0 / z + 1e-5 * rng.standard_normal(len(z)))
    # A cable over a sixth of every tile, 10 cm nearer.
    dirty = np.where(pixels[:, 0] % 24 < 4, z - 0.1, z)
    tiles = surface_tiles(pixels, dirty, q, K, noise, n_averaged=1, uneven_m=0.0)
    assert len(tiles) >= 16
    # 1e-5 over some 400 pixels, and the clipped normal tails: a tenth of it.
    np.testing.assert_allclose(tiles.inverse, tiles.ray @ q, atol=2e-6)
    # The plain mean is not.
    assert abs(np.mean(1.0 / dirty) - np.mean(1.0 / z)) > 5e-4


def test_many_small_tiles_know_no_more_than_neighbours_share() -> None:
    noise = DepthNoise(focal_baseline=FOCAL_BASELINE, sigma_px=0.0, fixed_sigma_px=0.06, floor_m=0.0)
    pixels, z = plane_pixels(np.array([0.0, 0.0, 0.5]), size=240)
    tiles = surface_tiles(pixels, z, np.array([0.0, 0.0, 0.5]), K, noise, n_averaged=1, uneven_m=0.0)
    mean_sigma = 1.0 / np.sqrt((1.0 / tiles.sigma**2).sum())
    # 28 x 28 pixels share an error of 0.06 px, and the square has 240 x 240.
    assert mean_sigma == pytest.approx(0.06 / FOCAL_BASELINE * 28 / 240, rel=0.1)


def test_bumps_of_a_floor_weigh_more_under_a_grazing_look() -> None:
    noise = DepthNoise(focal_baseline=FOCAL_BASELINE, sigma_px=1e-6, fixed_sigma_px=0.0, floor_m=0.0)
    # A level camera 1.2 m above the floor: 1 / z = y / 1.2.
    q, bump_m = np.array([0.0, 1 / 1.2, 0.0]), 0.002
    pixels, _ = plane_pixels(q)
    pixels[:, 1] += 300.0  # below the horizon, at 2.5 to 5 m
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    tiles = surface_tiles(pixels, 1.0 / (rays @ q), q, K, noise, n_averaged=1, uneven_m=bump_m)
    # The floor a bump nearer to the camera, along the same rays.
    bumped = rays @ (q * 1.2 / (1.2 - bump_m)) - rays @ q
    assert tiles.alone.mean() == pytest.approx(bumped.mean(), rel=0.05)
    # As if it were looked at face on it would be this.
    assert (bump_m * tiles.inverse**2).mean() < 0.5 * bumped.mean()


# --- the floor ------------------------------------------------------------------------------------------------------


def looking_down(yaw: float) -> Array:
    """A camera 1.5 m above the floor that looks 35 degrees down."""
    tilt, turn = np.radians(180 - 35), yaw
    T = exp_se3(np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0])) @ exp_se3(np.array([tilt, 0.0, 0.0, 0.0, 0.0, 0.0]))
    T[:3, 3] = -2.0 * np.array([np.sin(turn + np.pi), 0.0, np.cos(turn + np.pi)]) * -1.0
    T[1, 3] = 1.5
    return T


def floor_view(yaw: float, tops: list[tuple[float, float]], rng: np.random.Generator) -> DepthView:
    """The floor at height 0, and level squares of 0.4 m half width at (height, distance before the camera)."""
    T = looking_down(yaw)
    rows, columns = np.mgrid[0:480, 0:640]
    rays = np.stack([columns, rows, np.ones(rows.shape)], axis=-1) @ np.linalg.inv(K).T
    along = rays @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        z = np.where(along[..., 1] < 0, -T[1, 3] / along[..., 1], np.nan)
        ahead = T[:3, :3] @ np.array([0.0, 0.0, 1.0]) * [1, 0, 1]
        ahead /= np.linalg.norm(ahead)
        for height, distance in tops:
            hit = (height - T[1, 3]) / along[..., 1]
            points = T[:3, 3] + hit[..., None] * along
            middle = T[:3, 3] + distance * ahead
            on = (hit > 0) & (np.abs(points - middle)[..., [0, 2]].max(axis=-1) < 0.4)
            z = np.where(on, hit, z)
    z = 1.0 / (1.0 / z + 0.06 / FOCAL_BASELINE * rng.standard_normal(z.shape))
    return DepthView(
        depth_m=z,
        K=K,
        T_world_cam=T,
        noise=DepthNoise(focal_baseline=FOCAL_BASELINE),
        bias_prior=bias_prior(FOCAL_BASELINE),
        model=DepthBias(),
    )


def test_the_floor_of_all_wins_over_the_table_of_one() -> None:
    rng = np.random.default_rng(14)
    views = [floor_view(0.3 + yaw, [(0.7, 1.3)] if k == 0 else [], rng) for k, yaw in enumerate((0.0, 2.0, 4.0))]
    up = np.array([0.02, 1.0, -0.01]) / np.linalg.norm([0.02, 1.0, -0.01])
    floor = find_shared_floor(views, up)
    assert floor is not None
    # White noise over hundreds of squares; the naive mean of all heights is centimetres off, for the table.
    assert abs(floor[1]) < 2e-3
    assert np.degrees(np.arccos(floor[0] @ [0, 1, 0])) < 0.1
    pixels, z = floor_pixels(views[0], floor)
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    heights = (z[:, None] * rays) @ views[0].T_world_cam[:3, :3].T[:, 1] + views[0].T_world_cam[1, 3]
    assert np.abs(heights).max() < 0.1
    everything = views[0].depth_m[np.isfinite(views[0].depth_m)]
    assert len(z) < len(everything) / 4


def test_no_level_surface_is_no_floor() -> None:
    view = floor_view(0.0, [], np.random.default_rng(15))
    assert find_shared_floor([view], np.array([1.0, 0.0, 0.0])) is None
    assert find_shared_floor([replace(view, depth_m=np.full((480, 640), np.nan))], np.array([0.0, 1.0, 0.0])) is None


# --- markers --------------------------------------------------------------------------------------------------------


def test_equations_of_markers_are_what_the_adjustment_knows() -> None:
    rng = np.random.default_rng(16)
    rig = box_rig(rng, n_frame=8, geometry=rich_box())
    start = rig.estimate(rig.start(rng))
    joint = adjust_rig(start, rig.cameras, rig.detections, rig.geometry, moving=True)
    case = case_of(start, joint, rig.cameras, rig.detections, rig.geometry, moving=True)
    world = case.sightings.frames.index(joint.rig.world_frame)
    markers, halves = marker_equations(case, [1, 3], world)
    P = camera_covariance(markers.equations)
    for c, camera in enumerate(rig.cameras):
        mine = P[6 * c : 6 * c + 6, 6 * c : 6 * c + 6]
        # Shifts of edges are found over one more round there.
        np.testing.assert_allclose(np.diag(mine), np.diag(joint.covariance[camera.name]), rtol=0.1)
    assert markers.equations.targets == (1, 3)
    for half in halves:
        at = start_estimate(half.train, None)
        exact = half.held_out(at.T_world_cam, at.T_world_target)
        # 0.05 px a coordinate; the half that is tested is predicted by the other.
        assert 0.03 < np.sqrt((exact.off_px**2).mean()) < 0.2
        assert 0.8 < np.sqrt((exact.off**2).mean()) < 1.6
        bent = at.T_world_cam.copy()
        bent[0] = exp_se3(np.array([2e-3, 0, 0, 0, 0, 0])) @ bent[0]
        after = half.held_out(bent, at.T_world_target)
        worse = np.bincount(exact.camera, (after.off**2 - exact.off**2).sum(axis=1))
        # 2 mrad are more than a pixel; targets that follow the camera take the others along by less.
        assert worse[0] > 2 * worse[1:].max()


def test_targets_that_depth_does_not_measure_follow_the_cameras() -> None:
    rng = np.random.default_rng(17)
    rig = box_rig(rng, n_frame=6, geometry=rich_box())
    start = rig.estimate(rig.start(rng))
    joint = adjust_rig(start, rig.cameras, rig.detections, rig.geometry, moving=True)
    case = case_of(start, joint, rig.cameras, rig.detections, rig.geometry, moving=True)
    markers, _ = marker_equations(case, [], None)
    step = exp_se3(np.array([1e-4, -2e-4, 1e-4, 1e-3, 2e-3, -1e-3]))
    moved = markers.targets(step @ markers.poses.T_world_cam, np.empty((0, 4, 4)))
    # All cameras together: targets go with them, to first order of 0.2 mrad at some metres.
    np.testing.assert_allclose(moved, step @ markers.poses.T_world_target, atol=2e-5)


# --- the whole ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solved:
    """A simulated rig, solved, with its depth."""

    simulation: Simulation
    evidence: Evidence
    average: RigEstimate
    joint: JointRig
    pooled: Mapping[str, CameraDepth]


@pytest.fixture(scope="module")
def solved() -> Solved:
    simulation = simulate("demo", seed=1)
    target = marker_target(simulation.faces, simulation.dictionary)
    config = CalibrateConfig(detect=DetectConfig(dictionary=simulation.dictionary))
    evidence = look(simulation.recording, target, config, jobs=2, progress=SILENT)
    average = place_cameras(evidence, NOTHING_KEPT)[0]
    joint = adjust_placed(average, evidence, NOTHING_KEPT)
    pooled = pool_recording(simulation.recording, None, jobs=2, progress=SILENT)
    return Solved(simulation=simulation, evidence=evidence, average=average, joint=joint, pooled=pooled)


def test_cameras_that_were_refused_take_no_part(solved: Solved) -> None:
    depth = DepthConfig(verify=True, refine=True)
    evidence = replace(solved.evidence, config=replace(solved.evidence.config, depth=depth), pooled=solved.pooled)
    refused, *left = sorted(solved.joint.rig.cameras)
    rig = replace(solved.joint.rig, cameras={name: solved.joint.rig.cameras[name] for name in left})
    told = hear_depth(solved.average, rig, solved.joint, evidence, NOTHING_KEPT).notes
    assert told["depth_refined"]["accepted"], told["depth_refined"]["reason"]
    assert told["depth_bias"].keys() == set(left)
    assert told["depth_refined"]["cameras"].keys() == set(left)
    assert refused not in told["depth_verified"]


def test_a_simulated_rig_gets_its_biases_and_keeps_its_poses(solved: Solved) -> None:
    simulation, evidence, average, joint = solved.simulation, solved.evidence, solved.average, solved.joint
    pooled = solved.pooled
    faces = face_depths(evidence, joint.rig, pooled)
    found = refine_with_depth(average, joint, evidence, faces, pooled)
    assert found.accepted, found.reason
    for name, bias in found.biases.items():
        truth = simulation.depth_bias[name]
        assert abs(bias.scale - truth.scale) < SCALE_TOLERANCE
        assert bias.disparity_px is not None
        assert abs(bias.disparity_px - truth.disparity_px) < DISPARITY_TOLERANCE_PX
    before = {name: placement.T_world_cam for name, placement in joint.rig.cameras.items()}
    errors = [
        np.median([shift for _, shift in pair_errors(poses, simulation.T_world_cam).values()])
        for poses in (before, found.T_world_cam)
    ]
    # The promise: no rig worse by more than 5 percent or a millimetre; without biases it is centimetres.
    assert errors[1] < errors[0] + max(0.05 * errors[0], 1e-3)
    assert found.T_world_target.keys() == joint.rig.T_world_target.keys()
    # Nobody who knows which way is up: the target alone.
    alone = refine_with_depth(average, joint, evidence, faces, {})
    assert all(on_floor == 0 for _, on_floor in alone.patches.values())
