"""Camera poses from a target that rests: its frame is the world.

Owns      choosing among the rival solutions of a camera's views, and averaging over its frames.
Leaves    a target that is moved to moved_target.

A camera's views of a resting target all measure one pose. A rival solution of one view may fit that view a little
better by chance, but only the true pose explains all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from aruco.pose_averaging import PoseAverage, average_poses
from aruco.pose_math import Array, Pose, adjoint, invert_transform, pose_distance
from aruco.rig_estimate import Placement, RigEstimate
from aruco.view_pose import RULED_OUT_CHI2, Candidate, View

# Two views of one resting target agree far better than this, and the rivals of a square differ by more.
SAME_HYPOTHESIS_RAD = np.radians(6.0)
SAME_HYPOTHESIS_SHARE = 0.06  # of the distance
# A view that a hypothesis does not explain at all costs this much, in the corners' variance.
UNEXPLAINED_CHI2 = 4 * RULED_OUT_CHI2
# When fewer views than this agree on where the target is, it did not rest.
MIN_AGREEING_SHARE = 0.5


def place_cameras(views: Sequence[View], scale2: Mapping[str, float]) -> RigEstimate:
    """Every camera's pose in the frame of a target that rests.

    Args:
        views: Of all cameras.
        scale2: Camera -> factor on the corners' variances, from the residuals of all its views.

    Returns:
        The cameras that could be placed, and why the others could not.
    """
    cameras: dict[str, Placement] = {}
    lost: dict[str, str] = {}
    for camera in sorted({view.camera for view in views}):
        result = _place([view for view in views if view.camera == camera], scale2[camera])
        if isinstance(result, str):
            lost[camera] = result
        else:
            cameras[camera] = result
    frames = sorted({frame for placement in cameras.values() for frame in placement.frames})
    return RigEstimate(cameras=cameras, lost=lost, T_world_target={frame: np.eye(4) for frame in frames})


def _place(views: Sequence[View], scale2: float) -> Placement | str:
    """One camera's placement, or why there is none."""
    hypotheses = _hypotheses(views)
    cost = [sum(_cost(view, T, scale2) for view in views) for T in hypotheses]
    order = np.argsort(cost, kind="stable")
    if len(order) > 1 and cost[order[1]] - cost[order[0]] < RULED_OUT_CHI2:
        return (
            f"{len(views)} views leave two poses possible (a marker seen nearly face on): turn the target so that this "
            "camera sees two faces, or record more frames"
        )
    T_cam_target = hypotheses[order[0]]
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
    """Distinct poses that some view proposes; the better ones first."""
    kept: list[Pose] = []
    for candidate in sorted((c for view in views for c in view.candidates), key=lambda c: c.chi2):
        if not any(_same(candidate.T_cam_target, T) for T in kept):
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


def rests(estimate: RigEstimate) -> bool:
    """Whether the views agree that the target stayed where it was."""
    placements = estimate.cameras.values()
    agreeing = sum(len(p.frames) for p in placements)
    return agreeing >= MIN_AGREEING_SHARE * sum(p.n_views for p in placements)
