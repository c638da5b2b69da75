"""From an averaged rig to the jointly adjusted one, with the covariance of every camera.

Owns      which sightings enter, which pose carries the world, putting the result back into a RigEstimate.
Leaves    mathematics to problem and adjust, the judging of views to judge.

A target that rests is one frame: its corners are averaged over time first, so that what repeats in every frame is not
taken for knowledge. The world is the target's frame; for a moved target, that of the frame the averages chose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aruco.merged_detection import merge_detections
from aruco.model import Camera, Detection
from aruco.pose_math import Array
from aruco.rig_estimate import Placement, RigEstimate
from rigcal.solve.adjust import Gauge
from rigcal.solve.judge import Judged, adjust_judging
from rigcal.solve.problem import Poses, Sightings, gather, residuals

# camera -> frame -> markers
Detections = Mapping[str, Mapping[int, Detection]]
# A marker whose median corner is this many times as far off as all corners is misprinted, moved, or wrong in the map.
MAX_MARKER_MEDIAN = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointRig:
    """The adjusted rig, and what the adjustment says about its input."""

    rig: RigEstimate
    covariance: Mapping[str, Array]  # camera -> (6, 6) of the left perturbation (rotation, translation), world axes
    scale: float  # how many times larger residuals are than the corners' sigmas promise
    rejected: Mapping[str, tuple[int, ...]]  # camera -> frames whose view does not fit the others
    odd_markers: Mapping[int, float]  # marker -> its median corner over that of all corners, where that is large
    steps: int


def adjust_rig(
    rig: RigEstimate, cameras: Sequence[Camera], detections: Detections, geometry: Mapping[int, Array], *, moving: bool
) -> JointRig:
    """Adjust all placed cameras and all poses of the target together.

    Args:
        rig: The start: an average of single views.
        cameras: All cameras of the recording.
        detections: What they saw; frames without a pose of the target in ``rig`` are left out.
        geometry: Marker id -> (k, 3) points [m], target frame.
        moving: Whether the target has a pose of its own in every frame.
    """
    placed = [camera for camera in cameras if camera.name in rig.cameras]
    used = _moved(rig, detections) if moving else _resting(rig, detections)
    sightings = gather(placed, used, geometry)
    start = Poses(
        np.array([rig.cameras[camera.name].T_world_cam for camera in placed]),
        np.array([rig.T_world_target[frame] for frame in sightings.frames]),
    )
    gauge = Gauge(np.zeros(len(placed), dtype=bool), np.array([frame == rig.world_frame for frame in sightings.frames]))
    judged = adjust_judging(sightings, start, gauge)
    return _result(rig, sightings, judged, moving)


def _resting(rig: RigEstimate, detections: Detections) -> dict[str, dict[int, Detection]]:
    """One frame of merged corners for every camera, from the views that made its average."""
    return {
        name: {rig.world_frame: merge_detections([detections[name][frame] for frame in placement.frames])}
        for name, placement in rig.cameras.items()
    }


def _moved(rig: RigEstimate, detections: Detections) -> dict[str, dict[int, Detection]]:
    """All views of placed cameras, also those that were ambiguous alone."""
    return {
        name: {frame: d for frame, d in detections[name].items() if frame in rig.T_world_target} for name in rig.cameras
    }


def _result(rig: RigEstimate, sightings: Sightings, judged: Judged, moving: bool) -> JointRig:
    adjustment = judged.adjustment
    names = [camera.name for camera in sightings.cameras]
    frames_of = {
        name: [sightings.frames[f] for f in sightings.view_frame[(sightings.view_camera == c) & judged.kept]]
        for c, name in enumerate(names)
    }
    rejected = {
        name: tuple(sightings.frames[f] for f in sightings.view_frame[(sightings.view_camera == c) & ~judged.kept])
        for c, name in enumerate(names)
    }
    T_world_cam = dict(zip(names, adjustment.poses.T_world_cam))
    cameras: dict[str, Placement] = {
        name: replace(
            rig.cameras[name],
            T_world_cam=T_world_cam[name],
            frames=tuple(frames_of[name]) if moving else rig.cameras[name].frames,
        )
        for name in names
    }
    targets = dict(zip(sightings.frames, adjustment.poses.T_world_target))
    if not moving:
        targets = dict(rig.T_world_target)
    blocks = adjustment.covariance.reshape(len(names), 6, len(names), 6)
    return JointRig(
        rig=replace(rig, cameras=cameras, T_world_target=targets),
        covariance={name: blocks[c, :, c] for c, name in enumerate(names)},
        scale=adjustment.scale,
        rejected={name: frames for name, frames in rejected.items() if frames},
        odd_markers=_odd_markers(sightings.only_views(judged.kept), judged),
        steps=adjustment.steps,
    )


def _odd_markers(sightings: Sightings, judged: Judged) -> dict[int, float]:
    distance = np.linalg.norm(residuals(sightings, judged.adjustment.poses), axis=1)
    usual = float(np.median(distance)) if len(distance) else 1.0
    ratios = {
        int(marker): float(np.median(distance[sightings.marker == marker])) / usual
        for marker in np.unique(sightings.marker)
    }
    return {marker: ratio for marker, ratio in ratios.items() if ratio > MAX_MARKER_MEDIAN}
