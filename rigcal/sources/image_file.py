"""One image file: bytes in, a checked array or a clear complaint out.

Owns      what makes a PNG, JPEG or .npy file whole, and how large it may be.
Leaves    which file belongs to which frame to rgbd_folder.

What a decoder forgives depends on its version, it complains to the terminal, and it takes the memory that a header
asks for. So the container is checked before: its size, its end and, for PNG, its checksums (PNG specification, third
edition, chapter 5; ITU T.81, annex B).
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from tokenize import TokenError
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

# A raw 16-bit image of MAX_PIXELS.
MAX_FILE_BYTES = 256 * 2**20
MAX_PIXELS = 2**27

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_SIGNATURE = b"\xff\xd8\xff"
# Start-of-frame markers; C4, C8 and CC in the same range are tables.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_BARE = frozenset([0x01, *range(0xD0, 0xD8)])  # markers without a length


class ImageFileError(Exception):
    """An image file that cannot be used; the message completes the sentence "<file> ..."."""


def read_bytes(path: Path) -> bytes:
    """The bytes of a file of sane size; raises ImageFileError."""
    if path.exists() and not path.is_file():  # opening a pipe would wait for ever
        raise ImageFileError("is not a file")
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise ImageFileError(f"has {size >> 20} MiB, more than an image")
        data = path.read_bytes()
    except OSError as error:
        raise ImageFileError(f"cannot be read ({error.strerror or error})") from error
    if not data:
        raise ImageFileError("is empty (0 bytes)")
    return data


def decode(data: bytes, size: tuple[int, int] | None = None) -> NDArray[Any]:
    """The pixels of a PNG or JPEG file as they are stored: grey stays grey, 16 bits stay 16 bits.

    Args:
        data: The file's bytes.
        size: (width, height) that camera_info.yaml promises; None: any.

    Returns:
        (h, w), or (h, w, 3) BGR.

    Raises:
        ImageFileError: The file is no image, is cut off or damaged, or has another size.
    """
    width, height = _stated_size(data)
    if size is not None and (width, height) != size:
        raise ImageFileError(f"is {width} x {height}, but camera_info.yaml says {size[0]} x {size[1]}")
    if not 0 < width * height <= MAX_PIXELS:
        raise ImageFileError(f"says that it is {width} x {height}, which is not a camera's image")
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ImageFileError("cannot be decoded") from error
    if image is None or image.shape[:2] != (height, width):
        raise ImageFileError("cannot be decoded")
    # An alpha channel says nothing about what the camera saw.
    return np.ascontiguousarray(image[..., :3]) if image.ndim == 3 else image


def decode_8bit(data: bytes, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Like decode, and eight bits deep."""
    image = decode(data, size)
    if image.dtype != np.uint8:
        raise ImageFileError(f"has {8 * image.dtype.itemsize} bits a channel and must have 8")
    return image


def read_depth(path: Path, depth_scale: float, size: tuple[int, int] | None) -> NDArray[np.float32]:
    """A depth image in metres.

    Args:
        path: 16-bit grey PNG, or .npy of float32 metres.
        depth_scale: Metres per unit of a PNG.
        size: (width, height) that it must have; None: any.

    Returns:
        (h, w) metres along the optical axis, NaN where there is no measurement.

    Raises:
        ImageFileError: The file cannot be used.
    """
    if path.suffix.lower() == ".npy":
        metres = _read_npy(path, size)
        return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(np.nan))
    raw = decode(read_bytes(path), size)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise ImageFileError(f"must be 16-bit grey, but is {8 * raw.dtype.itemsize}-bit with shape {raw.shape}")
    return np.where(raw > 0, raw * depth_scale, np.nan).astype(np.float32)


def encode_png(image: NDArray[Any]) -> bytes:
    """The bytes of a PNG file, without loss."""
    # Level 1 is several times faster than the default and a few per cent larger.
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise ValueError(f"no PNG of an image of shape {image.shape} and type {image.dtype}")
    return data.tobytes()


def encode_depth(depth_m: NDArray[np.float32], depth_scale: float) -> bytes:
    """The bytes of a 16-bit depth PNG of (h, w) metres; see depth_steps."""
    return encode_png(depth_steps(depth_m, depth_scale))


def depth_steps(depth_m: NDArray[np.float32], step_m: float) -> NDArray[np.uint16]:
    """(h, w) metres as whole multiples of a step; NaN and what 16 bits cannot hold become 0."""
    steps = np.rint(np.nan_to_num(depth_m.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0) / step_m)
    return np.where((steps > 0) & (steps <= 65535), steps, 0).astype(np.uint16)


def _read_npy(path: Path, size: tuple[int, int] | None) -> NDArray[np.float32]:
    try:
        # Mapped, so that a header that promises more than the file has is refused before memory is taken.
        mapped = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise ImageFileError(f"cannot be read ({error.strerror or error})") from error
    except (ValueError, SyntaxError, TokenError, EOFError, OverflowError, TypeError) as error:
        raise ImageFileError("is not a whole .npy file") from error
    if not isinstance(mapped, np.ndarray) or mapped.ndim != 2 or mapped.dtype != np.float32:
        raise ImageFileError("must be one float32 array of two dimensions")
    height, width = mapped.shape
    if size is not None and (width, height) != size:
        raise ImageFileError(f"is {width} x {height}, but must be {size[0]} x {size[1]}")
    if not 0 < width * height <= MAX_PIXELS:
        raise ImageFileError(f"is {width} x {height}, which is not a camera's image")
    return np.array(mapped, dtype=np.float32, order="C")


def _stated_size(data: bytes) -> tuple[int, int]:
    """(width, height) of a whole PNG or JPEG file."""
    if data.startswith(_PNG_SIGNATURE):
        return _png_size(data)
    if data.startswith(_JPEG_SIGNATURE):
        return _jpeg_size(data)
    raise ImageFileError("is neither PNG nor JPEG")


def _png_size(data: bytes) -> tuple[int, int]:
    at, size = len(_PNG_SIGNATURE), None
    view = memoryview(data)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            break
        if zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(view[end - 4 : end], "big"):
            raise ImageFileError("is damaged (a checksum does not fit)")
        if size is None:
            if kind != b"IHDR" or length != 13:
                raise ImageFileError("is damaged (no PNG header)")
            size = struct.unpack_from(">II", data, at + 8)
        if kind == b"IEND":
            return size
        at = end
    raise ImageFileError("is cut off (the end of the PNG is missing)")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    at, size = 2, None
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            raise ImageFileError("is damaged (no JPEG marker where one must be)")
        marker = data[at + 1]
        if marker == 0xFF or marker in _JPEG_BARE:
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _JPEG_FRAMES and at + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, at + 5)
            size = (width, height)
        # After the start of scan FF D9 occurs only as the end of the image; it is looked for where it should be.
        if marker == 0xDA and size is not None and data.rfind(b"\xff\xd9", at) >= 0:
            return size
        if marker in (0xDA, 0xD9):
            break
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    raise ImageFileError("is cut off (the end of the JPEG is missing)")
