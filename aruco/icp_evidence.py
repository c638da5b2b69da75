"""How large errors of poses and of depth are, told by the clouds.

Owns      factors on the standard deviations of what is known beforehand, by marginal likelihood.
Leaves    the estimate with these to icp_solve.

Each factor is the mean of its logarithm over what the linear equations make of it, times a log-normal prior. Depth
errors of usual cameras are a prior for a rig whose cameras may all be better or worse: if nothing in the clouds asks
for them, they are taken to be small, and the clouds then say much more of the poses. Unknowns that different evidence
tells have factors of their own (automatic relevance determination; MacKay, ASHRAE Transactions 100, 1994; Neal,
Bayesian Learning for Neural Networks, 1996): what floors say of tilt and height is no testimony for yaw, x and z.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from aruco.floor_evidence import SCALE_LOG_SIGMA
from aruco.icp_equations import State
from aruco.icp_normal import Normal
from aruco.icp_prior import ASPECTS, Known, Part, Scales, default_of
from aruco.pose_math import Array

# Between cameras that somebody has just calibrated and ones that were dropped.
BIAS_LOG_SIGMA = math.log(3.0)
_POSES = np.geomspace(0.02, 50.0, 60)
# One camera's poses against the others': tripods are bumped one at a time.
OWN_LOG_SIGMA = math.log(3.0)
_OWN = np.geomspace(0.2, 20.0, 17)
# Not far above what is usual: systematic gaps of other kinds would pass for cameras that are as bad as that.
_DEPTH = {"bias": np.geomspace(0.1, 2.0, 13), "lean": np.geomspace(0.1, 2.0, 9)}


def told_scales(known: Known, state: State, clouds: Normal, M: Array, current: Scales) -> Scales:
    """The factors that clouds tell.

    Args:
        known: What is known beforehand.
        state: Where the estimate stands.
        clouds: What clouds say there.
        M: (size, k) the unknowns by the free ones.
        current: Factors that are taken to hold while others are told.
    """
    parts = known.parts(state)
    unknown = [c for c in known.layout.cameras if not known.given(c)]
    # What is set aside says nothing of how well poses are known: its factor is that of the others in the middle.
    heard = [c for c in unknown if clouds.H[known.layout.pose(c), known.layout.pose(c)].any()] or unknown
    now = {
        **{default_of(aspect, c): 1.0 for aspect in ASPECTS for c in unknown} | dict(current.default),
        **{"given": current.given, "bias": current.bias, "lean": current.lean, "certain": 1.0},
    }
    now = {name: now[name] for name in parts}
    now.update(_told(clouds, parts, M, now, {name: values for name, values in _DEPTH.items() if name in parts}))
    told: dict[str, float] = {}
    for aspect in ASPECTS if unknown else ():
        names = [default_of(aspect, c) for c in heard]
        now.update(_told_defaults(clouds, parts, M, now, names))
        told |= dict.fromkeys((default_of(aspect, c) for c in unknown), _middle(now, names))
        told |= {name: now[name] for name in names}
    if "given" in parts:
        now.update(_told(clouds, parts, M, now, {"given": _POSES}))
        now["given"] = max(now["given"], 1.0)
    return Scales(given=now.get("given", 1.0), default=told, bias=now.get("bias", 1.0), lean=now.get("lean", 1.0))


def _told_defaults(
    clouds: Normal, parts: Mapping[str, Part], M: Array, now: Mapping[str, float], names: Sequence[str]
) -> dict[str, float]:
    """Factors of one aspect of poses of which nobody has said it: one common to all cameras, and each one's own.

    One camera may have been displaced and the others be right; a factor for all would spoil these, and keep that one.
    """
    common = _middle(now, names)
    own = {name: now[name] / common for name in names}
    together = Part.joined([parts[name].scaled(own[name]) for name in names])
    others = {name: part for name, part in parts.items() if name not in names}
    common = _told(clouds, {**others, "default": together}, M, now, {"default": _POSES})["default"]
    told = {name: common * own[name] for name in names}
    if len(names) > 2:  # of two nobody knows which is the odd one
        for name in names:
            tried = common * _OWN
            logs = _evidence(clouds, parts, M, {**now, **told}, name, tried)
            logs -= 0.5 * (np.log(_OWN) / OWN_LOG_SIGMA) ** 2
            told[name] = _mean(logs, tried)
    return told


def _told(
    clouds: Normal, parts: Mapping[str, Part], M: Array, now: Mapping[str, float], tried: Mapping[str, Array]
) -> dict[str, float]:
    """Some factors at once, each tried at several values, the others as they are now."""
    if not tried:
        return {}
    *first, last = tried
    grid = np.array(list(product(*tried.values())))
    logs = np.concatenate([
        _evidence(clouds, parts, M, {**now, **dict(zip(first, values))}, last, tried[last])
        for values in product(*(tried[name] for name in first))
    ])  # fmt: skip
    widths = [SCALE_LOG_SIGMA if name in ("default", "given") else BIAS_LOG_SIGMA for name in tried]
    logs -= 0.5 * ((np.log(grid) / widths) ** 2).sum(axis=1)
    return {name: _mean(logs, grid[:, k]) for k, name in enumerate(tried)}


def _mean(logs: Array, values: Array) -> float:
    """Of the logarithms of values (k,), by the logarithms (k,) of their weights."""
    weights = np.exp(logs - logs.max())
    return math.exp(float(weights @ np.log(values) / weights.sum()))


def _middle(factors: Mapping[str, float], names: Sequence[str]) -> float:
    return math.exp(float(np.mean([math.log(factors[name]) for name in names])))


def _evidence(
    clouds: Normal, parts: Mapping[str, Part], M: Array, now: Mapping[str, float], name: str, values: Array
) -> Array:
    """Logarithm (k,) of the marginal likelihood for values (k,) of one factor, up to what no factor changes.

    Everything is solved at one value s. At another one the rows of this part weigh d = 1 / value^2 - 1 / s^2 more.
    That multiplies the determinant by det(I + d C), C being the covariance of the rows' residuals r, and adds
    d r . (I + d C)^-1 r to chi-square (matrix determinant lemma, Woodbury): with C diagonal, both are sums.
    """
    part, middle = parts[name], math.exp(float(np.mean(np.log(values))))
    factors = {other: now[other] for other in parts if other != name} | {name: middle}
    everything = Part.joined([parts[other].scaled(factors[other]) for other in sorted(parts)])
    H = M.T @ (clouds.H + everything.rows.T @ everything.rows) @ M
    g = M.T @ (clouds.g + everything.rows.T @ everything.off)
    rows = part.rows @ M
    solved = np.linalg.solve(H, np.column_stack([g, rows.T]))
    chi2 = everything.off @ everything.off - g @ solved[:, 0]
    C = rows @ solved[:, 1:]
    variance, axes = np.linalg.eigh((C + C.T) / 2)
    residual = axes.T @ (part.off - rows @ solved[:, 0])
    d = values[:, None] ** -2.0 - middle**-2.0
    # By the part alone they are known to the middle value: no more is left of them.
    grown = 1.0 + d * np.clip(variance, 0.0, middle**2)
    chi2 = chi2 + (d * residual**2 / grown).sum(axis=1)
    log_det = np.linalg.slogdet(H)[1] + np.log(grown).sum(axis=1)
    log_prior = 2.0 * sum(len(parts[other].off) * math.log(factors[other]) for other in parts if other != name)
    return -0.5 * (chi2 + log_det + log_prior + 2.0 * len(part.off) * np.log(values))
