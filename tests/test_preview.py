"""A preview shows what was found where it was found, and leaves the image alone."""

from __future__ import annotations

import numpy as np
import pytest
from marker_pictures import make_camera
from numpy.typing import NDArray
from target_views import CAMERA, box, looking_at, sight

from aruco import lens
from aruco.model import Camera, Detection
from aruco.pose_math import invert_transform, make_pose, transform_points
from aruco.preview import AXIS_COLOURS, FIRST_CORNER_COLOUR, MARKER_COLOUR, annotated

BOX = box()
T_CAM_TARGET = invert_transform(looking_at(np.array([0.9, 1.0, 2.3]), np.zeros(3)))
GREY = np.full((720, 1280), 90, np.uint8)
NOTHING = Detection(ids=np.empty(0, np.int64), corners_px=np.empty((0, 4, 2)), sigma_px=np.empty((0, 4)))


def found(camera: Camera = CAMERA) -> Detection:
    return sight(camera, T_CAM_TARGET, BOX, 0.0, np.random.default_rng(0))


def near_colour(image: NDArray[np.uint8], pixel: NDArray, colour: tuple[int, int, int]) -> bool:
    """Whether one of the 5 x 5 pixels around a place has nearly this colour."""
    u, v = np.rint(pixel).astype(int)
    return bool((np.abs(image[v - 2 : v + 3, u - 2 : u + 3].astype(int) - colour).max(axis=2) < 60).any())


@pytest.mark.parametrize("colour", [False, True])
def test_outlines_lie_on_the_markers(colour: bool) -> None:
    image = np.repeat(GREY[..., None], 3, axis=2) if colour else GREY
    before = image.copy()
    detection = found()
    drawn = annotated(image, detection, CAMERA, None, 0.3)
    assert drawn.shape == (720, 1280, 3)
    assert drawn.dtype == np.uint8
    np.testing.assert_array_equal(image, before)
    assert len(detection) == 3
    for corners in detection.corners_px:
        for a, b in zip(corners[1:], np.roll(corners, -1, axis=0)[1:]):
            assert near_colour(drawn, (2 * a + b) / 3, MARKER_COLOUR)
        # A circle of four pixels around the first corner, and only there.
        ring = [corners[0] + 4 * np.array([np.cos(t), np.sin(t)]) for t in np.linspace(0, 6, 12)]
        assert any(near_colour(drawn, place, FIRST_CORNER_COLOUR) for place in ring)
        ring = [corners[2] + 4 * np.array([np.cos(t), np.sin(t)]) for t in np.linspace(0, 6, 12)]
        assert not any(near_colour(drawn, place, FIRST_CORNER_COLOUR) for place in ring)


@pytest.mark.parametrize("lens_model", ["pinhole", "plumb_bob"])
def test_axes_point_where_the_target_says_in_red_green_and_blue(lens_model: str) -> None:
    camera = make_camera(lens_model=lens_model)
    drawn = annotated(GREY, NOTHING, camera, T_CAM_TARGET, 0.3)
    ends = lens.project(camera, transform_points(T_CAM_TARGET, 0.3 * np.eye(3)))
    for end, colour, channel in zip(ends, AXIS_COLOURS, (2, 1, 0)):
        assert near_colour(drawn, end, colour)
        assert int(np.argmax(colour)) == channel  # BGR: x red, y green, z blue
    assert (annotated(GREY, NOTHING, camera, None, 0.3) == 90).all()


def test_nothing_found_leaves_the_picture_as_it_is() -> None:
    assert (annotated(GREY, NOTHING, CAMERA, None, 0.3) == 90).all()


@pytest.mark.parametrize("z_m", [-2.0, 0.0, 0.1])
def test_a_target_behind_or_at_the_camera_has_no_axes_and_no_error(z_m: float) -> None:
    T = make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, z_m]))
    assert (annotated(GREY, NOTHING, CAMERA, T, 0.3) == 90).all()


def test_markers_at_the_border_and_axes_beyond_it_are_drawn_as_far_as_they_go() -> None:
    corners = np.array([[[-3.0, -2.0], [60.0, -4.0], [61.0, 50.0], [-2.5, 49.0]]])
    detection = Detection(ids=np.array([5]), corners_px=corners, sigma_px=np.full((1, 4), 0.1))
    far = make_pose(np.eye(3), np.array([2.5, 0.0, 2.0]))
    drawn = annotated(GREY, detection, CAMERA, far, 0.3)
    assert near_colour(drawn, np.array([30.0, 49.5]), MARKER_COLOUR)
    assert (drawn[:, 200:] == 90).all()
