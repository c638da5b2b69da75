"""Small video files for tests, written with PyAV."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rigcal.sources.decoding import import_av

H264, H265, MJPEG = "libx264", "libx265", "mjpeg"


def moving_images(n: int, size: tuple[int, int] = (160, 120), seed: int = 0) -> list[NDArray[np.uint8]]:
    """Images (h, w, 3) of a coarse pattern that moves, each with its number in bright and dark squares at the top."""
    width, height = size
    rng = np.random.default_rng(seed)
    ground = rng.integers(40, 216, ((height + n) // 16 + 2, (width + 2 * n) // 16 + 2, 3), dtype=np.uint8)
    ground = ground.repeat(16, axis=0).repeat(16, axis=1)
    images = []
    for i in range(n):
        image = np.ascontiguousarray(ground[i : i + height, 2 * i : 2 * i + width])
        for bit in range(8):
            image[:16, 16 * bit : 16 * bit + 16] = 255 if i >> bit & 1 else 0
        images.append(image)
    return images


def number_of(image: NDArray[np.uint8]) -> int:
    """The number that moving_images put into an image."""
    return sum(int(image[4:12, 16 * bit + 4 : 16 * bit + 12].mean() > 127) << bit for bit in range(8))


def write_video(
    path: Path,
    images: Sequence[NDArray[np.uint8]],
    *,
    codec: str = H264,
    stamps_ms: Sequence[int] | None = None,
    key_every: int = 10,
    b_frames: int = 0,
    open_gop: bool = False,
    pixels: str = "yuv420p",
    colour: tuple[int, int] | None = None,  # matrix of ITU-T H.273, and 1: limited range or 2: full range
    turned_deg: int = 0,
    options: dict[str, str] | None = None,
    container: dict[str, str] | None = None,
) -> None:
    """Write a video; 25 frames a second where no stamps are given. The container is chosen by the suffix.

    Images are (h, w, 3) BGR, or (h * 3 / 2, w) planes of yuv420p that are stored as they are.
    """
    av = import_av()
    with av.open(str(path), "w", options=container or {}) as out:
        stream = out.add_stream(codec, rate=25)
        rows, stream.width = images[0].shape[:2]
        stream.height = rows if images[0].ndim == 3 else rows * 2 // 3
        stream.pix_fmt = pixels
        stream.codec_context.time_base = Fraction(1, 25) if stamps_ms is None else Fraction(1, 1000)
        stream.gop_size = key_every
        stream.options = {**_keys(codec, key_every, b_frames, open_gop), **(options or {})}
        if colour is not None:
            stream.codec_context.colorspace, stream.codec_context.color_range = colour
        if turned_deg:
            stream.set_display_rotation(turned_deg)
        for number, image in enumerate(images):
            if image.ndim == 2:  # planes that are ready
                frame = av.VideoFrame.from_ndarray(image, "yuv420p")
            else:
                frame = av.VideoFrame.from_ndarray(image, "bgr24").reformat(format=pixels)
            frame.pts = number if stamps_ms is None else stamps_ms[number]
            frame.time_base = stream.codec_context.time_base
            frame.pict_type = 0
            out.mux(stream.encode(frame))
        out.mux(stream.encode())


def _keys(codec: str, key_every: int, b_frames: int, open_gop: bool) -> dict[str, str]:
    if codec == H264:
        # forced bframes: the encoder would not use them where little moves.
        common = f"keyint={key_every}:min-keyint={key_every}:scenecut=0:bframes={b_frames}:b-adapt=0"
        return {"x264-params": f"{common}:open-gop={int(open_gop)}:log-level=none", "crf": "12"}
    if codec == H265:
        common = f"keyint={key_every}:min-keyint={key_every}:scenecut=0:bframes={b_frames}:b-adapt=0"
        return {"x265-params": f"{common}:open-gop={int(open_gop)}:log-level=none:pools=1", "crf": "12"}
    return {"qscale": "2"} if codec == MJPEG else {}
