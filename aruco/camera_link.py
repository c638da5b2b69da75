"""The relative pose of two cameras from the frames that both see the target in.

Owns      the vote of frames over rival solutions, and the average of the winner.
Leaves    chaining links to a rig to moved_target.

In a shared frame ``T_i_j = T_i_target @ inv(T_j_target)``. Each view may offer several solutions, but only the true
pair gives the same T_i_j in every frame: so every pair of solutions is a vote, and frames that agree add up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.pose_averaging import PoseAverage, average_poses
from aruco.pose_math import Array, Pose, adjoint, invert_transform
from aruco.view_pose import RULED_OUT_CHI2, Candidate, View

# Measurements of one relative pose agree to this; wrong pairs of solutions are tens of degrees off.
AGREE_RAD = np.radians(5.0)
AGREE_SHARE = 0.08  # of the distance to the target
# The winner must lead by more than one frame's opinion could be wrong by chance.
MIN_LEAD = 0.5
# Enough proposals to contain the truth many times over; all votes are still counted for each.
MAX_PROPOSALS = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraLink:
    """The relative pose of two cameras, as their shared frames agree on it."""

    i: str
    j: str
    average: PoseAverage  # of T_i_j
    frames: tuple[int, ...]  # that agree

    @property
    def strength(self) -> float:
        """The information about the least known direction: a link is as good as its weakest side."""
        return float(np.linalg.eigvalsh(self.average.information)[0])


@dataclass(frozen=True, slots=True, eq=False)
class _Vote:
    """One way to pair the solutions of two views of one frame."""

    frame: int
    T_i_j: Pose
    a: Candidate
    b: Candidate
    weight: float  # 1 for the views' best solutions, falling with the misfit of others


def link_cameras(
    views_i: Mapping[int, View], views_j: Mapping[int, View], scale2: Mapping[str, float]
) -> CameraLink | None:
    """The relative pose that the shared frames of two cameras agree on.

    Args:
        views_i: Frame -> view of the first camera.
        views_j: Likewise of the second.
        scale2: Camera -> factor on the corners' variances.

    Returns:
        The link, or None without shared frames or when two different relative poses have about as many votes.
    """
    votes = [
        v for frame in sorted(views_i.keys() & views_j.keys()) for v in _votes(views_i[frame], views_j[frame], scale2)
    ]
    if not votes:
        return None
    winner = _elect(votes)
    if winner is None:
        return None
    agreeing = _one_per_frame([vote for vote, yes in zip(votes, winner) if yes])
    first = next(iter(views_i.values())).camera
    second = next(iter(views_j.values())).camera
    information = [_information(vote, scale2[first], scale2[second]) for vote in agreeing]
    average = average_poses([vote.T_i_j for vote in agreeing], information)
    frames = tuple(vote.frame for vote, keep in zip(agreeing, average.inliers) if keep)
    return CameraLink(i=first, j=second, average=average, frames=frames)


def _votes(view_i: View, view_j: View, scale2: Mapping[str, float]) -> list[_Vote]:
    return [
        _Vote(
            view_i.frame,
            a.T_cam_target @ invert_transform(b.T_cam_target),
            a,
            b,
            weight_of(view_i, a, scale2) * weight_of(view_j, b, scale2),
        )
        for a in view_i.candidates
        for b in view_j.candidates
    ]


def weight_of(view: View, candidate: Candidate, scale2: Mapping[str, float]) -> float:
    """A view's own opinion about one of its solutions, in (0, 1]: one for the best, falling with the misfit."""
    excess = (candidate.chi2 - view.best.chi2) / scale2[view.camera]
    return float(np.exp(-min(excess / RULED_OUT_CHI2, 4.0)))


def agreement(T_a: Pose, T_b: Pose, reach_m: Array) -> NDArray[np.bool_]:
    """Which of poses (m, 4, 4) and (n, 4, 4) agree, (m, n), for targets ``reach_m`` (n,) away."""
    from scipy.spatial.distance import cdist

    trace = T_a[:, :3, :3].reshape(len(T_a), 9) @ T_b[:, :3, :3].reshape(len(T_b), 9).T
    distance = cdist(T_a[:, :3, 3], T_b[:, :3, 3])
    return (trace > 1 + 2 * np.cos(AGREE_RAD)) & (distance < AGREE_SHARE * reach_m)


def _elect(votes: Sequence[_Vote]) -> NDArray[np.bool_] | None:
    """Which votes agree with the winner, (n,); None when a different relative pose comes close."""
    T = np.array([vote.T_i_j for vote in votes])
    weight = np.array([vote.weight for vote in votes])
    reach = np.array([np.linalg.norm(v.a.T_cam_target[:3, 3]) + np.linalg.norm(v.b.T_cam_target[:3, 3]) for v in votes])
    proposals = np.argsort(-weight, kind="stable")[:MAX_PROPOSALS]
    agree = agreement(T[proposals], T, reach / 2)
    # A frame counts once for a proposal, with its best fitting pair.
    _, frame = np.unique([vote.frame for vote in votes], return_inverse=True)
    tally = _support(agree, weight, frame)
    best = int(np.argmax(tally))
    # What speaks for the winner does not speak for a rival that lies just beyond its reach.
    rivals = ~agree[best, proposals]
    others = _support(agree[rivals] & ~agree[best], weight, frame)
    if len(others) and tally[best] - others.max() < MIN_LEAD:
        return None
    return agree[best]


def _support(agree: NDArray[np.bool_], weight: Array, frame: NDArray[np.intp]) -> Array:
    """For every proposal (p,) the sum over frames of the best weight among its votes; ``agree`` is (p, votes)."""
    support = np.zeros((len(agree), int(frame.max()) + 1))
    for vote in range(len(frame)):
        support[:, frame[vote]] = np.maximum(support[:, frame[vote]], agree[:, vote] * weight[vote])
    return support.sum(axis=1)


def _one_per_frame(votes: Sequence[_Vote]) -> list[_Vote]:
    best: dict[int, _Vote] = {}
    for vote in votes:
        if vote.frame not in best or vote.weight > best[vote.frame].weight:
            best[vote.frame] = vote
    return [best[frame] for frame in sorted(best)]


def _information(vote: _Vote, scale2_i: float, scale2_j: float) -> Array:
    """(6, 6) information of T_i_j: twists of both views add, the second carried into the first camera's frame."""
    A = adjoint(vote.T_i_j)
    covariance = scale2_i * np.linalg.inv(vote.a.information) + scale2_j * A @ np.linalg.inv(vote.b.information) @ A.T
    return np.linalg.inv(covariance)
