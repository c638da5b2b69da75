"""A mild texture for walls and floors.

Owns      one periodic tile of smooth noise.
Leaves    laying it on panels to render.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

# Long enough that its repetition does not show, and 4 mm a cell: finer than a pixel at the ranges of a room.
TILE_PERIOD_M = 2.0
_CELLS = 512
# Waves between these lengths; shorter ones would alias, as smooth surfaces get one ray a pixel.
_LONGEST_M = 1.0
_SHORTEST_M = 0.06


@cache
def texture_tile() -> NDArray[np.float32]:
    """Periodic noise (512, 512) of mean 0 and standard deviation 1 with a 1/f spectrum."""
    rng = np.random.default_rng(20)
    spectrum = np.fft.rfft2(rng.standard_normal((_CELLS, _CELLS)))
    per_m = np.fft.fftfreq(_CELLS, TILE_PERIOD_M / _CELLS)
    frequency = np.hypot(per_m[:, None], np.abs(per_m[None, : _CELLS // 2 + 1]))
    keep = (frequency >= 1 / _LONGEST_M) & (frequency <= 1 / _SHORTEST_M)
    spectrum *= np.where(keep, 1 / np.maximum(frequency, 1e-9), 0.0)
    tile = np.fft.irfft2(spectrum, s=(_CELLS, _CELLS))
    tile = (tile / tile.std()).astype(np.float32)
    tile.setflags(write=False)
    return tile
