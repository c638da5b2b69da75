"""What corners miss beyond their own noise: lenses that differ from their models, uneven prints, clocks that jitter.

Owns      the estimate of that model noise.

The fit of an edge promises hundredths of a pixel; a lens model is good for tenths. Weighted by the promise alone, the
sharpest corners decide everything although all are equally wrong. So where the residuals show more than the sigmas
promise, ``tau`` with ``tau^2 = median |r|^2 / (2 ln 2) - median sigma^2`` is added to every corner in quadrature.
"""

from __future__ import annotations

import numpy as np

from aruco.merged_detection import RAYLEIGH_MEDIAN
from rigcal.solve.adjust import Adjustment
from rigcal.solve.problem import Sightings

# Residuals up to this many times the promise are left to the common scale: sigmas are good to about that.
NOTICED = 1.5


def model_noise_px(sightings: Sightings, adjustment: Adjustment) -> float:
    """Standard deviation of a corner's coordinate beyond its sigma; zero where the sigmas explain the residuals.

    Args:
        sightings: The corners that were adjusted.
        adjustment: Their optimum.
    """
    if adjustment.scale < NOTICED:
        return 0.0
    squares_px = (adjustment.residuals**2).sum(axis=1) * sightings.sigma_px**2
    # The unknowns have absorbed what the scale gives back.
    plain = float(np.sqrt(np.median((adjustment.residuals**2).sum(axis=1)))) / RAYLEIGH_MEDIAN
    absorbed = (adjustment.scale / max(plain, 1e-12)) ** 2
    variance = absorbed * float(np.median(squares_px)) / RAYLEIGH_MEDIAN**2
    return float(np.sqrt(max(variance - float(np.median(sightings.sigma_px**2)), 0.0)))
