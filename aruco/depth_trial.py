"""What depth has corrected, on trial: markers and depth that took no part, before it has its say and after.

Owns      the halves, the comparison, what counts as worse.
Leaves    the estimates to depth_fusion.

Half of the markers and every second square of the depth images are used; the others are predicted. Then the same the
other way round. Depth corrects two things, and each is asked for by itself: biases alone against depth as it was
recorded, and poses that move against biases alone, or the biases' gain would hide a wrong move.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from aruco.depth_fusion import (
    KAPPA,
    DepthSensor,
    MarkerEquations,
    fuse,
    residuals,
    start_estimate,
    without_lean,
)
from aruco.depth_tiles import FLOOR, Tiles
from aruco.pose_math import Array, Pose

# Depth is worse where it is worse by two standard errors of paired differences, and by a share that matters.
SIGNIFICANT = 2.0
NOTICEABLE = 0.01
# Fewer pairs have no standard error worth the name.
MIN_PAIRS = 4
# Markers are worse where their squares grow by three times what chance makes of such a move, and by this many squared
# sigmas: what one more wrong corner adds, which is no harm to speak of.
CHANCES = 3.0
MIN_GROWTH = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeldOutMarkers:
    """How far off n corners are that took no part."""

    camera: NDArray[np.int64]  # (n,) index
    marker: NDArray[np.int64]  # (n,) number of its marker in its view
    off: Array  # (n, 2) in standard deviations
    off_px: Array  # (n, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MarkerHalf:
    """What half of the markers know, and how far off the other half is under poses of cameras and targets."""

    train: MarkerEquations  # about the same poses as those of all markers
    trained: NDArray[np.bool_]  # (k,) targets whose poses this half knows
    held_out: Callable[[Pose, Pose], HeldOutMarkers]


@dataclass(frozen=True, slots=True, kw_only=True)
class Growth:
    """What a move of the poses does to the squares of held-out corners.

    Corners whose prediction moves by m, in their own sigmas, change the sum of their squares by ``2 r . m + |m|^2``,
    whose first part has the standard deviation ``2 |m|`` by chance.
    """

    n_markers: int
    px: tuple[float, float]  # root mean square before and after
    squares: float  # by how much the sum of squares grows
    chance: float  # standard deviation of that

    @property
    def is_worse(self) -> bool:
        """Whether the move does harm."""
        return self.squares > max(CHANCES * self.chance, MIN_GROWTH)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """Residuals of what took no part: without depth, and with it."""

    n_markers: int
    marker_px: tuple[float, float]  # root mean square: markers alone, poses moved by depth
    n_patches: int
    depth_mm: tuple[float, float, float]  # median distance: as recorded, biases alone, poses moved too
    growth: Mapping[str, Growth] = field(default_factory=dict)  # camera -> of its markers when poses move


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """The figures, and what became worse, in words; empty: nothing."""

    figures: HeldOut
    against_bias: str  # biases alone
    against_move: str  # poses that move, with biases


@dataclass(frozen=True, slots=True, eq=False)
class _Compared:
    """Held-out corners and tiles of one half."""

    markers: tuple[HeldOutMarkers, HeldOutMarkers]  # markers alone, poses moved
    loss: Array  # (n, 3) of tiles: as recorded, biases alone, poses moved too
    distance_m: Array  # (n, 3)
    block: Array  # (n,)


def on_held_out(
    halves: Sequence[MarkerHalf],
    tiles: Tiles,
    sensors: Mapping[str, DepthSensor],
    floor: tuple[Array, float] | None,
    held: NDArray[np.bool_],
    unwritten: NDArray[np.bool_],
    sizes: tuple[float, float],
) -> Trial:
    """Figures on what each half has not used, and what became worse.

    Args:
        halves: Two halves of the markers; none: nothing is held out.
        tiles: What depth says.
        sensors: Camera -> its depth.
        floor: Roughly.
        held: (c, 2) parameters of biases that stay zero in the estimate.
        unwritten: (c, 2) those that stay zero in what is written.
        sizes: Scale of the residuals, size of the leans.
    """
    odd = _is_odd(tiles)
    compared = [
        _compared(half, tiles, odd if k % 2 else ~odd, sensors, floor, (held, unwritten), sizes)
        for k, half in enumerate(halves)
    ]
    names = halves[0].train.cameras if halves else ()
    growth = {name: _growth(compared, [c]) for c, name in enumerate(names)}
    together = _growth(compared, list(range(len(names))))
    loss, distance_m = (
        np.concatenate([np.empty((0, 3)), *(getattr(k, name) for k in compared)]) for name in ("loss", "distance_m")
    )
    block = np.concatenate([np.empty(0), *(k.block for k in compared)])
    recorded, alone, moved = loss.T
    mm = tuple(1e3 * _median(column) for column in distance_m.T)
    figures = HeldOut(
        n_markers=together.n_markers,
        marker_px=together.px,
        n_patches=len(block),
        depth_mm=(mm[0], mm[1], mm[2]),
        growth=growth,
    )
    against_bias, against_move = "", _of_markers(growth, together)
    if _is_worse(recorded, alone, block):
        against_bias = f"held-out depth agrees no better without its bias: {mm[0]:.3g} mm before, {mm[1]:.3g} mm after"
    if not against_move and (_is_worse(alone, moved, block) or _is_worse(recorded, moved, block)):
        against_move = (
            f"held-out depth agrees no better with moved poses: {min(mm[:2]):.3g} mm before, {mm[2]:.3g} mm after"
        )
    return Trial(figures=figures, against_bias=against_bias, against_move=against_move)


def _compared(
    half: MarkerHalf,
    tiles: Tiles,
    mine: NDArray[np.bool_],
    sensors: Mapping[str, DepthSensor],
    floor: tuple[Array, float] | None,
    zero: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    sizes: tuple[float, float],
) -> _Compared:
    """Held-out markers and tiles, before depth has its say, when it corrects itself alone, and when poses move."""
    known = tiles.target == FLOOR
    known[~known] = half.trained[tiles.target[~known]]
    train, test = tiles.only(mine & known), tiles.only(~mine & known)
    (held, unwritten), (scale, lean_px) = zero, sizes
    start = replace(start_estimate(half.train, floor), scale=scale)
    moved = fuse(half.train, train, sensors, start, lean_px=lean_px, fixed_bias=held, scale=scale)
    estimates = (
        without_lean(half.train, train, sensors, start, np.ones_like(held)),
        without_lean(half.train, train, sensors, start, unwritten),
        without_lean(half.train, train, sensors, moved, unwritten),
    )
    e = np.stack([np.nan_to_num(residuals(test, at, sensors, half.train), nan=np.inf) for at in estimates], axis=1)
    return _Compared(
        (
            half.held_out(start.T_world_cam, start.T_world_target),
            half.held_out(moved.T_world_cam, moved.T_world_target),
        ),
        np.log1p(np.minimum((e / scale / KAPPA) ** 2, 1e6)),
        np.abs(e) * (test.sigma / test.inverse**2)[:, None],
        test.camera * 2.0**32 + test.block,
    )


def _growth(compared: Sequence[_Compared], cameras: Sequence[int]) -> Growth:
    """Of the squares of some cameras' held-out corners; those that were far off anyway count little."""
    n, squares, variance = 0, 0.0, 0.0
    for half in compared:
        mine = np.isin(half.markers[0].camera, cameras)
        r, after = (k.off[mine] for k in half.markers)
        weight = 1.0 / (1.0 + (r**2).sum(axis=1) / KAPPA**2)
        n += len(np.unique(half.markers[0].marker[mine]))
        squares += float(weight @ ((after**2).sum(axis=1) - (r**2).sum(axis=1)))
        variance += 4.0 * float(weight @ ((after - r) ** 2).sum(axis=1))
    px = tuple(_rms([half.markers[k] for half in compared], cameras) for k in (0, 1))
    return Growth(n_markers=n, px=(px[0], px[1]), squares=squares, chance=math.sqrt(variance))


def _of_markers(growth: Mapping[str, Growth], together: Growth) -> str:
    """Whose markers the move predicts worse, or all together, in words; empty if none."""
    worse = {f"of camera {name}": of_camera for name, of_camera in growth.items() if of_camera.is_worse}
    if together.is_worse and not worse:
        worse = {"of all cameras": together}
    if not worse:
        return ""
    said = ", ".join(f"{whose} ({g.px[0]:.3g} px before, {g.px[1]:.3g} px after)" for whose, g in worse.items())
    return f"held-out markers {said} are predicted worse with depth"


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


def _rms(parts: Sequence[HeldOutMarkers], cameras: Sequence[int]) -> float:
    """Distance of the corners of some cameras [px]."""
    off = np.concatenate([np.empty((0, 2)), *(part.off_px[np.isin(part.camera, cameras)] for part in parts)])
    return float(np.sqrt((off**2).sum(axis=1).mean())) if len(off) else 0.0


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0
