"""A recording of ROS messages, whatever container they lie in: its frames, one at a time.

Owns      which depth belongs to which image, reading a frame.
Leaves    finding cameras and stamps to ros_opening, containers to message_store, pixels to ros_images.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.lens import bend
from aruco.model import BadFrame, Camera, Frame
from rigcal.sources.decompression import DamagedError
from rigcal.sources.message_store import MessageStore
from rigcal.sources.rgbd_folder import belonging
from rigcal.sources.ros_images import confidence_percent, depth_metres, image_pixels
from rigcal.sources.ros_messages import PackedImage, RawImage, read_compressed, read_image
from rigcal.sources.topic_names import IMAGE


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stamped:
    """The messages of a topic in the order of their stamps."""

    topic: str
    stamps_ns: NDArray[np.int64]  # (n,), strictly ascending
    numbers: NDArray[np.int64]  # (n,) of the messages in the store

    def number_of(self, images: Stamped) -> NDArray[np.int64]:
        """For each image (n,) the number of the message that belongs to it, -1 for none."""
        of = belonging(images.stamps_ns, self.stamps_ns)
        return np.where(of >= 0, self.numbers[of] if len(self.numbers) else -1, -1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraSource:
    """One camera and where its frames are."""

    camera: Camera
    image: Stamped
    depth: Stamped | None = None
    depth_lens: Camera | None = None  # intrinsics of the depth images as they are recorded
    confidence: Stamped | None = None


class RosRecording:
    """Images, depth and intrinsics of ROS messages; implements aruco.model.Recording."""

    def __init__(self, store: MessageStore, sources: Sequence[CameraSource]) -> None:
        self._store = store
        self._sources = {source.camera.name: source for source in sources}
        self._depth = {name: _numbers(source.depth, source.image) for name, source in self._sources.items()}
        self._confidence = {name: _numbers(source.confidence, source.image) for name, source in self._sources.items()}

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, sorted by name."""
        return tuple(self._sources[name].camera for name in sorted(self._sources))

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The sorted time stamps of a camera's images, from their headers."""
        return self._of(camera).image.stamps_ns

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """Ascending indices of the images that a depth image belongs to."""
        self._of(camera)
        return np.flatnonzero(self._depth[camera] >= 0)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """A camera's frames at ascending indices into its stamps, read one at a time."""
        source = self._of(camera)
        return (self._frame(source, int(index), depth) for index in indices)

    def _of(self, camera: str) -> CameraSource:
        if camera not in self._sources:
            raise InputError(f"no camera {camera} in the recording; it has {', '.join(sorted(self._sources))}.")
        return self._sources[camera]

    def _frame(self, source: CameraSource, index: int, with_depth: bool) -> Frame | BadFrame:
        camera, stamp_ns, topic = source.camera, int(source.image.stamps_ns[index]), source.image.topic
        depth_m = confidence = None
        try:
            data = self._store.message(topic, int(source.image.numbers[index]))
            image = image_pixels(parsed_image(data, self._store, topic))
            _check_size(image, (camera.width, camera.height), "the intrinsics are of")
            number = self._depth[camera.name][index]
            if with_depth and source.depth is not None and number >= 0:
                topic = source.depth.topic
                depth_m = self._depth_of(source, topic, int(number))
            number = self._confidence[camera.name][index]
            if depth_m is not None and source.confidence is not None and number >= 0:
                topic = source.confidence.topic
                confidence = confidence_percent(self._image(topic, int(number)))
                _check_size(confidence, depth_m.shape[::-1], "depth is")
        except DamagedError as error:
            reason = f"a message of {topic} {error}"
            logger.debug("skipped: {}", reason)
            return BadFrame(camera.name, stamp_ns, reason, depth_may_be_why=topic != source.image.topic)
        return Frame(
            camera=camera.name,
            stamp_ns=stamp_ns,
            image=image,
            digest=hashlib.sha256(data).hexdigest(),
            depth_m=depth_m,
            confidence=confidence,
        )

    def _image(self, topic: str, number: int) -> RawImage | PackedImage:
        return parsed_image(self._store.message(topic, number), self._store, topic)

    def _depth_of(self, source: CameraSource, topic: str, number: int) -> NDArray[np.float32]:
        depth_m = depth_metres(self._image(topic, number), source.camera.depth_scale)
        lens = source.depth_lens or source.camera
        _check_size(depth_m, (lens.width, lens.height), "the intrinsics are of")
        return _straightened(depth_m, lens) if lens.has_distortion else depth_m


def parsed_image(data: bytes, store: MessageStore, topic: str) -> RawImage | PackedImage:
    """A message of an image topic; raises DamagedError."""
    about = store.topics[topic]
    return read_image(data, about.encoding) if about.type == IMAGE else read_compressed(data, about.encoding)


def _numbers(stamped: Stamped | None, images: Stamped) -> NDArray[np.int64]:
    return np.full(len(images.stamps_ns), -1, dtype=np.int64) if stamped is None else stamped.number_of(images)


def _check_size(image: NDArray[np.generic], size: tuple[int, ...], what: str) -> None:
    if image.shape[1::-1] != size:
        raise DamagedError(f"is {image.shape[1]} x {image.shape[0]}, but {what} {size[0]} x {size[1]}")


def _straightened(depth_m: NDArray[np.float32], lens: Camera) -> NDArray[np.float32]:
    """Depth of a distorted image as a pinhole with the same K has it; no value is mixed from two."""
    height, width = depth_m.shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    recorded = np.nan_to_num(bend(lens, np.stack([columns.ravel(), rows.ravel()], axis=1)), nan=-1.0)
    x, y = recorded.astype(np.float32).T.reshape(2, height, width)
    return cv2.remap(depth_m, x, y, cv2.INTER_NEAREST, borderValue=(float("nan"),) * 4).astype(np.float32, copy=False)
