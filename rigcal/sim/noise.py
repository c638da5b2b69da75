"""What a sensor makes of a perfect picture.

Owns      blur, exposure and noise of images; noise, bias, edges and holes of stereo depth; reproducible chance.
Leaves    perfect pictures to render.

Every array of random numbers comes from a generator of its own, seeded by what it is for: any frame can be made
alone and is always the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.errors import InputError

_FULL_SCALE = 255.0


class Purpose(IntEnum):
    """What a generator is for."""

    PLACEMENT = 0
    BIAS = 1
    IMAGE = 2
    DEPTH = 3
    FIXED_DEPTH = 4
    CLOCK = 5
    FURNITURE = 6


def generator(seed: int, purpose: Purpose, camera: int = 0, frame: int = 0) -> np.random.Generator:
    """The generator for one purpose, camera index and frame index.

    Raises:
        InputError: The seed is negative.
    """
    if seed < 0:
        raise InputError(f"seed {seed} is negative; choose a whole number from 0.")
    return np.random.default_rng([seed, int(purpose), camera, frame])


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageNoise:
    """A sensor behind a lens; levels are of 255."""

    blur_px: float = 0.6  # standard deviation of the point spread
    exposure: float = 0.9  # part of full scale that a brightness of 1 fills
    falloff: float = 0.15  # how much darker the corners of the image are
    read_noise: float = 1.2
    shot_noise: float = 2.2  # at full scale; it goes with the root of the level, so the sum is about 2 at mid grey


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthNoise:
    """A stereo matcher; errors in pixels of disparity."""

    sigma_px: float = 0.12  # drawn anew each frame
    fixed_sigma_px: float = 0.06  # the same in every frame: averaging over time leaves it
    correlation_px: float = 3.0  # standard deviation of the window that neighbouring errors share
    fixed_correlation_px: float = 8.0
    grown_px: int = 4  # how far a nearer surface covers a farther one beyond its edge
    step_px: float = 2.0  # jumps of disparity above this are edges
    dropout: float = 0.02  # part of the image without depth, in blots


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthBias:
    """Systematic error of one camera: ``1 / z_true = (1 + scale) / z_measured - disparity_px / (f B)``."""

    scale: float = 0.0
    disparity_px: float = 0.0


def expose(brightness: NDArray[np.float32], noise: ImageNoise) -> NDArray[np.float32]:
    """The expected image of a brightness (h, w): blurred, with falloff, in levels of 0 to 255."""
    h, w = brightness.shape
    image = brightness
    if noise.blur_px > 0:
        image = cv2.GaussianBlur(image, (0, 0), noise.blur_px, borderType=cv2.BORDER_REPLICATE)
    v, u = np.linspace(-1, 1, h, dtype=np.float32)[:, None], np.linspace(-1, 1, w, dtype=np.float32)
    gain = np.asarray(1.0 - noise.falloff / 2 * (u * u + v * v), dtype=np.float32)
    gain *= np.float32(noise.exposure * _FULL_SCALE)
    return np.asarray(np.clip(image * gain, 0.0, _FULL_SCALE), dtype=np.float32)


def sense(expected: NDArray[np.float32], noise: ImageNoise, rng: np.random.Generator) -> NDArray[np.uint8]:
    """One 8-bit image (h, w) of an expected one: shot noise, read noise, rounding."""
    variance = expected * np.float32(noise.shot_noise**2 / _FULL_SCALE) + np.float32(noise.read_noise**2)
    image = rng.standard_normal(expected.shape, dtype=np.float32)
    image *= np.sqrt(variance)
    image += expected
    return np.clip(np.rint(image), 0.0, _FULL_SCALE).astype(np.uint8)


def grow_edges(depth_m: NDArray[np.float32], noise: DepthNoise, focal_baseline: float) -> NDArray[np.float32]:
    """Depth (h, w) [m] in which nearer surfaces cover farther ones beyond their edges; f B in px m."""
    if noise.grown_px <= 0:
        return depth_m
    size = 2 * noise.grown_px + 1
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    nearest = cv2.erode(np.where(np.isfinite(depth_m), depth_m, np.float32(1e6)), window)
    with np.errstate(divide="ignore"):
        jump_px = focal_baseline * (1.0 / nearest - 1.0 / np.where(np.isfinite(depth_m), depth_m, np.inf))
    return np.where((jump_px > noise.step_px) & (nearest < 1e5), nearest, depth_m)


def fixed_error(shape: tuple[int, int], noise: DepthNoise, rng: np.random.Generator) -> NDArray[np.float32]:
    """The part (h, w) of a camera's disparity error that never changes [px]."""
    return _smooth_noise(shape, noise.fixed_correlation_px, rng) * np.float32(noise.fixed_sigma_px)


def measure_depth(
    grown_m: NDArray[np.float32],
    fixed_px: NDArray[np.float32],
    noise: DepthNoise,
    bias: DepthBias,
    focal_baseline: float,
    rng: np.random.Generator,
) -> NDArray[np.float32]:
    """One depth image of a stereo camera.

    Args:
        grown_m: (h, w) depth with edges as the matcher sees them [m].
        fixed_px: (h, w) disparity error that this camera always makes [px].
        noise: How large the changing part is, and how many pixels stay empty.
        bias: This camera's systematic error.
        focal_baseline: f B [px m].
        rng: Chance of this frame.

    Returns:
        (h, w) metres, NaN where the matcher found nothing.
    """
    error_px = fixed_px + _smooth_noise(grown_m.shape, noise.correlation_px, rng) * np.float32(noise.sigma_px)
    inverse = 1.0 / grown_m + (np.float32(bias.disparity_px) + error_px) * np.float32(1.0 / focal_baseline)
    inverse *= np.float32(1.0 / (1.0 + bias.scale))
    # A disparity that noise has pushed below zero is no measurement.
    depth_m = np.where(inverse > 0, 1.0 / np.where(inverse > 0, inverse, 1.0), np.float32(np.nan))
    if noise.dropout > 0:
        depth_m[_blots(grown_m.shape, noise, rng)] = np.nan
    return depth_m


def _blots(shape: tuple[int, ...], noise: DepthNoise, rng: np.random.Generator) -> NDArray[np.bool_]:
    # At half the size: blots a few pixels wide do not need finer dice.
    field = _smooth_noise(((shape[0] + 1) // 2, (shape[1] + 1) // 2), noise.correlation_px / 2, rng)
    level = np.quantile(field, 1.0 - noise.dropout)
    small = (field > level).astype(np.uint8)
    return cv2.resize(small, (2 * small.shape[1], 2 * small.shape[0]), interpolation=cv2.INTER_NEAREST)[
        : shape[0], : shape[1]
    ].astype(bool)


def _smooth_noise(shape: tuple[int, ...], sigma_px: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Normal noise (h, w) of variance 1 everywhere, which neighbours within about ``sigma_px`` share."""
    if sigma_px <= 0:
        return rng.standard_normal(shape, dtype=np.float32)
    radius = int(np.ceil(3 * sigma_px))
    kernel = cv2.getGaussianKernel(2 * radius + 1, sigma_px, cv2.CV_32F)
    kernel /= np.linalg.norm(kernel)
    # Noise beyond the border is drawn too: mirrored noise would make the border louder than the middle.
    white = rng.standard_normal((shape[0] + 2 * radius, shape[1] + 2 * radius), dtype=np.float32)
    smooth = cv2.sepFilter2D(white, -1, kernel, kernel)
    return np.asarray(smooth[radius : radius + shape[0], radius : radius + shape[1]], dtype=np.float32)
