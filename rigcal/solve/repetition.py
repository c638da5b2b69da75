"""How much corners repeat each other: the factor by which independent residuals promise too little.

Owns      the places a target was in, and the comparison of each place's pull on the cameras with what independent
          corners would pull.

A frame taken a little late, or a lens that differs from its model, moves all corners of a view together, and frames of
a target that rests repeat each other's errors. Each place's gradient s_k with respect to the cameras, its targets
eliminated, then has a larger spread than the normal equations promise: ``sum s_k^T P s_k`` is on average
``variance (p - sum tr (S_k P)^2)`` for independent residuals, where S_k is what place k adds to the cameras' system S,
P = S^-1, and p the number of unknowns. That is the trace of the sandwich covariance clustered by places (Liang and
Zeger, "Longitudinal data analysis using generalized linear models", 1986), with each cluster's leverage taken out
exactly.

Places can only disagree about where cameras are relative to each other. Where the target of one frame carries the
world, that frame alone says where all of them together are in it: six unknowns without a witness, which take no part.
So its target is eliminated here like any other, S_k is what it adds about relative poses, and p has six less. Nothing
else changes: with N the common twist, ``S_k N = 0`` and ``P S N = N``, so the full S_k of that frame would only have
six more of tr (S_k P)^2. A single camera has no relative pose, hence no factor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aruco.pose_math import Array, Pose

# Each place's leverage costs a product of two matrices over all cameras: so many, evenly spread, stand for all.
MAX_PLACES = 100
# A place that alone decides where a camera is has nothing to disagree with: three that count alike reach 2/3.
MIN_INDEPENDENT = 0.6
# A target that has moved less than this is where it was: its corners lie nearly at the same places of pixels and lens,
# and a small target's pose is not known better.
SAME_PLACE_M = 0.01
SAME_PLACE_RAD = 0.04


def places(T_world_target: Pose) -> NDArray[np.int64]:
    """The place (f,) of every frame (f, 4, 4): that of the first frame near to it, or a new one."""
    label = np.zeros(len(T_world_target), dtype=np.int64)
    known = np.empty((0, 4, 4))
    for f, T in enumerate(T_world_target):
        near = _is_near(known, T)
        label[f] = np.argmax(near) if near.any() else len(known)
        known = known if near.any() else np.concatenate([known, T[None]])
    return label


def _is_near(known: Pose, T: Pose) -> NDArray[np.bool_]:
    """Which of some poses (k, 4, 4) are the same place as T."""
    shift_m = np.linalg.norm(known[:, :3, 3] - T[:3, 3], axis=1)
    cosine = (np.einsum("kij,ij->k", known[:, :3, :3], T[:3, :3]) - 1) / 2
    return (shift_m < SAME_PLACE_M) & (np.arccos(np.clip(cosine, -1.0, 1.0)) < SAME_PLACE_RAD)


def repetition(
    W: Array, g: Array, E: Array, Y: Array, P: Array, variance: float, place: NDArray[np.int64], *, frame_held: bool
) -> float:
    """The factor on the covariance, at least one.

    Args:
        W: (f, c, 6, 6) what every view adds to the normal equations, zero where there is none.
        g: (f, c, 6) every view's gradient, for the target's twist, at the optimum.
        E: (f, 6c, 6) coupling of cameras and targets.
        Y: (f, 6c, 6) E times the inverses of the targets' blocks, also of a target that carries the world.
        P: (6c, 6c) inverse of the cameras' system, zero for fixed ones.
        variance: Of a residual coordinate.
        place: (f,) frames with equal numbers may repeat each other.
        frame_held: Whether the target of one frame carries the world, rather than cameras do.
    """
    n_free = 6 * (np.count_nonzero(P.any(axis=1).reshape(-1, 6).any(axis=1)) - frame_held)
    if n_free <= 0:  # pull and leverage would be rounding errors, and so would be their ratio
        return 1.0
    n_place = int(place.max(initial=-1)) + 1
    scores = np.zeros((n_place, P.shape[0]))
    np.add.at(scores, place, -g.reshape(len(g), -1))
    pull = float(np.einsum("ki,ki->", scores @ P, scores))
    step = max(1, -(-n_place // MAX_PLACES))
    some = (np.flatnonzero(place == k) for k in range(0, n_place, step))
    leverage = sum(_squared_leverage(W[f], E[f], Y[f], P) for f in some) * step
    if n_free - leverage <= MIN_INDEPENDENT * n_free:
        return 1.0
    return max(1.0, pull / (variance * (n_free - leverage)))


def _squared_leverage(W: Array, E: Array, Y: Array, P: Array) -> float:
    """Trace of (S_k P)^2 for the frames of one place."""
    S = -np.tensordot(Y, E, axes=([0, 2], [0, 2]))
    for k, block in enumerate(W.sum(axis=0)):
        S[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += block
    L = S @ P
    return float(np.einsum("ij,ji->", L, L))
