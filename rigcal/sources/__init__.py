"""Recordings: what can be read, and opening it.

Owns      choosing the reader of a path, and joining several recordings into one.
Leaves    each format to its own file, imported only when chosen.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from aruco.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from aruco.model import BadFrame, Camera, Frame, Recording

__all__ = ["open_recordings"]

# Known by their suffix, but not readable yet.
SVO_SUFFIXES = (".svo", ".svo2")


def open_recordings(paths: Sequence[Path]) -> Recording:
    """Open one or more recordings as one.

    Args:
        paths: Recordings, cameras of recordings, or folders of recordings.

    Returns:
        A recording with the cameras of all of them.

    Raises:
        InputError: A path cannot be read as a recording, or two of them have a camera of one name.
    """
    opened = [pair for path in paths for pair in _open(Path(path))]
    if not opened:
        raise InputError("no recording given; give at least one RGB-D folder.")
    return opened[0][1] if len(opened) == 1 else _Joined(opened)


def _open(path: Path) -> list[tuple[Path, Recording]]:
    """The recordings at a path, each with the path that it was found at."""
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file or folder; give a recording.")
    if not os.path.isdir(path):
        raise _unreadable_file(path)
    from rigcal.sources.rgbd_folder import RgbdFolder, is_rgbd_folder

    if is_rgbd_folder(path):
        return [(path, RgbdFolder(path))]
    children = sorted(path.iterdir())
    # A folder.part is what an interrupted write leaves.
    folders = [child for child in children if child.is_dir() and child.suffix != ".part" and is_rgbd_folder(child)]
    if folders:
        return [(folder, RgbdFolder(folder)) for folder in folders]
    for child in children:
        if child.suffix.lower() in SVO_SUFFIXES:
            raise _unreadable_file(child)
    return [(path, RgbdFolder(path))]  # raises, and says what such a folder has


def _unreadable_file(path: Path) -> InputError:
    if path.suffix.lower() in SVO_SUFFIXES:
        return InputError(
            f"{path}: SVO files cannot be read by this version yet; export the recording to an RGB-D folder "
            "(<camera>/camera_info.yaml and <camera>/image/<stamp_ns>.png) and give that folder."
        )
    return InputError(f"{path}: not a recording that is known here; known: a folder of RGB-D images (RGB-D folder).")


class _Joined:
    """Several recordings as one; implements aruco.model.Recording."""

    def __init__(self, opened: Sequence[tuple[Path, Recording]]) -> None:
        self._owners: dict[str, Recording] = {}
        places: dict[str, Path] = {}
        for path, recording in opened:
            for camera in recording.cameras:
                if camera.name in places:
                    raise InputError(
                        f"camera {camera.name} is in {places[camera.name]} and in {path}; rename the camera's folder "
                        "in one of them, or leave one out."
                    )
                places[camera.name] = path
                self._owners[camera.name] = recording
        cameras = [camera for _, recording in opened for camera in recording.cameras]
        self._cameras = tuple(sorted(cameras, key=lambda camera: camera.name))

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of all recordings, sorted by name."""
        return self._cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The sorted time stamps of a camera's frames."""
        return self._owner(camera).stamps_ns(camera)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """Ascending indices of the camera's frames that have depth."""
        return self._owner(camera).depth_indices(camera)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """A camera's frames at ascending indices into its stamps, one at a time."""
        return self._owner(camera).frames(camera, indices, depth=depth)

    def _owner(self, camera: str) -> Recording:
        if camera not in self._owners:
            raise InputError(f"no camera {camera} in the recordings; they have {', '.join(sorted(self._owners))}.")
        return self._owners[camera]
