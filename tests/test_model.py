from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from aruco.errors import InputError
from aruco.model import MAX_IMAGE_SIDE_PX, SILENT, BadFrame, Camera, CameraPose, Detection, Frame, Sighting

K = np.array([[700.0, 0.0, 640.0], [0.0, 700.0, 360.0], [0.0, 0.0, 1.0]])


def camera(**changes: Any) -> Camera:
    return Camera(**{"name": "left", "width": 1280, "height": 720, "K": K, **changes})


def detection(n: int = 3) -> Detection:
    return Detection(
        ids=np.arange(n, dtype=np.int64), corners_px=np.arange(8.0 * n).reshape(n, 4, 2), sigma_px=np.ones((n, 4))
    )


def camera_pose(**changes: Any) -> CameraPose:
    plain = {"n_frames": 3, "n_markers": 2, "rms_px": 0.1, "spread_m": 0.001, "spread_rad": 0.001}
    return CameraPose(**{"camera": "left", "T_world_cam": np.eye(4), **plain, **changes})


def test_a_camera_has_a_pinhole_lens_unless_told() -> None:
    pinhole = camera()
    assert pinhole.distortion_model == "plumb_bob"
    np.testing.assert_array_equal(pinhole.distortion, np.zeros(5))
    assert not pinhole.has_distortion
    assert camera(distortion=[0.0, 0.0, 0.0, 0.0, 1e-9]).has_distortion
    # A fisheye differs from a pinhole even with zero coefficients.
    assert camera(distortion_model="equidistant", distortion=np.zeros(4)).has_distortion


@pytest.mark.parametrize(
    ("model", "given", "kept"),
    [
        ("plumb_bob", [], [0, 0, 0, 0, 0]),
        ("plumb_bob", [1, 2, 3, 4], [1, 2, 3, 4, 0]),
        ("plumb_bob", [1, 2, 3, 4, 5], [1, 2, 3, 4, 5]),
        # Some drivers write eight or more numbers whatever the model; zeros say nothing.
        ("plumb_bob", [1, 2, 3, 4, 5, 0, 0, 0], [1, 2, 3, 4, 5]),
        ("rational_polynomial", [1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0, 0], [1, 2, 3, 4, 5, 6, 7, 8]),
        ("equidistant", [[1], [2], [3], [4]], [1, 2, 3, 4]),
    ],
)
def test_coefficients_are_filled_up_to_their_model(model: str, given: list[Any], kept: list[float]) -> None:
    np.testing.assert_array_equal(camera(distortion_model=model, distortion=given).distortion, kept)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"K": np.full((3, 3), np.nan)}, "camera_matrix: holds NaN"),
        ({"K": np.zeros((3, 3))}, "camera_matrix: focal lengths must be positive, got fx=0"),
        ({"K": np.diag([700.0, -700.0, 1.0])}, "fy=-700"),
        ({"K": np.eye(4)}, r"camera_matrix: want shape \(3, 3\)"),
        ({"K": K.T}, "not a camera matrix"),
        ({"K": np.diag([700.0, 700.0, 2.0])}, "not a camera matrix"),
        ({"depth_K": np.zeros((3, 3))}, "depth_camera_matrix: focal"),
        ({"width": 0}, "image size 0 x 720"),
        ({"height": -1}, "image size 1280 x -1"),
        ({"width": MAX_IMAGE_SIDE_PX + 1}, "image size"),
        ({"distortion_model": "thin_prism"}, "unknown distortion_model 'thin_prism'; known: plumb_bob"),
        ({"distortion": [0.1, 0.2]}, "plumb_bob wants 5 distortion_coefficients, got 2"),
        ({"distortion": [0.1, 0.2, 0, 0, 0, 0.3]}, "plumb_bob wants 5 distortion_coefficients, got 6"),
        ({"distortion_model": "equidistant", "distortion": []}, "equidistant wants 4"),
        ({"distortion_model": "rational_polynomial", "distortion": np.zeros(5)}, "rational_polynomial wants 8"),
        ({"distortion": [0.1, np.inf, 0, 0]}, "distortion_coefficients: holds NaN or infinite"),
        ({"depth_scale": 0.0}, "depth_scale"),
        ({"depth_scale": float("nan")}, "depth_scale"),
        ({"baseline_m": -0.12}, "baseline"),
        ({"baseline_m": float("inf")}, "baseline"),
    ],
)
def test_a_camera_that_cannot_be_is_refused_with_its_name(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(InputError, match=f"camera left.*{reason}"):
        camera(**changes)


def test_a_camera_keeps_its_own_read_only_arrays() -> None:
    mine = K.copy()
    held = camera(K=mine, depth_K=mine, distortion=np.zeros(5))
    mine[0, 0] = 1.0
    assert held.K[0, 0] == 700.0
    assert held.depth_K is not None
    for array in (held.K, held.depth_K, held.distortion):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


@pytest.mark.parametrize("name", ["width", "K", "widht"])  # frozen, frozen, unknown
def test_a_camera_cannot_be_changed(name: str) -> None:
    with pytest.raises((AttributeError, TypeError)):
        setattr(camera(), name, 3)


def test_everything_is_frozen() -> None:
    frame = Frame(camera="left", stamp_ns=1, image=np.zeros((2, 2), np.uint8))
    sighting = Sighting(camera="left", frame=0, stamp_ns=1, detection=detection())
    for thing in (frame, sighting, detection(), camera_pose(), BadFrame("left", 1, "zero bytes")):
        for field in dataclasses.fields(thing):
            with pytest.raises(dataclasses.FrozenInstanceError):
                setattr(thing, field.name, None)


@pytest.mark.parametrize(
    ("n_ids", "corners", "sigmas"), [(2, (3, 4, 2), (2, 4)), (2, (2, 4, 2), (3, 4)), (1, (4, 2), (4,)), (0, (0,), (0,))]
)
def test_a_detection_has_four_corners_a_marker(n_ids: int, corners: tuple[int, ...], sigmas: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=f"for {n_ids} ids"):
        Detection(ids=np.arange(n_ids, dtype=np.int64), corners_px=np.zeros(corners), sigma_px=np.zeros(sigmas))


def test_a_detection_can_be_narrowed_and_not_changed() -> None:
    three = detection(3)
    assert len(three) == 3
    two = three.only(np.array([True, False, True]))
    assert two.ids.tolist() == [0, 2]
    np.testing.assert_array_equal(two.corners_px, three.corners_px[[0, 2]])
    none = three.only(np.zeros(3, dtype=np.bool_))
    assert len(none) == 0
    assert none.corners_px.shape == (0, 4, 2)
    for array in (three.ids, two.corners_px, two.sigma_px):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_a_camera_pose_is_checked_and_copied() -> None:
    T = np.eye(4)
    pose = camera_pose(T_world_cam=T)
    T[0, 3] = 5.0
    assert pose.T_world_cam[0, 3] == 0.0
    with pytest.raises(ValueError, match=r"left.T_world_cam.*proper rotation"):
        camera_pose(T_world_cam=np.diag([1.0, 1.0, -1.0, 1.0]))


def test_the_silent_guest_listens_to_anything() -> None:
    assert SILENT.step("detecting", 3, 10) is None
