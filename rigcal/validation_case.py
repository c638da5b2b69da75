"""A calibration to be validated: its corners as arrays, and parts of them solved again.

Owns      which views took part, merging those of a target at rest, solving some frames from the optimum on.
Leaves    what to solve and to compare to validation, mathematics to rigcal.solve.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.errors import CalibrationError
from aruco.merged_detection import merge_detections
from aruco.model import Camera, Detection
from aruco.pose_math import Array
from aruco.rig_estimate import RigEstimate
from rigcal.solve.adjust import Adjustment, Gauge, adjust
from rigcal.solve.joint import Detections, JointRig
from rigcal.solve.problem import Poses, Sightings, gather

# camera -> frames
Frames = Mapping[str, Sequence[int]]


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A calibration to be validated, with its corners as arrays."""

    rig: RigEstimate
    joint: JointRig
    cameras: tuple[Camera, ...]  # placed
    detections: Detections
    geometry: Mapping[int, Array]
    moving: bool
    used: Mapping[str, tuple[int, ...]]  # camera -> frames that took part
    sightings: Sightings  # of these; merged to one frame for a target that rests
    poses: Poses  # the optimum

    @property
    def noise_px(self) -> float:
        """Model noise of every corner, beside its sigma."""
        return self.joint.corners.noise_px

    def gauge(self, *, cameras: bool = False) -> Gauge:
        """Cameras that were kept carry the world; else the first of a moved target, the target at rest; or all."""
        kept = np.array([camera.name in self.joint.fixed for camera in self.cameras], dtype=bool)
        resting = not self.moving and not kept.any()
        if not (kept.any() or resting):
            kept[:1] = True
        return Gauge(kept | cameras, np.full(len(self.sightings.frames), resting))


def case_of(
    rig: RigEstimate,
    joint: JointRig,
    cameras: Sequence[Camera],
    detections: Detections,
    geometry: Mapping[int, Array],
    moving: bool,
) -> Case:
    """The corners that made a calibration; see validation.validate for the arguments."""
    placed = tuple(camera for camera in cameras if camera.name in joint.rig.cameras)
    targets = joint.rig.T_world_target
    wrong = {name: set(frames) for name, frames in joint.rejected.items()} if moving else {}
    frames_of = {
        camera.name: detections[camera.name] if moving else joint.rig.cameras[camera.name].frames for camera in placed
    }
    used = {
        name: tuple(
            f for f in sorted(frames) if f in targets and f not in wrong.get(name, ()) and len(detections[name][f])
        )
        for name, frames in frames_of.items()
    }
    chosen = {name: {f: detections[name][f] for f in frames} for name, frames in used.items()}
    sightings = gather(placed, chosen if moving else merged_views(detections, used), geometry, joint.corners.noise_px)
    T_world_cam = np.array([joint.rig.cameras[camera.name].T_world_cam for camera in placed]).reshape(-1, 4, 4)
    T_world_target = np.array([targets[f] if moving else np.eye(4) for f in sightings.frames]).reshape(-1, 4, 4)
    if not moving:
        T_world_target[:] = targets[joint.rig.world_frame]
    poses = Poses(T_world_cam, T_world_target)
    return Case(rig, joint, placed, detections, geometry, moving, used, sightings, poses)


def merged_views(detections: Detections, frames: Frames) -> dict[str, dict[int, Detection]]:
    """All frames of each camera as one."""
    return {name: {0: merge_detections([detections[name][f] for f in mine])} for name, mine in frames.items() if mine}


def solve_part(case: Case, frames: Frames) -> Adjustment | None:
    """The optimum over some frames of every camera; None where they leave a camera undetermined."""
    if case.moving:
        inside = view_mask(case, frames)
        sightings, start = case.sightings.only_views(inside), case.poses
    else:
        merged = merged_views(case.detections, frames)
        sightings, start = gather(case.cameras, merged, case.geometry, case.noise_px), case.poses
    if len(np.unique(sightings.view_camera)) < len(case.cameras):
        return None
    try:
        return adjust(sightings, start, case.gauge())
    except CalibrationError:
        return None


def view_mask(case: Case, frames: Frames) -> NDArray[np.bool_]:
    """The views (v,) of these frames of every camera."""
    sets = [set(frames.get(camera.name, ())) for camera in case.cameras]
    s = case.sightings
    return np.array([s.frames[f] in sets[c] for c, f in zip(s.view_camera, s.view_frame)], dtype=bool)
