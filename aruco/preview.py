"""Markers and the target's axes drawn on an image, for people to look at."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.model import Camera, Detection
from aruco.pose_math import Pose, transform_points

# BGR: x red, y green, z blue, as everywhere.
AXIS_COLOURS = ((60, 60, 255), (60, 220, 60), (255, 120, 40))
MARKER_COLOUR = (0, 220, 255)
FIRST_CORNER_COLOUR = (0, 0, 255)
# OpenCV draws with fixed-point coordinates of this many binary places.
SHIFT = 4


def annotated(
    image: NDArray[np.uint8], detection: Detection, camera: Camera, T_cam_target: Pose | None, axis_m: float
) -> NDArray[np.uint8]:
    """A copy of an image with outlines, ids, first corners, and the target's axes.

    Args:
        image: (h, w) grey or (h, w, 3) BGR.
        detection: The markers in it.
        camera: Whose image it is.
        T_cam_target: The target's pose; None draws no axes.
        axis_m: Length of the axes.
    """
    drawn = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
    for marker, corners in zip(detection.ids, detection.corners_px):
        cv2.polylines(drawn, [_fixed(corners)], True, MARKER_COLOUR, 1, cv2.LINE_AA, SHIFT)
        first = _fixed(corners[:1])[0]
        cv2.circle(drawn, (int(first[0]), int(first[1])), 4 << SHIFT, FIRST_CORNER_COLOUR, 1, cv2.LINE_AA, SHIFT)
        middle = corners.mean(axis=0)
        place = (int(middle[0]) - 10, int(middle[1]) + 5)
        cv2.putText(drawn, str(marker), place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, MARKER_COLOUR, 2, cv2.LINE_AA)
    if T_cam_target is not None:
        _draw_axes(drawn, camera, T_cam_target, axis_m)
    return np.asarray(drawn, dtype=np.uint8)


def _draw_axes(drawn: NDArray, camera: Camera, T_cam_target: Pose, axis_m: float) -> None:
    ends = transform_points(T_cam_target, np.vstack([np.zeros(3), axis_m * np.eye(3)]))
    pixels = lens.project(camera, ends)
    limit = 4 * max(camera.width, camera.height)
    if not np.isfinite(pixels).all() or np.abs(pixels).max() > limit:
        return
    fixed = _fixed(pixels)
    for end, colour in zip(fixed[1:], AXIS_COLOURS):
        cv2.line(drawn, tuple(map(int, fixed[0])), tuple(map(int, end)), colour, 2, cv2.LINE_AA, SHIFT)


def _fixed(points: NDArray) -> NDArray[np.int32]:
    return np.rint(points * (1 << SHIFT)).astype(np.int32)
