"""SVO2 recordings of ZED cameras, read without the ZED SDK.

Owns      the recording: cameras with the intrinsics of their rectified left image, frames decoded from key frames on.
Leaves    the container to mcap_index, its header to svo2_header, which frames there are to svo2_frames, their pictures
          to svo2_pictures, lenses to zed_conf, gravity to svo2_sensors, depth to stereo_depth.

The file holds both eyes as they were recorded and no intrinsics, so each camera's SN<serial>.conf is needed. What is
handed out is the left eye, rectified to a pinhole camera as the SDK does it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.model import BadFrame, Camera, Frame
from aruco.pose_math import Array
from rigcal.sources.ahead import made_ahead
from rigcal.sources.decoding import import_av
from rigcal.sources.mcap_index import DamagedError, McapIndex
from rigcal.sources.mcap_records import MAGIC
from rigcal.sources.options import SourceOptions
from rigcal.sources.svo2_frames import LOST, Row, footers, frame_index
from rigcal.sources.svo2_header import CameraTopics, camera_topics, unreadable_coding
from rigcal.sources.svo2_payload import Coding, Footer, FrameError, coding_of, payload_of
from rigcal.sources.svo2_pictures import Answer, FramePictures
from rigcal.sources.zed_conf import Rectification, factory_calibration, find_conf

if TYPE_CHECKING:
    from rigcal.sources.stereo_depth import StereoMatcher

SUFFIX = ".svo2"
# The container's header names who wrote it; the first chunk, which is not compressed, the topics.
_SIGNS = (b"libmcap stereolabs", b"svo_header", b"/side_by_side")

# Frames that are asked how they are coded, spread over the recording: where one is damaged its neighbours may be.
_LOOKED_AT = 5


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file is an SVO2 recording, from its first bytes; of a damaged or encrypted one the suffix tells."""
    if head.startswith(MAGIC):
        return any(sign in head for sign in _SIGNS) or path.suffix.lower() == SUFFIX
    return path.suffix.lower() == SUFFIX and any(head)


def opened(path: Path, options: SourceOptions) -> Svo2:
    """Open an SVO2 recording.

    Args:
        path: The file.
        options: ``zed_conf`` and ``stereo_depth`` matter here.

    Raises:
        InputError: Not an SVO2 file, damaged beyond use, encrypted, of an unknown version, or a camera's factory
            calibration is not to be had.
        MissingExtraError: The packages mcap or av are not installed.
    """
    return Svo2(path, options)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Source:
    """One camera of the file."""

    topics: CameraTopics
    camera: Camera
    pictures: FramePictures
    rectification: Rectification


class Svo2:
    """One SVO2 file with its cameras; implements aruco.model.Recording and KnowsUp."""

    def __init__(self, path: Path, options: SourceOptions) -> None:
        """Find the cameras, their frames and intrinsics; no picture is decoded.

        Raises:
            InputError: See ``opened``.
            MissingExtraError: A package is not installed.
        """
        self._path, self._stereo_depth = path, options.stereo_depth
        self._up: dict[str, Array | None] = {}
        self._mcap = _container(path)
        topics = camera_topics(self._mcap)
        rows = footers(self._mcap, [camera.frames for camera in topics])
        opened = [self._source(camera, rows[camera.frames], options) for camera in topics]
        self._sources = {source.camera.name: source for source in opened if source is not None}
        if not self._sources:
            raise InputError(f"{path}: holds not a single whole frame; record it again.")
        if self._mcap.loss is not None:
            logger.warning("{} {}", path, self._mcap.loss)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, named by serial number and sorted; of the rectified left image."""
        return tuple(self._sources[name].camera for name in sorted(self._sources))

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The sorted time stamps of a camera's frames, from their footers."""
        return self._of(camera).pictures.index.stamps_ns

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """Ascending indices of the frames that depth can be matched for; none unless it was asked for."""
        usable = self._of(camera).pictures.index.begins >= 0
        return np.flatnonzero(usable if self._stereo_depth else np.zeros_like(usable))

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """A camera's frames at ascending indices, decoded from the key frame before each group of them on."""
        return self._frames(self._of(camera), indices, depth and self._stereo_depth)

    def up_in_camera(self, camera: str) -> Array | None:
        """(3,) unit vector against gravity in the camera's axes, from its accelerometer; see svo2_sensors.

        The first call reads the sensor messages of the camera, the others remember.
        """
        sensors = self._of(camera).topics.sensors
        if sensors is not None and camera not in self._up:
            from rigcal.sources.svo2_sensors import up_in_camera

            self._up[camera] = up_in_camera(self._mcap, sensors, camera)
        return self._up.get(camera)

    def _of(self, camera: str) -> _Source:
        if camera not in self._sources:
            raise InputError(f"no camera {camera} in the recording; it has {', '.join(sorted(self._sources))}.")
        return self._sources[camera]

    def _source(self, topics: CameraTopics, rows: Sequence[Row], options: SourceOptions) -> _Source | None:
        if not any(isinstance(row, Footer) for row in rows):
            if any(row != LOST for row in rows):
                raise unreadable_coding(self._path, topics.serial)
            logger.warning("{}: camera {} is left out, it has not a single whole frame", self._path, topics.serial)
            return None
        coding = self._coding(topics, rows)
        log_times_ns = self._mcap.log_times_ns(topics.frames)
        index = frame_index(self._path, rows, log_times_ns, alone=coding == "jpeg")
        conf = find_conf(topics.serial, options.zed_conf, self._path.resolve().parent)
        width, height = index.size
        rectification = factory_calibration(conf, width, height).rectification()
        logger.debug("camera {}: {} {}, rectified by {}", topics.serial, coding, index.size, conf)
        camera = Camera(
            name=topics.serial,
            width=width,
            height=height,
            K=rectification.K,
            baseline_m=rectification.baseline_m,
        )
        pictures = FramePictures(mcap=self._mcap, channel=topics.frames, coding=coding, index=index)
        return _Source(topics=topics, camera=camera, pictures=pictures, rectification=rectification)

    def _coding(self, topics: CameraTopics, rows: Sequence[Row]) -> Coding:
        """How the camera's pictures are coded, from the first of some key frames that tells it."""
        sound = [message for message, row in enumerate(rows) if isinstance(row, Footer)]
        keys = [message for message in sound if cast(Footer, rows[message]).is_key]
        asked = keys or sound
        lost = False
        for at in np.unique(np.linspace(0, len(asked) - 1, _LOOKED_AT).astype(int)).tolist():
            try:
                coding = coding_of(payload_of(self._mcap.message(topics.frames, asked[at])))
            except (DamagedError, FrameError):
                lost = True
                continue
            if coding is not None:
                if coding != "jpeg":
                    import_av()  # here, so that somebody who lacks it hears it at once
                return coding
        if lost:
            raise InputError(f"{self._path}: the key frames of camera {topics.serial} are damaged; copy it again.")
        raise unreadable_coding(self._path, topics.serial)

    def _frames(self, source: _Source, indices: Sequence[int], with_depth: bool) -> Iterator[Frame | BadFrame]:
        # One for each reader: a matcher works in memory of its own, which two must not share.
        matcher = _matcher(source) if with_depth else None
        answers = source.pictures.read(indices, both=with_depth)
        # Rectifying takes a third of the time that decoding the next picture does.
        return made_ahead(lambda answer: self._frame(source, answer, matcher), answers)

    def _frame(self, source: _Source, answer: Answer, matcher: StereoMatcher | None) -> Frame | BadFrame:
        index, pair, message = answer
        if isinstance(pair, str):
            return self._bad(source, index, pair)
        width = source.camera.width
        left = source.rectification.left(pair[:, :width])
        depth_m = None if matcher is None else matcher.depth_m(left, source.rectification.right(pair[:, width:]))
        return Frame(
            camera=source.camera.name,
            stamp_ns=int(source.pictures.index.stamps_ns[index]),
            image=left,
            digest=hashlib.sha256(message).hexdigest(),
            depth_m=depth_m,
        )

    def _bad(self, source: _Source, index: int, what: str) -> BadFrame:
        name, message = source.camera.name, int(source.pictures.index.messages[index])
        # Named from the camera on, so that the reason does not depend on where the recording lies.
        reason = f"{name}: frame {message} {what}"
        logger.debug("skipped: {}", reason)
        return BadFrame(name, int(source.pictures.index.stamps_ns[index]), reason)


def _matcher(source: _Source) -> StereoMatcher:
    from rigcal.sources.stereo_depth import StereoMatcher

    return StereoMatcher(
        K=source.rectification.K,
        baseline_m=source.rectification.baseline_m,
        size=(source.camera.width, source.camera.height),
    )


def _container(path: Path) -> McapIndex:
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InputError(
                f"{path}: is named {SUFFIX} and does not begin like one: it is damaged, of an older version, or "
                "encrypted (the ZED SDK can do that from version 5.3 on); copy it again or use the ZED SDK."
            )
    return McapIndex(path, extra="all")
