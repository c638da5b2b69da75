"""A target that rests: frames decide together what none decides alone, and a camera in doubt is named."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from marker_pictures import make_camera
from scipy.stats import chi2
from target_views import CAMERA, any_pose, box, looking_at, pose_error, sight, square, tilted

from aruco.errors import CalibrationError
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, invert_transform, log_se3, make_pose
from aruco.resting_target import information_of_inverse, place_cameras
from aruco.rig_estimate import RigEstimate
from aruco.view_pose import View, solve_view

BOX = box()
RING = {
    f"c{k}": looking_at(np.array([2.5 * np.sin(a), 1.0, 2.5 * np.cos(a)]), np.zeros(3))
    for k, a in enumerate((0.3, 1.9, 3.4, 5.0))
}
AT_REST = {frame: np.eye(4) for frame in range(3)}


def placed(
    cameras: Mapping[str, Pose],
    T_world_target: Mapping[int, Pose],
    geometry: Mapping[int, Array],
    sigma_px: float,
    rng: np.random.Generator,
) -> RigEstimate:
    """The rig from simulated sightings; ``shuffled`` tests give their own views."""
    return place_cameras(*sightings(cameras, T_world_target, geometry, sigma_px, rng))


def sightings(
    cameras: Mapping[str, Pose],
    T_world_target: Mapping[int, Pose],
    geometry: Mapping[int, Array],
    sigma_px: float,
    rng: np.random.Generator,
) -> tuple[list[Camera], list[View], dict[str, dict[int, Detection]], Mapping[int, Array], dict[str, float]]:
    """The arguments of place_cameras."""
    models = [make_camera(name) for name in cameras]
    detections = {
        name: {
            f: sight(CAMERA, invert_transform(T) @ target, geometry, sigma_px, rng)
            for f, target in T_world_target.items()
        }
        for name, T in cameras.items()
    }
    solved = [solve_view(m, f, d, geometry) for m in models for f, d in detections[m.name].items()]
    return models, [view for view in solved if view is not None], detections, geometry, dict.fromkeys(cameras, 1.0)


def test_exact_views_give_the_exact_rig() -> None:
    rig = placed(RING, AT_REST, BOX, 0.0, np.random.default_rng(0))
    assert not rig.lost
    for name, T_world_cam in RING.items():
        # See test_view_pose for single views; the average adds nothing.
        assert pose_error(rig.cameras[name].T_world_cam, T_world_cam)[1] < 1e-3
        assert rig.cameras[name].spread_m < 1e-6
        assert rig.cameras[name].frames == (0, 1, 2)
    assert all(np.array_equal(T, np.eye(4)) for T in rig.T_world_target.values())
    assert list(rig.T_world_target) == [0, 1, 2]


def test_noise_of_a_good_fit_gives_millimetres() -> None:
    rig = placed(RING, AT_REST, BOX, 0.05, np.random.default_rng(1))
    for name, T_world_cam in RING.items():
        turn_deg, shift_mm = pose_error(rig.cameras[name].T_world_cam, T_world_cam)
        # Two faces at 0.05 px and 3.6 mm a pixel, three frames: 0.02 degrees, 0.7 mm; four sigma.
        assert turn_deg < 0.08
        assert shift_mm < 3.0


def test_frames_decide_together_what_single_views_cannot() -> None:
    small, misled = square(0.1), 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T = tilted(15.0, rng.uniform(0, 6), 1.0, 2.0)
        truth = {"a": invert_transform(T)}
        arguments = sightings(truth, {frame: np.eye(4) for frame in range(40)}, small, 0.1, rng)
        rig = place_cameras(*arguments)
        # 35 px at 0.1 px tell the tilt to 1.5 degrees in one view, 40 views to 0.25; four sigma.
        assert pose_error(rig.cameras["a"].T_world_cam, truth["a"])[0] < 1.0
        assert rig.cameras["a"].n_ambiguous > 20
        misled += sum(pose_error(view.best.T_cam_target, T)[0] > 8.0 for view in arguments[1])
    # The tolerance bites: some views, taken alone, choose the other pose.
    assert misled > 0


def test_a_camera_in_doubt_is_lost_with_a_reason() -> None:
    truth = {"a": invert_transform(tilted(12.0, 0.5, 1.0, 2.0))}
    rig = placed(truth, {frame: np.eye(4) for frame in range(3)}, square(0.1), 0.3, np.random.default_rng(0))
    assert not rig.cameras
    assert "two poses" in rig.lost["a"]
    assert not rig.T_world_target


def test_a_target_that_was_moved_is_told() -> None:
    rng = np.random.default_rng(3)
    moved = {frame: any_pose(rng, shift_m=0.2) for frame in range(8)}
    with pytest.raises(CalibrationError, match="--moving-target"):
        placed(RING, moved, BOX, 0.05, rng)


def test_two_frames_that_disagree_are_a_moved_target() -> None:
    rng = np.random.default_rng(3)
    with pytest.raises(CalibrationError, match="--moving-target"):
        placed(RING, {0: np.eye(4), 1: any_pose(rng, shift_m=0.2)}, BOX, 0.05, rng)


def test_a_few_frames_in_which_it_moved_are_left_out() -> None:
    rng = np.random.default_rng(4)
    frames = {frame: np.eye(4) for frame in range(8)} | {3: make_pose(np.eye(3), np.array([0.0, 0.1, 0.3]))}
    rig = placed(RING, frames, BOX, 0.05, rng)
    for name, T_world_cam in RING.items():
        assert pose_error(rig.cameras[name].T_world_cam, T_world_cam)[1] < 3.0
        assert 3 not in rig.cameras[name].frames
        assert (len(rig.cameras[name].frames), rig.cameras[name].n_views) == (7, 8)


def test_information_of_the_inverse_predicts_its_scatter() -> None:
    rng, repeats = np.random.default_rng(5), 200
    T_world_cam = RING["c0"]
    squared = []
    for _ in range(repeats):
        view = solve_view(CAMERA, 0, sight(CAMERA, invert_transform(T_world_cam), BOX, 0.2, rng, most=2), BOX)
        assert view is not None
        xi = log_se3(T_world_cam @ view.best.T_cam_target)
        squared.append(xi @ information_of_inverse(view.best) @ xi)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * repeats) / repeats
    assert low < np.mean(squared) < high


def test_the_order_of_views_does_not_matter() -> None:
    cameras, views, detections, _, scale2 = sightings(RING, AT_REST, BOX, 0.05, np.random.default_rng(6))
    shuffled = [views[k] for k in np.random.default_rng(7).permutation(len(views))]
    a = place_cameras(cameras, views, detections, BOX, scale2)
    b = place_cameras(cameras[::-1], shuffled, detections, BOX, scale2)
    assert list(a.cameras) == list(b.cameras) == sorted(RING)
    for name in RING:
        np.testing.assert_allclose(a.cameras[name].T_world_cam, b.cameras[name].T_world_cam, atol=1e-10)
        assert sorted(a.cameras[name].frames) == sorted(b.cameras[name].frames)


def test_a_turned_rig_is_the_same_rig() -> None:
    rig = placed(RING, AT_REST, BOX, 0.05, np.random.default_rng(8))
    R = any_pose(np.random.default_rng(9))[:3, :3]
    turned = rig.turned(R)
    names = sorted(RING)
    for frame, T in rig.T_world_target.items():
        for name in names:
            before = invert_transform(rig.cameras[name].T_world_cam) @ T
            after = invert_transform(turned.cameras[name].T_world_cam) @ turned.T_world_target[frame]
            np.testing.assert_allclose(after, before, atol=1e-12)
        np.testing.assert_allclose(turned.T_world_target[frame][:3, :3], R @ T[:3, :3], atol=1e-12)
