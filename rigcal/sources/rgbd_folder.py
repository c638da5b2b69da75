"""The RGB-D folder: a recording as plain image files, one subfolder a camera.

Owns      which files of a folder are which camera's frames, and reading them one at a time.
Leaves    intrinsics to camera_info, the bytes of images to image_file, writing to rgbd_writer.

    <recording>/<camera>/camera_info.yaml
    <recording>/<camera>/image/<stamp_ns>.png|jpg
    <recording>/<camera>/depth/<stamp_ns>.png|npy          optional
    <recording>/<camera>/confidence/<stamp_ns>.png         optional
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.model import BadFrame, Camera, Frame, name_trouble
from aruco.svo_sync import MAX_STAMP_NS, default_tolerance_ns, nearest
from rigcal.sources.camera_info import FILE_NAME, load_camera_info
from rigcal.sources.image_file import ImageFileError, decode_8bit, read_bytes, read_depth
from rigcal.sources.options import SourceOptions
from rigcal.sources.rgbd_writer import write_recording

__all__ = ["RgbdFolder", "opened", "recognises", "write_recording"]

IMAGE, DEPTH, CONFIDENCE = "image", "depth", "confidence"
# Of two files with one stamp the suffix that comes first here wins.
SUFFIXES = {IMAGE: (".png", ".jpg", ".jpeg"), DEPTH: (".png", ".npy"), CONFIDENCE: (".png",)}
_STAMPED_NAME = re.compile(r"(-?[0-9]{1,19})(\.[a-z]+)", re.IGNORECASE)


def recognises(path: Path, head: bytes) -> bool:
    """Whether a folder holds a recording or a camera of one, as names tell: some camera has a folder of images."""
    return any((folder / IMAGE).is_dir() for folder in _camera_folders(path))


def opened(path: Path, options: SourceOptions) -> RgbdFolder:
    """Open a recording folder, or the folder of a single camera; raises InputError as RgbdFolder does."""
    return RgbdFolder(path)


class RgbdFolder:
    """A recording folder, or the folder of a single camera; implements aruco.model.Recording."""

    def __init__(self, path: Path) -> None:
        """Find the cameras and their stamps; no image is opened.

        Raises:
            InputError: There is no such folder, no camera, a camera without usable intrinsics, or no image at all.
        """
        folders = _camera_folders(path)
        if not folders:
            raise InputError(
                f"{path}: no recording there; an RGB-D folder has <camera>/{FILE_NAME} and "
                f"<camera>/{IMAGE}/<stamp_ns>.png or .jpg."
            )
        self._folders = {folder.name: _CameraFolder.opened(folder) for folder in folders}
        if not any(len(folder.image.stamps_ns) for folder in self._folders.values()):
            raise InputError(f"{path}: no camera has an image; they belong in <camera>/{IMAGE}/<stamp_ns>.png or .jpg.")

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, sorted by name; one without images is among them."""
        return tuple(self._folders[name].camera for name in sorted(self._folders))

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The sorted time stamps of a camera's images; raises InputError for an unknown camera."""
        return self._folder(camera).image.stamps_ns

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """Ascending indices of the images that a depth file belongs to."""
        return np.flatnonzero(self._folder(camera).depth_of >= 0)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """A camera's frames at ascending indices into its stamps, read one at a time.

        A depth or confidence file that cannot be read makes its frame bad, but only when depth is asked for.
        """
        folder = self._folder(camera)
        return (folder.read(int(index), depth) for index in indices)

    def _folder(self, camera: str) -> _CameraFolder:
        if camera not in self._folders:
            raise InputError(f"no camera {camera} in the recording; it has {', '.join(sorted(self._folders))}.")
        return self._folders[camera]


def is_without_images(path: Path) -> bool:
    """Whether a folder has cameras' descriptions alone, as an RGB-D folder without images has, and videos may have."""
    return bool(_camera_folders(path)) and not recognises(path, b"")


def _camera_folders(path: Path) -> list[Path]:
    # The folder's name is the camera's, also for "." and links.
    path = path.resolve()
    try:
        if _is_camera(path):
            return [path]
        return [child for child in sorted(path.iterdir()) if child.is_dir() and _is_camera(child)]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); give a recording's folder.") from error


def _is_camera(path: Path) -> bool:
    if (path / FILE_NAME).is_file():
        return True
    # Of a recording that has a camera called image, that is not the folder of its images.
    return any((path / kind).is_dir() and not (path / kind / FILE_NAME).is_file() for kind in SUFFIXES)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Stamped:
    """The usable files of one folder, by time."""

    folder: Path
    stamps_ns: NDArray[np.int64]  # (n,), strictly ascending
    names: tuple[str, ...]  # (n,)

    @staticmethod
    def listed(folder: Path, suffixes: Sequence[str]) -> _Stamped:
        found: dict[int, str] = {}
        for _, name in sorted(_candidates(folder, suffixes)):
            stamp = int(Path(name).stem)
            if stamp in found:
                logger.debug("{}: {} is left out, {} has the same stamp", folder, name, found[stamp])
            else:
                found[stamp] = name
        stamps = np.array(sorted(found), dtype=np.int64)
        stamps.setflags(write=False)
        return _Stamped(folder=folder, stamps_ns=stamps, names=tuple(found[stamp] for stamp in stamps.tolist()))

    def path(self, index: int) -> Path:
        return self.folder / self.names[index]


def _candidates(folder: Path, suffixes: Sequence[str]) -> Iterator[tuple[int, str]]:
    """(rank of the suffix, name) of the files that are named after a stamp."""
    if not folder.is_dir():
        return
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                match = _STAMPED_NAME.fullmatch(entry.name)
                known = match is not None and match[2].lower() in suffixes and abs(int(match[1])) <= MAX_STAMP_NS
                if match is not None and known:  # what is named like a frame and is none is a bad frame when read
                    yield suffixes.index(match[2].lower()), entry.name
                else:
                    logger.warning("{}: {} is ignored, not <stamp_ns>{}", folder, entry.name, " or ".join(suffixes))
    except OSError as error:
        raise InputError(f"{folder}: cannot be read ({error.strerror or error}); mend its permissions.") from error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _CameraFolder:
    camera: Camera
    image: _Stamped
    depth: _Stamped
    confidence: _Stamped
    depth_of: NDArray[np.int64]  # (n images,) index of the image's depth file, -1 for none
    confidence_of: NDArray[np.int64]  # likewise

    @staticmethod
    def opened(path: Path) -> _CameraFolder:
        if trouble := name_trouble(path.name):
            raise InputError(f"{path.parent}: camera {path.name[:40]!r}: {trouble}; rename its folder.")
        files = {kind: _Stamped.listed(path / kind, suffixes) for kind, suffixes in SUFFIXES.items()}
        return _CameraFolder(
            camera=load_camera_info(path / FILE_NAME, path.name),
            **files,
            depth_of=belonging(files[IMAGE].stamps_ns, files[DEPTH].stamps_ns),
            confidence_of=belonging(files[IMAGE].stamps_ns, files[CONFIDENCE].stamps_ns),
        )

    def read(self, index: int, depth: bool) -> Frame | BadFrame:
        stamp_ns = int(self.image.stamps_ns[index])
        path = self.image.path(index)
        depth_m = confidence = None
        try:
            data = read_bytes(path)
            image = decode_8bit(data, (self.camera.width, self.camera.height))
            if depth and self.depth_of[index] >= 0:
                path = self.depth.path(self.depth_of[index])
                depth_m = read_depth(path, self.camera.depth_scale, self._depth_size())
            if depth and self.confidence_of[index] >= 0:
                path = self.confidence.path(self.confidence_of[index])
                confidence = _read_confidence(path, self._depth_size() if depth_m is None else depth_m.shape[::-1])
        except ImageFileError as error:
            # Named from the camera on, so that the reason does not depend on where the recording lies.
            reason = f"{Path(*path.parts[-3:]).as_posix()} {error}"
            logger.debug("skipped: {}", reason)
            beside = path != self.image.path(index)
            return BadFrame(self.camera.name, stamp_ns, reason, depth_may_be_why=beside)
        return Frame(
            camera=self.camera.name,
            stamp_ns=stamp_ns,
            image=image,
            digest=hashlib.sha256(data).hexdigest(),
            depth_m=depth_m,
            confidence=confidence,
        )

    def _depth_size(self) -> tuple[int, int] | None:
        """A depth image without a matrix of its own has the image's pixels."""
        return (self.camera.width, self.camera.height) if self.camera.depth_K is None else None


def _read_confidence(path: Path, size: tuple[int, ...] | None) -> NDArray[np.uint8]:
    confidence = decode_8bit(read_bytes(path))
    if confidence.ndim != 2 or (size is not None and confidence.shape[::-1] != size):
        raise ImageFileError(f"has shape {confidence.shape}; it must be grey and have the depth's size")
    return confidence


def belonging(images_ns: NDArray[np.int64], others_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each image (n,) the file that belongs to it, -1 for none.

    A file belongs to the image whose stamp is nearest, within half a frame period; of several the nearest is taken.
    Where images are seconds apart (stills) the reach is bounded as for synchronising cameras.
    """
    found = np.full(len(images_ns), -1, dtype=np.int64)
    if not len(images_ns) or not len(others_ns):
        return found
    owner = nearest(images_ns, others_ns)
    distance = np.abs(images_ns[owner] - others_ns)
    within = distance <= default_tolerance_ns([images_ns])
    # The last assignment stays: the nearest file, of equals the earlier.
    order = np.lexsort((-others_ns, -distance))
    order = order[within[order]]
    found[owner[order]] = order
    return found
