"""What depth has corrected, on trial: markers and depth that took no part, before it has its say and after.

Owns      the halves, the comparison, what counts as worse.
Leaves    the estimates to depth_fusion.

Half of the markers and every second square of the depth images are used; the others are predicted. Then the same the
other way round.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.depth_fusion import KAPPA, DepthSensor, MarkerEquations, fuse, residuals, start_estimate
from aruco.depth_tiles import FLOOR, Tiles
from aruco.pose_math import Array, Pose

# Worse is what is worse by two standard errors of paired differences, and by a share that matters.
SIGNIFICANT = 2.0
NOTICEABLE = 0.01
# Fewer pairs have no standard error worth the name.
MIN_PAIRS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeldOutMarkers:
    """How far off markers are that took no part."""

    cost: Array  # (g,) robust loss of each marker in a view
    squares_px2: Array  # (g,) mean squared distance of its corners


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MarkerHalf:
    """What half of the markers know, and how far off the other half is under poses of cameras and targets."""

    train: MarkerEquations  # about the same poses as those of all markers
    trained: NDArray[np.bool_]  # (k,) targets whose poses this half knows
    held_out: Callable[[Pose, Pose], HeldOutMarkers]


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """Residuals of what took no part: without depth, and with it."""

    n_markers: int
    marker_px: tuple[float, float]  # root mean square
    n_patches: int
    depth_mm: tuple[float, float]  # median distance


def on_held_out(
    halves: Sequence[MarkerHalf],
    tiles: Tiles,
    sensors: Mapping[str, DepthSensor],
    floor: tuple[Array, float] | None,
    held: NDArray[np.bool_],
    sizes: tuple[float, float],
) -> tuple[HeldOut, str]:
    """Figures on what each half has not used, and what became worse, in words."""
    odd = _is_odd(tiles)
    compared = [
        _compared(half, tiles, odd if k % 2 else ~odd, sensors, floor, held, sizes) for k, half in enumerate(halves)
    ]
    markers = [np.concatenate([np.empty((0, 2)), *(pair[0][k] for pair in compared)]) for k in (0, 1)]
    depth = [np.concatenate([np.empty((0, 3)), *(pair[1][k] for pair in compared)]) for k in (0, 1)]
    figures = HeldOut(
        n_markers=len(markers[0]),
        marker_px=(_rms(markers[0][:, 1]), _rms(markers[1][:, 1])),
        n_patches=len(depth[0]),
        depth_mm=(_median(1e3 * depth[0][:, 1]), _median(1e3 * depth[1][:, 1])),
    )
    if _is_worse(markers[0][:, 0], markers[1][:, 0], np.arange(float(len(markers[0])))):
        px = figures.marker_px
        return figures, f"held-out markers are predicted worse with depth: {px[0]:.3g} px before, {px[1]:.3g} px after"
    if _is_worse(depth[0][:, 0], depth[1][:, 0], depth[0][:, 2]):
        mm = figures.depth_mm
        return figures, f"held-out depth agrees no better with it: {mm[0]:.3g} mm before, {mm[1]:.3g} mm after"
    return figures, ""


def _compared(
    half: MarkerHalf,
    tiles: Tiles,
    mine: NDArray[np.bool_],
    sensors: Mapping[str, DepthSensor],
    floor: tuple[Array, float] | None,
    held: NDArray[np.bool_],
    sizes: tuple[float, float],
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Held-out markers (loss, squares) and tiles (loss, distance [m], block): before and after depth has its say."""
    known = tiles.target == FLOOR
    known[~known] = half.trained[tiles.target[~known]]
    train, test = tiles.only(mine & known), tiles.only(~mine & known)
    start = start_estimate(half.train, floor)
    nothing, (scale, lean_px) = np.ones_like(held), sizes
    before = fuse(half.train, train, sensors, start, lean_px=0.0, fixed_bias=nothing, fixed_poses=True, scale=scale)
    after = fuse(half.train, train, sensors, start, lean_px=lean_px, fixed_bias=held, scale=scale)
    markers, depth = [], []
    for at in (before, after):
        seen = half.held_out(at.T_world_cam, at.T_world_target)
        markers.append(np.stack([seen.cost, seen.squares_px2], axis=1))
        e = np.nan_to_num(residuals(test, at, sensors, half.train), nan=np.inf)
        loss = np.log1p(np.minimum((e / scale / KAPPA) ** 2, 1e6))
        depth.append(
            np.stack([loss, np.abs(e) * test.sigma / test.inverse**2, test.camera * 2.0**32 + test.block], axis=1)
        )
    return (markers[0], markers[1]), (depth[0], depth[1])


def _is_odd(tiles: Tiles) -> NDArray[np.bool_]:
    """The black squares of a chessboard of blocks over each image."""
    return ((tiles.block // 4096 + tiles.block % 4096) % 2).astype(bool)


def _is_worse(before: Array, after: Array, group: Array) -> bool:
    """Whether losses (n,) grew by more than chance; those of one group stand and fall together."""
    index = np.unique(group, return_inverse=True)[1]
    if index.max(initial=-1) + 1 < MIN_PAIRS:
        return False
    grown = np.bincount(index, after - before)
    error = float(np.std(grown, ddof=1)) * math.sqrt(len(grown))
    total = float(grown.sum())
    return total > SIGNIFICANT * error and total > NOTICEABLE * float(before.sum())


def _rms(squares: Array) -> float:
    return float(np.sqrt(squares.mean())) if len(squares) else 0.0


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0
