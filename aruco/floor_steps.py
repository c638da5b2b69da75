"""Two floors at two heights: cameras that agree among themselves, and not with the others, about nothing but height.

Owns      whether the floors form two groups by more than poses and bias explain, and which.
Leaves    the sizes of pose and bias errors in a single floor to floor_evidence, what follows to floor_levelling.

A step between the groups is one number more; whether it earns its place is told by the Bayes factor of both models,
the sizes of errors integrated out. A camera of its own height that is turned too is no step: it was moved.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from aruco.floor_evidence import SCALE_LOG_SIGMA, Wants, wants_of
from aruco.floor_model import FloorState, Sight
from aruco.pose_math import Array

# Platforms and stairs; higher ones are no common floor in the first place.
STEP_SIGMA_M = 0.15
# Less is the height of a carpet, and does not spoil a floor.
LEAST_STEP_M = 0.015
# Log of the odds that a step must earn, after what the number of possible groups costs. On 216 simulated rigs without
# one, of 3 to 6 cameras with errors of 0.01 to 0.6 degrees, 1.8 was the most.
LOG_ODDS = 4.0
# Floors are within this of the world's first guess, one sigma: wide enough to say nothing.
_SLOPE_SIGMA, _HEIGHT_SIGMA_M = 0.2, 2.0
# All groups of so many cameras are tried, of more only those that the order of heights makes.
_ALL_GROUPS = 8
# Cameras that somebody has chosen may have a bias much smaller than others have.
_BIAS_LOG_SIGMA = math.log(2.0)
_POSES, _BIASES = np.geomspace(0.02, 50.0, 30), np.geomspace(0.1, 8.0, 10)
_OWN = np.geomspace(1.0, 1e3, 16)


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorStep:
    """Cameras whose floor lies at another height than the others'."""

    cameras: tuple[str, ...]  # at most half of all
    rise_m: float  # of their floor above that of the others
    log_odds: float  # for it, against one floor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Odds:
    """Evidence of one floor over the sizes of errors (m,), and what a step would add to it."""

    log_evidence: Array  # (m,)
    information: Array  # (m, 3 n, 3 n) inverse covariances of all wishes
    pulled: Array  # (m, 3 n) the same times the wishes

    def with_step(self, by_step: Array) -> tuple[float, float]:
        """Log of the evidence of a step along (3 n,), and its most probable height [m]."""
        p = np.einsum("i,mij,j->m", by_step, self.information, by_step)
        q = self.pulled @ by_step
        known = p + 1.0 / STEP_SIGMA_M**2
        logs = self.log_evidence + 0.5 * (q**2 / known - np.log(STEP_SIGMA_M**2 * known))
        weights = np.exp(logs - logs.max())
        return _log_sum(logs), float(weights @ (q / known) / weights.sum())


def floor_step(sights: Sequence[Sight], state: FloorState) -> FloorStep | None:
    """The step that parts the cameras' floors best, where it is far more probable than a single floor."""
    wants, given = wants_of(sights, state), np.array([sight.given for sight in sights])
    odds = _odds(wants, given, np.ones((1, len(sights))))
    single = _log_sum(odds.log_evidence)
    groups = list(_groups(wants.wish[:, 2]))
    best: FloorStep | None = None
    for group in groups:
        by_step = np.zeros_like(wants.wish)
        by_step[list(group)] = wants.by_floor[list(group), :, 2]
        log_step, rise_m = odds.with_step(by_step.ravel())
        gain = log_step - single - math.log(len(groups))
        better = abs(rise_m) >= LEAST_STEP_M and gain > (LOG_ODDS if best is None else best.log_odds)
        if better and log_step > _moved(group, wants, given):
            best = FloorStep(cameras=tuple(sights[k].camera for k in group), rise_m=rise_m, log_odds=gain)
    return best


def _groups(heights: Array) -> Iterator[tuple[int, ...]]:
    """Indices of at most half of all cameras."""
    n = len(heights)
    for size in range(1, n // 2 + 1):
        if n <= _ALL_GROUPS:
            # Of two halves of the same size one is enough.
            yield from (g for g in combinations(range(n), size) if 2 * size < n or 0 in g)
        else:
            order = [int(k) for k in np.argsort(heights)]
            yield tuple(order[:size])
            yield tuple(order[-size:])


def _moved(group: Sequence[int], wants: Wants, given: Array) -> float:
    """Log of the evidence that a single camera was moved instead: turned and raised at will. Two are not at once."""
    if len(group) > 1:
        return -math.inf
    own = np.ones((len(_OWN), len(given)))
    own[:, group[0]] = _OWN
    return _log_sum(_odds(wants, given, own).log_evidence) - math.log(len(_OWN))


def _odds(wants: Wants, given: Array, own: Array) -> _Odds:
    """Evidence of one floor, for all sizes of errors, and own factors (k, n) of single cameras' poses."""
    n = len(given)
    scale, bias = (a.repeat(len(own)) for a in (np.repeat(_POSES, len(_BIASES)), np.tile(_BIASES, len(_POSES))))
    k = np.tile(np.arange(len(own)), len(_POSES) * len(_BIASES))
    # What somebody has said of poses can be too good, not too bad.
    poses = np.where(given, np.maximum(scale, 1.0)[:, None], scale[:, None]) * own[k]
    S = np.zeros((len(scale), n, 3, n, 3))
    S[:, np.arange(n), :, np.arange(n), :] = np.moveaxis(wants.spread(poses, bias), 1, 0)
    floor = wants.by_floor.reshape(3 * n, 3) * [_SLOPE_SIGMA, _SLOPE_SIGMA, _HEIGHT_SIGMA_M]
    V = S.reshape(len(scale), 3 * n, 3 * n) + floor @ floor.T
    wish = wants.wish.ravel()
    information = np.linalg.inv(V)
    pulled = information @ wish
    prior = -0.5 * (np.log(scale) / SCALE_LOG_SIGMA) ** 2 - 0.5 * (np.log(bias) / _BIAS_LOG_SIGMA) ** 2
    prior -= _log_sum(prior) - math.log(len(own))
    return _Odds(
        log_evidence=prior - 0.5 * (pulled @ wish + np.linalg.slogdet(V)[1]), information=information, pulled=pulled
    )


def _log_sum(logs: Array) -> float:
    return float(logs.max() + np.log(np.exp(logs - logs.max()).sum()))
