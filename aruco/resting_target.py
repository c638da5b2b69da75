"""Camera poses from a target that rests: its frame is the world.

Owns      choosing among the rival solutions of a camera's views, and averaging over its frames.
Leaves    a target that is moved to moved_target.

A camera's views of a resting target all measure one pose. A rival solution of one view may fit that view a little
better by chance, but only the true pose explains all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aruco.errors import CalibrationError
from aruco.pose_averaging import PoseAverage, average_poses
from aruco.pose_math import Array, Pose, adjoint, invert_transform, pose_distance
from aruco.rig_estimate import Placement, RigEstimate
from aruco.view_pose import RULED_OUT_CHI2, Candidate, View

# Two views of one resting target agree far better than this, and the rivals of a square differ by more.
SAME_HYPOTHESIS_RAD = np.radians(6.0)
SAME_HYPOTHESIS_SHARE = 0.06  # of the distance
# A view that a hypothesis does not explain at all costs this much, in the corners' variance.
UNEXPLAINED_CHI2 = 4 * RULED_OUT_CHI2
# A resting target has two or four; a moved one as many as frames, which need not all be counted to be refused.
MAX_HYPOTHESES = 20
# When fewer views than this agree on where the target is, it did not rest.
MIN_AGREEING_SHARE = 0.5


def place_cameras(views: Sequence[View], scale2: Mapping[str, float]) -> RigEstimate:
    """Every camera's pose in the frame of a target that rests.

    Args:
        views: Of all cameras.
        scale2: Camera -> factor on the corners' variances, from the residuals of all its views.

    Returns:
        The cameras that could be placed, and why the others could not.

    Raises:
        CalibrationError: Most views disagree on where the target is: it did not rest.
    """
    by_camera = {name: [v for v in views if v.camera == name] for name in sorted({v.camera for v in views})}
    hypotheses = {name: _ranked(mine, scale2[name]) for name, mine in by_camera.items()}
    _require_rest(by_camera, hypotheses)
    cameras: dict[str, Placement] = {}
    lost: dict[str, str] = {}
    for name, mine in by_camera.items():
        best, *rivals = hypotheses[name]
        if rivals and rivals[0].cost - best.cost < RULED_OUT_CHI2:
            lost[name] = (
                f"{len(mine)} views leave two poses possible (a marker seen nearly face on): turn the target so that "
                "this camera sees two faces, or record more frames"
            )
        else:
            cameras[name] = _placement(mine, best.T_cam_target, scale2[name])
    frames = sorted({frame for placement in cameras.values() for frame in placement.frames})
    targets = {frame: np.eye(4) for frame in frames}
    return RigEstimate(cameras=cameras, lost=lost, T_world_target=targets, world_frame=frames[0] if frames else 0)


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """A pose of the target that some view proposes, and what all views of the camera think of it."""

    T_cam_target: Pose
    cost: float  # in variances of the corners
    n_explained: int  # views with a solution there


def _ranked(views: Sequence[View], scale2: float) -> list[_Hypothesis]:
    ranked = [
        _Hypothesis(T, sum(_cost(v, T, scale2) for v in views), sum(_explaining(v, T) is not None for v in views))
        for T in _hypotheses(views)
    ]
    return sorted(ranked, key=lambda h: h.cost)


def _require_rest(by_camera: Mapping[str, Sequence[View]], hypotheses: Mapping[str, Sequence[_Hypothesis]]) -> None:
    agreeing = sum(ranked[0].n_explained for ranked in hypotheses.values())
    if agreeing < MIN_AGREEING_SHARE * sum(map(len, by_camera.values())):
        raise CalibrationError(
            "The views do not agree on where the target rests: if it was moved between frames, pass --moving-target; "
            "otherwise cut the recording to the part in which it rests."
        )


def _placement(views: Sequence[View], T_cam_target: Pose, scale2: float) -> Placement:
    explained = [(view, c) for view in views if (c := _explaining(view, T_cam_target)) is not None]
    average = _average([c for _, c in explained])
    used = [view for (view, _), keep in zip(explained, average.inliers) if keep]
    return Placement(
        T_world_cam=average.T,
        spread_rad=average.spread_rad,
        spread_m=average.spread_m,
        frames=tuple(view.frame for view in used),
        n_views=len(views),
        n_ambiguous=sum(view.is_ambiguous(scale2) for view in views),
    )


def _hypotheses(views: Sequence[View]) -> list[Pose]:
    """Distinct poses that some view proposes, the better ones first."""
    kept: list[Pose] = []
    for candidate in sorted((c for view in views for c in view.candidates), key=lambda c: c.chi2):
        if len(kept) < MAX_HYPOTHESES and not any(_same(candidate.T_cam_target, T) for T in kept):
            kept.append(candidate.T_cam_target)
    return kept


def _same(T_a: Pose, T_b: Pose) -> bool:
    angle, distance = pose_distance(T_a, T_b)
    return angle < SAME_HYPOTHESIS_RAD and distance < SAME_HYPOTHESIS_SHARE * float(np.linalg.norm(T_b[:3, 3]))


def _explaining(view: View, T_cam_target: Pose) -> Candidate | None:
    return next((c for c in view.candidates if _same(c.T_cam_target, T_cam_target)), None)


def _cost(view: View, T_cam_target: Pose, scale2: float) -> float:
    candidate = _explaining(view, T_cam_target)
    if candidate is None:
        return UNEXPLAINED_CHI2
    return min((candidate.chi2 - view.best.chi2) / scale2, UNEXPLAINED_CHI2)


def _average(candidates: Sequence[Candidate]) -> PoseAverage:
    """The mean of the camera's poses in the target's frame."""
    poses = [invert_transform(c.T_cam_target) for c in candidates]
    return average_poses(poses, [information_of_inverse(c) for c in candidates])


def information_of_inverse(candidate: Candidate) -> Array:
    """The (6, 6) information of ``T_target_cam``: a left twist x of it is ``-Ad(T_cam_target) x`` of its inverse."""
    A = adjoint(candidate.T_cam_target)
    return A.T @ candidate.information @ A
