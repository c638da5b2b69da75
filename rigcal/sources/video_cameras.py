"""Intrinsics of a video's camera: found beside the file or where the user says, and fitting its images.

Owns      where intrinsics are looked for, which camera of a file is the video's.
Leaves    reading the files to the reader that comes in with the options.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from aruco.errors import InputError
from aruco.model import Camera
from rigcal.sources.camera_info import FILE_NAME
from rigcal.sources.options import SourceOptions

SUFFIXES = (".yaml", ".yml", ".xml", ".json", ".toml")
KNOWN = "ROS camera_info.yaml, OpenCV FileStorage, Kalibr camchain or aniposelib TOML"


def camera_of_video(video: Path, size: tuple[int, int], options: SourceOptions, *, alone: bool) -> Camera:
    """The camera that recorded a video.

    Args:
        video: The file; its name without suffix is the camera's.
        size: (width, height) of its images.
        options: Which file has the intrinsics, if the user said so, and who reads it.
        alone: Whether it is the only video, so that a file with one camera is meant for it.

    Returns:
        The camera, called like the video.

    Raises:
        InputError: There are no intrinsics, or none of a camera of this name, or for images of another size.
    """
    complaints: list[str] = []
    for path, own in _candidates(video, options.intrinsics):
        try:
            cameras = options.read_cameras(path)
        except InputError as error:
            if path == options.intrinsics:
                raise
            complaints.append(str(error))
            continue
        camera = _chosen(cameras, video.stem, alone or own)
        if camera is not None:
            return _fitting(replace(camera, name=video.stem), path, video, size)
        complaints.append(f"{path} has {_listed(cameras)}, none of which is called {video.stem}")
    told = f" ({'; '.join(complaint.rstrip('.') for complaint in complaints)})" if complaints else ""
    raise InputError(
        f"{video}: no intrinsics of its camera{told}; give them with --intrinsics FILE ({KNOWN}), or put such a file "
        f"beside the video as {video.stem}.yaml."
    )


def _candidates(video: Path, given: Path | None) -> Iterator[tuple[Path, bool]]:
    """Files that may hold the intrinsics, and whether each is named after this video."""
    if given is not None and not given.is_dir():
        yield given, False
        return
    folder = video.parent if given is None else given
    own = [folder / f"{video.stem}{suffix}" for suffix in SUFFIXES] + [folder / video.stem / FILE_NAME]
    shared = [folder / FILE_NAME, *(folder / f"intrinsics{suffix}" for suffix in SUFFIXES)]
    shared += [*sorted(folder.glob("camchain*.yaml")), folder / "calibration.toml"]
    for path in own + shared:
        if path.is_file():
            yield path, path in own


def _chosen(cameras: Mapping[str, Camera], name: str, only: bool) -> Camera | None:
    if name in cameras:
        return cameras[name]
    return next(iter(cameras.values())) if only and len(cameras) == 1 else None


def _fitting(camera: Camera, path: Path, video: Path, size: tuple[int, int]) -> Camera:
    if (camera.width, camera.height) == size:
        return camera
    if (camera.height, camera.width) == size:
        advice = "they are of turned images, and these stay as stored: calibrate with images as stored"
    else:
        advice = "give the intrinsics of this resolution"
    raise InputError(
        f"{path}: the intrinsics are of images of {camera.width} x {camera.height}, but {video.name} has "
        f"{size[0]} x {size[1]}; {advice}."
    )


def _listed(cameras: Mapping[str, Camera]) -> str:
    names = sorted(cameras)
    return ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "") if names else "no camera"
