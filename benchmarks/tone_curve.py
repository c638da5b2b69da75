"""Images as most cameras give them: not proportional to light, but bent by the sRGB curve.

Owns      the curve, and a recording whose images went through it.
Leaves    light to rigcal.sim, which is linear.

A bent edge looks shifted towards its dark side: markers look smaller, by about half the width of the blur.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aruco.model import BadFrame, Camera, Frame, Recording

FULL_SCALE = 255.0


def srgb(levels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Levels, 0 to 255, of light that fills a share of the full scale (IEC 61966-2-1)."""
    light = np.clip(levels / FULL_SCALE, 0.0, 1.0)
    bent = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (FULL_SCALE * bent).astype(np.float32)


_TABLE = np.rint(srgb(np.arange(256, dtype=np.float32))).astype(np.uint8)


class BentRecording:
    """A Recording with every image bent."""

    def __init__(self, linear: Recording) -> None:
        self._linear = linear

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """As those of the linear one."""
        return self._linear.cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """As those of the linear one."""
        return self._linear.stamps_ns(camera)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """As those of the linear one."""
        return self._linear.depth_indices(camera)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """The linear one's, bent."""
        for frame in self._linear.frames(camera, indices, depth=depth):
            yield frame if isinstance(frame, BadFrame) else replace(frame, image=_TABLE[frame.image])
