"""Whether the frames of a calibration were taken at one moment, asked of all views.

Owns      which views are asked: also rejected ones, and those of cameras that were lost, which tell most.
Leaves    the answer to rigcal.quality.timing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from aruco.model import Camera
from aruco.pose_math import Pose, invert_transform
from rigcal.quality.moving_views import Seen
from rigcal.quality.timing import Timing, find_timing
from rigcal.solve.problem import gather
from rigcal.validation_case import Case


def timing_of(case: Case, cameras: Sequence[Camera], times_s: Mapping[int, float] | None = None) -> Timing | None:
    """What the views of a moved target say about when they were taken; None where that cannot be told.

    Args:
        case: The calibration.
        cameras: All cameras of the recording.
        times_s: When each frame was taken; without it, frames follow each other evenly.
    """
    if not case.moving or len(case.used) < 2:
        return None
    placed = {camera.name: T for camera, T in zip(case.cameras, case.poses.T_world_cam)}
    found = find_timing(_seen(case, cameras, placed, times_s))
    lost = _lost(case, placed)
    if lost and (found is None or not found.is_clear):
        # A clock may be what a camera was lost for; anything else would only hide what the others say.
        with_lost = find_timing(_seen(case, cameras, {**placed, **lost}, times_s))
        found = with_lost if with_lost is not None and with_lost.is_clear else found
    return found


def _lost(case: Case, placed: Mapping[str, Pose]) -> dict[str, Pose]:
    """T_world_cam of cameras that only the average placed, carried over by one that the adjustment kept."""
    average = {name: placement.T_world_cam for name, placement in case.rig.cameras.items()}
    common = next(name for name in placed if name in average)
    T_new_old = placed[common] @ invert_transform(average[common])
    return {name: T_new_old @ T for name, T in average.items() if name not in placed}


def _seen(
    case: Case, cameras: Sequence[Camera], T_world_cam: Mapping[str, Pose], times_s: Mapping[int, float] | None
) -> Seen:
    asked = [camera for camera in cameras if camera.name in T_world_cam]
    targets = case.joint.rig.T_world_target
    views = {c.name: {f: d for f, d in case.detections[c.name].items() if f in targets and len(d)} for c in asked}
    s = gather(asked, views, case.geometry)
    period_s, times = 0.0, np.array(s.frames, dtype=np.float64)
    if times_s is not None and len(s.frames) > 1:
        times = np.array([times_s[f] for f in s.frames])
        period_s = float(np.median(np.diff(np.sort(times))))
        times = times / period_s
    return Seen(
        cameras=asked,
        T_world_cam=np.array([T_world_cam[camera.name] for camera in asked]).reshape(-1, 4, 4),
        T_world_target=np.array([targets[f] for f in s.frames]).reshape(-1, 4, 4),
        times=times,
        camera=s.view_camera[s.corner_view],
        frame=s.view_frame[s.corner_view],
        marker=s.marker,
        points=s.points,
        pixels=s.pixels,
        period_s=period_s,
    )
