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


def told_scales(known: Known, state: State, clouds: Normal, M: Array, current: Scales, *, biased: bool) -> Scales:
    """The factors that clouds tell.

    Args:
        known: What is known beforehand.
        state: Where the estimate stands.
        clouds: What clouds say there.
        M: (size, k) the unknowns by the free ones.
        current: Factors that are taken to hold while others are told.
        biased: Whether depth errors are estimated.
    """
    parts = known.parts(state)
    unknown = [c for c in known.layout.cameras if not known.given(c)]
    defaults = [[default_of(aspect, c) for c in unknown] for aspect in ASPECTS]
    now = {
        **{name: current.default.get(name, 1.0) for names in defaults for name in names},
        **{"given": current.given, "bias": current.bias, "lean": current.lean, "measured": 1.0},
    }
    now = {name: now[name] for name in parts}
    if biased:
        now.update(_told(clouds, parts, M, now, {name: values for name, values in _DEPTH.items() if name in parts}))
    for names in defaults:
        now.update(_told_defaults(clouds, parts, M, now, names))
    if "given" in parts:
        now.update(_told(clouds, parts, M, now, {"given": _POSES}))
        now["given"] = max(now["given"], 1.0)
    return Scales(
        given=now.get("given", 1.0),
        default={name: now[name] for names in defaults for name in names},
        bias=now.get("bias", 1.0),
        lean=now.get("lean", 1.0),
    )


def _told_defaults(
    clouds: Normal, parts: Mapping[str, Part], M: Array, now: Mapping[str, float], names: Sequence[str]
) -> dict[str, float]:
    """Factors of one aspect of poses of which nobody has said it: one common to all cameras, and each one's own.

    One camera may have been displaced and the others be right; a factor for all would spoil these, and keep that one.
    """
    if not names:
        return {}
    common = math.exp(float(np.mean([math.log(now[name]) for name in names])))
    own = {name: now[name] / common for name in names}
    weighed = [parts[name].normal.scaled(own[name] ** -2.0) for name in names]
    together = Part(normal=sum(weighed[1:], weighed[0]), n=sum(parts[name].n for name in names))
    others = {name: part for name, part in parts.items() if name not in names}
    common = _told(clouds, {**others, "default": together}, M, now, {"default": _POSES})["default"]
    told = {name: common * own[name] for name in names}
    if len(names) > 2:  # of two nobody knows which is the odd one
        for name in names:
            tried = common * _OWN
            logs = _evidence(clouds, parts, M, {**now, **told}, [name], tried[:, None])
            logs -= 0.5 * (np.log(_OWN) / OWN_LOG_SIGMA) ** 2
            told[name] = _mean(logs, tried)
    return told


def _told(
    clouds: Normal, parts: Mapping[str, Part], M: Array, now: Mapping[str, float], tried: Mapping[str, Array]
) -> dict[str, float]:
    """Some factors at once, each tried at several values, the others as they are now."""
    names = list(tried)
    if not names:
        return {}
    grid = np.stack([axis.ravel() for axis in np.meshgrid(*tried.values(), indexing="ij")], axis=1)
    logs = _evidence(clouds, parts, M, now, names, grid)
    widths = [SCALE_LOG_SIGMA if name in ("default", "given") else BIAS_LOG_SIGMA for name in names]
    logs -= 0.5 * ((np.log(grid) / widths) ** 2).sum(axis=1)
    return {name: _mean(logs, grid[:, k]) for k, name in enumerate(names)}


def _mean(logs: Array, values: Array) -> float:
    """Of the logarithms of values (k,), by the logarithms (k,) of their weights."""
    weights = np.exp(logs - logs.max())
    return math.exp(float(weights @ np.log(values) / weights.sum()))


def _evidence(
    clouds: Normal, parts: Mapping[str, Part], M: Array, now: Mapping[str, float], names: Sequence[str], grid: Array
) -> Array:
    """Logarithm (k,) of the marginal likelihood for factors (k, len(names)), up to a constant."""
    H, g = M.T @ clouds.H @ M, M.T @ clouds.g
    for name in sorted(parts.keys() - set(names)):
        part = parts[name].normal
        H, g = H + M.T @ part.H @ M / now[name] ** 2, g + M.T @ part.g / now[name] ** 2
    W = grid**-2.0
    tried = [parts[name] for name in names]
    H = H + np.einsum("kp,pij->kij", W, np.stack([M.T @ part.normal.H @ M for part in tried]))
    g = g + W @ np.stack([M.T @ part.normal.g for part in tried])
    chi2 = W @ np.array([part.normal.chi2 for part in tried])
    chi2 = chi2 - np.einsum("ki,ki->k", g, np.linalg.solve(H, g[..., None])[..., 0])
    log_prior = 2.0 * np.log(grid) @ np.array([float(part.n) for part in tried])
    return -0.5 * (chi2 + np.linalg.slogdet(H)[1] + log_prior)
