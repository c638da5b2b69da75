"""Intrinsics of a video's camera: found beside the file or where the user says.

Owns      where intrinsics are looked for, in which order, and when that is not clear.
Leaves    reading the files to the reader that comes in with the options, which of a file's cameras is the video's and
          whether it fits to given_cameras.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from loguru import logger

from aruco.errors import InputError
from aruco.model import Camera
from rigcal.sources.camera_info import FILE_NAME, dump_camera_info
from rigcal.sources.given_cameras import fitting, listed, meant
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
        InputError: There are no intrinsics, none of a camera of this name, several that differ, or for images of
            another size.
    """
    complaints: list[str] = []
    for paths, own in _candidates(video, options.intrinsics):
        found = list(_found(paths, video.stem, options, only=alone or own, complaints=complaints))
        if found:
            path, camera = _only(found, video)
            logger.debug("{}: intrinsics of {}", video, path)
            return fitting(replace(camera, name=video.stem), path, video.name, size)
    told = f" ({'; '.join(complaint.rstrip('.') for complaint in complaints)})" if complaints else ""
    if options.intrinsics is not None:
        raise InputError(
            f"{video}: no intrinsics of its camera in what --intrinsics gives{told}; call one of these cameras "
            f"{video.stem}, or give those that are this video's."
        )
    raise InputError(
        f"{video}: no intrinsics of its camera{told}; give them with --intrinsics FILE ({KNOWN}), or put such a file "
        f"beside the video as {video.stem}.yaml."
    )


def _candidates(video: Path, given: Path | None) -> Iterator[tuple[list[Path], bool]]:
    """What may hold the intrinsics, best first, and whether it is named after this video; lists are of equal rank."""
    if given is not None and not given.is_dir():
        yield [given], False
        return
    folder = video.parent if given is None else given
    own = [folder / f"{video.stem}{suffix}" for suffix in SUFFIXES] + [folder / video.stem / FILE_NAME]
    shared = [folder / FILE_NAME, *(folder / f"intrinsics{suffix}" for suffix in SUFFIXES)]
    yield from (([path], True) for path in own if path.is_file())
    yield from (([path], False) for path in shared if path.is_file())
    yield sorted(folder.glob("camchain*.yaml")), False
    yield [path for path in [folder / "calibration.toml"] if path.is_file()], False
    if given is not None:  # some calibrations are folders
        yield [given], False


def _found(
    paths: Sequence[Path], name: str, options: SourceOptions, *, only: bool, complaints: list[str]
) -> Iterator[tuple[Path, Camera]]:
    """Those that have the camera, with it; of the others the complaint is noted."""
    for path in paths:
        try:
            cameras = options.read_cameras(path)
        except InputError as error:
            if path == options.intrinsics and not complaints:
                raise
            complaints.append(str(error))
            continue
        camera = meant(cameras, name, only=only)
        if camera is not None:
            yield path, camera
        else:
            complaints.append(f"{path} has {listed(cameras)}, none of which is called {name}")


def _only(found: Sequence[tuple[Path, Camera]], video: Path) -> tuple[Path, Camera]:
    """The first, if nobody else says otherwise."""
    (path, camera), *others = found
    for other, another in others:
        if dump_camera_info(replace(another, name=camera.name)) != dump_camera_info(camera):
            raise InputError(
                f"{video}: {path.name} and {other.name} beside it have different intrinsics for its camera; name the "
                "file that is meant with --intrinsics FILE."
            )
    return path, camera
