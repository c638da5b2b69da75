"""What corners miss beyond their own noise: lenses that differ from their models, uneven prints, clocks that jitter.

Owns      the estimate of that model noise.

The fit of an edge promises hundredths of a pixel; a lens model is good for tenths. Weighted by the promise alone, the
sharpest corners decide everything although all are equally wrong. So where the residuals show more than the sigmas
promise, ``tau`` is added to every corner in quadrature, with

    tau^2 = mean over views of (median |r| / sqrt(2 ln 2))^2 - median sigma^2

Views, not corners, because all corners of a view err together, and the mean, not the median, because views differ: a
clock that jitters costs a fast one pixels and a slow one nothing. A loss whose scale came from the median corner would
throw out the fast ones, though views that differ so widely are all needed. Views that were judged not to belong do not
count.
"""

from __future__ import annotations

import numpy as np

from rigcal.solve.judge import Judged, view_medians_px
from rigcal.solve.problem import Sightings

# Residuals up to this many times the promise are left to the common scale: sigmas are good to about that.
NOTICED = 1.5


def model_noise_px(sightings: Sightings, judged: Judged, own_sigma_px: float) -> float:
    """Standard deviation of a corner's coordinate beyond its sigma; zero where the sigmas explain the residuals.

    Args:
        sightings: All corners.
        judged: Their adjustment, and which views belong.
        own_sigma_px: Median of the corners' own sigmas, without model noise.
    """
    if not judged.kept.any():
        return 0.0
    medians = view_medians_px(sightings.only_views(judged.kept), judged.adjustment.poses)
    # The unknowns have absorbed a share of the residuals.
    variance = judged.adjustment.absorbed * float(np.mean(medians**2))
    return float(np.sqrt(max(variance - own_sigma_px**2, 0.0)))
