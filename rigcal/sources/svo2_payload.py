"""One message of an SVO2 frame stream: sizes, the coded pair of images, a footer.

Owns      the bytes of a message, and images that are coded as JPEG strips.
Leaves    which frames need which to svo2_frames, H.264 and H.265 to decoding.

    u32 size of what follows, u32 size of the payload, payload, 56 bytes of footer

The payload is one picture of both eyes side by side: Annex-B H.264 or H.265, or, of cameras on computers without a
video encoder, four u64 sizes and four grey JPEG images, which one above the other are the bytes of YUYV pixels.
"""

from __future__ import annotations

import struct
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.svo_sync import MAX_STAMP_NS
from rigcal.sources.image_file import MAX_PIXELS, ImageFileError, decode_8bit

Coding = Literal["h264", "hevc", "jpeg"]
HEAD = struct.Struct("<II")
# Width, height, four constants, stamp [ns], payload bytes, type, last key frame, number, key frame's mark, padding.
# The first constant (0x5c002c00 in the files described) is not asked for: sizes that fit say more than a number of
# which nobody knows the meaning.
FOOTER = struct.Struct("<II4iQIiiIi4x")
KEY_FRAME = 3  # 0: made from those before it; of JPEG frames nobody has told the type
_MAX_FRAME_TYPE = 255

_JPEG = b"\xff\xd8\xff"
_MAX_STRIPS = 16
_START_CODE = b"\x00\x00\x01"
# Parameter sets come in the first bytes of a key frame.
_LOOKED_AT_BYTES = 4096
_H264_SPS, _HEVC_VPS, _HEVC_SPS = 7, 32, 33


class FrameError(Exception):
    """A frame that cannot be used; the message completes the sentence "frame <n> ..."."""


class Footer(NamedTuple):
    """What a frame says of itself."""

    size: tuple[int, int]  # of one eye's image [px]
    stamp_ns: int
    is_key: bool
    last_key: int  # number of the key frame that it belongs to
    number: int


def footer_of(tail: bytes, total: int) -> Footer:
    """The footer of a message.

    Args:
        tail: The message's last FOOTER.size bytes.
        total: How many bytes the whole message has.

    Raises:
        FrameError: The bytes are no footer of such a message.
    """
    if len(tail) != FOOTER.size or total < HEAD.size + FOOTER.size:
        raise FrameError(f"is cut off ({total} bytes)")
    width, height, _, _, _, _, stamp_ns, payload, kind, last_key, number, _ = FOOTER.unpack(tail)
    if payload != total - HEAD.size - FOOTER.size:
        raise FrameError("has a damaged footer (its size does not fit)")
    if not 0 <= kind <= _MAX_FRAME_TYPE or not 0 < stamp_ns <= MAX_STAMP_NS:
        raise FrameError("has a damaged footer (no frame type or time stamp)")
    if not 0 < width * height <= MAX_PIXELS:
        raise FrameError(f"says that it is {width} x {height}, which is not a camera's image")
    return Footer(eye_size(width, height), stamp_ns, kind == KEY_FRAME, last_key, number)


def eye_size(width: int, height: int) -> tuple[int, int]:
    """The size of one eye's image, where the width may be that of one or of both [px].

    One eye's image of any ZED is at most 1.8 times as wide as it is high, both together are 3.2 times or more.
    """
    return (width // 2, height) if width > 2.5 * height else (width, height)


def payload_of(message: bytes) -> bytes:
    """The coded pair of images of a message; raises FrameError where its sizes do not fit."""
    if len(message) < HEAD.size + FOOTER.size:
        raise FrameError(f"is cut off ({len(message)} bytes)")
    total, payload = HEAD.unpack_from(message)
    if total != len(message) - 4 or payload != len(message) - HEAD.size - FOOTER.size:
        raise FrameError("has a damaged header (its sizes do not fit)")
    return message[HEAD.size : HEAD.size + payload]


def coding_of(payload: bytes) -> Coding | None:
    """How a key frame is coded; None: it cannot be seen."""
    if _strips(payload):
        return "jpeg"
    data = payload[:_LOOKED_AT_BYTES]
    at = data.find(_START_CODE)
    while 0 <= at < len(data) - 4:
        first, second = data[at + 3], data[at + 4]
        # H.265 has two bytes of header here; a single layer and the lowest temporal one make the second byte 1.
        if second == 1 and first >> 1 in (_HEVC_VPS, _HEVC_SPS):
            return "hevc"
        if first < 0x80 and first & 0x1F == _H264_SPS:
            return "h264"
        at = data.find(_START_CODE, at + 3)
    return None


def jpeg_pair(payload: bytes) -> NDArray[np.uint8]:
    """Both eyes, (h, 2 w, 3) BGR, of JPEG strips; raises FrameError."""
    strips: list[NDArray[np.uint8]] = []
    try:
        for begin, end in _strips(payload):
            strips.append(decode_8bit(payload[begin:end]))
            if sum(strip.size for strip in strips) > 2 * MAX_PIXELS:
                raise FrameError("has JPEG strips larger than a camera's image")
    except ImageFileError as error:
        raise FrameError(f"has a JPEG strip that {error}") from error
    if not strips or any(strip.ndim != 2 or strip.shape[1] != strips[0].shape[1] for strip in strips):
        raise FrameError("has JPEG strips that do not make an image")
    rows = np.vstack(strips)
    if rows.shape[1] % 4:
        raise FrameError("has JPEG strips that do not make an image")
    return np.asarray(cv2.cvtColor(rows.reshape(rows.shape[0], -1, 2), cv2.COLOR_YUV2BGR_YUYV), dtype=np.uint8)


def _strips(payload: bytes) -> list[tuple[int, int]]:
    """(begin, end) of each JPEG of a payload that is a list of u64 sizes and as many JPEG files; else nothing."""
    count, rest = divmod(payload[: 8 * _MAX_STRIPS + 3].find(_JPEG), 8)
    if count < 1 or rest:
        return []
    ends = 8 * count + np.cumsum(np.frombuffer(payload, dtype="<u8", count=count).astype(np.float64))
    if ends[-1] != len(payload):
        return []
    begins = [8 * count, *ends[:-1].astype(int).tolist()]
    pieces = list(zip(begins, ends.astype(int).tolist()))
    return pieces if all(payload.startswith(_JPEG, begin) for begin, _ in pieces) else []
