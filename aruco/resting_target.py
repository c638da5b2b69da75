"""Camera poses from a target that rests: its frame is the world.

Owns      the frames in which it rests, the rival solutions of all of them together, averaging over them.
Leaves    a target that is moved to moved_target.

A camera's views of a resting target show the same corners, so whether it rests is seen in the images, without any
pose. Single views of a small square seen nearly face on have two solutions and scatter by tens of degrees; corners
averaged over all frames have less noise, and what rivals remain are those of the camera's whole recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from aruco.errors import CalibrationError
from aruco.merged_detection import REST_PX, frames_at_rest, merge_detections
from aruco.model import Camera, Detection
from aruco.pose_averaging import PoseAverage, average_poses
from aruco.pose_math import Array, Pose, adjoint, invert_transform, pose_distance
from aruco.rig_estimate import Placement, RigEstimate
from aruco.view_pose import Candidate, View, solve_view

# A single view's solution belongs to the pose that all frames give together if it is nearer than this; the rival of
# a square lies farther off.
SAME_SOLUTION_RAD = np.radians(6.0)
SAME_SOLUTION_SHARE = 0.06  # of the distance
# When in fewer frames than this the corners stay where they mostly are, the target did not rest.
MIN_RESTING_SHARE = 0.5
NOT_AT_REST = (
    "The target does not stay in one place: if it was moved between frames, pass --moving-target; otherwise cut the "
    "recording to the part in which it rests."
)


def place_cameras(
    cameras: Sequence[Camera],
    views: Sequence[View],
    detections: Mapping[str, Mapping[int, Detection]],
    geometry: Mapping[int, Array],
    scale2: Mapping[str, float],
    known: Mapping[str, Pose] | None = None,
) -> RigEstimate:
    """Every camera's pose in the frame of a target that rests, or in the world of known cameras.

    Args:
        cameras: Those of the recording.
        views: Of all cameras.
        detections: Camera -> frame -> markers, at least for the frames of the views.
        geometry: Marker id -> (k, 3) points [m], target frame.
        scale2: Camera -> factor on the corners' variances, from the residuals of all its views.
        known: T_world_cam of cameras that stay where they are.

    Returns:
        The cameras that could be placed, and why the others could not; none when there are known cameras and none of
        them could be placed.

    Raises:
        CalibrationError: The corners do not stay where they are: the target did not rest.
    """
    placed: dict[str, Placement] = {}
    lost: dict[str, str] = {}
    in_order = sorted(cameras, key=lambda camera: camera.name)
    seen = {camera: [view for view in views if view.camera == camera.name] for camera in in_order}
    resting = {
        camera.name: frames_at_rest({view.frame: detections[camera.name][view.frame] for view in mine})
        for camera, mine in seen.items()
        if mine
    }
    _require_rest(resting, len(views))
    for camera, mine in seen.items():
        if mine and not resting[camera.name]:
            lost[camera.name] = "its views show the target in another place each time"
        elif mine:
            merged = merge_detections([detections[camera.name][frame] for frame in resting[camera.name]])
            whole = solve_view(camera, min(resting[camera.name]), merged, geometry)
            _require_one_place(whole, mine)
            result = _place(whole, mine, resting[camera.name], scale2[camera.name])
            (lost if isinstance(result, str) else placed)[camera.name] = result  # pyright: ignore[reportArgumentType]
    frames = sorted({frame for placement in placed.values() for frame in placement.frames})
    targets = {frame: np.eye(4) for frame in frames}
    rig = RigEstimate(cameras=placed, lost=lost, T_world_target=targets, world_frame=frames[0] if frames else 0)
    return rig if not known else _in_their_world(rig, known)


def _in_their_world(rig: RigEstimate, known: Mapping[str, Pose]) -> RigEstimate:
    """The rig moved to where known cameras stand, and these put exactly there."""
    fixed = {name: known[name] for name in rig.cameras if name in known}
    if not fixed:
        reason = "no camera that is to stay where it is could be placed by this recording"
        return replace(rig, cameras={}, lost={**rig.lost, **dict.fromkeys(rig.cameras, reason)}, T_world_target={})
    T_world_target = average_poses([T @ invert_transform(rig.cameras[n].T_world_cam) for n, T in fixed.items()]).T
    cameras = {
        name: replace(placement, T_world_cam=fixed.get(name, T_world_target @ placement.T_world_cam))
        for name, placement in rig.cameras.items()
    }
    return replace(rig, cameras=cameras, T_world_target=dict.fromkeys(rig.T_world_target, T_world_target))


def _require_rest(resting: Mapping[str, Sequence[int]], n_views: int) -> None:
    if sum(map(len, resting.values())) < MIN_RESTING_SHARE * n_views:
        raise CalibrationError(NOT_AT_REST)


def _require_one_place(whole: View | None, views: Sequence[View]) -> None:
    """Markers that never show in one frame cannot be seen to move, but then no pose explains all of them together."""
    single_px = float(np.median([view.best.rms_px for view in views]))
    if whole is not None and len(views) > 1 and whole.best.rms_px > 3 * single_px + REST_PX:
        raise CalibrationError(NOT_AT_REST)


def _place(whole: View | None, views: Sequence[View], resting: Sequence[int], scale2: float) -> Placement | str:
    """One camera's placement from all its frames together and one by one, or why there is none."""
    if whole is None:
        return f"no pose in front of the camera explains its {len(views)} views: check the marker map"
    # Few residuals say little about the noise: the sigmas count as much as eight of them.
    if whole.is_ambiguous(max(1.0, (whole.best.chi2 + 8.0) / (whole.dof + 8.0))):
        return (
            f"{len(views)} views leave two poses possible (a marker seen nearly face on): turn the target so that this "
            "camera sees two faces, or record more frames"
        )
    at_rest = [view for view in views if view.frame in set(resting)]
    matching = [c for view in at_rest if (c := _solution_near(view, whole.best.T_cam_target)) is not None]
    trusted = len(matching) >= len(at_rest) / 2
    average = _average(matching if trusted else [whole.best])
    return Placement(
        T_world_cam=average.T,
        spread_rad=average.spread_rad,
        spread_m=average.spread_m,
        frames=tuple(view.frame for view in at_rest),
        n_views=len(views),
        n_ambiguous=sum(view.is_ambiguous(scale2) for view in views),
    )


def _solution_near(view: View, T_cam_target: Pose) -> Candidate | None:
    reach = SAME_SOLUTION_SHARE * float(np.linalg.norm(T_cam_target[:3, 3]))
    for candidate in view.candidates:
        angle, distance = pose_distance(candidate.T_cam_target, T_cam_target)
        if angle < SAME_SOLUTION_RAD and distance < reach:
            return candidate
    return None


def _average(candidates: Sequence[Candidate]) -> PoseAverage:
    """The mean of the camera's poses in the target's frame."""
    poses = [invert_transform(c.T_cam_target) for c in candidates]
    return average_poses(poses, [information_of_inverse(c) for c in candidates])


def information_of_inverse(candidate: Candidate) -> Array:
    """The (6, 6) information of ``T_target_cam``: a left twist x of it is ``-Ad(T_cam_target) x`` of its inverse."""
    A = adjoint(candidate.T_cam_target)
    return A.T @ candidate.information @ A
