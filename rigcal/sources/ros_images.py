"""Pixels of ROS images: encodings and compressions to what a Frame holds.

Owns      the encodings of sensor_msgs/image_encodings.h that cameras use, and image_transport's compressions.
Leaves    messages to ros_messages, PNG and JPEG to image_file.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rigcal.sources.decompression import DamagedError
from rigcal.sources.image_file import MAX_PIXELS, ImageFileError, decode, decode_8bit
from rigcal.sources.ros_messages import PackedImage, RawImage

Image = NDArray[np.uint8]

# Encoding -> bytes a pixel, and how to make grey or BGR of (h, w, bytes) pixels.
_GREY = (1, lambda pixels: pixels[..., 0])
_BGR = (3, lambda pixels: pixels)
_RGB = (3, lambda pixels: pixels[..., ::-1])
_BGRA = (4, lambda pixels: pixels[..., :3])
_RGBA = (4, lambda pixels: pixels[..., 2::-1])
_UYVY = (2, lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_YUV2BGR_UYVY))
_YUYV = (2, lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_YUV2BGR_YUY2))


def _bayer(code: int) -> tuple[int, Callable[[Image], Image]]:
    return 1, lambda pixels: cv2.cvtColor(pixels[..., 0], code)  # type: ignore[return-value]


_ENCODINGS: dict[str, tuple[int, Callable[[Image], Any]]] = {
    "mono8": _GREY,
    "8uc1": _GREY,
    "y8": _GREY,
    "bgr8": _BGR,
    "8uc3": _BGR,
    "rgb8": _RGB,
    "bgra8": _BGRA,
    "8uc4": _BGRA,
    "rgba8": _RGBA,
    "yuv422": _UYVY,
    "uyvy": _UYVY,
    "yuv422_yuy2": _YUYV,
    "yuyv": _YUYV,
    "yuy2": _YUYV,
    # ROS names a mosaic by its first two rows; OpenCV's short names begin a pixel later.
    "bayer_rggb8": _bayer(cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": _bayer(cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": _bayer(cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": _bayer(cv2.COLOR_BayerGRBG2BGR),
}
_DEPTH_ENCODINGS = {"16uc1": np.dtype("u2"), "mono16": np.dtype("u2"), "z16": np.dtype("u2"), "32fc1": np.dtype("f4")}
# What compressed_depth_image_transport puts before the picture: its kind, and two numbers of the quantisation.
_DEPTH_HEADER = struct.Struct("<iff")


def is_depth(encoding: str) -> bool:
    """Whether an Image's encoding, or a CompressedImage's format, is one of depth."""
    name = encoding.split(";")[0].strip().lower()
    return name in ("16uc1", "32fc1", "z16") or "compressedDepth" in encoding


def image_pixels(message: RawImage | PackedImage) -> Image:
    """(h, w) grey or (h, w, 3) BGR of an image; raises DamagedError, which names what is not known."""
    if isinstance(message, PackedImage):
        return _unpacked_image(message)
    known = _ENCODINGS.get(message.encoding.lower())
    if known is None:
        raise DamagedError(
            f"has the encoding {message.encoding[:40]!r}, which is not read; record one of {', '.join(_ENCODINGS)}"
        )
    depth, convert = known
    pixels = _rows(message, depth).reshape(message.height, message.width, depth)
    if depth == 2 and message.width % 2:
        raise DamagedError(f"has {message.width} columns, but {message.encoding} has pairs")
    return np.ascontiguousarray(convert(pixels))


def depth_metres(message: RawImage | PackedImage, depth_scale: float) -> NDArray[np.float32]:
    """(h, w) metres of a depth image, NaN where there is no measurement.

    Args:
        message: The image.
        depth_scale: Metres per unit of 16-bit images.

    Raises:
        DamagedError: It is no depth image, or damaged.
    """
    if isinstance(message, PackedImage):
        return _unpacked_depth(message, depth_scale)
    kind = _DEPTH_ENCODINGS.get(message.encoding.lower())
    if kind is None:
        raise DamagedError(f"has the encoding {message.encoding[:40]!r}, which is not depth (16UC1, mono16, 32FC1)")
    values = _rows(message, kind.itemsize).view(kind.newbyteorder(">" if message.is_bigendian else "<"))
    return _metres(values, depth_scale)


def confidence_percent(message: RawImage | PackedImage) -> Image:
    """(h, w) 0..100, lower is more trustworthy; the ZED's driver gives whole numbers as 32FC1. Raises DamagedError."""
    if isinstance(message, RawImage) and message.encoding.lower() == "32fc1":
        values = _rows(message, 4).view(np.dtype("f4").newbyteorder(">" if message.is_bigendian else "<"))
        return np.clip(np.nan_to_num(values.astype(np.float32), nan=100, posinf=100, neginf=100), 0, 100).astype(
            np.uint8
        )
    confidence = image_pixels(message)
    if confidence.ndim != 2:
        raise DamagedError("is not grey")
    return confidence


def _metres(values: NDArray[Any], depth_scale: float) -> NDArray[np.float32]:
    """0, negative and infinite values are no measurements (REP 118)."""
    metres = values.astype(np.float32) if values.dtype.kind == "f" else (values * depth_scale).astype(np.float32)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan))


def _rows(message: RawImage, pixel_bytes: int) -> Image:
    """(h, w * pixel_bytes) bytes without the padding of rows."""
    width, height = message.width, message.height
    if not 0 < width * height <= MAX_PIXELS:
        raise DamagedError(f"says that it is {width} x {height}, which is not a camera's image")
    row = width * pixel_bytes
    step = message.step or row
    # The padding of the last row may be missing.
    if step < row or len(message.data) < step * (height - 1) + row:
        raise DamagedError(
            f"has {len(message.data)} bytes in rows of {step}, too few for {width} x {height} of "
            f"{message.encoding[:40]}"
        )
    data = np.frombuffer(message.data, dtype=np.uint8)
    rows = np.lib.stride_tricks.as_strided(data, shape=(height, row), strides=(step, 1), writeable=False)
    return np.ascontiguousarray(rows)


def _unpacked_image(message: PackedImage) -> Image:
    try:
        image = decode_8bit(bytes(message.data))
    except ImageFileError as error:
        raise DamagedError(f"({message.format[:40]}) {error}") from error
    # A publisher that compresses RGB as if it were BGR says so.
    return np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 and "compressed rgb" in message.format else image


def _unpacked_depth(message: PackedImage, depth_scale: float) -> NDArray[np.float32]:
    packed = "compressedDepth" in message.format
    if packed and "rvl" in message.format.lower():
        raise DamagedError("is depth compressed as RVL, which is not read; record compressedDepth as PNG, or raw depth")
    if packed and len(message.data) < _DEPTH_HEADER.size:
        raise DamagedError(f"ends after {len(message.data)} bytes")
    try:
        values = decode(bytes(message.data[_DEPTH_HEADER.size if packed else 0 :]))
    except ImageFileError as error:
        raise DamagedError(f"({message.format[:40]}) {error}") from error
    if values.ndim != 2 or values.dtype != np.uint16:
        raise DamagedError(f"({message.format[:40]}) is not 16-bit grey")
    if not message.format.strip().lower().startswith("32fc1"):
        return _metres(values, depth_scale)
    if not packed:
        raise DamagedError(f"({message.format[:40]}) does not say how metres became 16 bits; record compressedDepth")
    # 32-bit depth is stored as quantised inverse depth: value = a / metres + b, 0 for none.
    _, a, b = _DEPTH_HEADER.unpack_from(message.data)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _metres(np.where(values > 0, np.float32(a) / (values.astype(np.float32) - np.float32(b)), 0), 1.0)
