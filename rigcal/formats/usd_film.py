"""A pinhole camera as focal length and film, in the single precision that USD has for them.

Owns      focal length, apertures and aperture offsets of a camera matrix, and back.
Leaves    the file to usd and usd_text.

USD's film is a rectangle behind the lens: pixel edges 0 and w lie on its borders, so our first pixel's centre, 0, lies
half a pixel inside. Offsets move the film, the image moves against it; USD's y points up, ours down (OpenUSD,
GfCamera). Only ratios to the focal length matter, so of all focal lengths near that of an ordinary lens the one is
taken whose other four numbers suffer least from being rounded to single precision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aruco.pose_math import Array
from rigcal.formats.rig import HALF_PIXEL

# In USD's units, tenths of a world unit (here a metre): 25 mm.
_FOCAL = 0.25
# So many focal lengths are tried, one float32 after another. The first would be off by up to 4e-5 px in a 4K image, the
# best of so many by less than 6e-7 px; four times as many gain little more.
_TRIES = 2**20


@dataclass(frozen=True, slots=True, kw_only=True)
class Film:
    """What a UsdGeom.Camera says about its lens; all numbers are representable in single precision."""

    focal_length: float
    aperture_x: float
    aperture_y: float
    offset_x: float
    offset_y: float

    def pinhole(self, width: int, height: int) -> tuple[float, float, float, float]:
        """The (fx, fy, cx, cy) [px] of an image of this size; pixel (0, 0) is the centre of the first pixel."""
        fx, fy = width * self.focal_length / self.aperture_x, height * self.focal_length / self.aperture_y
        cx = 0.5 * width - width * self.offset_x / self.aperture_x
        cy = 0.5 * height + height * self.offset_y / self.aperture_y
        return fx, fy, cx - HALF_PIXEL, cy - HALF_PIXEL


def film_of(pinhole: tuple[float, float, float, float], width: int, height: int) -> Film:
    """The film of a camera (fx, fy, cx, cy) [px], rounded with the least harm to any pixel of its image."""
    fx, fy, cx, cy = pinhole
    f32 = np.float32(_FOCAL) + np.arange(_TRIES, dtype=np.float32) * np.spacing(np.float32(_FOCAL))
    f = f32.astype(np.float64)
    ax, ay = _rounded(f * (width / fx)), _rounded(f * (height / fy))
    ox = _rounded(f * ((0.5 * width - (cx + HALF_PIXEL)) / fx))
    oy = _rounded(f * (((cy + HALF_PIXEL) - 0.5 * height) / fy))
    error_x = _worst_px(fx, cx + HALF_PIXEL, width, width * f / ax, 0.5 * width - width * ox / ax)
    error_y = _worst_px(fy, cy + HALF_PIXEL, height, height * f / ay, 0.5 * height + height * oy / ay)
    k = int(np.argmin(np.maximum(error_x, error_y)))
    return Film(
        focal_length=float(f[k]),
        aperture_x=float(ax[k]),
        aperture_y=float(ay[k]),
        offset_x=float(ox[k]),
        offset_y=float(oy[k]),
    )


def _rounded(values: Array) -> Array:
    return values.astype(np.float32).astype(np.float64)


def _worst_px(focal: float, centre: float, size: int, focals: Array, centres: Array) -> Array:
    """How far any pixel of an image moves when focal length and centre are replaced, (n,) of (n,) candidates."""
    reach = max(centre, size - centre)
    return np.abs(centres - centre) + reach * np.abs(focals / focal - 1.0)
