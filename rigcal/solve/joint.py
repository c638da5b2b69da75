"""From an averaged rig to the jointly adjusted one, with the covariance of every camera.

Owns      which sightings enter, which pose carries the world, putting the result back into a RigEstimate.
Leaves    mathematics to problem and adjust, the judging of views to judge.

A target that rests is one frame: its corners are averaged over time first, so that what repeats in every frame is not
taken for knowledge. The world is the target's frame; for a moved target, that of the frame the averages chose, unless
no view of that frame is left. Cameras that must stay where they are carry the world instead, and the target is free.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from aruco.errors import CalibrationError
from aruco.merged_detection import merge_detections
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, invert_transform
from aruco.rig_estimate import Placement, RigEstimate
from aruco.uncertainty import carried
from rigcal.solve.adjust import Gauge
from rigcal.solve.corner_errors import CornerErrors, adjust_explaining
from rigcal.solve.judge import MAX_VIEW_MEDIAN, Judged, confirmed
from rigcal.solve.problem import Poses, Sightings, gather, residuals
from rigcal.solve.target_shape import refine_target

# camera -> frame -> markers
Detections = Mapping[str, Mapping[int, Detection]]
# A marker whose median corner is this many times as far off as all corners is misprinted, moved, or wrong in the map.
MAX_MARKER_MEDIAN = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class JointRig:
    """The adjusted rig, and what the adjustment says about its input."""

    rig: RigEstimate
    covariance: Mapping[str, Array]  # camera -> (6, 6) of the left perturbation (rotation, translation), world axes
    common: Mapping[tuple[str, str], Array]  # (camera, camera) -> (6, 6) covariance of the one with the other
    scale: float  # how many times larger residuals are than the corners' sigmas and the model noise promise
    corners: CornerErrors  # what they miss together
    rejected: Mapping[str, tuple[int, ...]]  # placed camera -> frames whose view does not fit the others
    odd_markers: Mapping[int, float]  # marker -> its median corner over that of all corners, where that is large
    steps: int
    fixed: frozenset[str] = frozenset()  # cameras that were not to be moved


def adjust_rig(
    rig: RigEstimate,
    cameras: Sequence[Camera],
    detections: Detections,
    geometry: Mapping[int, Array],
    *,
    moving: bool,
    fixed: Collection[str] = (),
    shape_unknown: bool = False,
) -> JointRig:
    """Adjust all placed cameras and all poses of the target together.

    Args:
        rig: The start: an average of single views.
        cameras: All cameras of the recording.
        detections: What they saw; frames without a pose of the target in ``rig`` are left out.
        geometry: Marker id -> (k, 3) points [m], target frame.
        moving: Whether the target has a pose of its own in every frame.
        fixed: Cameras that stay where ``rig`` puts them, to the bit.
        shape_unknown: Whether the geometry was estimated from the same views: the covariance then contains that.

    Returns:
        The cameras that views are left of, and why others are lost; of a moved target, the frames used.

    Raises:
        CalibrationError: The views contradict each other so much that no two cameras are left.
    """
    sightings, start, gauge = prepared(rig, cameras, detections, geometry, moving=moving, fixed=fixed)
    found = adjust_explaining(sightings, start, gauge)
    judged, covariance = found.judged, found.judged.adjustment.covariance
    if shape_unknown and judged.kept.any():
        kept = found.sightings.only_views(judged.kept)
        covariance = refine_target(kept, judged.adjustment.poses, judged.gauge, geometry).covariance
    covariance = covariance + found.shift_covariance
    judged = replace(judged, adjustment=replace(judged.adjustment, covariance=covariance))
    result = _result(rig, found.sightings, judged, moving)
    return replace(result, corners=found.errors, fixed=frozenset(fixed))


def prepared(
    rig: RigEstimate,
    cameras: Sequence[Camera],
    detections: Detections,
    geometry: Mapping[int, Array],
    *,
    moving: bool,
    fixed: Collection[str] = (),
) -> tuple[Sightings, Poses, Gauge]:
    """What is adjusted, from where on, and what carries the world; see adjust_rig for the arguments."""
    placed = [camera for camera in cameras if camera.name in rig.cameras]
    used = _moved(rig, detections) if moving else _resting(rig, detections)
    sightings = gather(placed, used, geometry)
    start = Poses(
        np.array([rig.cameras[camera.name].T_world_cam for camera in placed]),
        np.array([rig.T_world_target[frame] for frame in sightings.frames]),
    )
    held = np.array([camera.name in fixed for camera in placed], dtype=bool)
    gauge = Gauge(held, np.array([frame == rig.world_frame and not held.any() for frame in sightings.frames]))
    return sightings, start, gauge


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
    kept, rejected = _frames_of(sightings, judged.kept), _frames_of(sightings, ~judged.kept)
    lost = {name: _why_lost(sightings, judged, c) for c, name in enumerate(names) if not kept[name]}
    if len(lost) == len(names) or (moving and len(lost) == len(names) - 1 > 0):
        reasons = "; ".join(f"{name}: {reason}" for name, reason in lost.items())
        raise CalibrationError(f"The views contradict each other. {reasons}.")
    world_frame, T_new_world = _world(rig, sightings, judged)
    cameras: dict[str, Placement] = {
        name: replace(
            rig.cameras[name],
            T_world_cam=T_new_world @ adjustment.poses.T_world_cam[c],
            frames=kept[name] if moving else rig.cameras[name].frames,
        )
        for c, name in enumerate(names)
        if name not in lost
    }
    used = {sightings.frames[f] for f in sightings.view_frame[judged.kept]}
    targets = {
        frame: T_new_world @ T for frame, T in zip(sightings.frames, adjustment.poses.T_world_target) if frame in used
    }
    blocks = adjustment.covariance.reshape(len(names), 6, len(names), 6)
    return JointRig(
        rig=replace(
            rig,
            cameras=cameras,
            lost={**rig.lost, **lost},
            T_world_target=targets if moving else dict.fromkeys(rig.T_world_target, targets[rig.world_frame]),
            world_frame=world_frame,
        ),
        covariance={name: carried(blocks[c, :, c], T_new_world) for c, name in enumerate(names) if name not in lost},
        common={
            (names[i], names[j]): carried(blocks[i, :, j], T_new_world)
            for i, j in permutations(range(len(names)), 2)
            if not {names[i], names[j]} & lost.keys()
        },
        scale=adjustment.scale,
        corners=CornerErrors(),
        rejected={name: frames for name, frames in rejected.items() if frames and name not in lost},
        odd_markers=_odd_markers(sightings, judged),
        steps=adjustment.steps,
    )


def _frames_of(sightings: Sightings, views: NDArray[np.bool_]) -> dict[str, tuple[int, ...]]:
    return {
        camera.name: tuple(sightings.frames[f] for f in sightings.view_frame[(sightings.view_camera == c) & views])
        for c, camera in enumerate(sightings.cameras)
    }


def _why_lost(sightings: Sightings, judged: Judged, camera: int) -> str:
    mine = sightings.view_camera == camera
    fits = judged.fits
    nothing_held = Gauge(np.zeros(len(sightings.cameras), dtype=bool), judged.gauge.fixed_frames)
    if confirmed(sightings, fits, nothing_held)[mine].any():
        return "the views of it that fit are connected with no other camera: put the target where two cameras see it"
    seen_by = np.bincount(sightings.view_frame, minlength=len(sightings.frames))
    shared = mine & (seen_by > 1)[sightings.view_frame]
    asked = shared if shared.any() else mine
    off = float(np.median(judged.view_median[asked])) if asked.any() else np.inf
    return (
        f"{int(fits[asked].sum()) or 'none'} of its {int(asked.sum())} views in frames of other cameras fits them and "
        f"the marker map (corners typically {off:.0f} times as far off as usual): check its intrinsics, its clock, and "
        "that the target rested"
    )


def _world(rig: RigEstimate, sightings: Sightings, judged: Judged) -> tuple[int, Pose]:
    """The frame whose target carries the world, and the way there from the world of the adjustment."""
    if not judged.gauge.fixed_frames.any():
        return rig.world_frame, np.eye(4)
    f = int(np.argmax(judged.gauge.fixed_frames))
    T_world_target = judged.adjustment.poses.T_world_target[f]
    if (T_world_target == rig.T_world_target[rig.world_frame]).all():
        return rig.world_frame, np.eye(4)
    return sightings.frames[f], invert_transform(T_world_target)


def _odd_markers(sightings: Sightings, judged: Judged) -> dict[int, float]:
    """Markers whose median corner is far off, in views that belong: those kept, and those that one marker spoils."""
    distance = np.linalg.norm(residuals(sightings, judged.adjustment.poses), axis=1)
    distance = np.nan_to_num(distance, nan=np.inf)
    view, marker = sightings.corner_view, sightings.marker
    usual = float(np.median(distance[judged.kept[view]]))
    belongs = judged.kept.copy()
    for v in np.flatnonzero(~judged.kept):
        mine = slice(int(sightings.start[v]), int(sightings.start[v + 1]))
        medians = [np.median(distance[mine][marker[mine] == m]) for m in np.unique(marker[mine])]
        belongs[v] = min(medians) <= MAX_VIEW_MEDIAN * usual
    counted = belongs[view]
    ratios = {
        int(m): float(np.median(distance[counted & (marker == m)])) / max(usual, 1e-9)
        for m in np.unique(marker[counted])
    }
    return {m: ratio for m, ratio in ratios.items() if ratio > MAX_MARKER_MEDIAN}
