"""Writing a recording as an RGB-D folder, whole or not at all.

Owns      the order of writing, and what happens when it is interrupted.
Leaves    the layout to rgbd_folder's description, bytes to camera_info and image_file.

Everything goes into a sibling folder ``<name>.part`` that is renamed at the end. The camera_info files are written
last: until then the folder does not read as a recording.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from loguru import logger

from aruco.errors import OutputError
from aruco.model import SILENT, BadFrame, Camera, Frame, Progress, Recording
from rigcal.sources.camera_info import FILE_NAME, dump_camera_info
from rigcal.sources.image_file import encode_depth, encode_png


def write_recording(recording: Recording, out: Path, *, depth: bool, progress: Progress = SILENT) -> None:
    """Write a recording as an RGB-D folder, one frame at a time.

    Args:
        recording: What to write; frames that cannot be read are left out and logged.
        out: The folder to make; it must not exist or be empty.
        depth: Whether to write depth and confidence too.
        progress: Told how many frames are written.

    Raises:
        OutputError: The folder holds something or cannot be written.
    """
    for camera in recording.cameras:
        _refuse_unusable_name(camera.name)
    total = sum(len(recording.stamps_ns(camera.name)) for camera in recording.cameras)
    done = 0
    with _appearing_whole(out) as part:
        for camera in recording.cameras:
            folder = part / camera.name
            for kind in ("image", "depth", "confidence") if depth else ("image",):
                (folder / kind).mkdir(parents=True)
            for frame in recording.frames(camera.name, range(len(recording.stamps_ns(camera.name))), depth=depth):
                if isinstance(frame, BadFrame):
                    logger.warning("camera {}: frame {} is left out: {}", camera.name, frame.stamp_ns, frame.reason)
                else:
                    _write_frame(folder, camera, frame, depth)
                done += 1
                progress.step("write", done, total)
        for camera in recording.cameras:
            (part / camera.name / FILE_NAME).write_text(dump_camera_info(camera), encoding="utf-8")


def _write_frame(folder: Path, camera: Camera, frame: Frame, depth: bool) -> None:
    name = f"{frame.stamp_ns}.png"
    (folder / "image" / name).write_bytes(encode_png(frame.image))
    if depth and frame.depth_m is not None:
        (folder / "depth" / name).write_bytes(encode_depth(frame.depth_m, camera.depth_scale))
    if depth and frame.confidence is not None:
        (folder / "confidence" / name).write_bytes(encode_png(frame.confidence))


def _refuse_unusable_name(name: str) -> None:
    if name in ("", ".", "..") or any(sign in name for sign in "/\\\0"):
        raise OutputError(f"camera {name!r}: a folder cannot have this name; rename the camera.")


@contextmanager
def _appearing_whole(out: Path) -> Iterator[Path]:
    """A folder to fill, which becomes ``out`` at the end and disappears if anything goes wrong."""
    out = out.resolve()
    part = out.with_name(out.name + ".part")
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise OutputError(f"{out}: exists and is not an empty folder; choose another place or remove it.")
        if part.exists():
            raise OutputError(f"{part}: is left from an interrupted run, or another one is writing it; remove it.")
        part.mkdir(parents=True)
        try:
            yield part
            if out.exists():
                out.rmdir()
            part.rename(out)
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error}); choose another place.") from error
