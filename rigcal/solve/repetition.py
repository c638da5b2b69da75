"""How much corners of one frame repeat each other: the factor by which independent residuals promise too little.

Owns      the comparison of every frame's pull on the cameras with what independent corners would pull.

A frame taken a little late, or a lens that differs from its model, moves all corners of a view together. Each frame's
gradient s_f with respect to the cameras, its target eliminated, then has a larger spread than the normal equations
promise: ``sum s_f^T P s_f`` is on average ``variance (p - sum tr (S_f P)^2)`` for independent residuals, where S_f is
what frame f adds to the cameras' system S, P = S^-1, and p the number of unknowns. That is the trace of the sandwich
covariance clustered by frames (Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986),
with the leverage of each frame taken out exactly.
"""

from __future__ import annotations

import numpy as np

from aruco.pose_math import Array

# Each frame's leverage costs a product of two matrices over all cameras: so many frames, evenly spread, stand for all.
MAX_FRAMES = 100
# A frame that alone decides where a camera is has nothing to disagree with: three frames that count alike reach 2/3.
MIN_INDEPENDENT = 0.6


def repetition(W: Array, g: Array, E: Array, Y: Array, P: Array, variance: float) -> float:
    """The factor on the covariance, at least one.

    Args:
        W: (f, c, 6, 6) what every view adds to the normal equations, zero where there is none.
        g: (f, c, 6) every view's gradient, for the target's twist, at the optimum.
        E: (f, 6c, 6) coupling of cameras and targets.
        Y: (f, 6c, 6) E times the inverses of the targets' blocks.
        P: (6c, 6c) inverse of the cameras' system, zero for fixed ones.
        variance: Of a residual coordinate.
    """
    n_frame = len(W)
    scores = -g.reshape(n_frame, -1)
    pull = float(np.einsum("fi,fi->", scores @ P, scores))
    step = -(-n_frame // MAX_FRAMES) if n_frame else 1
    leverage = sum(_squared_leverage(W[f], E[f], Y[f], P) for f in range(0, n_frame, step)) * step
    n_free = 6 * np.count_nonzero(P.any(axis=1).reshape(-1, 6).any(axis=1))
    if n_free - leverage <= MIN_INDEPENDENT * n_free:
        return 1.0
    return max(1.0, pull / (variance * (n_free - leverage)))


def _squared_leverage(W: Array, E: Array, Y: Array, P: Array) -> float:
    """Trace of (S_f P)^2 for one frame."""
    S = -Y @ E.T
    for k, block in enumerate(W):
        S[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += block
    L = S @ P
    return float(np.einsum("ij,ji->", L, L))
