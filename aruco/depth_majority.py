"""Which of a pixel's values over time show the scene, and what they say together.

Owns      the noise level of a recording, the majority of each pixel's values, which values agree with it.
Leaves    holding and choosing images to depth_pool.

Values are judged in inverse depth, in which the noise of stereo is the same everywhere. They lie in clusters: the
scene, and whatever passed or stood in front of it. The scene is the cluster that holds the majority. The densest half
of the values (the shortest interval with more than half of them) lies in it; the densest part of that half is of one
cluster even where another holds nearly as many, and the band around it takes in the cluster and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.depth_image import Depth, Mask

# Of a pixel's values the scene must hold this part: with 45 to 55 percent nobody can tell which of two is the scene.
MIN_SHARE = 0.55
# And a pixel must be measured that often: what only shows while something stands there is not the scene.
MIN_PRESENCE = 0.5
_BAND_SIGMAS = 3.5
# Most recordings hold whole millimetres.
_BAND_FLOOR_M = 0.001
# Where two clusters are equal, the densest half is the inner halves of both: no more than half of it is of one.
_CORE = 0.5
_STRIDE = 4
# Median of |a - b| of two normal variables of sigma 1.
_MEDIAN_DIFFERENCE = 0.9539

Values = NDArray[np.floating[Any]]


def noise_level(images: Sequence[Depth]) -> float:
    """Standard deviation [1/m] over time of the inverse depth of a typical pixel; 0 for a single image.

    Of each pixel, images half the recording apart are compared, because neighbours in time can share their noise. What
    is typical of a pixel, and of all pixels, is not what things do that pass through.
    """
    apart = len(images) // 2
    if not apart:
        return 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        few = [1.0 / image[::_STRIDE, ::_STRIDE].ravel() for image in images]
    differences = np.sort([np.abs(a - b) for a, b in zip(few, few[apart:])], axis=0)  # NaN come last
    known = np.count_nonzero(~np.isnan(differences), axis=0)
    of_pixel = np.take_along_axis(differences, np.maximum(known - 1, 0)[None] // 2, axis=0)[0][known > 0]
    return float(np.median(of_pixel)) / _MEDIAN_DIFFERENCE if len(of_pixel) else 0.0


def band(inverse: Values, sigma: Values | float, noise: float) -> Values:
    """How far [1/m] values of one cluster lie from its middle, of pixels with inverse depth and sigma [1/m]."""
    return _BAND_SIGMAS * np.fmax(sigma, noise) + _BAND_FLOOR_M * inverse**2


def majority(depth: Values, noise: float) -> tuple[Values, Values, NDArray[np.int64]]:
    """The scene's depth [m], its standard deviation over time [m] and how many values it holds, each (n,).

    Args:
        depth: (n, frames) metres, NaN = none.
        noise: See noise_level.

    Returns:
        NaN, NaN and 0 for pixels in which nothing holds the majority; a NaN deviation for a single value.
    """
    with np.errstate(divide="ignore"):
        values = np.sort(1.0 / depth, axis=1)  # NaN come last
    measured = np.count_nonzero(~np.isnan(values), axis=1)
    middle, sigma = np.full(len(values), np.nan), np.full(len(values), np.nan)
    count = np.zeros(len(values), dtype=np.int64)
    least = max(1, int(np.ceil(MIN_PRESENCE * depth.shape[1])))
    for n in range(least, depth.shape[1] + 1):
        chosen = np.flatnonzero(measured == n)
        if len(chosen):
            middle[chosen], sigma[chosen], count[chosen] = _clustered(values[chosen, :n], noise)
    sound = (count >= least) & (count > MIN_SHARE * measured)
    middle[~sound], sigma[~sound], count[~sound] = np.nan, np.nan, 0
    return 1.0 / middle, sigma / middle**2, count


def _clustered(values: Values, noise: float) -> tuple[Values, Values, NDArray[np.int64]]:
    """Mean, deviation and size of the cluster around the densest part of the densest half; sorted values (n, k)."""
    k = values.shape[1]
    half = k // 2 + 1
    core = min(half, max(2, int(np.ceil(_CORE * half)))) if k > 1 else 1
    start = np.argmin(values[:, half - 1 :] - values[:, : k - half + 1], axis=1)[:, None]
    inside = start + np.arange(half - core + 1)
    widths = np.take_along_axis(values, inside + core - 1, axis=1) - np.take_along_axis(values, inside, axis=1)
    first = start + np.argmin(widths, axis=1)[:, None]
    low, high = np.take_along_axis(values, first, axis=1), np.take_along_axis(values, first + core - 1, axis=1)
    # So much of a normal distribution lies within so many sigmas around its middle.
    sigmas = 2.0 * NormalDist().inv_cdf(0.5 + core / k / 2) if core < k else np.inf
    centre = (low + high) / 2
    together = np.abs(values - centre) <= band(centre, (high - low) / sigmas, noise)
    count = np.count_nonzero(together, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(together, values, 0.0).sum(axis=1) / count
        squares = (np.where(together, values - mean[:, None], 0.0) ** 2).sum(axis=1)
        return mean, np.sqrt(squares / (count - 1)), count


def agreeing(image: Depth, depth: Values, spread: Values, noise: float) -> Mask:
    """Where one image shows what all together do: the pooled depth with its deviation over time."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / depth
        return np.abs(1.0 / image - inverse) <= band(inverse, spread * inverse**2, noise)
