"""The random error of depth, and what a camera's systematic error may be before anybody has measured it.

Owns      sigma of a pixel over its depth, what averaging leaves of it, how far neighbours share errors, the bias prior.
Leaves    the systematic error itself to depth_bias, measuring the noise of one recording to depth_pool.

A stereo matcher errs in disparity, by about the same everywhere: sigma_z = z^2 sigma_d / (f B), with f B the focal
length times the baseline. Time of flight and structured light fade with the square of the distance too, so the same
law serves where f B is not known, with a stand-in for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from aruco.depth_bias import DepthModel
from aruco.errors import InputError
from aruco.pose_math import Array

# f B [px m] where nobody has said it. ZED cameras have about 84 at 720p, the larger RealSenses 50 to 60, the small ones
# 32. With 64 and the sigmas below a pixel's total noise is 0.0021 z^2, about the 0.0019 z^2 that is known of the first
# Kinect: the middle of the field, rather too little trust than too much.
DEFAULT_FOCAL_BASELINE = 64.0
# Side of the square of pixels [px] whose fixed errors together are worth one measurement. Errors smoothed by a Gaussian
# of s pixels correlate as exp(-r^2 / (4 s^2)), which adds up to 4 pi s^2 pixels; matching windows and rectification
# errors of s = 8 px make it a square of 28.
CORRELATION_PX = 28.0
# The same of the part that changes from frame to frame: s = 3 px.
TEMPORAL_CORRELATION_PX = 11.0
# What the error of one camera is believed to be before it is measured, one sigma. Calibrations of baseline and focal
# length hold to a few tenths of a percent, rectification to 0.1 or 0.2 mrad, which is 0.15 px at f = 700 px.
PRIOR_SCALE = 0.003
PRIOR_DISPARITY_PX = 0.15
# Of a time-of-flight camera: makers promise 11 mm and 0.1 percent as a limit, which is two sigma.
PRIOR_OFFSET_M = 0.0055


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthNoise:
    """Random error of a depth camera, without its bias."""

    focal_baseline: float | None = None  # f B [px m] of the depth image; None: DEFAULT_FOCAL_BASELINE
    sigma_px: float = 0.12  # of disparity, drawn anew in each frame
    fixed_sigma_px: float = 0.06  # of disparity, the same in each frame of a resting scene
    floor_m: float = 0.0005  # rounding to millimetres and the like, in each frame

    def __post_init__(self) -> None:
        """Refuse numbers that are no noise."""
        fB, sigmas = self.focal_baseline, (self.sigma_px, self.fixed_sigma_px, self.floor_m)
        if fB is not None and not (math.isfinite(fB) and fB > 0):
            raise InputError(f"depth noise: focal_baseline must be positive pixel metres, got {fB}.")
        if not all(math.isfinite(s) and s >= 0 for s in sigmas):
            raise InputError(f"depth noise: sigmas must be finite and not negative, got {sigmas}.")

    def sigma_m(self, depth_m: ArrayLike) -> Array:
        """Standard deviation [m] of one pixel in one frame at depth [m] of any shape; NaN stays."""
        return self.averaged_sigma_m(depth_m, 1)

    def fixed_sigma_m(self, depth_m: ArrayLike) -> Array:
        """The part of it [m] that averaging over time leaves."""
        return self.fixed_sigma_px * self._metres_per_px(depth_m)

    def averaged_sigma_m(self, depth_m: ArrayLike, count: ArrayLike) -> Array:
        """Standard deviation [m] of a pixel that was averaged over ``count`` frames (an array or one number)."""
        changing = np.hypot(self.sigma_px * self._metres_per_px(depth_m), self.floor_m)
        n = np.maximum(np.asarray(count, dtype=np.float64), 1.0)
        return np.asarray(np.hypot(self.fixed_sigma_m(depth_m), changing / np.sqrt(n)))

    def _metres_per_px(self, depth_m: ArrayLike) -> Array:
        fB = DEFAULT_FOCAL_BASELINE if self.focal_baseline is None else self.focal_baseline
        return np.asarray(depth_m, dtype=np.float64) ** 2 / fB


def independent_count(n_pixels: float, *, stride: int = 1) -> float:
    """How many independent measurements pixels of one surface are worth, at least 1.

    Args:
        n_pixels: How many there are.
        stride: They are every stride-th pixel of the image in both directions.
    """
    return max(1.0, n_pixels * min(1.0, (stride / CORRELATION_PX) ** 2))


def bias_prior(focal_baseline: float | None = None, model: DepthModel = "stereo") -> Array:
    """Covariance (2, 2) of (scale, inverse depth [1/m]) of an unmeasured bias, or of (scale, offset [m])."""
    if model == "offset":
        return np.diag([PRIOR_SCALE**2, PRIOR_OFFSET_M**2])
    fB = DEFAULT_FOCAL_BASELINE if focal_baseline is None else focal_baseline
    return np.diag([PRIOR_SCALE**2, (PRIOR_DISPARITY_PX / fB) ** 2])
