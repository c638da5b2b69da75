"""OpenCV's own marker corners, to compare with on the same images.

Owns      ArUco detection with each of OpenCV's refinements, in the form that tag_wall compares.
Leaves    our own detection to aruco.detector.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.detector import get_dictionary
from aruco.pose_math import Array

Finds = tuple[NDArray[np.int64], Array]  # ids (n,), corners (n, 4, 2) [px]

REFINEMENTS = {
    "none": cv2.aruco.CORNER_REFINE_NONE,
    "subpix": cv2.aruco.CORNER_REFINE_SUBPIX,
    "contour": cv2.aruco.CORNER_REFINE_CONTOUR,
    "apriltag": cv2.aruco.CORNER_REFINE_APRILTAG,
}


def plain_detector(dictionary: str, refinement: str = "none") -> Callable[[NDArray[np.uint8]], Finds]:
    """OpenCV's detector with its default parameters and one of its refinements."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = REFINEMENTS[refinement]
    detector = cv2.aruco.ArucoDetector(get_dictionary(dictionary), parameters)

    def detect(image: NDArray[np.uint8]) -> Finds:
        corners, ids, _ = detector.detectMarkers(image)
        n = 0 if ids is None else len(ids)
        found = np.empty(0, np.int64) if ids is None else np.asarray(ids, np.int64).reshape(n)
        return found, np.asarray(corners, np.float64).reshape(n, 4, 2)

    return detect
