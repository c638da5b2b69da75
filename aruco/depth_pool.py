"""Many depth images of a resting scene, and one clean one of them.

Owns      which images are held, pooling them, how well single images agree with the result.
Leaves    what a pixel's values say to depth_majority, what is a depth image to depth_image, edges to depth_mask.

Memory: at most MAX_FRAMES images are held, and fewer of large ones, evenly spread over everything that is offered.
More would not help: the part of a pixel's error that never changes is larger than what is left of the changing one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.depth_image import Depth, Mask, check_depth, with_holes
from aruco.depth_majority import agreeing, majority, noise_level
from aruco.depth_mask import mask_edges, mask_grazing
from aruco.errors import InputError

__all__ = [
    "Depth",
    "DepthFrame",
    "KeptFrame",
    "Mask",
    "PooledDepth",
    "check_depth",
    "mask_edges",
    "mask_grazing",
    "pool_depth",
    "spread_indices",
]

Confidence = NDArray[np.uint8]
DepthFrame = tuple[int, Depth, Confidence | None]  # stamp [ns], metres, 0..100

MAX_FRAMES = 64
KEPT_FRAMES = 5
# Of the images held; more than 64 of 1080p.
MAX_BYTES = 640 * 2**20
_MIN_HELD = 4
# 100 is no trust at all. What the camera itself hardly believes is left out; the majority of the rest decides.
WORST_CONFIDENCE = 95
_NO_CONFIDENCE = 255
_CHUNK_BYTES = 8 * 2**20
# Below any noise, and what is rounded takes half the room on disk: an eighth of a millimetre, and a 64th of one.
_QUANTUM_M = np.float32(2.0**-13)
_SPREAD_QUANTUM_M = np.float32(2.0**-16)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeptFrame:
    """One depth image that went into a pooled one."""

    depth: NDArray[np.float32]  # (H, W) metres, NaN = none
    score: float  # 0..1: the part of the pooled image that it measured, and where it agrees


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PooledDepth:
    """What one camera saw of the resting scene."""

    depth: NDArray[np.float32]  # (H, W) metres along the optical axis, NaN = none
    spread: NDArray[np.float32]  # (H, W) robust standard deviation over time [m], NaN below two measurements
    count: NDArray[np.uint16]  # (H, W) measurements pooled, 0 where there is no depth
    confidence: Confidence | None  # (H, W) median, 0..100, lower is more trustworthy
    n_frames: int  # images pooled
    n_seen: int  # images offered
    undecided: float  # part of the measured pixels in which nothing holds the majority
    frames: Mapping[int, KeptFrame]  # the best of them, by stamp [ns]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Held:
    stamp_ns: int
    depth: NDArray[np.float32]
    confidence: Confidence | None


def spread_indices(n: int, most: int = MAX_FRAMES) -> list[int]:
    """At most ``most`` of n frames, evenly spread: those that are worth reading where their number is known."""
    return np.unique(np.round(np.linspace(0, n - 1, min(n, most))).astype(int)).tolist() if n > 0 else []


def pool_depth(
    frames: Iterable[DepthFrame], *, max_frames: int = MAX_FRAMES, n_kept: int = KEPT_FRAMES, where: str = "depth"
) -> PooledDepth:
    """Pool depth images of one camera, taken one at a time.

    Args:
        frames: Stamp [ns], depth (H, W) [m] with NaN or 0 for holes, confidence (H, W) 0..100 or None; in time order.
        max_frames: How many images are held at most.
        n_kept: How many of the best are given back.
        where: Camera or file, for messages.

    Raises:
        InputError: Images differ in size, are no depth images, or none holds a measurement.
    """
    held, n_seen = _evenly_held(frames, max(max_frames, _MIN_HELD), where)
    if not held:
        raise InputError(f"{where}: none of {n_seen} depth images holds a measurement; check the recording's depth.")
    noise = noise_level([h.depth for h in held])
    depth, spread, count, measured = _pooled(held, noise)
    agree = [agreeing(h.depth, depth, spread, noise) for h in held]
    undecided = 1.0 - np.count_nonzero(count) / np.count_nonzero(measured)
    logger.debug("{}: {} of {} depth images pooled, {:.1%} undecided", where, len(held), n_seen, undecided)
    return PooledDepth(
        depth=depth,
        spread=spread,
        count=count,
        confidence=_pooled_confidence(held, agree),
        n_frames=len(held),
        n_seen=n_seen,
        undecided=float(undecided),
        frames=_best(held, agree, max(int(np.count_nonzero(count)), 1), n_kept),
    )


def _evenly_held(frames: Iterable[DepthFrame], most: int, where: str) -> tuple[list[_Held], int]:
    """Every image while there is room; then every second, every fourth... of all that were offered."""
    held: list[_Held] = []
    step, n_seen, n_sound = 1, 0, 0
    for stamp_ns, depth, confidence in frames:
        n_seen += 1
        frame = _trusted(stamp_ns, depth, confidence, f"{where}, {stamp_ns}")
        if held and frame.depth.shape != held[0].depth.shape:
            raise InputError(
                f"{where}, {stamp_ns}: depth of {frame.depth.shape[::-1]} pixels among images of "
                f"{held[0].depth.shape[::-1]}; record one camera with one resolution."
            )
        if not np.isfinite(frame.depth).any():
            continue
        if n_sound % step == 0:
            held.append(frame)
        n_sound += 1
        if len(held) > max(_MIN_HELD, min(most, MAX_BYTES // (5 * frame.depth.size))):
            held, step = held[::2], 2 * step
    return held, n_seen


def _trusted(stamp_ns: int, depth: Depth, confidence: Confidence | None, where: str) -> _Held:
    """An image of its own, without what the camera itself does not trust."""
    image = np.array(with_holes(depth, where), dtype=np.float32)
    if confidence is not None:
        confidence = np.array(confidence)
        if confidence.shape != image.shape or confidence.dtype != np.uint8:
            raise InputError(
                f"{where}: confidence of {confidence.dtype} {confidence.shape} beside depth of {image.shape}; both "
                "must be images of one size, confidence with 8 bits."
            )
        image[confidence > WORST_CONFIDENCE] = np.nan
    return _Held(stamp_ns=stamp_ns, depth=image, confidence=confidence)


def _pooled(
    held: Sequence[_Held], noise: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint16], Mask]:
    """Depth, spread and count (H, W), and where anything was measured; some rows at a time."""
    shape = height, width = held[0].depth.shape
    depth, spread = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
    count, measured = np.empty(shape, dtype=np.uint16), np.empty(shape, dtype=bool)
    n_rows = max(1, _CHUNK_BYTES // (4 * len(held) * width))
    for top in range(0, height, n_rows):
        rows = slice(top, top + n_rows)
        values = np.stack([h.depth[rows].ravel() for h in held], axis=1)
        found = majority(values, noise)
        depth[rows], spread[rows], count[rows] = (part.reshape(-1, width) for part in found)
        measured[rows] = np.isfinite(values).any(axis=1).reshape(-1, width)
    return _rounded(depth, _QUANTUM_M), _rounded(spread, _SPREAD_QUANTUM_M), count, measured


def _rounded(image: NDArray[np.float32], quantum: np.float32) -> NDArray[np.float32]:
    return np.round(image / quantum) * quantum


def _pooled_confidence(held: Sequence[_Held], agree: Sequence[Mask]) -> Confidence | None:
    """The median over the measurements that were pooled; 100 where there are none."""
    known = [(h.confidence, a) for h, a in zip(held, agree) if h.confidence is not None]
    if not known:
        return None
    pooled = np.empty(agree[0].shape, dtype=np.uint8)
    n_rows = max(1, _CHUNK_BYTES // (len(known) * len(pooled[0])))
    for top in range(0, len(pooled), n_rows):
        rows = slice(top, top + n_rows)
        values = np.stack([np.where(a[rows], c[rows], np.uint8(_NO_CONFIDENCE)) for c, a in known], axis=-1)
        values.sort(axis=-1)
        middle = np.maximum(np.count_nonzero(values != _NO_CONFIDENCE, axis=-1) - 1, 0) // 2
        pooled[rows] = np.take_along_axis(values, middle[..., None], axis=-1)[..., 0]
    return np.minimum(pooled, 100)


def _best(held: Sequence[_Held], agree: Sequence[Mask], n_pixels: int, n_kept: int) -> dict[int, KeptFrame]:
    """The images with the highest scores, in time order; of equals the earlier."""
    scores = [np.count_nonzero(a) / n_pixels for a in agree]
    chosen = sorted(sorted(range(len(held)), key=lambda i: -scores[i])[:n_kept])
    return {held[i].stamp_ns: KeptFrame(depth=held[i].depth, score=float(scores[i])) for i in chosen}
