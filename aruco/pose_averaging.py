"""Many measurements of one pose in, one robust pose and its spread out.

Owns      the robust weighted mean on SE(3).
Leaves    which measurements belong together to resting_target and moved_target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.pose_math import Array, Pose, exp_se3, invert_transform, log_se3, pose_distance

# Beyond this many robust standard deviations a measurement is an outlier. Three would cut 1 in 400 good ones.
OUTLIER_SIGMAS = 4.0
# With information the squared distance has six degrees of freedom: its median is 5.3, and one in a million exceeds
# 38. The median of a few may be small by luck, so they are allowed more.
MANY_FACTOR = 7.5
FEW, FEW_FACTOR = 6, 30.0
# Starts tried, and the squared distance from which on a measurement is simply far.
MAX_STARTS, CAP = 30, 60.0
MAX_STEPS = 50
CONVERGED = 1e-12
# The mean of a handful of measurements must not reject by a spread that is small by luck.
MIN_SPREAD_RAD = 1e-4
MIN_SPREAD_M = 1e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseAverage:
    """A robust mean and how far its inliers lie from it."""

    T: Pose
    inliers: NDArray[np.bool_]  # (n,)
    information: Array  # (6, 6) sum over inliers, left perturbation
    spread_rad: float  # root mean square over inliers
    spread_m: float

    @property
    def n_inliers(self) -> int:
        """How many measurements took part."""
        return int(self.inliers.sum())


def average_poses(poses: Sequence[Pose], information: Sequence[Array] | None = None) -> PoseAverage:
    """The robust mean of measurements of one pose.

    The start is the measurement nearest to all others, so fewer than half of them may be arbitrarily wrong. Then
    weighted means on SE(3) alternate with the rejection of measurements beyond OUTLIER_SIGMAS robust deviations.

    Args:
        poses: n >= 1 transforms T_a_b.
        information: For each a (6, 6) inverse covariance of the left perturbation (rotation, translation), up to one
            common factor; None weighs all alike.

    Returns:
        The mean; with one measurement its spread is zero.

    Raises:
        ValueError: No poses.
    """
    if not len(poses):
        raise ValueError("no poses to average")
    weights = [np.eye(6)] * len(poses) if information is None else list(information)
    T = poses[_medoid(poses) if information is None else _most_plausible(poses, information)]
    inliers = np.ones(len(poses), dtype=bool)
    for _ in range(10):
        now = _agreeing(poses, information, T, inliers)
        if not now.any():
            now = inliers
        T_new = _weighted_mean(poses, weights, now, T)
        settled = bool((now == inliers).all()) and max(pose_distance(T, T_new)) < CONVERGED
        T, inliers = T_new, now
        if settled:
            break
    angle, distance = _distances(poses, T)
    return PoseAverage(
        T=T,
        inliers=inliers,
        information=np.sum([w for w, keep in zip(weights, inliers) if keep], axis=0),
        spread_rad=float(np.sqrt(np.mean(angle[inliers] ** 2))),
        spread_m=float(np.sqrt(np.mean(distance[inliers] ** 2))),
    )


def _distances(poses: Sequence[Pose], T: Pose) -> tuple[Array, Array]:
    pairs = np.array([pose_distance(T, other) for other in poses])
    return pairs[:, 0], pairs[:, 1]


def _agreeing(
    poses: Sequence[Pose], information: Sequence[Array] | None, T: Pose, inliers: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which measurements scatter about T as the others do, (n,)."""
    angle, distance = _distances(poses, T)
    if information is None:
        return (angle <= _limit(angle, inliers, MIN_SPREAD_RAD)) & (distance <= _limit(distance, inliers, MIN_SPREAD_M))
    T_inv = invert_transform(T)
    xi = np.array([log_se3(pose @ T_inv) for pose in poses])
    squares = np.einsum("ni,nij,nj->n", xi, np.array(information), xi)
    factor = FEW_FACTOR if inliers.sum() < FEW else MANY_FACTOR
    same = (angle <= MIN_SPREAD_RAD) & (distance <= MIN_SPREAD_M)
    return same | (squares <= factor * float(np.median(squares[inliers])))


def _limit(values: Array, inliers: NDArray[np.bool_], floor: float) -> float:
    """The largest distance that still counts as scatter, from the median of those that count now."""
    # The distance in three dimensions of unit normals has median 1.54.
    return OUTLIER_SIGMAS * max(float(np.median(values[inliers])) / 1.54 * np.sqrt(3), floor)


def _medoid(poses: Sequence[Pose]) -> int:
    """The measurement with the smallest median distance to the others; turn and shift each in their own median."""
    if len(poses) <= 2:
        return 0
    # Hundreds of measurements show their middle as well as thousands do.
    pick = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), 200)).astype(int))
    T = np.array([poses[i] for i in pick])
    R = T[:, :3, :3].reshape(len(T), 9)
    angle = np.arccos(np.clip((R @ R.T - 1) / 2, -1, 1))  # from the traces of all relative rotations
    pairs = np.stack([angle, np.linalg.norm(T[:, None, :3, 3] - T[:, :3, 3], axis=2)], axis=2)
    scale = np.median(pairs, axis=(0, 1)) + np.array([MIN_SPREAD_RAD, MIN_SPREAD_M])
    cost = np.median((pairs / scale).sum(axis=2), axis=1)
    return int(pick[np.argmin(cost)])


def _most_plausible(poses: Sequence[Pose], information: Sequence[Array]) -> int:
    """The measurement that most others lie near in the measure of their own information, outliers capped."""
    if len(poses) <= 2:
        return int(np.argmax([np.trace(w) for w in information])) if len(poses) else 0
    T, W = np.array(poses), np.array(information)
    known = np.argsort(-np.linalg.slogdet(W)[1], kind="stable")[:MAX_STARTS]
    spread = np.linspace(0, len(poses) - 1, min(len(poses), MAX_STARTS)).astype(int)
    starts = np.unique(np.concatenate([known, spread]))
    costs = [float(np.minimum(_squares(T, W, T[j]), CAP).sum()) for j in starts]
    return int(starts[np.argmin(costs)])


def _squares(T: Pose, W: Array, T_ref: Pose) -> Array:
    """Squared distances (n,) of poses (n, 4, 4) from one, in their information; the turn as sin of its angle."""
    R = T[:, :3, :3] @ T_ref[:3, :3].T
    turn = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    turn[np.trace(R, axis1=1, axis2=2) < 1] = 1.0  # beyond a right angle the sine falls again
    xi = np.concatenate([turn, T[:, :3, 3] - R @ T_ref[:3, 3]], axis=1)
    return np.einsum("ni,nij,nj->n", xi, W, xi)


def _weighted_mean(poses: Sequence[Pose], weights: Sequence[Array], keep: NDArray[np.bool_], T: Pose) -> Pose:
    H = np.sum([w for w, k in zip(weights, keep) if k], axis=0)
    for _ in range(MAX_STEPS):
        T_inv = invert_transform(T)
        g = np.sum([w @ log_se3(pose @ T_inv) for pose, w, k in zip(poses, weights, keep) if k], axis=0)
        step = np.linalg.solve(H, g)
        T = exp_se3(step) @ T
        if np.linalg.norm(step) < CONVERGED:
            break
    return T
