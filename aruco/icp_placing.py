"""Where cameras are put once it is decided which of them stay.

Owns      placed: cameras that stay at their start, the others beside them; the covariances of all.
Leaves    the estimate in which all are free to icp_solve, who stays to icp_gates.

A camera that stays is off its estimated place by a twist d. One that moves had better follow it in part: put where the
estimate has it, it would stand well beside others that move and be off by d beside the one that stays. The expected
squares of what relative poses are off by are least, summed over all pairs that overlap, where every moving camera's own
twist off its estimate is the mean of those of the cameras that it overlaps: a harmonic function on the graph of pairs,
given where cameras stay (Zhu, Ghahramani, Lafferty, Semi-supervised learning using Gaussian fields and harmonic
functions, 2003). Leaving everybody at the start is one of the choices that this is the best of; holding cameras where
they stay as if that was known would pull all others to their error.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from aruco.icp_rows import POSE
from aruco.icp_types import Pair
from aruco.pose_math import Array, adjoint, exp_se3, invert_transform

if TYPE_CHECKING:
    from aruco.icp_solve import Registration


def placed(registration: Registration, stay: Collection[str]) -> Registration:
    """The registration with some cameras at their start, the reference among them, and the others beside them.

    Args:
        registration: With all cameras where they are estimated.
        stay: These, besides cameras that are not linked with the reference.
    """
    reg = registration
    still = tuple(sorted({reg.reference, *reg.unlinked, *stay}))
    moving = tuple(name for name in reg.layout.cameras if name not in still)
    W = harmonic_weights(reg.pairs, moving, still)
    off = np.stack([reg.back[name] for name in still])
    poses = {name: reg.start[name] for name in still}
    for name, twist in zip(moving, W @ off):
        T_own_cam = invert_transform(reg.T_out_own) @ reg.T_world_cam[name]
        poses[name] = reg.T_out_own @ exp_se3(twist) @ T_own_cam
    covariance = _covariances(reg, still, moving, W)
    return replace(reg, T_world_cam=dict(sorted(poses.items())), covariance=covariance)


def harmonic_weights(pairs: Iterable[Pair], moving: Sequence[str], still: Sequence[str]) -> Array:
    """(m, k) shares that cameras that stay have in the twist of each one that moves; each row's sum is 1.

    Args:
        pairs: Of cameras that overlap, by which all of ``moving`` are linked to some of ``still``.
        moving: m cameras.
        still: k cameras.
    """
    names = [*moving, *still]
    L = np.zeros((len(names), len(names)))
    for a, b in pairs:
        i, j = names.index(a), names.index(b)
        L[[i, j], [i, j]] += 1.0
        L[[i, j], [j, i]] -= 1.0
    m = len(moving)
    W: Array = np.linalg.solve(L[:m, :m], -L[:m, m:])
    return W


def _covariances(reg: Registration, still: Sequence[str], moving: Sequence[str], W: Array) -> dict[str, Array]:
    """(6, 6) of all poses in the returned world, left perturbation.

    With x the errors of the estimate and e those at the start, a camera is off by x_a + sum_b W_ab (e_b - x_b). The
    start is made of less than the estimate is, so E[x e^T] = E[x x^T] = P, and what comes out has the covariance
    P + K (S - P) K^T. That a pose was kept because no better one was proved does not make it any better.
    """
    names = (*moving, *still)
    at = np.concatenate([np.r_[reg.layout.pose(name)] for name in names])
    Ad = np.kron(np.eye(len(names)), adjoint(reg.T_out_own))
    P = Ad @ reg.joint[np.ix_(at, at)] @ Ad.T
    here = np.s_[POSE * len(moving) :]
    S = np.zeros_like(P[here, here])
    for k, name in enumerate(still):
        of = slice(POSE * k, POSE * (k + 1))
        S[of, of] = reg.start_covariance[name]
    K = np.kron(W, np.eye(POSE))
    S_moving = P[: len(K), : len(K)] + K @ (_at_least(S, P[here, here]) - P[here, here]) @ K.T
    out = dict(reg.start_covariance)
    for k, name in enumerate(moving):
        of = slice(POSE * k, POSE * (k + 1))
        out[name] = (S_moving[of, of] + S_moving[of, of].T) / 2
    return {name: out[name] for name in reg.layout.cameras}


def _at_least(S: Array, least: Array) -> Array:
    """A covariance that promises nowhere more than another does: models of its makers differ."""
    L = np.linalg.cholesky(least)
    whitened = np.linalg.solve(L, np.linalg.solve(L, S).T)
    values, vectors = np.linalg.eigh((whitened + whitened.T) / 2)
    back = L @ vectors
    return back @ np.diag(np.maximum(values, 1.0)) @ back.T
