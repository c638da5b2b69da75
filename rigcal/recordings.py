"""What readers of recordings are told, from the options of a command.

Owns      SourceOptions from the command line, and reading intrinsics files of any kind.
Leaves    the formats of such files to rigcal.sources.camera_info and rigcal.formats.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from aruco.errors import InputError
from aruco.model import Camera
from rigcal.sources.options import DEPTH_MODES, SourceOptions

# Enough to tell one YAML file from another.
HEAD_BYTES = 64 * 2**10


def plain_options() -> SourceOptions:
    """What readers are told where nobody said anything."""
    return SourceOptions(read_cameras=read_cameras)


def options_from(given: Mapping[str, Any]) -> SourceOptions:
    """What readers are told, from the options of rigcal.source_options.

    Raises:
        InputError: An option cannot be used.
    """
    return SourceOptions(
        depth_mode=_depth_mode(given["depth_mode"]),
        zed_conf=given["zed_conf"],
        stereo_depth=given["stereo_depth"],
        topics=tuple(given["topics"]),
        same_clock=given["same_clock"],
        intrinsics=given["intrinsics"],
        read_cameras=read_cameras,
    )


def read_cameras(path: Path) -> Mapping[str, Camera]:
    """The cameras of an intrinsics file or folder: ROS camera_info YAML, or a calibration that holds intrinsics.

    Returns:
        Name -> camera; a camera_info file's only camera is called what the file calls it, else like the file.

    Raises:
        InputError: The file cannot be read or holds no intrinsics.
    """
    if path.is_dir():
        return _of_folder(path)
    head = _head(path)
    if _is_camera_info(head):
        from rigcal.sources.camera_info import load_camera_info

        named = re.search(r"^camera_name:[ \t]*[\"']?([^\s\"'#]+)", head, re.MULTILINE)
        name = path.stem if named is None else named[1]
        return {name: load_camera_info(path, name)}
    from rigcal.formats.registry import cameras_of

    return cameras_of(path)


def _of_folder(path: Path) -> Mapping[str, Camera]:
    from rigcal.formats.registry import UnknownFormatError, cameras_of

    try:
        return cameras_of(path)
    except UnknownFormatError as error:
        raise InputError(
            f"{path}: no intrinsics there; give a file of them, a COLMAP text model, or for videos a folder with "
            "<video>.yaml for each or camchain.yaml for all."
        ) from error


def _depth_mode(word: str) -> str:
    from rigcal.sources.zed_sdk import depth_mode_named

    return depth_mode_named(word, DEPTH_MODES)


def _head(path: Path) -> str:
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the cameras' intrinsics.")
    try:
        with path.open("rb") as stream:
            return stream.read(HEAD_BYTES).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); mend its permissions.") from error


def _is_camera_info(head: str) -> bool:
    """OpenCV's own calibration files have the same keys, but matrices of a type of their own."""
    keys = (r"^[\"']?image_width[\"']?\s*:", r"^[\"']?camera_matrix[\"']?\s*:")
    return "opencv-matrix" not in head and all(re.search(key, head, re.MULTILINE) for key in keys)
