"""How errors of depth go with range and with the place in the image, and what that looks like.

Owns      robust slopes with standard errors, likely causes.
Leaves    the errors to depth_verify, tiles of neighbouring pixels to depth_tiles, estimating a bias to depth_refine.

Range and place in the image often go together: a target on the floor is nearer the lower it is seen. A slope that the
other explains as well is marked as not its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from aruco.depth_tiles import MAD_TO_SIGMA
from aruco.pose_math import Array

# Cauchy's weight at this many sigmas is a half; 95 % efficient on normal errors (Holland and Welsch, 1977).
_CAUCHY = 2.385
_STEPS = 20
# Four slopes a camera, and tiles that share more than the noise model knows: three sigmas would cry wolf.
SIGNIFICANT = 4.0
# A trend that changes depth by less than this share of the range over what was seen is of no use to anybody.
RELEVANT_SHARE = 0.001
# Two explanations are told apart where one fits worse by four sigmas.
TOLD_APART = SIGNIFICANT**2
_TINY = 1e-12
_TILES_PER_PARAMETER = 3

Cause = Literal["", "scale", "disparity", "offset", "mixed", "unknown"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TileErrors:
    """Errors of depth, one a tile of neighbouring pixels."""

    places: Array  # (n, 2) in normalised image coordinates, x right, y down, 0 at the optical axis
    range_m: Array  # (n,) predicted depth
    errors_m: Array  # (n,)
    sigma_m: Array  # (n,) standard deviation that makes the mean over all right; see depth_tiles
    alone_m: Array  # (n,) what the noise model promises of a tile by itself

    def __len__(self) -> int:
        """How many tiles there are."""
        return len(self.errors_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Trend:
    """A slope of the error."""

    slope: float  # metres of error per unit
    sigma: float  # its standard error
    effect_m: float  # slope times how far apart the ends of what was seen are
    range_m: float  # typical range, to judge the effect by
    is_own: bool  # False: range and place in the image explain it alike, because they went together

    @property
    def is_significant(self) -> bool:
        """Whether it is there for sure, and large enough to matter."""
        large = abs(self.effect_m) >= RELEVANT_SHARE * self.range_m
        return large and abs(self.slope) >= SIGNIFICANT * self.sigma


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trends:
    """What goes with what."""

    level_m: float  # the typical error
    level_sigma_m: float
    scatter: float  # what no trend explains, in sigmas of the noise model; 1 where noise does
    slopes: Mapping[str, Trend]  # of ``range`` [m per m]; ``right``, ``down``, ``outwards`` [m per focal length]
    cause: Cause  # what the error looks like over range; "" where there is none to explain


def trends(tiles: TileErrors) -> Trends | None:
    """Level and slopes of the errors; None where tiles are too few for a level."""
    if len(tiles) < _TILES_PER_PARAMETER:
        return None
    level = _robust_fit(tiles, {})
    enough = len(tiles) >= _TILES_PER_PARAMETER * (1 + len(_drivers(tiles)))
    whole = _robust_fit(tiles, _drivers(tiles)) if enough else level
    return Trends(
        level_m=float(level.values[0]),
        level_sigma_m=float(level.sigmas[0]),
        scatter=whole.scale,
        slopes=_slopes(tiles, whole) if enough else {},
        cause=_cause(tiles, whole),
    )


def _drivers(tiles: TileErrors) -> dict[str, Array]:
    """What an error may go with, (n,) each; range first."""
    right, down = tiles.places.T
    return {"range": tiles.range_m, "right": right, "down": down, "outwards": np.hypot(right, down)}


def _slopes(tiles: TileErrors, whole: _Fit) -> dict[str, Trend]:
    """Range without regard to the place, the place without regard to range, and which of them explains more.

    On a single flat marker range is a function of the place: together they would explain each other away.
    """
    drivers = _drivers(tiles)
    place = {name: drivers[name] for name in ("right", "down")}
    fits = {"range": _robust_fit(tiles, {"range": drivers["range"]}), "place": _robust_fit(tiles, place)}
    weights = whole.weights / max(whole.scale, 1.0) ** 2
    misfit = {name: _misfit(fit.A, tiles.errors_m, weights) for name, fit in fits.items()}
    known = {"range": fits["range"].slope(1), "right": fits["place"].slope(1), "down": fits["place"].slope(2)}
    together = _robust_fit(tiles, {"range": drivers["range"], **place})
    both = {name: together.slope(k) for k, name in enumerate(known, start=1)}
    found: dict[str, Trend] = {}
    for name in known:
        mine, other = ("range", "place") if name == "range" else ("place", "range")
        own = misfit[other] - misfit[mine] >= TOLD_APART or abs(both[name][0]) >= SIGNIFICANT * both[name][1]
        found[name] = _trend(drivers[name], *known[name], tiles, own)
    # Only beside all others: on a target away from the middle, outwards is also right or down.
    found["outwards"] = _trend(drivers["outwards"], *whole.slope(4), tiles, True)
    rivals = {"range": ("right", "down"), "right": ("range",), "down": ("range",), "outwards": ()}
    alone = {name: not any(found[r].is_significant for r in rivals[name]) for name in found}
    return {name: replace(trend, is_own=trend.is_own or alone[name]) for name, trend in found.items()}


def _trend(driver: Array, slope: float, sigma: float, tiles: TileErrors, is_own: bool) -> Trend:
    span = float(np.subtract(*np.quantile(driver, [0.95, 0.05])))
    typical_m = float(np.median(tiles.range_m))
    return Trend(slope=slope, sigma=sigma, effect_m=slope * span, range_m=typical_m, is_own=is_own)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fit:
    A: Array  # (n, p); the first column is 1
    values: Array  # (p,)
    sigmas: Array  # (p,) standard errors
    weights: Array  # (n,) of squared errors
    scale: float  # of the residuals, in promised sigmas of a tile alone: what tiles share is no scatter

    def slope(self, k: int) -> tuple[float, float]:
        """The k-th value and its standard error."""
        return float(self.values[k]), float(self.sigmas[k])


def _robust_fit(tiles: TileErrors, drivers: Mapping[str, Array]) -> _Fit:
    """A level and slopes by least squares with Cauchy's loss at the residuals' own scale."""
    A = np.column_stack([np.ones(len(tiles)), *(d - np.median(d) for d in drivers.values())])
    n, p = A.shape
    scaled, errors = A / tiles.sigma_m[:, None], tiles.errors_m / tiles.sigma_m
    to_alone = tiles.sigma_m / tiles.alone_m
    loss, values, scale = np.ones(n), np.zeros(p), 1.0
    for _ in range(_STEPS):
        root = np.sqrt(loss)
        values = np.linalg.lstsq(scaled * root[:, None], errors * root, rcond=None)[0]
        residuals = (errors - scaled @ values) * to_alone
        scale = MAD_TO_SIGMA * float(np.median(np.abs(residuals))) * math.sqrt(n / max(n - p, 1))
        loss = 1.0 / (1.0 + (residuals / (_CAUCHY * max(scale, _TINY))) ** 2)
    # The noise model is a promise of the least there is: residuals may only widen it.
    sigmas = _standard_errors((scaled * loss[:, None]).T @ scaled) * max(scale, 1.0)
    return _Fit(A=A, values=values, sigmas=sigmas, weights=loss / tiles.sigma_m**2, scale=scale)


def _standard_errors(normal: Array) -> Array:
    """Roots (p,) of the diagonal of the inverse of normal equations (p, p); huge for what they do not determine."""
    sizes = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(normal / np.outer(sizes, sizes))
    return np.sqrt((vectors**2) @ (1.0 / np.maximum(values, _TINY))) / sizes


def _cause(tiles: TileErrors, fit: _Fit) -> Cause:
    """Which law the errors follow with range: z (scale), its square (disparity), none (offset), or several."""
    z = tiles.range_m
    weights = fit.weights / max(fit.scale, 1.0) ** 2
    laws: dict[Cause, Array] = {"scale": z[:, None], "disparity": (z**2)[:, None], "offset": np.ones((len(z), 1))}
    misfits: dict[Cause, float] = {name: _misfit(A, tiles.errors_m, weights) for name, A in laws.items()}
    if float(weights @ tiles.errors_m**2) < min(misfits.values()) + TOLD_APART:
        return ""
    (best, least), (_, second), _ = sorted(misfits.items(), key=lambda pair: pair[1])
    if least > _misfit(np.column_stack([z, z**2]), tiles.errors_m, weights) + TOLD_APART:
        return "mixed"
    return best if second - least >= TOLD_APART else "unknown"


def _misfit(A: Array, errors_m: Array, weights: Array) -> float:
    """The weighted sum of squares that columns (n, p) leave."""
    root = np.sqrt(weights)
    residuals = root * errors_m - root[:, None] * A @ np.linalg.lstsq(root[:, None] * A, root * errors_m, rcond=None)[0]
    return float(residuals @ residuals)
