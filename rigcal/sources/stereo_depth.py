"""Depth of a rectified stereo pair by semi-global matching, for recordings that hold both eyes and no depth.

Owns      matching two rectified images, and which of the matches may be believed.
Leaves    rectifying to the format that knows the lenses.

Semi-global matching: Hirschmueller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008, in
OpenCV's variant (Birchfield and Tomasi's cost, five paths).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.pose_math import Array

NEAREST_M = 0.3
"""Nearer than this nothing is looked for: the ZED cameras' own limit."""

_BLOCK_PX = 5
# OpenCV's disparities are whole multiples of this, and the number of them a multiple of it too.
_STEPS_PER_PX = 16
# Memory and time grow with the candidates (width x candidates x 40 bytes). Eyes half a metre apart see as near as
# 0.4 m with so many.
_MAX_DISPARITIES = 1024
# The two eyes' answers for one point differ by less than this, or one of them does not see it.
_MAX_LEFT_RIGHT_PX = 1.0
# Least squares over a window this wide: on rendered rooms 13 is no better, and edges grow with it.
_WINDOW_PX = 9
# The second step halves what the first left; a third changes the third digit.
_REFINING_STEPS = 2
# Semi-global matching is off by a third of a pixel: what moves farther straddles an edge.
_MAX_REFINEMENT_PX = 0.7
# Slow differences in brightness between the eyes (vignetting, exposure) are taken out over this width.
_SHADING_PX = 31
# A window whose own texture cannot fix its disparity better than this is not matched but filled in by its neighbours.
_MAX_WINDOW_SIGMA_PX = 0.25
# Rounding to whole grey levels alone is 0.29; compressed video is never better than this.
_MIN_NOISE = 0.5
# What is left between matched windows: noise of two images (with slack), and a tenth of the picture for what differs
# between views; between wrong matches it is twice the picture.
_NOISE_SLACK = 1.7
_MAX_UNLIKE = 0.1
# Islands smaller than this are chance: a wrong match is lonely, a surface is not.
_SPECKLE_AREA_PX = 200
_SPECKLE_STEP_PX = 1.0
# From here on the distance is uncertain by a tenth and more.
_MIN_DISPARITY_PX = 1.0


class StereoMatcher:
    """Depth from rectified pairs of one stereo camera.

    How good it is where there is fine texture everywhere, measured on rendered pairs with 1.5 grey levels of noise
    and exact truth (disparity error as 1.4826 times the median deviation, its median, share of pixels with depth, share
    of those more than 1 px off):

        texture of   5 % of the brightness   0.12 px, below 0.01 px, 83 %, 0.02 %
        texture of  10 % of the brightness   0.07 px, below 0.01 px, 88 %, below 0.01 %
        a room, walls and floor of 10 %      0.11 px, below 0.01 px, 74 %, 0.08 %
        a wall without texture               no depth

    Rooms are seldom like that. In the simulator's own room (box-static: plain floor and walls, a box with markers) only
    5 to 9 % of the pixels have depth, none of them on floor or walls; of those 5 to 8 % are more than 1 px off, at
    upright edges, and the median is off by less than 0.02 px.

    A distance z is off by ``z^2 / (f * baseline)`` times that: at 3 m 1 cm for 0.1 px, f = 700 px and a baseline of
    0.12 m. Real pairs add what their rectification is off by (a tenth of a pixel moves everything at 3 m by that
    centimetre) and what their codec smoothed. So this is less accurate than the maker's own depth: good for telling a
    wrong pose or scale, not for refining one to millimetres.

    Within about half of the nine-pixel window an edge is drawn to the nearer or farther side. Wallpaper that repeats
    within the range of disparities can match itself, as it does for every such method.
    """

    def __init__(self, *, K: Array, baseline_m: float, size: tuple[int, int], nearest_m: float = NEAREST_M) -> None:
        """Set up for images of one size.

        Args:
            K: (3, 3) shared by both rectified images; the same principal point in both (CALIB_ZERO_DISPARITY).
            baseline_m: Distance of the eyes [m].
            size: (width, height) of one eye.
            nearest_m: Nothing nearer is looked for [m]; with eyes far apart the limit lies farther off.

        Raises:
            InputError: The numbers are not those of a stereo camera.
        """
        numbers = (float(K[0, 0]), baseline_m, nearest_m)
        if not all(np.isfinite(number) and number > 0 for number in numbers):
            raise InputError(
                f"stereo depth: focal length, baseline and nearest distance must be positive, got {numbers}; "
                "check the camera's calibration."
            )
        self._width, self._height = size
        self._focal_baseline = float(K[0, 0]) * baseline_m
        widest_px = min(self._focal_baseline / nearest_m, self._width, _MAX_DISPARITIES - 1)
        self._candidates = _STEPS_PER_PX * (int(widest_px) // _STEPS_PER_PX + 1)
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self._candidates,
            blockSize=_BLOCK_PX,
            P1=8 * _BLOCK_PX**2,
            P2=32 * _BLOCK_PX**2,
            disp12MaxDiff=-1,  # checked here, with the right eye's own answer
            preFilterCap=31,
            uniquenessRatio=10,
            speckleWindowSize=0,  # filtered here, after the check
            mode=cv2.StereoSGBM_MODE_SGBM,
        )

    def depth_m(self, left_bgr: NDArray[np.uint8], right_bgr: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The depth of every pixel of the left image.

        Args:
            left_bgr: (h, w, 3) or grey (h, w), rectified.
            right_bgr: Likewise, of the right eye.

        Returns:
            (h, w) metres along the optical axis, NaN where unknown.

        Raises:
            ValueError: The images do not have the size of the calibration.
        """
        left, right = self._grey(left_bgr), self._grey(right_bgr)
        coarse = self._disparity(left, right)
        # Mirrored, the right eye is a left one.
        coarse_right = self._disparity(right[:, ::-1], left[:, ::-1])[:, ::-1]
        keep = _agreeing(coarse, coarse_right)
        del coarse_right
        noise = max(_noise(left), _noise(right), _MIN_NOISE)
        disparity, trusted = _refined(_unshaded(left), _unshaded(right), np.maximum(coarse, 0), noise)
        keep &= trusted & (np.abs(disparity - coarse) <= _MAX_REFINEMENT_PX) & (disparity >= _MIN_DISPARITY_PX)
        keep &= _not_speckles(np.where(keep, disparity, 0))
        disparity[~keep] = np.nan
        return (self._focal_baseline / disparity).astype(np.float32)

    def _grey(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if image.shape[:2] != (self._height, self._width):
            raise ValueError(f"want images of {self._width} x {self._height}, got shape {image.shape}")
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image, dtype=np.uint8)

    def _disparity(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(h, w) pixels by which the right image's match lies further left; negative where there is none."""
        # OpenCV leaves out the columns whose farthest candidate lies outside: a fifth of the image with near range.
        padded = [
            cv2.copyMakeBorder(np.ascontiguousarray(image), 0, 0, self._candidates, 0, cv2.BORDER_REPLICATE)
            for image in (left, right)
        ]
        steps = self._matcher.compute(*padded)[:, self._candidates :]
        return np.asarray(steps, dtype=np.float32) / np.float32(_STEPS_PER_PX)


def _agreeing(disparity: NDArray[np.float32], disparity_right: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(h, w) whether the right image's match of a pixel leads back to it."""
    matched = np.rint(np.arange(disparity.shape[1]) - disparity).astype(np.intp)
    inside = (disparity >= 0) & (matched >= 0)
    back = np.take_along_axis(disparity_right, np.where(inside, matched, 0), axis=1)
    return inside & (np.abs(back - disparity) <= _MAX_LEFT_RIGHT_PX)


def _refined(
    left: NDArray[np.float32], right: NDArray[np.float32], disparity: NDArray[np.float32], noise: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Disparities by least squares on brightness, and where they may be believed.

    Semi-global matching's fractions of a pixel are drawn to whole ones: off by a fifth of a pixel and, on a floor, all
    to one side. Here each window gets the one disparity that explains the difference of its brightness best: Lucas
    and Kanade's step, linearised at every pixel's own disparity, along the row. Its variance is at best
    ``2 noise^2 / sum slope^2``; where that is large, semi-global matching has filled in from what lies around, right
    or wrong.

    Args:
        left: (h, w) brightness.
        right: (h, w) of the other eye.
        disparity: (h, w) first guess, not negative.
        noise: Standard deviation of one image's brightness.

    Returns:
        (h, w) disparities and (h, w) whether texture fixes them and the two windows look alike.
    """
    columns, rows = np.meshgrid(
        np.arange(left.shape[1], dtype=np.float32), np.arange(left.shape[0], dtype=np.float32), copy=False
    )
    slope_left, slope_right = _slope(left), _slope(right)
    power = np.empty_like(left)
    for _ in range(_REFINING_STEPS):
        at = columns - disparity
        slope = (slope_left + _sampled(slope_right, at, rows)) / 2
        power = _mean(slope * slope)
        shift = slope * disparity - (left - _sampled(right, at, rows))
        disparity = np.divide(_mean(slope * shift), np.maximum(power, 1e-6), dtype=np.float32)
    unlike = _mean((left - _sampled(right, columns - disparity, rows)) ** 2)
    # The mean of two slopes, each half the difference of two noisy values, has a quarter of the noise's variance.
    textured = _WINDOW_PX**2 * (power - 0.25 * noise**2) * _MAX_WINDOW_SIGMA_PX**2 > 2.0 * noise**2
    alike = unlike <= np.maximum(_NOISE_SLACK * 2.0 * noise**2, _MAX_UNLIKE * _mean(left * left))
    return disparity, textured & alike


def _slope(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h, w) change of brightness per pixel along the row."""
    kernel = np.array([[-0.5, 0.0, 0.5]], dtype=np.float32)
    return np.asarray(cv2.filter2D(image, cv2.CV_32F, kernel, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)


def _mean(image: NDArray[Any]) -> NDArray[np.float32]:
    """(h, w) mean over each pixel's window."""
    return np.asarray(cv2.boxFilter(image, cv2.CV_32F, (_WINDOW_PX, _WINDOW_PX)), dtype=np.float32)


def _sampled(
    image: NDArray[np.float32], columns: NDArray[np.float32], rows: NDArray[np.float32]
) -> NDArray[np.float32]:
    """(h, w) an image at other columns, between pixels too."""
    sampled = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled, dtype=np.float32)


def _unshaded(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(h, w) brightness against its surroundings."""
    image = grey.astype(np.float32)
    return image - np.asarray(cv2.boxFilter(image, cv2.CV_32F, (_SHADING_PX, _SHADING_PX)), dtype=np.float32)


def _not_speckles(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(h, w) whether a pixel belongs to an area of some size; zero: no pixel."""
    steps = np.rint(disparity * _STEPS_PER_PX).astype(np.int16)
    cv2.filterSpeckles(steps, 0, _SPECKLE_AREA_PX, _SPECKLE_STEP_PX * _STEPS_PER_PX)
    return steps > 0


def _noise(grey: NDArray[np.uint8]) -> float:
    """Standard deviation of an image's noise: Immerkaer, "Fast noise variance estimation", CVIU 1996, by the median."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    response = np.asarray(cv2.filter2D(grey, cv2.CV_32F, kernel), dtype=np.float32)
    # The kernel's root sum of squares is 6; 0.6745 sigma is the median of |noise|.
    return float(np.median(np.abs(response))) / (6.0 * 0.6745)
