"""Residuals are zero where the rig is right, and known where it is wrong by a known amount."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from marker_pictures import FOCAL_PX, make_camera
from target_views import any_pose, box, looking_at, sight

from aruco.model import Detection
from aruco.pose_math import Pose, invert_transform
from aruco.reprojection import Reprojection, reproject
from aruco.rig_estimate import Placement, RigEstimate

BOX = box()
T_WORLD_CAM = {
    "a": looking_at(np.array([0.3, 1.0, 2.5]), np.zeros(3)),
    "b": looking_at(np.array([2.4, 0.8, -0.5]), np.zeros(3)),
}


def placed(T_world_cam: Pose, frames: tuple[int, ...]) -> Placement:
    return Placement(
        T_world_cam=T_world_cam, spread_rad=0.0, spread_m=0.0, frames=frames, n_views=len(frames), n_ambiguous=0
    )


def rig_of(T_world_target: Mapping[int, Pose], frames: tuple[int, ...]) -> RigEstimate:
    return RigEstimate(
        cameras={name: placed(T, frames) for name, T in T_WORLD_CAM.items()}, lost={}, T_world_target=T_world_target
    )


def detections_of(
    T_world_target: Mapping[int, Pose], lens_model: str = "pinhole", sigma_px: float = 0.0
) -> dict[str, dict[int, Detection]]:
    rng = np.random.default_rng(1)
    return {
        name: {
            frame: sight(make_camera(name, lens_model), invert_transform(T) @ T_target, BOX, sigma_px, rng)
            for frame, T_target in T_world_target.items()
        }
        for name, T in T_WORLD_CAM.items()
    }


@pytest.mark.parametrize("lens_model", ["pinhole", "plumb_bob", "equidistant"])
def test_a_true_rig_has_no_residuals_wherever_the_target_is(lens_model: str) -> None:
    rng = np.random.default_rng(0)
    frames = {2: np.eye(4), 5: any_pose(rng, shift_m=0.1)}
    cameras = {name: make_camera(name, lens_model) for name in T_WORLD_CAM}
    residuals = reproject(cameras, rig_of(frames, (2, 5)), detections_of(frames, lens_model), BOX)
    assert list(residuals) == ["a", "b"]
    for result in residuals.values():
        assert np.abs(result.errors_px).max() < 1e-9
    # The frames matter: exchanged, they no longer explain the corners.
    swapped = {2: frames[5], 5: frames[2]}
    worse = reproject(cameras, rig_of(swapped, (2, 5)), detections_of(frames, lens_model), BOX)
    assert worse["a"].rms_px > 1.0


def test_only_the_frames_asked_for_count() -> None:
    frames = {0: np.eye(4), 1: np.eye(4)}
    detections = {"a": {1: detections_of(frames)["a"][1]}}
    residuals = reproject({"a": make_camera("a")}, rig_of(frames, (0, 1)), detections, BOX)
    assert residuals["a"].errors_px.shape == (4 * len(detections["a"][1]), 2)


def test_a_shifted_corner_shows_its_shift_with_its_sign() -> None:
    frames = {0: np.eye(4)}
    detection = detections_of(frames)["a"][0]
    moved = Detection(
        ids=detection.ids, corners_px=detection.corners_px + np.array([0.3, -0.4]), sigma_px=detection.sigma_px
    )
    result = reproject({"a": make_camera("a")}, rig_of(frames, (0,)), {"a": {0: moved}}, BOX)["a"]
    # Where the rig puts the corner minus where it was seen.
    np.testing.assert_allclose(result.errors_px, np.broadcast_to([-0.3, 0.4], result.errors_px.shape), atol=1e-9)
    assert result.rms_px == pytest.approx(0.5)


def test_noise_comes_back_as_rms_over_both_coordinates() -> None:
    frames = {frame: np.eye(4) for frame in range(40)}
    detections = {"a": detections_of(frames, sigma_px=0.1)["a"]}
    result = reproject({"a": make_camera("a")}, rig_of(frames, tuple(frames)), detections, BOX)["a"]
    # 320 corners or more tell it to 3 %: four sigma.
    assert result.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.12)


def test_a_camera_that_stands_a_centimetre_aside_is_seen_in_pixels() -> None:
    frames = {0: np.eye(4)}
    detections = {"a": detections_of(frames)["a"]}
    aside = T_WORLD_CAM["a"].copy()
    aside[:3, 3] += 0.01 * aside[:3, 0]
    rig = RigEstimate(cameras={"a": placed(aside, (0,))}, lost={}, T_world_target=frames)
    result = reproject({"a": make_camera("a")}, rig, detections, BOX)["a"]
    # One centimetre to the right, 2.2 to 2.9 m away: everything moves 2.4 to 3.2 px to the left.
    assert (result.errors_px[:, 0] < -0.01 * FOCAL_PX / 2.9).all()
    assert (result.errors_px[:, 0] > -0.01 * FOCAL_PX / 2.1).all()


def test_rms_counts_corners_not_coordinates() -> None:
    assert Reprojection(np.array([[3.0, 4.0], [0.0, 0.0]]), np.array([7, 8])).rms_px == pytest.approx(np.sqrt(12.5))
