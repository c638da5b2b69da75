"""From an average to the adjusted rig: what enters, what comes back, and what is said about the input."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from joint_rigs import MIDDLE, Seen, SimRig, board_rig, box_rig, exchanged, pair_errors, rich_box, ring
from marker_pictures import make_camera
from target_views import box, sight

from aruco.errors import CalibrationError
from aruco.model import Detection
from aruco.pose_math import Array, exp_se3, exp_so3, invert_transform, log_se3, make_pose
from rigcal.solve.joint import JointRig, adjust_rig
from rigcal.solve.problem import Poses

# A lost camera's sightings are of another target pose altogether.
ELSEWHERE = exp_se3(np.array([0.3, -0.2, 0.25, 0.1, 0.2, -0.1]))


def adjusted(rig: SimRig, start: Poses, *, moving: bool = True) -> JointRig:
    return adjust_rig(rig.estimate(start), rig.cameras, rig.detections, rig.geometry, moving=moving)


def millimetres(joint: JointRig, rig: SimRig) -> float:
    """The worst relative pose of the cameras that are left."""
    left = [k for k, camera in enumerate(rig.cameras) if camera.name in joint.rig.cameras]
    found = np.array([joint.rig.cameras[rig.cameras[k].name].T_world_cam for k in left])
    return float(pair_errors(found, rig.truth.T_world_cam[left])[1].max())


def resting_rig(rng: np.random.Generator, *, n_frame: int = 10, sigma_px: float = 0.05) -> SimRig:
    """A box that rests, every frame with noise of its own; every camera sees several markers."""
    geometry = rich_box()
    T_world_target = make_pose(exp_so3(np.array([0.0, 0.4, 0.0])), MIDDLE)
    cameras = tuple(make_camera(f"c{k}") for k in range(3))
    places = np.array([invert_transform(T_world_target) @ T for T in ring(3, 2.4, rng)])
    seen: Seen = {
        camera.name: {f: sight(camera, invert_transform(T), geometry, sigma_px, rng) for f in range(n_frame)}
        for camera, T in zip(cameras, places)
    }
    return SimRig(
        cameras=cameras,
        detections=seen,
        geometry=geometry,
        truth=Poses(places, np.array([np.eye(4)] * n_frame)),
        frames=tuple(range(n_frame)),
    )


# --- the ordinary ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_a_moved_target_gives_tenths_of_a_millimetre_where_the_start_has_many(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = box_rig(rng)
    start = rig.start(rng)
    joint = adjusted(rig, start)
    # The standard deviation of a pair is 0.1-0.2 mm for these twelve frames; the worst of six, three times that.
    assert millimetres(joint, rig) < 1.0
    assert pair_errors(start.T_world_cam, rig.truth.T_world_cam)[1].max() > 5.0
    assert not joint.rejected
    assert not joint.odd_markers
    assert not joint.rig.lost
    assert joint.scale == pytest.approx(1.0, abs=0.15)
    assert joint.rig.world_frame == 0
    assert joint.rig.T_world_target.keys() == set(rig.frames)
    np.testing.assert_array_equal(joint.rig.T_world_target[0], start.T_world_target[0])


def test_a_resting_target_is_averaged_over_time_first() -> None:
    rng = np.random.default_rng(0)
    rig = resting_rig(rng)
    start = rig.start(rng)
    start = Poses(start.T_world_cam, rig.truth.T_world_target)
    joint = adjusted(rig, start, moving=False)
    # 0.05 px over ten frames and some ten corners each: about 0.2 mm at 2.4 m.
    assert millimetres(joint, rig) < 1.0
    for k, camera in enumerate(rig.cameras):
        xi = log_se3(rig.truth.T_world_cam[k] @ invert_transform(joint.rig.cameras[camera.name].T_world_cam))
        S = joint.covariance[camera.name]
        # Chi-square of six is below 22.5 in 999 of 1000 cases.
        assert xi @ np.linalg.solve(S, xi) < 22.5
        assert joint.rig.cameras[camera.name].frames == rig.frames
    assert all(np.array_equal(T, np.eye(4)) for T in joint.rig.T_world_target.values())


def test_points_of_a_board_are_adjusted_as_corners_of_markers_are() -> None:
    rng = np.random.default_rng(1)
    rig = board_rig(rng)
    joint = adjusted(exchanged(rig, "c1", 3, 20), rig.start(rng))
    assert joint.rejected == {"c1": (3, 20)}
    assert not joint.odd_markers
    # The limit for this case.
    assert millimetres(joint, rig) < 2.2


def test_two_runs_and_another_order_of_the_detections_give_the_same_bytes() -> None:
    rng = np.random.default_rng(2)
    rig = exchanged(box_rig(rng), "c1", 3, 7)
    start = rig.start(rng)
    shuffled = {name: dict(reversed(views.items())) for name, views in reversed(rig.detections.items())}
    first, again, other = (adjusted(r, start) for r in (rig, rig, rig.with_detections(shuffled)))
    for result in (again, other):
        assert result.rejected == first.rejected
        assert result.scale == first.scale
        for name in first.rig.cameras:
            assert result.rig.cameras[name].T_world_cam.tobytes() == first.rig.cameras[name].T_world_cam.tobytes()
            assert result.covariance[name].tobytes() == first.covariance[name].tobytes()


def test_a_rejected_view_is_no_longer_one_that_took_part() -> None:
    rng = np.random.default_rng(3)
    rig = box_rig(rng)
    joint = adjusted(exchanged(rig, "c2", 5, 8), rig.start(rng))
    assert joint.rejected == {"c2": (5, 8)}
    assert not {5, 8} & set(joint.rig.cameras["c2"].frames)
    assert {5, 8} <= set(joint.rig.cameras["c1"].frames)


def test_frames_without_a_pose_of_the_target_are_left_out() -> None:
    rng = np.random.default_rng(4)
    rig = box_rig(rng)
    estimate = rig.estimate(rig.start(rng))
    some = {frame: T for frame, T in estimate.T_world_target.items() if frame not in (4, 9)}
    estimate = replace(estimate, T_world_target=some)
    joint = adjust_rig(estimate, rig.cameras, rig.detections, rig.geometry, moving=True)
    assert joint.rig.T_world_target.keys() == some.keys()


# --- markers --------------------------------------------------------------------------------------------------------


def misplaced(geometry: Mapping[int, Array], marker: int, by_m: Array) -> dict[int, Array]:
    return {m: c + by_m if m == marker else c for m, c in geometry.items()}


@pytest.mark.parametrize("seed", range(3))
def test_a_marker_ten_millimetres_off_in_the_map_is_named(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = box_rig(rng)
    wrong = replace(rig, geometry=misplaced(rig.geometry, 24, np.array([0.01, 0.0, 0.0])))
    joint = adjusted(wrong, rig.start(rng))
    assert joint.odd_markers.keys() == {24}
    assert joint.odd_markers[24] > 10


def test_a_marker_ten_millimetres_off_on_a_resting_target_is_named() -> None:
    rng = np.random.default_rng(5)
    rig = resting_rig(rng)
    marker = int(rig.detections["c0"][0].ids[0])
    wrong = replace(rig, geometry=misplaced(rig.geometry, marker, np.array([0.007, 0.0, 0.007])))
    start = Poses(rig.start(rng).T_world_cam, rig.truth.T_world_target)
    joint = adjusted(wrong, start, moving=False)
    assert joint.odd_markers.keys() == {marker}


@pytest.mark.parametrize("seed", range(3))
def test_exchanged_frames_do_not_make_a_marker_odd(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = box_rig(rng, n_frame=25)
    assert not adjusted(exchanged(rig, "c0", 3, 9), rig.start(rng)).odd_markers


# --- what goes missing ----------------------------------------------------------------------------------------------


def elsewhere(rig: SimRig, index: int, rng: np.random.Generator, frames: set[int] | None = None) -> SimRig:
    """The same with one camera's views of other poses of the target, each its own."""
    camera = rig.cameras[index]

    def wrong(frame: int) -> Detection:
        T_cam_target = invert_transform(rig.truth.T_world_cam[index]) @ rig.truth.T_world_target[frame]
        shift = ELSEWHERE @ make_pose(exp_so3(0.3 * rng.standard_normal(3)), np.zeros(3))
        return sight(camera, T_cam_target @ shift, rig.geometry, 0.05, rng)

    views = {f: wrong(f) if frames is None or f in frames else d for f, d in rig.detections[camera.name].items()}
    return rig.with_detections({**rig.detections, camera.name: {f: d for f, d in views.items() if len(d)}})


def test_a_camera_of_which_no_view_fits_is_lost_with_a_reason() -> None:
    rng = np.random.default_rng(6)
    rig = box_rig(rng)
    joint = adjusted(elsewhere(rig, 3, rng), rig.start(rng))
    assert set(joint.rig.cameras) == set(joint.covariance) == {"c0", "c1", "c2"}
    assert "c3" not in joint.rejected
    assert "clock" in joint.rig.lost["c3"]
    assert millimetres(joint, rig) < 1.0


def test_a_camera_at_rest_whose_only_view_does_not_fit_is_lost_with_a_reason() -> None:
    rng = np.random.default_rng(7)
    rig = resting_rig(rng)
    spoilt = {
        f: replace(d, corners_px=d.corners_px + 15 * np.random.default_rng(0).standard_normal(d.corners_px.shape))
        for f, d in rig.detections["c1"].items()
    }
    start = Poses(rig.start(rng).T_world_cam, rig.truth.T_world_target)
    joint = adjusted(rig.with_detections({**rig.detections, "c1": spoilt}), start, moving=False)
    assert set(joint.rig.cameras) == {"c0", "c2"}
    assert "none of its 1 views" in joint.rig.lost["c1"]


def apart(rig: SimRig, last: int) -> SimRig:
    """The same with frames up to ``last`` for the first camera, and from 4 on for the others."""
    return rig.with_detections(
        {
            name: {f: d for f, d in views.items() if (f <= last if name == "c0" else f >= 4)}
            for name, views in rig.detections.items()
        }
    )


@pytest.mark.parametrize(
    ("last", "reason"), [(3, "put the target where two cameras see it"), (4, "none of its 1 views")]
)
def test_a_camera_that_is_cut_off_is_lost_with_a_reason(last: int, reason: str) -> None:
    rng = np.random.default_rng(8)
    rig = box_rig(rng)
    # Camera 0 meets the others in no frame, or in frame 4 only, and there it does not fit.
    joint = adjusted(elsewhere(apart(rig, last), 0, rng, {4}), rig.start(rng))
    assert set(joint.rig.cameras) == {"c1", "c2", "c3"}
    assert reason in joint.rig.lost["c0"]
    # The first frame is lost with it: another one carries the world, and the target lies in its origin there.
    assert joint.rig.world_frame >= 4
    np.testing.assert_allclose(joint.rig.T_world_target[joint.rig.world_frame], np.eye(4), atol=1e-12)
    assert min(joint.rig.T_world_target) >= 4
    assert millimetres(joint, rig) < 1.0


def test_a_covariance_is_carried_to_the_new_world() -> None:
    rng = np.random.default_rng(9)
    rig = box_rig(rng)
    gone = {name: {f: d for f, d in views.items() if f > 0} for name, views in rig.detections.items()}
    start = rig.start(rng)
    estimate = rig.with_detections(gone).estimate(start)
    new = adjust_rig(estimate, rig.cameras, gone, rig.geometry, moving=True)
    f = new.rig.world_frame
    assert f != 0
    T_f_first = invert_transform(rig.truth.T_world_target[f])
    for k, camera in enumerate(rig.cameras):
        xi = log_se3(T_f_first @ rig.truth.T_world_cam[k] @ invert_transform(new.rig.cameras[camera.name].T_world_cam))
        # Chi-square of six is below 22.5 in 999 of 1000 cases.
        assert xi @ np.linalg.solve(new.covariance[camera.name], xi) < 22.5


def test_views_that_leave_no_two_cameras_are_an_error_that_names_them() -> None:
    rng = np.random.default_rng(14)
    rig = box_rig(rng, n_cam=2, geometry=box(0.3))
    with pytest.raises(CalibrationError, match=r"contradict each other\. c0: .* views .*; c1: .* views"):
        adjusted(elsewhere(elsewhere(rig, 0, rng), 1, rng), rig.start(rng))


@pytest.mark.parametrize("seed", range(10, 16))
def test_two_cameras_that_contradict_each_other_everywhere_are_never_silent(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = box_rig(rng, n_cam=2, geometry=box(0.3))
    try:
        joint = adjusted(elsewhere(elsewhere(rig, 0, rng), 1, rng), rig.start(rng))
    except CalibrationError:
        return
    # Where all is wrong nothing stands out: but then all residuals are pixels, a hundred times what sigmas promise.
    assert joint.corners.beyond_promise > 10


def test_a_single_camera_of_a_moved_target_is_adjusted_to_its_frame() -> None:
    rng = np.random.default_rng(11)
    rig = box_rig(rng, n_cam=1, n_frame=3, geometry=rich_box())
    joint = adjusted(rig, rig.start(rng))
    assert set(joint.rig.cameras) == {"c0"}
    assert np.isfinite(joint.covariance["c0"]).all()


@pytest.mark.parametrize("n_frame", [1, 8], ids=["resting", "moved"])
def test_a_single_camera_knows_its_pose_as_well_as_it_says(n_frame: int) -> None:
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        rig = box_rig(rng, n_cam=1, n_frame=n_frame, geometry=rich_box())
        joint = adjusted(rig, rig.start(rng), moving=n_frame > 1)
        xi = log_se3(rig.truth.T_world_cam[0] @ invert_transform(joint.rig.cameras["c0"].T_world_cam))
        squares.append(xi @ np.linalg.solve(joint.covariance["c0"], xi))
    # Chi-square of 120 is within these in 999 of 1000 cases.
    assert 75.4 < sum(squares) < 177.6
    # Chi-square of six is below 27.9 in 9999 of 10000 cases: no seed is told far too sure, nor hidden by the mean.
    assert max(squares) < 27.9
