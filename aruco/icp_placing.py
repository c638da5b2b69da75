"""Where cameras are put once it is decided which of them stay.

Owns      placed: cameras that stay at their start, the others beside them; the covariances of all.
Leaves    the estimate in which all are free to icp_solve, who stays to icp_gates.

A camera that stays is off its estimated place by a twist d. One that moves had better follow it in part: put where the
estimate has it, it would stand well beside others that move and be off by d beside the one that stays. With twists y of
moving cameras off their estimates, a pair is expected to be off by what the estimate leaves and by y_a - y_b, which it
feels at both cameras and as a turn. The sum of squares over all pairs that overlap, each by what was known of it at the
start, is least where every moving camera's twist is the mean of those of the cameras that it overlaps, weighed by these
quadratic forms: a harmonic function on the graph of pairs, given where cameras stay (Zhu, Ghahramani, Lafferty,
Semi-supervised learning using Gaussian fields and harmonic functions, 2003). That all stay is one of the choices that
this is the best of. Holding cameras where they stay as if that was known would pull all others to their error.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from aruco.floor_model import centre_jacobian
from aruco.icp_rows import POSE
from aruco.icp_types import Pair
from aruco.pose_math import Array, Pose, adjoint, exp_se3, invert_transform

if TYPE_CHECKING:
    from aruco.icp_solve import Registration

# A turn of one camera against another counts by what it moves at this distance [m], where rooms are looked at.
LOOKED_AT_M = 3.0


def placed(registration: Registration, stay: Collection[str]) -> Registration:
    """The registration with some cameras at their start, the reference among them, and the others beside them.

    Args:
        registration: An estimate, whatever cameras it has been placed beside before.
        stay: These, besides cameras that are not linked with the reference.
    """
    reg = registration
    still = tuple(sorted({reg.reference, *reg.unlinked, *stay}))
    moving = tuple(name for name in reg.layout.cameras if name not in still)
    estimate = {name: estimated(reg, name) for name in reg.layout.cameras}
    K = shares(pair_weights(reg.pairs, estimate, reg.start_covariance), moving, still)
    off = np.concatenate([adjoint(reg.T_out_own) @ reg.back[name] for name in still])
    poses = {name: reg.start[name] for name in still}
    for name, twist in zip(moving, (K @ off).reshape(-1, POSE)):
        poses[name] = exp_se3(twist) @ estimate[name]
    covariance = _covariances(reg, still, moving, K)
    return replace(reg, T_world_cam=dict(sorted(poses.items())), covariance=covariance)


def estimated(registration: Registration, camera: str) -> Pose:
    """T_world_cam where the estimate has a camera, the reference standing at its start."""
    T_out_own = registration.T_out_own
    back = T_out_own @ exp_se3(-registration.back[camera]) @ invert_transform(T_out_own)
    return back @ registration.start[camera]


def pair_weights(
    pairs: Iterable[Pair], T_world_cam: Mapping[str, Pose], start_covariance: Mapping[str, Array]
) -> dict[Pair, Array]:
    """(6, 6) by which the twist that is between two cameras counts: squared error of a pair over what it was known to.

    Args:
        pairs: Of cameras.
        T_world_cam: About where they stand.
        start_covariance: Camera -> (6, 6) of its pose at the start.
    """
    weights: dict[Pair, Array] = {}
    for a, b in pairs:
        J_a, J_b = (centre_jacobian(T_world_cam[name][:3, 3]) for name in (a, b))
        Q = J_a[3:].T @ J_a[3:] + J_b[3:].T @ J_b[3:] + LOOKED_AT_M**2 * J_a[:3].T @ J_a[:3]
        weights[a, b] = Q / float(np.trace(Q @ (start_covariance[a] + start_covariance[b])))
    return weights


def shares(weights: Mapping[Pair, Array], moving: Sequence[str], still: Sequence[str]) -> Array:
    """(6 m, 6 k) what twists of cameras that stay make of those that move; the blocks of a row add up to the identity.

    Args:
        weights: Pair -> (6, 6) of the twist between its cameras; they link all of ``moving`` to some of ``still``.
        moving: m cameras.
        still: k cameras.
    """
    names = [*moving, *still]
    L = np.zeros((POSE * len(names), POSE * len(names)))
    for (a, b), Q in weights.items():
        i, j = (slice(POSE * names.index(name), POSE * (names.index(name) + 1)) for name in (a, b))
        L[i, i] += Q
        L[j, j] += Q
        L[i, j] -= Q
        L[j, i] -= Q
    m = POSE * len(moving)
    K: Array = np.linalg.solve(L[:m, :m], -L[:m, m:])
    return K


def _covariances(reg: Registration, still: Sequence[str], moving: Sequence[str], K: Array) -> dict[str, Array]:
    """(6, 6) of all poses in the returned world, left perturbation.

    With x the errors of the estimate and e those at the start, a camera is off by x_a + sum_b K_ab (e_b - x_b). The
    start is made of less than the estimate is, so E[x e^T] = E[x x^T] = P, and what comes out has the covariance
    P + K (S - P) K^T. That a pose was kept because no better one was proved does not make it any better.
    """
    names = (*moving, *still)
    at = np.concatenate([np.r_[reg.layout.pose(name)] for name in names])
    Ad = np.kron(np.eye(len(names)), adjoint(reg.T_out_own))
    P = Ad @ reg.joint[np.ix_(at, at)] @ Ad.T
    here = np.s_[len(K) :]
    S = np.zeros_like(P[here, here])
    for k, name in enumerate(still):
        of = slice(POSE * k, POSE * (k + 1))
        S[of, of] = reg.start_covariance[name]
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
