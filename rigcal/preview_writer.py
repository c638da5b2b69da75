"""Annotated frames in a folder: ``<folder>/<camera>/<stamp>.jpg``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from aruco.errors import OutputError
from aruco.model import Camera, Detection, Frame
from aruco.pose_math import Array
from aruco.preview import annotated
from aruco.view_pose import View


class PreviewWriter:
    """Called with every image that was read; safe to call from several threads.

    Args:
        folder: Where the pictures go; created, and kept apart by camera.
        geometry: Marker id -> (4, 3) corners [m], for the length of the axes.

    Raises:
        OutputError: The folder cannot be written.
    """

    def __init__(self, folder: Path, geometry: Mapping[int, Array]) -> None:
        self._folder = folder
        corners = np.concatenate(list(geometry.values()))
        self._axis_m = 0.5 * float(np.ptp(corners, axis=0).max())
        self._make(folder)

    def __call__(self, frame: Frame, camera: Camera, detection: Detection, view: View | None) -> None:
        """Write one picture."""
        T_cam_target = None if view is None else view.best.T_cam_target
        picture = annotated(frame.image, detection, camera, T_cam_target, self._axis_m)
        folder = self._folder / camera.name
        self._make(folder)
        path = folder / f"{frame.stamp_ns}.jpg"
        _, data = cv2.imencode(".jpg", picture)
        try:
            path.write_bytes(data.tobytes())
        except OSError as error:
            raise OutputError(f"{path}: the preview cannot be written ({error.strerror or error}).") from error

    @staticmethod
    def _make(folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: the preview folder cannot be made ({error.strerror or error}).") from error
