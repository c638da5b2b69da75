"""Writing a recording as an RGB-D folder, whole or not at all; or frame by frame, for those who go on later.

Owns      the order of writing, and what happens when it is interrupted.
Leaves    the layout to rgbd_folder's description, bytes to camera_info and image_file.

Everything goes into a sibling folder ``<name>.part`` that is renamed at the end. The camera_info files are written
last: until then the folder does not read as a recording.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import OutputError
from aruco.model import SILENT, BadFrame, Camera, Frame, Progress, Recording, name_trouble
from rigcal.sources.camera_info import FILE_NAME, dump_camera_info
from rigcal.sources.image_file import encode_depth, encode_png

_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"\0\0\0\0IEND\xaeB`\x82"
# Of a file that is being written.
_HALF = ".half"


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
        refuse_unusable_name(camera.name)
    total = sum(len(recording.stamps_ns(camera.name)) for camera in recording.cameras)
    done = 0
    with _appearing_whole(out) as part:
        frames = RgbdFrames(part, recording.cameras, rounded=True)
        for camera in recording.cameras:
            for frame in recording.frames(camera.name, range(len(recording.stamps_ns(camera.name))), depth=depth):
                if isinstance(frame, BadFrame):
                    logger.warning("camera {}: frame {} is left out: {}", camera.name, frame.stamp_ns, frame.reason)
                else:
                    frames.store(frames.packed(frame))
                done += 1
                progress.step("write", done, total)
        frames.finish()


class RgbdFrames:
    """Frames in a folder that grows, and that a later run can go on with."""

    def __init__(self, folder: Path, cameras: Sequence[Camera], *, rounded: bool = False) -> None:
        """Begin the folder, or go on with it.

        Args:
            folder: Where it is or will be.
            cameras: All that it will have.
            rounded: Depth is written in 16-bit multiples of the camera's depth_scale, as depth cameras do. Otherwise
                nothing is lost: depth that such do not hold is written as float32.
        """
        self._folder, self._rounded = folder, rounded
        self._cameras = {camera.name: camera for camera in cameras}
        for name in self._cameras:
            refuse_unusable_name(name)
            (folder / name / "image").mkdir(parents=True, exist_ok=True)

    def finished(self, camera: str) -> NDArray[np.int64]:
        """The stamps of a camera's frames that are there and whole: after a power failure files may be empty or cut."""
        folder = self._folder / camera
        files = [path for path in (folder / "image").glob("*.png") if path.stem.lstrip("-").isdecimal()]
        stamps = [int(path.stem) for path in files if all(map(_is_whole, (path, *_companions(folder, path.stem))))]
        if len(stamps) < len(files):
            logger.info("{}: {} frames are not whole and are written again", folder, len(files) - len(stamps))
        return np.array(sorted(stamps), dtype=np.int64)

    def packed(self, frame: Frame) -> list[tuple[Path, bytes]]:
        """A frame as it will be stored; may be called from several threads."""
        folder, scale = self._folder / frame.camera, self._cameras[frame.camera].depth_scale
        files: list[tuple[Path, bytes]] = []
        if frame.depth_m is not None:
            as_png = self._rounded or fits_steps(frame.depth_m, scale)
            data = encode_depth(frame.depth_m, scale) if as_png else _npy(frame.depth_m)
            files.append((folder / "depth" / f"{frame.stamp_ns}.{'png' if as_png else 'npy'}", data))
        if frame.confidence is not None:
            files.append((folder / "confidence" / f"{frame.stamp_ns}.png", encode_png(frame.confidence)))
        # The image last: with it the frame is whole.
        return [*files, (folder / "image" / f"{frame.stamp_ns}.png", encode_png(frame.image))]

    def store(self, packed: Sequence[tuple[Path, bytes]]) -> None:
        """Add a frame."""
        for path, data in packed:
            _write_at_once(path, data)

    def finish(self) -> None:
        """Make the folder a recording."""
        for left in self._folder.glob(f"*/*/*{_HALF}"):
            left.unlink()
        for name, camera in self._cameras.items():
            _write_at_once(self._folder / name / FILE_NAME, dump_camera_info(camera).encode())

    def close(self) -> None:
        """Leave the folder as it is, to be gone on with."""


def _companions(folder: Path, stamp: str) -> Iterator[Path]:
    for name in (f"depth/{stamp}.png", f"depth/{stamp}.npy", f"confidence/{stamp}.png"):
        if (folder / name).exists():
            yield folder / name


def _is_whole(path: Path) -> bool:
    """Whether an image file ends as it was written, as far as its beginning and end tell."""
    try:
        if path.suffix == ".npy":
            np.load(path, mmap_mode="r", allow_pickle=False)
            return True
        with path.open("rb") as file:
            start = file.read(len(_PNG_START))
            size = file.seek(0, 2)
            file.seek(max(0, size - len(_PNG_END)))
            return start == _PNG_START and file.read() == _PNG_END
    except (OSError, ValueError, EOFError):
        return False


def fits_steps(depth_m: NDArray[np.float32], step_m: float) -> bool:
    """Whether 16-bit multiples of a step hold a depth image, but for the rounding of its float32 numbers."""
    measured = depth_m[np.isfinite(depth_m)].astype(np.float64)
    units = np.rint(measured / step_m)
    # Those who made the numbers multiplied in float32 or in float64.
    near = np.abs(units * step_m - measured) <= 2.0**-22 * measured
    return bool((near & (units >= 1) & (units <= 65535)).all())


def _npy(depth_m: NDArray[np.float32]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, depth_m.astype(np.float32), allow_pickle=False)
    return stream.getvalue()


def _write_at_once(path: Path, data: bytes) -> None:
    """A file that is never there in part, whenever the process ends."""
    path.parent.mkdir(exist_ok=True)
    half = path.with_name(path.name + _HALF)
    half.write_bytes(data)
    half.replace(path)


def refuse_unusable_name(name: str) -> None:
    """Refuse a camera's name that would lead elsewhere as a folder's, or that calibrating would refuse.

    Raises:
        OutputError: It is one; see aruco.model.name_trouble.
    """
    if trouble := name_trouble(name):
        raise OutputError(f"camera {name[:40]!r}: {trouble}; rename the camera.")


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
