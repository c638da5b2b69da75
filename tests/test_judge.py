"""Views on trial: what does not belong is found and named, and nothing that goes missing ends in a crash."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from joint_rigs import SimRig, board_rig, box_rig, exchanged, flat, pair_errors
from target_views import sight

from aruco.errors import CalibrationError
from aruco.model import Detection
from aruco.pose_math import exp_se3, exp_so3, invert_transform, make_pose, rotation_angle
from aruco.view_pose import solve_view
from rigcal.solve import adjust as solver
from rigcal.solve.adjust import Gauge, adjust
from rigcal.solve.judge import Judged, adjust_judging, confirmed, tied, view_medians
from rigcal.solve.problem import Poses, gather

# The limits for two exchanged frames among 25: corners of 0.1 px at 2 m.
MEDIAN_MM, WORST_MM = 1.3, 2.2


def rejected(rig: SimRig, judged: Judged) -> set[tuple[str, int]]:
    s = rig.sightings()
    return {
        (rig.cameras[s.view_camera[v]].name, s.frames[s.view_frame[v]]) for v in np.flatnonzero(~judged.kept).tolist()
    }


def millimetres(poses: Poses, rig: SimRig) -> np.ndarray:
    return pair_errors(poses.T_world_cam, rig.truth.T_world_cam)[1]


@pytest.mark.parametrize("seed", range(5))
def test_two_exchanged_frames_of_one_camera_are_found_and_do_no_harm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = board_rig(rng)
    start = rig.start(rng)
    swapped = exchanged(rig, "c2", 4, 17)
    judged = adjust_judging(swapped.sightings(), start, swapped.gauge())
    assert rejected(swapped, judged) == {("c2", 4), ("c2", 17)}
    with_them = millimetres(judged.adjustment.poses, rig)
    assert np.median(with_them) < MEDIAN_MM
    assert with_them.max() < WORST_MM
    # As without the exchange: two views of a hundred fewer move the result by a part of its standard deviation.
    untouched = adjust_judging(rig.sightings(), start, rig.gauge())
    assert untouched.kept.all()
    assert with_them.max() < 1.5 * millimetres(untouched.adjustment.poses, rig).max()


@pytest.mark.parametrize("seed", range(5))
def test_plain_least_squares_without_judging_misses_it(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(seed)
    rig = exchanged(board_rig(rng), "c2", 4, 17)
    monkeypatch.setattr(solver, "KAPPA", 1e9)
    plain = adjust(rig.sightings(), rig.start(rng), rig.gauge())
    assert millimetres(plain.poses, rig).max() > 2 * WORST_MM


@pytest.mark.parametrize("seed", range(4))
def test_a_target_that_moves_while_one_camera_takes_its_frame_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = box_rig(rng)
    T_cam_target = invert_transform(rig.truth.T_world_cam[1]) @ rig.truth.T_world_target[5]
    nudge = exp_se3(np.array([0.02, -0.01, 0.015, 0.02, 0.01, 0.0]))
    moved = sight(rig.cameras[1], T_cam_target @ nudge, rig.geometry, 0.05, rng)
    late = rig.with_detections({**rig.detections, "c1": {**rig.detections["c1"], 5: moved}})
    judged = adjust_judging(late.sightings(), rig.start(rng), rig.gauge())
    assert rejected(late, judged) == {("c1", 5)}
    # One standard deviation of a pair is about 0.2 mm.
    assert millimetres(judged.adjustment.poses, rig).max() < 1.0


@pytest.mark.parametrize("start_sigma", [5e-4, 3e-3], ids=["good start", "rough start"])
@pytest.mark.parametrize("seed", range(4))
def test_the_flipped_solution_of_one_view_does_not_survive(seed: int, start_sigma: float) -> None:
    rng = np.random.default_rng(seed)
    boards = board_rig(rng)
    # One small marker: its two solutions explain a view almost equally well.
    geometry = {0: 0.1 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])}
    seen = {
        camera.name: {
            f: sight(camera, invert_transform(T) @ target, geometry, 0.1, rng)
            for f, target in enumerate(boards.truth.T_world_target)
        }
        for camera, T in zip(boards.cameras, boards.truth.T_world_cam)
    }
    rig = SimRig(cameras=boards.cameras, detections=seen, geometry=geometry, truth=boards.truth, frames=boards.frames)
    start = rig.start(rng, start_sigma)
    flipped = {f: T for f in range(1, 25) if (T := flip(rig, start, f)) is not None}
    assert len(flipped) >= 5
    targets = start.T_world_target.copy()
    for frame in list(flipped)[:5]:
        targets[frame] = flipped[frame]
    judged = adjust_judging(rig.sightings(), Poses(start.T_world_cam, targets), rig.gauge())
    # It is the start that was wrong, not a view: all of them are kept.
    assert judged.kept.all()
    for frame in list(flipped)[:5]:
        turn = judged.adjustment.poses.T_world_target[frame, :3, :3].T @ rig.truth.T_world_target[frame, :3, :3]
        # Four views of a marker of 70 px with corners of 0.1 px know its tilt to some tenths of a degree.
        assert np.degrees(rotation_angle(turn)) < 2.0


def flip(rig: SimRig, start: Poses, frame: int) -> np.ndarray | None:
    """Where the first camera's other solution puts the target, if it has one that is far off."""
    camera = rig.cameras[0]
    view = solve_view(camera, frame, rig.detections[camera.name][frame], rig.geometry)
    assert view is not None
    for candidate in view.candidates:
        T = start.T_world_cam[0] @ candidate.T_cam_target
        if np.degrees(rotation_angle(T[:3, :3].T @ rig.truth.T_world_target[frame, :3, :3])) > 20:
            return T
    return None


def test_a_frame_with_a_wildly_wrong_start_comes_back() -> None:
    rng = np.random.default_rng(0)
    rig = box_rig(rng)
    start = rig.start(rng)
    targets = start.T_world_target.copy()
    targets[3] = targets[3] @ make_pose(exp_so3(np.radians(60) * np.array([0, 0.6, 0.8])), np.zeros(3))
    judged = adjust_judging(rig.sightings(), Poses(start.T_world_cam, targets), rig.gauge())
    assert judged.kept.all()


# --- what may go missing --------------------------------------------------------------------------------------------


def scrambled(rig: SimRig, camera: str, frames: set[int], rng: np.random.Generator) -> SimRig:
    """The same with a camera's views of some frames replaced by views of the target in other places."""
    index = [c.name for c in rig.cameras].index(camera)
    T_cam_world = invert_transform(rig.truth.T_world_cam[index])

    def wrong(frame: int) -> Detection:
        shift = make_pose(exp_so3(0.2 * rng.standard_normal(3)), 0.2 * rng.standard_normal(3))
        seen = T_cam_world @ rig.truth.T_world_target[frame] @ shift
        return sight(rig.cameras[index], seen, rig.geometry, 0.05, rng)

    views = {f: wrong(f) if f in frames else d for f, d in rig.detections[camera].items()}
    return rig.with_detections({**rig.detections, camera: {f: d for f, d in views.items() if len(d)}})


def test_a_camera_that_loses_all_its_views_is_held_and_left_out() -> None:
    rng = np.random.default_rng(1)
    rig = box_rig(rng)
    start = rig.start(rng)
    lost = scrambled(rig, "c3", set(rig.frames), rng)
    judged = adjust_judging(lost.sightings(), start, rig.gauge())
    assert not judged.kept[lost.sightings().view_camera == 3].any()
    assert judged.gauge.fixed_cameras.tolist() == [False, False, False, True]
    assert not judged.adjustment.covariance[18:].any()
    assert np.isfinite(judged.adjustment.covariance).all()
    assert pair_errors(judged.adjustment.poses.T_world_cam[:3], rig.truth.T_world_cam[:3])[1].max() < 1.0


def test_another_frame_carries_the_world_when_all_views_of_the_first_are_wrong() -> None:
    rng = np.random.default_rng(2)
    rig = box_rig(rng)
    bad = rig
    for camera in rig.cameras:
        bad = scrambled(bad, camera.name, {0}, rng)
    judged = adjust_judging(bad.sightings(), rig.start(rng), rig.gauge())
    # Of views that contradict each other one may keep the frame to itself, where it does no harm.
    assert len({camera for camera, frame in rejected(bad, judged) if frame == 0}) >= 2
    assert judged.gauge.fixed_frames.sum() == 1
    assert millimetres(judged.adjustment.poses, rig).max() < 1.0


def without(rig: SimRig, keep: dict[str, range]) -> SimRig:
    return rig.with_detections(
        {name: {f: d for f, d in views.items() if f in keep[name]} for name, views in rig.detections.items()}
    )


def test_of_a_rig_in_parts_the_largest_is_solved() -> None:
    rng = np.random.default_rng(3)
    rig = box_rig(rng)
    parts = without(rig, {"c0": range(4), "c1": range(4, 12), "c2": range(4, 12), "c3": range(4, 12)})
    judged = adjust_judging(parts.sightings(), rig.start(rng), rig.gauge())
    assert judged.gauge.fixed_cameras.tolist() == [True, False, False, False]
    assert np.flatnonzero(judged.gauge.fixed_frames)[0] >= 4
    assert not judged.kept[parts.sightings().view_camera == 0].any()


def test_fixed_cameras_carry_the_world_in_every_part() -> None:
    rig = box_rig(np.random.default_rng(4))
    parts = without(rig, {"c0": range(4), "c1": range(4), "c2": range(4, 12), "c3": range(4, 12)}).sightings()
    everything = np.ones(parts.n_views, dtype=bool)
    both = Gauge(np.array([True, False, True, False]), flat(12, -1))
    assert tied(parts, everything, both)[0].all()
    kept, gauge = tied(parts, everything, Gauge(flat(4, 0), flat(12, -1)))
    assert set(parts.view_camera[kept].tolist()) == {0, 1}
    assert gauge.fixed_cameras.tolist() == [True, False, True, True]


def test_a_view_with_a_corner_behind_its_camera_is_judged_and_not_solved() -> None:
    rng = np.random.default_rng(5)
    rig = box_rig(rng)
    start = rig.start(rng)
    sightings = rig.sightings()
    points = sightings.points.copy()
    R_target_world = start.T_world_target[sightings.view_frame[7], :3, :3].T
    points[int(sightings.start[7])] = R_target_world @ (-50.0 * start.T_world_cam[sightings.view_camera[7], :3, 2])
    behind = replace(sightings, points=points)
    assert np.isinf(view_medians(behind, start)[7])
    judged = adjust_judging(behind, start, rig.gauge())
    assert np.flatnonzero(~judged.kept).tolist() == [7]
    assert np.isfinite(judged.adjustment.covariance).all()


def test_views_that_are_all_behind_their_cameras_are_an_error_with_a_sentence() -> None:
    rig = box_rig(np.random.default_rng(6))
    turned = Poses(rig.truth.T_world_cam @ np.diag([-1.0, 1.0, -1.0, 1.0]), rig.truth.T_world_target)
    with pytest.raises(CalibrationError, match="No view fits"):
        adjust_judging(rig.sightings(), turned, rig.gauge())


def test_no_view_at_all_is_an_error_with_a_sentence() -> None:
    rig = box_rig(np.random.default_rng(7))
    nothing = gather(rig.cameras, {}, rig.geometry)
    empty = Poses(rig.truth.T_world_cam, np.empty((0, 4, 4)))
    with pytest.raises(CalibrationError, match="No view fits"):
        adjust_judging(nothing, empty, Gauge(flat(4, -1), np.zeros(0, dtype=bool)))


def test_a_view_as_good_as_its_sigmas_has_a_median_of_one() -> None:
    rig = board_rig(np.random.default_rng(8))
    # 48 corners: a view's median scatters by a tenth, that of 100 views by a hundredth.
    assert np.median(view_medians(rig.sightings(), rig.truth)) == pytest.approx(1.0, abs=0.05)


def test_a_camera_that_agrees_in_one_frame_of_many_is_not_confirmed() -> None:
    rig = box_rig(np.random.default_rng(9))
    sightings = rig.sightings()
    fits = (sightings.view_camera != 2) | (sightings.view_frame == 5)
    gauge = rig.gauge()
    np.testing.assert_array_equal(confirmed(sightings, fits, gauge), fits & (sightings.view_camera != 2))
    # A fixed camera needs no witness, nor does one that meets the others in a single frame.
    assert confirmed(sightings, fits, Gauge(flat(4, 2), gauge.fixed_frames))[fits].all()
    assert confirmed(sightings.only_views(fits), np.ones(int(fits.sum()), dtype=bool), gauge).all()
