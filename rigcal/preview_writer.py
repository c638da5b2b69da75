"""Annotated frames in a folder: ``<folder>/<camera>/<stamp>.jpg``.

Owns      writing them, and removing what a run that did not get through all frames has made of them.
Leaves    what is drawn to aruco.preview.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from threading import Lock
from types import TracebackType

import cv2
import numpy as np

from aruco.errors import OutputError, RigError
from aruco.model import Camera, Detection, Frame
from aruco.pose_math import Array
from aruco.preview import annotated
from aruco.view_pose import View

_HALF = ".half"  # of a picture that is being written


class PreviewWriter:
    """Called with every image that was read; safe to call from several threads.

    As a context, it removes what it has made where the block ends by an exception; but for an error that the user can
    cure after ``finish``: then the pictures are all there, and may show what went wrong.

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
        self._lock = Lock()  # of what was made
        self._folders: list[Path] = []  # inner ones last
        self._pictures: list[Path] = []
        self._is_whole = self._is_over = False
        try:
            self._make(folder)
        except BaseException:
            self._discard()
            raise

    def __call__(self, frame: Frame, camera: Camera, detection: Detection, view: View | None) -> None:
        """Write one picture."""
        T_cam_target = None if view is None else view.best.T_cam_target
        picture = annotated(frame.image, detection, camera, T_cam_target, self._axis_m)
        folder = self._folder / camera.name
        path = folder / f"{frame.stamp_ns}.jpg"
        _, data = cv2.imencode(".jpg", picture)
        with self._lock:
            if self._is_over:
                return
            self._make(folder)
            try:
                self._write(path, data.tobytes())
            except OSError as error:
                raise OutputError(f"{path}: the preview cannot be written ({error.strerror or error}).") from error

    def finish(self) -> None:
        """Every picture has been written."""
        self._is_whole = True

    def __enter__(self) -> PreviewWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is not None and not (self._is_whole and issubclass(kind, RigError)):
            self._discard()

    def _write(self, path: Path, data: bytes) -> None:
        """A picture whole or not at all; one of an earlier run is replaced."""
        half = path.with_name(path.name + _HALF)
        is_new = not path.exists()
        try:
            half.write_bytes(data)
            if is_new:
                self._pictures.append(path)
            half.replace(path)
        except BaseException:
            with suppress(OSError):
                half.unlink(missing_ok=True)
            raise

    def _make(self, folder: Path) -> None:
        try:
            missing = [path for path in (folder, *folder.parents) if not path.exists()]
            self._folders += reversed(missing)
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: the preview folder cannot be made ({error.strerror or error}).") from error

    def _discard(self) -> None:
        """Remove what this run has made, and nothing else; a folder that somebody put something into stays."""
        with self._lock:
            self._is_over = True
            for path in self._pictures:
                with suppress(OSError):
                    path.unlink()
            for folder in reversed(self._folders):
                with suppress(OSError):
                    folder.rmdir()
