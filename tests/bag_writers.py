"""Bags as other programs write them: serialised and stored by rosbags and mcap, not by what is tested."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

STORES = {1: Stores.ROS1_NOETIC, 2: Stores.ROS2_HUMBLE}
K = np.array([[100.0, 0, 31.5], [0, 101.0, 23.5], [0, 0, 1]])
SIZE = (64, 48)
KINDS = ("bag", "sqlite3", "rosbag2-mcap", "mcap")


class Message(NamedTuple):
    topic: str
    type: str
    log_ns: int
    data: bytes


class Ros:
    """Messages of ROS 1 or ROS 2."""

    def __init__(self, version: int) -> None:
        self.version = version
        self.store: Typestore = get_typestore(STORES[version])

    def message(self, topic: str, kind: str, log_ns: int, **fields: Any) -> Message:
        made = self.store.types[kind](**fields)
        write = self.store.serialize_ros1 if self.version == 1 else self.store.serialize_cdr
        return Message(topic, kind, log_ns, bytes(write(made, kind)))

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        stamp = self.store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        extra = {"seq": 7} if self.version == 1 else {}
        return self.store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id, **extra)

    def image(
        self, topic: str, stamp_ns: int, pixels: Any, encoding: str, frame_id: str = "optical", **more: Any
    ) -> Message:
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
        padded = np.pad(rows, ((0, 0), (0, more.get("padding", 0))), constant_values=99)
        fields = {
            "header": self.header(stamp_ns, frame_id),
            "height": pixels.shape[0],
            "width": more.get("width", pixels.shape[1]),
            "encoding": encoding,
            "is_bigendian": more.get("is_bigendian", 0),
            "step": padded.shape[1],
            "data": padded.ravel(),
        }
        return self.message(topic, "sensor_msgs/msg/Image", more.get("log_ns", stamp_ns + 5_000_000), **fields)

    def compressed(self, topic: str, stamp_ns: int, data: bytes, form: str, frame_id: str = "optical") -> Message:
        fields = {"header": self.header(stamp_ns, frame_id), "format": form, "data": np.frombuffer(data, np.uint8)}
        return self.message(topic, "sensor_msgs/msg/CompressedImage", stamp_ns, **fields)

    def info(
        self,
        topic: str,
        stamp_ns: int = 10**9,
        *,
        size: tuple[int, int] = SIZE,
        k: Any = K,
        d: Sequence[float] = (),
        **more: Any,
    ) -> Message:
        roi = more.get("roi", (0, 0, 0, 0))
        p = more.get("p", np.hstack([k, np.zeros((3, 1))]))
        fields = {
            "header": self.header(stamp_ns, more.get("frame_id", "optical")),
            "height": size[1],
            "width": size[0],
            "distortion_model": more.get("model", "plumb_bob"),
            "d": np.array(d, dtype=np.float64),
            "k": np.array(k, dtype=np.float64).ravel(),
            "r": np.eye(3).ravel(),
            "p": np.array(p, dtype=np.float64).ravel(),
            "binning_x": more.get("binning", 0),
            "binning_y": more.get("binning", 0),
            "roi": self.store.types["sensor_msgs/msg/RegionOfInterest"](*roi, do_rectify=False),
        }
        if self.version == 1:
            fields = {key.upper() if key in ("d", "k", "r", "p") else key: value for key, value in fields.items()}
        return self.message(topic, "sensor_msgs/msg/CameraInfo", more.get("log_ns", stamp_ns), **fields)


def write_bag1(path: Path, messages: Iterable[Message], *, compression: str = "", chunk_bytes: int = 20_000) -> Path:
    """A ROS 1 bag; types that ROS does not have come with an empty definition."""
    store = get_typestore(STORES[1])
    writer = Writer1(path)
    if compression:
        writer.set_compression(Writer1.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk_bytes
    with writer:
        connections: dict[str, Any] = {}
        for message in messages:
            if message.topic not in connections:
                known = message.type in store.types
                connections[message.topic] = (
                    writer.add_connection(message.topic, message.type, typestore=store)
                    if known
                    else writer.add_connection(message.topic, message.type, msgdef="# unknown", md5sum="0" * 32)
                )
            writer.write(connections[message.topic], message.log_ns, message.data)
    return path


def write_bag2(
    path: Path, messages: Iterable[Message], *, mcap: bool = False, compression: str = "", define: bool = True
) -> Path:
    """A rosbag2 folder; ``compression`` is "message" or "file"."""
    store = get_typestore(STORES[2])
    writer = Writer2(path, version=8, storage_plugin=StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3)
    if compression:
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = (
                    writer.add_connection(message.topic, message.type, typestore=store)
                    if define
                    else writer.add_connection(message.topic, message.type, msgdef="", rihs01="")
                )
            writer.write(connections[message.topic], message.log_ns, message.data)
    return path


def write_mcap(
    path: Path, messages: Iterable[Message], *, version: int = 2, compression: str = "ZSTD", **options: Any
) -> Path:
    """A bare MCAP file."""
    store = get_typestore(STORES[version])
    with path.open("wb") as stream:
        writer = McapWriter(
            stream, compression=CompressionType[compression], chunk_size=options.pop("chunk_bytes", 20_000), **options
        )
        writer.start(profile=f"ros{version}", library="a test")
        channels: dict[str, int] = {}
        for message in messages:
            if message.topic not in channels:
                text, _ = store.generate_msgdef(message.type, ros_version=version)
                name = message.type if version == 2 else message.type.replace("/msg/", "/")
                schema = writer.register_schema(name, f"ros{version}msg", text.encode())
                encoding = "cdr" if version == 2 else "ros1"
                channels[message.topic] = writer.register_channel(message.topic, encoding, schema)
            writer.add_message(channels[message.topic], message.log_ns, message.data, message.log_ns)
        writer.finish()
    return path


def write(kind: str, folder: Path, made: Any) -> Path:
    """A bag of one of KINDS with the messages that ``made(ros)`` gives."""
    if kind == "bag":
        return write_bag1(folder / "rig.bag", made(Ros(1)))
    if kind == "mcap":
        return write_mcap(folder / "rig.mcap", made(Ros(2)))
    return write_bag2(folder / "rig", made(Ros(2)), mcap=kind == "rosbag2-mcap")


def pictures(n: int, seed: int = 1, size: tuple[int, int] = SIZE) -> list[np.ndarray[Any, Any]]:
    """(h, w, 3) noise: every pixel and channel differs."""
    rng = np.random.default_rng(seed)
    return [rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8) for _ in range(n)]


def jpeg(image: Any) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


def png(image: Any) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()
