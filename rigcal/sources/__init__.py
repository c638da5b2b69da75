"""Recordings: what can be read, and opening it.

Owns      finding the recordings at a path, choosing their readers by what the files hold, opening them as one.
Leaves    each format to its own file, imported only when asked; joining to joined; what is no recording to unknown.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Protocol

from loguru import logger

from aruco.errors import InputError

if TYPE_CHECKING:
    from aruco.model import Recording
    from rigcal.sources.options import SourceOptions

__all__ = ["open_recordings"]

# What readers are shown of a file.
HEAD_BYTES = 64 * 2**10
# Of files that lie beside recordings in a folder; a file that is named itself is looked into whatever its suffix.
NEVER_RECORDINGS = frozenset(
    f".{suffix}"
    for suffix in (
        *("png", "jpg", "jpeg", "npy", "yaml", "yml", "json", "csv", "toml", "txt", "md", "conf"),
        *("parquet", "h5", "hdf5", "html", "zip", "py"),
    )
)
# What an interrupted write leaves.
UNFINISHED_SUFFIX = ".part"
# Its state, in a folder that a conversion was interrupted in; see rigcal.recording_conversion.
STATE_FILE = "conversion.json"
RGBD_FOLDER = "RGB-D folder"


class _Reader(Protocol):
    """A module that reads one format."""

    def recognises(self, path: Path, head: bytes) -> bool: ...

    def opened(self, path: Path, options: SourceOptions) -> Recording: ...


class _Found(NamedTuple):
    """A recording that is not yet opened."""

    path: Path
    kind: str  # recordings of one folder are of one kind
    reader: _Reader


def open_recordings(paths: Sequence[Path], options: SourceOptions | None = None) -> Recording:
    """Open one or more recordings as one.

    Args:
        paths: Recordings of any format, cameras of recordings, or folders of recordings of one kind.
        options: What readers are told besides the path; None: the defaults.

    Returns:
        A recording with the cameras of all of them.

    Raises:
        InputError: A path cannot be read as a recording, or two of them have a camera of one name.
        MissingExtraError: A format's optional package is not installed.
    """
    found = [one for path in paths for one in _found(Path(path))]
    if not found:
        raise InputError("no recording given; give at least one recording, or a folder of recordings.")
    from rigcal.sources.joined import joined
    from rigcal.sources.options import SourceOptions

    return joined(_opened(found, options or SourceOptions()))


def _opened(found: Sequence[_Found], options: SourceOptions) -> list[tuple[Path, Recording]]:
    """Each recording with where it lies; all videos are one, because they may have one clock and one calibration."""
    options = replace(options, is_only=len(found) == 1)
    videos = [one.path for one in found if one.kind == "video"]
    opened = [(one.path, _with_sdk_or_without(one, options)) for one in found if one.kind != "video"]
    if options.stereo_depth:
        _tell_of_sdk_depth([one.path for one in found if one.kind == "ZED" and _only_sdk_reads(one)])
    if options.zed_conf is not None:
        _refuse_one_conf_for_several(options.zed_conf, [recording for _, recording in opened])
    if videos:
        from rigcal.sources import video

        place = videos[0] if len(videos) == 1 else Path(os.path.commonpath([path.resolve() for path in videos]))
        opened.append((place, video.opened_together(videos, options)))
    return opened


def _with_sdk_or_without(found: _Found, options: SourceOptions) -> Recording:
    """The SDK knows its own files best; depth by semi-global matching is only to be had without it.

    What it does not open, for want of a GPU or of a calibration that --zed-conf names, can be read all the same.
    """
    if found.kind != "ZED" or options.stereo_depth or _only_sdk_reads(found):
        return found.reader.opened(found.path, options)
    from rigcal.sources import zed_sdk
    from rigcal.sources.zed_player import RefusedError

    if not zed_sdk.is_available():
        return found.reader.opened(found.path, options)
    try:
        return zed_sdk.opened(found.path, options)
    except RefusedError as error:
        logger.warning("{} It is read without the SDK, which gives no depth unless --stereo-depth asks for it", error)
        return found.reader.opened(found.path, options)


def _only_sdk_reads(found: _Found) -> bool:
    from rigcal.sources import zed_sdk

    return found.reader is zed_sdk


def _tell_of_sdk_depth(paths: Sequence[Path]) -> None:
    if paths:
        logger.warning(
            "--stereo-depth: {} only the ZED SDK reads, so its own depth is used there", ", ".join(map(str, paths))
        )


def _refuse_one_conf_for_several(conf: Path, recordings: Sequence[Recording]) -> None:
    """A calibration that does not say whose it is cannot be that of two cameras."""
    from rigcal.sources.svo2 import Svo2
    from rigcal.sources.zed_conf import require_one_camera

    own = [recording for recording in recordings if isinstance(recording, Svo2)]
    require_one_camera(conf, [camera.name for recording in own for camera in recording.cameras])


def _found(path: Path) -> list[_Found]:
    """The recordings at a path; raises InputError where there is none."""
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file or folder; give a recording.")
    from rigcal.sources.unknown import unfinished, unknown_file

    if os.path.isdir(path):
        if (path / STATE_FILE).is_file() and path.suffix == UNFINISHED_SUFFIX:
            raise unfinished(path)
        return _in_folder(path)
    if not path.is_file():  # opening a pipe would wait for ever
        raise InputError(f"{path}: is neither a file nor a folder; give a recording.")
    one = _file(path)
    if one is None:
        raise unknown_file(path, _head(path))
    return [one]


def _in_folder(path: Path) -> list[_Found]:
    whole = _folder(path)
    if whole is not None and whole.kind != RGBD_FOLDER:
        return [whole]
    inside = list(_children(path, but_images=whole is not None))
    if whole is not None:
        inside = [whole, *(one for one in inside if one.kind != RGBD_FOLDER)]
    kinds = sorted({one.kind for one in inside})
    if len(kinds) > 1:
        examples = ", ".join(f"{next(o.path.name for o in inside if o.kind == k)} ({k})" for k in kinds)
        raise InputError(f"{path}: holds recordings of several kinds, {examples}; give those that are meant by name.")
    if inside:
        _tell_left_out(path, inside)
        return inside
    from rigcal.sources import rgbd_folder
    from rigcal.sources.unknown import RECORDING_SUFFIXES, empty_folder, unknown_file

    for child in _considered(path):
        if child.suffix.lower() in RECORDING_SUFFIXES and child.is_file():
            raise unknown_file(child, _head(child))
    if rgbd_folder.is_without_images(path):  # its reader says what it lacks
        return [_Found(path, RGBD_FOLDER, rgbd_folder)]
    raise empty_folder(path)


def _tell_left_out(path: Path, inside: Sequence[_Found]) -> None:
    """Name what looks like one more camera and is none; raises InputError for a file, which is one that was lost."""
    from rigcal.sources.rgbd_folder import is_without_images
    from rigcal.sources.unknown import RECORDING_SUFFIXES, what_it_is

    used = {one.path for one in inside}
    for child in _considered(path):
        if child in used:
            continue
        if child.is_dir():
            # Beside videos these are their intrinsics; a camera of the folder itself stays one of it.
            if inside[0].kind == RGBD_FOLDER and path not in used and is_without_images(child):
                logger.warning("{}: is left out: it has camera_info.yaml but no image", child)
        elif child.suffix.lower() in RECORDING_SUFFIXES:
            why = what_it_is(child, _head(child)) if child.is_file() else "is no file that could be read"
            raise InputError(f"{child}: {why}, or move it out of the folder if it is no recording.")


def _considered(path: Path) -> Iterator[Path]:
    for child in sorted(path.iterdir()):
        if child.suffix.lower() not in (*NEVER_RECORDINGS, UNFINISHED_SUFFIX) and not child.name.startswith("."):
            yield child


def _children(path: Path, *, but_images: bool = False) -> Iterator[_Found]:
    for child in _considered(path):
        if but_images and child.name in ("image", "depth", "confidence"):  # many files, none of them a recording
            continue
        one = _folder(child) if child.is_dir() else _file(child) if child.is_file() else None
        if one is not None:
            yield one


def _folder(path: Path) -> _Found | None:
    from rigcal.sources import rgbd_folder

    if rgbd_folder.recognises(path, b""):
        return _Found(path, RGBD_FOLDER, rgbd_folder)
    from rigcal.sources import ros_bag

    return _Found(path, "ROS bag", ros_bag) if ros_bag.recognises(path, b"") else None


def _file(path: Path) -> _Found | None:
    """The first reader that knows what the file holds, if one does."""
    from rigcal.sources.unknown import is_text

    head = _head(path)
    if path.suffix.lower() in (".svo", ".svo2") and is_text(head):  # the SDK would be asked for whatever is named so
        return None
    for kind, reader in _file_readers():
        if reader.recognises(path, head):
            return _Found(path, kind, reader)
    return None


def _file_readers() -> Iterator[tuple[str, _Reader]]:
    """Readers of files, each imported when those before it do not know the file."""
    from rigcal.sources import svo2

    yield "ZED", svo2
    from rigcal.sources import mcap_file

    yield "MCAP", mcap_file
    from rigcal.sources import ros_bag

    yield "ROS bag", ros_bag
    from rigcal.sources import zed_sdk

    yield "ZED", zed_sdk
    from rigcal.sources import video

    yield "video", video


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(HEAD_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); mend its permissions.") from error
