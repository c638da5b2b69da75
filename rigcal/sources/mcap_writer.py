"""Writing frames as ROS 2 messages into an MCAP file, so that ROS 2, Foxglove and rigcal read them.

Owns      namespaces, messages, and which frames of a file that was begun before are there.
Leaves    names of topics to rigcal_topics, the records of the file to mcap_growing, the bytes of images to image_file.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.errors import MissingExtraError, OutputError
from aruco.model import Camera, Frame
from aruco.pose_math import Array
from rigcal.sources.image_file import depth_steps, encode_png
from rigcal.sources.mcap_growing import ChunkMessage, GrowingMcap, PackedChunk, packed_chunk
from rigcal.sources.rgbd_writer import fits_steps
from rigcal.sources.rigcal_topics import (
    BASELINE_KEY,
    CONFIDENCE,
    DEPTH,
    DEPTH_INFO,
    IMAGE,
    INFO,
    NAME_KEY,
    TOPICS,
    TYPES,
)

_MM = 0.001
# ROS's time has 32 bits of seconds, MCAP's has no sign.
_MAX_STAMP_NS = 10**9 * 2**31


class McapFrames:
    """Frames in an MCAP file that grows."""

    def __init__(self, path: Path, cameras: Sequence[Camera], with_depth: Collection[str] = ()) -> None:
        """Begin the file, or go on with it.

        Args:
            path: The file.
            cameras: All that it will have.
            with_depth: Names of those that have depth; confidence without it is not written.

        Raises:
            OutputError: What is there is something else.
            MissingExtraError: A package is not installed.
        """
        self._messages = _Messages()
        self._cameras = {camera.name: camera for camera in cameras}
        self._with_depth = frozenset(with_depth)
        names = namespaces(self._cameras)
        types = sorted(set(TYPES))
        self._first = {name: 1 + len(TOPICS) * k for k, name in enumerate(names)}  # channel of a camera's images
        channels = [
            self._messages.channel(self._first[name] + k, f"/{names[name]}/{topic}", types.index(kind) + 1, about)
            for name, about in ((name, _about(self._cameras[name])) for name in names)
            for k, (topic, kind) in enumerate(zip(TOPICS, TYPES))
            if k in (IMAGE, INFO) or name in self._with_depth
        ]
        schemas = [self._messages.schema(k + 1, kind) for k, kind in enumerate(types)]
        self._file = GrowingMcap(path, schemas, channels, frozenset(self._first.values()))

    def finished(self, camera: str) -> NDArray[np.int64]:
        """The stamps of a camera's frames that are there."""
        return np.array(self._file.log_times_ns[self._first[camera]], dtype=np.int64)

    def packed(self, frame: Frame) -> PackedChunk:
        """A frame as it will be stored; may be called from several threads.

        Raises:
            OutputError: Its stamp is beyond what such files can hold.
        """
        if not 0 <= frame.stamp_ns < _MAX_STAMP_NS:
            raise OutputError(
                f"camera {frame.camera}: the time stamp {frame.stamp_ns} ns is beyond ROS's time; convert to an RGB-D "
                "folder instead."
            )
        camera, first = self._cameras[frame.camera], self._first[frame.camera]
        head = self._messages.header(frame.stamp_ns, frame.camera)
        parts: list[tuple[int, memoryview]] = []
        has_depth = frame.camera in self._with_depth
        if has_depth and frame.depth_m is not None:
            size = (frame.depth_m.shape[1], frame.depth_m.shape[0])
            parts.append((DEPTH, self._messages.depth(head, frame.depth_m)))
            parts.append((DEPTH_INFO, self._messages.info(head, size, camera.K_depth, "plumb_bob", np.zeros(5))))
        if has_depth and frame.confidence is not None:
            parts.append((CONFIDENCE, self._messages.raw(head, frame.confidence, "mono8")))
        size = (camera.width, camera.height)
        parts.append((INFO, self._messages.info(head, size, camera.K, camera.distortion_model, camera.distortion)))
        # The image last: with it the frame is whole.
        parts.append((IMAGE, self._messages.image(head, frame.image)))
        messages = [ChunkMessage(first + kind, frame.stamp_ns, bytes(data)) for kind, data in parts]
        return packed_chunk(messages, compressed=len(parts) > 2)  # a PNG does not become smaller

    def store(self, packed: PackedChunk) -> None:
        """Add a frame."""
        self._file.add(packed)

    def finish(self) -> None:
        """End the file, which is a whole recording then."""
        self._file.finish()

    def close(self) -> None:
        """Leave the file as it is, to be gone on with."""
        self._file.close()


def namespaces(cameras: Iterable[str]) -> Mapping[str, str]:
    """For each camera's name a part of a ROS 2 topic, each another."""
    found: dict[str, str] = {}
    for name in sorted(cameras):
        base = re.sub("[^A-Za-z0-9]+", "_", name).strip("_") or "camera"
        base = base if base[0].isalpha() else f"camera_{base}"
        choice, k = base, 2
        while choice in found.values():
            choice, k = f"{base}_{k}", k + 1
        found[name] = choice
    return found


def _about(camera: Camera) -> dict[str, str]:
    baseline = {} if camera.baseline_m is None else {BASELINE_KEY: repr(float(camera.baseline_m))}
    return {NAME_KEY: camera.name, **baseline}


class _Messages:
    """ROS 2 messages as bytes."""

    def __init__(self) -> None:
        try:
            from rosbags.typesys import Stores, get_typestore
        except ModuleNotFoundError as error:
            if error.name is None or error.name.partition(".")[0] != "rosbags":
                raise
            raise MissingExtraError("rosbags", "bags") from error
        self._store = get_typestore(Stores.ROS2_HUMBLE)

    def schema(self, number: int, kind: str) -> Any:
        from mcap.records import Schema

        name = f"sensor_msgs/msg/{kind}"
        text, _ = self._store.generate_msgdef(name, ros_version=2)
        return Schema(id=number, name=name, encoding="ros2msg", data=text.encode())

    def channel(self, number: int, topic: str, schema: int, about: Mapping[str, str]) -> Any:
        from mcap.records import Channel

        return Channel(id=number, topic=topic, message_encoding="cdr", schema_id=schema, metadata=dict(about))

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        stamp = self._store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return self._store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)

    def image(self, head: Any, image: NDArray[np.uint8]) -> memoryview:
        data = np.frombuffer(encode_png(image), dtype=np.uint8)
        # As ROS's compressed_image_transport writes it.
        encoding = "mono8" if image.ndim == 2 else "bgr8"
        return self._cdr("CompressedImage", header=head, format=f"{encoding}; png compressed {encoding}", data=data)

    def depth(self, head: Any, depth_m: NDArray[np.float32]) -> memoryview:
        if fits_steps(depth_m, _MM):
            return self.raw(head, depth_steps(depth_m, _MM), "16UC1")
        return self.raw(head, depth_m.astype(np.float32), "32FC1")

    def raw(self, head: Any, pixels: NDArray[Any], encoding: str) -> memoryview:
        height, width = pixels.shape
        return self._cdr(
            "Image",
            header=head,
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=width * pixels.itemsize,
            data=np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<")).view(np.uint8).ravel(),
        )

    def info(self, head: Any, size: tuple[int, int], K: Array, model: str, distortion: Array) -> memoryview:
        roi = self._store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, do_rectify=False)
        return self._cdr(
            "CameraInfo",
            header=head,
            height=size[1],
            width=size[0],
            distortion_model=model,
            d=np.array(distortion, dtype=np.float64),
            k=np.array(K, dtype=np.float64).ravel(),
            r=np.eye(3).ravel(),
            p=np.hstack([K, np.zeros((3, 1))]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def _cdr(self, kind: str, **fields: Any) -> memoryview:
        name = f"sensor_msgs/msg/{kind}"
        return self._store.serialize_cdr(self._store.types[name](**fields), name)
