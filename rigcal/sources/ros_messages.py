"""Messages of sensor_msgs as their bytes have them, from ROS 1 and ROS 2 serialisations alike.

Owns      the fields of Image, CompressedImage, CameraInfo and of the few messages beside them that are wanted.
Leaves    pixels to ros_images, cameras to ros_cameras.

ROS 1 puts fields one after the other, little-endian (wiki.ros.org/ROS/Technical Overview). ROS 2 writes CDR: four
bytes that tell the byte order, numbers aligned to their size from there, strings that end with a zero (OMG DDS-RTPS
9.2.2). Trailing bytes are allowed: RealSense's bags append the depth unit to images, and CDR pads.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.pose_math import Array
from rigcal.sources.decompression import DamagedError

# A header with a frame_id of a sane length; image_transport's topics have some 30 letters.
HEAD_BYTES = 512


class _Bytes:
    """A message, field by field."""

    def __init__(self, data: bytes, encoding: str) -> None:
        self._data = memoryview(data)
        self._at = self._origin = 0
        self._order = "<"
        self._is_cdr = encoding == "cdr"
        if self._is_cdr:
            # The last bit of the representation tells the order; the others that there is no parameter list.
            if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
                raise DamagedError("is not plain CDR")
            self._order = "<" if data[1] else ">"
            self._at = self._origin = 4

    def number(self, kind: str) -> int:
        """One whole number; kind as struct names it."""
        return self._unpacked(kind, 1)[0]

    def numbers(self, kind: str, count: int) -> list[float]:
        """An array of fixed length."""
        return list(self._unpacked(kind, count))

    def doubles(self) -> list[float]:
        """A sequence of float64."""
        count = self.number("I")
        return self.numbers("d", count) if count else []

    def text(self) -> str:
        """A string."""
        raw = bytes(self._taken(self.number("I")))
        return (raw[:-1] if self._is_cdr and raw[-1:] == b"\0" else raw).decode("utf-8", "replace")

    def raw(self) -> memoryview:
        """A sequence of bytes."""
        return self._taken(self.number("I"))

    def rest(self) -> memoryview:
        """What follows."""
        return self._data[self._at :]

    def stamp_ns(self) -> int:
        """A time, seconds and nanoseconds."""
        seconds = self.number("i" if self._is_cdr else "I")
        return seconds * 10**9 + self.number("I")

    def _unpacked(self, kind: str, count: int) -> tuple[int, ...]:
        size = struct.calcsize(kind)
        if self._is_cdr:
            self._at += -(self._at - self._origin) % size
        return struct.unpack(f"{self._order}{count}{kind}", self._taken(size * count))

    def _taken(self, size: int) -> memoryview:
        end = self._at + size
        if end > len(self._data):
            raise DamagedError(f"ends after {len(self._data)} bytes, within a field")
        piece = self._data[self._at : end]
        self._at = end
        return piece


@dataclass(frozen=True, slots=True, kw_only=True)
class Header:
    """When, and in which frame."""

    stamp_ns: int
    frame_id: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RawImage:
    """sensor_msgs/Image."""

    header: Header
    width: int
    height: int
    encoding: str
    is_bigendian: bool
    step: int  # bytes a row
    data: memoryview
    depth_unit_m: float | None = None  # only RealSense's own recordings have it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PackedImage:
    """sensor_msgs/CompressedImage."""

    header: Header
    format: str
    data: memoryview


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraInfo:
    """sensor_msgs/CameraInfo."""

    header: Header
    width: int
    height: int
    model: str
    D: Array  # (n,)
    K: Array  # (3, 3)
    P: Array  # (3, 4)
    binning: tuple[int, int]
    roi: tuple[int, int]  # left, top

    def same_lens(self, other: CameraInfo) -> bool:
        """Whether two messages state one calibration."""
        return self.model == other.model and all(
            np.array_equal(a, b) for a, b in ((self.D, other.D), (self.K, other.K))
        )


def read_header(data: bytes, encoding: str) -> Header:
    """The std_msgs/Header that a message begins with; the message may be cut behind it. Raises DamagedError."""
    return _header(_Bytes(data, encoding), encoding)


def read_image(data: bytes, encoding: str) -> RawImage:
    """A sensor_msgs/Image; raises DamagedError."""
    fields = _Bytes(data, encoding)
    header = _header(fields, encoding)
    height, width = fields.number("I"), fields.number("I")
    name, is_bigendian, step = fields.text(), bool(fields.number("B")), fields.number("I")
    pixels = fields.raw()
    return RawImage(
        header=header,
        width=width,
        height=height,
        encoding=name,
        is_bigendian=is_bigendian,
        step=step,
        data=pixels,
        depth_unit_m=_realsense_unit(header, bytes(fields.rest()), encoding),
    )


def read_compressed(data: bytes, encoding: str) -> PackedImage:
    """A sensor_msgs/CompressedImage; raises DamagedError."""
    fields = _Bytes(data, encoding)
    header = _header(fields, encoding)
    return PackedImage(header=header, format=fields.text(), data=fields.raw())


def read_camera_info(data: bytes, encoding: str) -> CameraInfo:
    """A sensor_msgs/CameraInfo; raises DamagedError."""
    fields = _Bytes(data, encoding)
    header = _header(fields, encoding)
    height, width, model = fields.number("I"), fields.number("I"), fields.text()
    D, K = fields.doubles(), fields.numbers("d", 9)
    fields.numbers("d", 9)  # R: the image is used as it is
    P = fields.numbers("d", 12)
    binning = (fields.number("I"), fields.number("I"))
    left, top = fields.number("I"), fields.number("I")
    return CameraInfo(
        header=header,
        width=width,
        height=height,
        model=model,
        D=np.array(D, dtype=np.float64),
        K=np.array(K).reshape(3, 3),
        P=np.array(P).reshape(3, 4),
        binning=(max(binning[0], 1), max(binning[1], 1)),
        roi=(left, top),
    )


def read_key_value(data: bytes, encoding: str) -> tuple[str, str]:
    """A diagnostic_msgs/KeyValue; raises DamagedError."""
    fields = _Bytes(data, encoding)
    return fields.text(), fields.text()


def read_transform(data: bytes, encoding: str) -> NDArray[np.float64]:
    """A geometry_msgs/Transform as (7,) translation and quaternion x y z w; raises DamagedError."""
    return np.array(_Bytes(data, encoding).numbers("d", 7))


def read_float32(data: bytes, encoding: str) -> float:
    """A std_msgs/Float32; raises DamagedError."""
    return _Bytes(data, encoding).numbers("f", 1)[0]


def _header(fields: _Bytes, encoding: str) -> Header:
    if encoding == "ros1":
        fields.number("I")  # sequence number, which ROS 2 has no more
    return Header(stamp_ns=fields.stamp_ns(), frame_id=fields.text())


def _realsense_unit(header: Header, rest: bytes, encoding: str) -> float | None:
    """Metres of a depth unit, which librealsense puts behind the image and marks by the frame_id "1"."""
    if encoding != "ros1" or header.frame_id != "1" or len(rest) != 4:
        return None
    unit = struct.unpack("<f", rest)[0]
    return unit if math.isfinite(unit) and unit > 0 else None
