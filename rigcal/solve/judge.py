"""Whole views on trial: adjust, look at every view under the result, leave out those that do not belong, repeat.

Owns      which views take part.
Leaves    the adjustment itself to adjust.

A robust loss on single corners is not enough: when two frames of one camera are exchanged, or a target moves while a
frame is taken, all corners of the view are wrong together and agree with each other. So each view is judged by its
median corner, in units of the scale that the data themselves show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.pose_math import Array
from rigcal.solve.adjust import RAYLEIGH_MEDIAN, Adjustment, Gauge, adjust
from rigcal.solve.problem import Poses, Sightings, residuals

# The median of a view's corners, in robust standard deviations of all corners. One for ordinary views; small or
# oblique markers and imperfect intrinsics reach three or four. A wrong view is tens or hundreds off.
MAX_VIEW_MEDIAN = 6.0
# The start is an average of single views: it is allowed more.
MAX_START_MEDIAN = 20.0
MAX_ROUNDS = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged:
    """An adjustment over the views that belong."""

    adjustment: Adjustment
    kept: NDArray[np.bool_]  # (v,)
    view_median: Array  # (v,) of every view, kept or not, in robust standard deviations


def adjust_judging(sightings: Sightings, start: Poses, gauge: Gauge) -> Judged:
    """Adjust over all views that agree; views may come back when the poses get better."""
    median = view_medians(sightings, start)
    kept = median <= MAX_START_MEDIAN * max(1.0, float(np.median(median)))
    adjustment = adjust(sightings.only_views(kept), start, gauge)
    for _ in range(MAX_ROUNDS):
        median = view_medians(sightings, adjustment.poses) / adjustment.scale
        now = median <= MAX_VIEW_MEDIAN
        if (now == kept).all() or not now.any():
            break
        kept = now
        adjustment = adjust(sightings.only_views(kept), adjustment.poses, gauge)
    return Judged(adjustment=adjustment, kept=kept, view_median=median)


def view_medians(sightings: Sightings, poses: Poses) -> Array:
    """The median distance (v,) of every view's corners, one for a view as good as its sigmas promise."""
    distance = np.linalg.norm(residuals(sightings, poses), axis=1) / RAYLEIGH_MEDIAN
    distance = np.nan_to_num(distance, nan=np.inf)
    # All views at once: sorted within each view, the median is the middle of its stretch.
    ordered = distance[np.lexsort([distance, sightings.corner_view])]
    return ordered[sightings.start[:-1] + sightings.corners_per_view // 2]
