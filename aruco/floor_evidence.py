"""How large the errors of a rig's poses and of its depth are, told by how much the cameras' floors disagree.

Owns      factors on the standard deviations of poses (common ones, and of single cameras far off) and of bias.
Leaves    the estimate with these to floor_fusion.

Bias of depth tilts what a camera sees about its own x axis only and raises it; errors of poses tilt it about every
axis. So the floors of a few cameras tell rough poses from good ones, and large bias from both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aruco.floor_model import FloorState, Sight, predicted_plane
from aruco.floor_plane import Mask
from aruco.pose_math import Array

# Tools range from a tenth to ten times the default: a factor of 6 either way is one sigma. A covariance that somebody
# computed can be as wrong, upwards: it knows nothing of a tripod that was moved since.
SCALE_LOG_SIGMA = math.log(6.0)
# A scale too small keeps a bad pose as it is, one too large lets in what bias does to a camera's floor. So where poses
# are the better witness the lower part of what the scale may be is taken, and where floors are, its upper end. On 40
# simulated rigs the middle, the most probable one, and the one of the mean gain each leave twice the tilt and height
# in rough poses (0.09 degrees and 2.8 mm for 0.04 and 1.3), and good ones no better.
SCALE_QUANTILES = (0.25, 0.97)
# Share of a correction that would be done by the middle of what the scale may be, in the direction most in doubt: below
# and above this the one or the other quantile is taken, and between the two in proportion.
GAIN_RANGE = (0.2, 0.4)
# One in a thousand (chi-square, 3 degrees) before a single camera's pose is called worse than the others'.
ODD_CHI2 = 16.3
# And its own error then is the one that makes it an ordinary surprise.
MEAN_CHI2 = 3.0
# The prior of bias is that of usual cameras; where it may be much larger, rough poses on unbiased depth pass for good
# ones on biased depth.
BIAS_LOG_SIGMA = math.log(1.2)
_SCALES = np.geomspace(0.02, 50.0, 60)
_OWN_SCALES = np.geomspace(0.02, 1e4, 132)
_BIAS_SCALES = np.geomspace(0.25, 8.0, 11)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scales:
    """Factors on standard deviations."""

    poses: dict[str, float]  # camera -> on those of its pose's prior, as the estimate works with
    honest: dict[str, float]  # camera -> likewise, the middle of what it may be: what covariances afterwards tell
    bias: float = 1.0  # on those of what is not known of the depth's bias


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Wants:
    """The corrections that the cameras' floors ask for, linearly: ``wish = by_floor @ floor + correction + noise``."""

    wish: Array  # (n, 3)
    by_floor: Array  # (n, 3, 3)
    noise: Array  # (n, 3, 3)
    bias: Array  # (n, 3, 3)
    prior: Array  # (n, 3, 3)

    def only(self, keep: Mask) -> Wants:
        """Those of some of the cameras."""
        return Wants(
            wish=self.wish[keep],
            by_floor=self.by_floor[keep],
            noise=self.noise[keep],
            bias=self.bias[keep],
            prior=self.prior[keep],
        )

    def spread(self, poses: Array, bias: Array) -> Array:
        """(..., n, 3, 3) covariances of the wishes for factors (..., n) and (...)."""
        return self.noise + bias[..., None, None, None] ** 2 * self.bias + poses[..., None, None] ** 2 * self.prior


def wants_of(sights: Sequence[Sight], state: FloorState) -> Wants:
    """What each camera's floor asks for, against the floor of a state."""
    wish, by_floor, back = [], [], []
    for sight in sights:
        predicted, floor_slope, camera_slope = predicted_plane(sight.T_world_cam, state, np.zeros(3))
        back.append(np.linalg.inv(camera_slope))
        wish.append(back[-1] @ (sight.a - predicted))
        by_floor.append(back[-1] @ floor_slope)
    return Wants(
        wish=np.array(wish),
        by_floor=np.array(by_floor),
        noise=np.array([B @ sight.noise @ B.T for B, sight in zip(back, sights)]),
        bias=np.array([B @ sight.bias @ B.T for B, sight in zip(back, sights)]),
        prior=np.array([sight.prior for sight in sights]),
    )


def _floor_of(wants: Wants, poses: Array, bias: Array) -> tuple[Array, Array, Array]:
    """The floor (..., 3), its covariance, and the restricted log-likelihood (...) of factors (..., n) and (...)."""
    S = wants.spread(poses, bias)
    W = np.linalg.inv(S)
    information = np.einsum("nki,...nkl,nlj->...ij", wants.by_floor, W, wants.by_floor)
    pull = np.einsum("nki,...nkl,nl->...i", wants.by_floor, W, wants.wish)
    floor = np.linalg.solve(information, pull[..., None])[..., 0]
    left = wants.wish - np.einsum("nij,...j->...ni", wants.by_floor, floor)
    chi2 = np.einsum("...nk,...nkl,...nl->...", left, W, left)
    log_det = np.linalg.slogdet(S)[1].sum(axis=-1) + np.linalg.slogdet(information)[1]
    return floor, np.linalg.inv(information), -0.5 * (chi2 + log_det)


def told_scales(sights: Sequence[Sight], state: FloorState) -> Scales:
    """The factors that the cameras' floors tell: of single cameras far off the others, then common ones of the rest."""
    wants = wants_of(sights, state)
    given = np.array([sight.given for sight in sights])
    # What an odd camera's own factor is has no part in the others': that would call these worse to explain it.
    own = np.full(len(sights), np.nan)
    # Two cameras cannot tell which of them is wrong, nor can two against two.
    for _ in range((len(sights) - 1) // 2):
        chi2, worst, factor = max(_surprise(int(k), wants, given, np.isnan(own)) for k in np.nonzero(np.isnan(own))[0])
        if chi2 <= ODD_CHI2:
            break
        own[worst] = factor
    rest = np.isnan(own)
    poses, middle = own.copy(), own.copy()
    poses[rest], bias = _common_scales(wants.only(rest), given[rest])
    middle[rest], _ = _common_scales(wants.only(rest), given[rest], (0.5, 0.5))
    names = [sight.camera for sight in sights]
    return Scales(
        poses=dict(zip(names, map(float, poses))),
        honest=dict(zip(names, map(float, np.maximum(middle, poses)))),
        bias=bias,
    )


def _common_scales(wants: Wants, given: Mask, quantiles: tuple[float, float] = SCALE_QUANTILES) -> tuple[Array, float]:
    """(n,) one factor for all poses without a covariance, one, at least 1, for those with one; and one for bias."""
    scales, bias = np.ones(len(given)), 1.0
    if len(given) < 2:
        return scales, bias
    for group in (~given, given):
        if group.any():
            tried = np.where(group, _SCALES[:, None], scales)
            logs = _floor_of(wants, tried[:, None, :], _BIAS_SCALES)[2]
            logs = logs - 0.5 * (np.log(_SCALES) / SCALE_LOG_SIGMA)[:, None] ** 2
            logs -= 0.5 * (np.log(_BIAS_SCALES) / BIAS_LOG_SIGMA) ** 2
            weights = np.exp(logs - logs.max())
            bias = math.exp(float(weights.sum(axis=0) @ np.log(_BIAS_SCALES) / weights.sum()))
            chosen = _chosen(weights.sum(axis=1), wants.only(group), bias, quantiles)
            scales[group] = max(chosen, 1.0) if group is given else chosen
    return scales, bias


def _chosen(weights: Array, wants: Wants, bias: float, quantiles: tuple[float, float]) -> float:
    """The scale to work with, of what the scales _SCALES are worth: between two quantiles, by who knows better."""
    below = np.cumsum(weights)
    lower, middle, upper = np.interp(np.array([quantiles[0], 0.5, quantiles[1]]) * below[-1], below, _SCALES)
    floors, both = (wants.spread(np.full(len(wants.wish), s), np.array(bias)) for s in (0.0, float(middle)))
    # In the direction in which a camera's floor knows least: bias leaves roll alone, where any pose can be corrected.
    left = np.linalg.eigvals(np.linalg.solve(both, floors)).real.max(axis=-1)
    gain = 1.0 - float(left.mean())
    share = float(np.interp(gain, GAIN_RANGE, (0.0, 1.0)))
    return float(lower ** (1.0 - share) * upper**share)


def _surprise(k: int, wants: Wants, given: Mask, ordinary: Mask) -> tuple[float, int, float]:
    """Of one camera's wish under what other ordinary ones say: chi-square (3 degrees), its index, its own factor."""
    others = ordinary & (np.arange(len(given)) != k)
    rest = wants.only(others)
    # A few good cameras by chance make no other one odd: the upper end of what their errors may be.
    upper = (SCALE_QUANTILES[1], SCALE_QUANTILES[1])
    common, bias = _common_scales(rest, given[others], upper)
    floor, floor_covariance, _ = _floor_of(rest, common, np.array(bias))
    same = common[given[others] == given[k]]
    left = wants.wish[k] - wants.by_floor[k] @ floor
    known = wants.noise[k] + bias**2 * wants.bias[k] + wants.by_floor[k] @ floor_covariance @ wants.by_floor[k].T
    factors = np.concatenate([same[:1] if len(same) else np.ones(1), _OWN_SCALES])
    S = known + factors[:, None, None] ** 2 * wants.prior[k]
    chi2 = np.einsum("i,nij,j->n", left, np.linalg.inv(S), left)
    return float(chi2[0]), k, float(_OWN_SCALES[np.argmax(chi2[1:] <= MEAN_CHI2)])
