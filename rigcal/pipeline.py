"""The stories: what happens, in which order, from recordings to poses.

Owns      the order of the steps, and what to say when one of them cannot go on.
Leaves    every step to the tools in aruco and the rooms of rigcal.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco import alignment, moved_target, resting_target
from aruco.detector import MarkerDetector
from aruco.errors import CalibrationError, InputError
from aruco.marker_geometry import Face, load_faces
from aruco.model import SILENT, Calibration, Camera, CameraPose, Progress, Recording
from aruco.moved_alignment import find_up_moved
from aruco.pose_math import Array, Pose, make_pose
from aruco.reprojection import Reprojection, reproject
from aruco.rig_estimate import Placement, RigEstimate
from aruco.svo_sync import SyncResult, sample, synchronise
from aruco.uncertainty import carried
from aruco.view_pose import variance_factor
from rigcal import diagnosis
from rigcal.config import AlignConfig, CalibrateConfig, FrameConfig, Resources
from rigcal.detecting import OnFrame, Seen, digest_of, watch
from rigcal.preview_writer import PreviewWriter
from rigcal.solve.joint import JointRig, adjust_rig
from rigcal.sources import open_recordings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """What stands in the room: the faces of a marker map, and the hash of the file they came from."""

    faces: Sequence[Face]
    digest: str = ""

    @property
    def geometry(self) -> dict[int, Array]:
        """Marker id -> (4, 3) corners [m]."""
        return {marker: corners for face in self.faces for marker, corners in zip(face.ids, face.corners)}


def calibrate(
    recording: Recording,
    target: Target,
    config: CalibrateConfig,
    *,
    resources: Resources | None = None,
    progress: Progress = SILENT,
    on_frame: OnFrame | None = None,
) -> Calibration:
    """Every camera's pose in the target's world.

    Args:
        recording: Synchronised or to be synchronised images of one or more cameras.
        target: The marker target in them.
        config: What changes the result.
        resources: What changes only time and memory.
        progress: Is told how far the long steps have come.
        on_frame: Is called with every image that was read, from several threads.

    Raises:
        InputError: The recording or an option cannot be used.
        CalibrationError: No camera could be placed, or up is ambiguous.
    """
    jobs = (resources or Resources()).jobs
    sync, groups = choose_frames(recording, config.frames)
    detector = MarkerDetector(config.detect.dictionary, target.geometry)
    seen = watch(
        recording,
        sync,
        groups,
        detector,
        target.geometry,
        min_markers=config.detect.min_markers,
        jobs=jobs,
        progress=progress,
        on_frame=on_frame,
    )
    diagnosis.require_views(recording, target.geometry, config.detect, seen)
    rig = place_cameras(recording.cameras, seen, target.geometry, moving=config.moving_target)
    joint = adjust(rig, recording, seen, target, config) if config.joint else None
    rig = rig if joint is None else joint.rig
    T_aligned_world, aligned = align(rig, target.faces, config.align, moving=config.moving_target)
    rig = rig.turned(T_aligned_world[:3, :3])
    residuals = reproject({c.name: c for c in recording.cameras}, rig, _used_detections(rig, seen), target.geometry)
    return Calibration(
        cameras=tuple(
            _camera_pose(name, rig.cameras[name], residuals[name], seen[name], joint, T_aligned_world)
            for name in rig.cameras
        ),
        lost={**diagnosis.cameras_without_views(recording, sync, seen), **rig.lost},
        up=config.align.up_axis if config.align.enabled else None,
        frames={name: s.counts for name, s in seen.items()},
        notes={**aligned, **_adjustment_note(joint), **_notes(recording, target, config, sync, groups, seen)},
    )


def calibrate_files(
    paths: Sequence[Path],
    markers: Path,
    config: CalibrateConfig,
    *,
    jobs: int | None = None,
    progress: Progress = SILENT,
    preview: Path | None = None,
) -> Calibration:
    """The same, from files: recordings, a marker map, and a folder for previews if they are wished."""
    target = Target(faces=load_faces(markers), digest=hashlib.sha256(markers.read_bytes()).hexdigest())
    MarkerDetector(config.detect.dictionary)  # a wrong name is told before the recordings are searched
    alignment.specified_face(target.faces, config.align.ground_face, config.align.ground_marker_id)
    recording = open_recordings(paths)
    on_frame = None if preview is None else PreviewWriter(preview, target.geometry)
    resources = Resources() if jobs is None else Resources(jobs=jobs)
    return calibrate(recording, target, config, resources=resources, progress=progress, on_frame=on_frame)


def choose_frames(recording: Recording, config: FrameConfig) -> tuple[SyncResult, NDArray[np.int64]]:
    """Which frames belong together, and which of these take part: (n, n_cameras) indices, -1 for none.

    Raises:
        InputError: Cameras have frames, but none of them at the same moment.
    """
    stamps = {camera.name: recording.stamps_ns(camera.name) for camera in recording.cameras}
    tolerance = None if config.sync_tolerance_ms is None else round(1e6 * config.sync_tolerance_ms)
    sync = synchronise(stamps, tolerance_ns=tolerance)
    if not len(sync.groups):
        closest = "" if sync.closest_ns is None else f" (closest: {sync.closest_ns / 1e6:.1f} ms apart)"
        raise InputError(
            f"No two cameras have frames within {sync.tolerance_ns / 1e6:g} ms of each other{closest}: check that the "
            "recordings were made together and on one clock, or raise --sync-tolerance-ms."
        )
    return sync, sample(sync.groups, config.sample_interval, config.max_samples)


def place_cameras(
    cameras: Sequence[Camera], seen: Mapping[str, Seen], geometry: Mapping[int, Array], *, moving: bool
) -> RigEstimate:
    """The rig, from the views of a target that rests or is moved.

    Raises:
        CalibrationError: No camera could be placed, or a target that should rest was moved.
    """
    views = [view for s in seen.values() for view in s.views]
    scale2 = {name: variance_factor(s.views) for name, s in seen.items() if s.views}
    if moving:
        rig = moved_target.place_cameras(views, scale2)
    else:
        detections = {name: s.detections for name, s in seen.items()}
        rig = resting_target.place_cameras(cameras, views, detections, geometry, scale2)
    if not rig.cameras:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in rig.lost.items())
        raise CalibrationError(f"No camera could be placed. {reasons}.")
    return rig


def adjust(
    rig: RigEstimate, recording: Recording, seen: Mapping[str, Seen], target: Target, config: CalibrateConfig
) -> JointRig:
    """All cameras and frames together, from the average on."""
    detections = {name: s.detections for name, s in seen.items()}
    return adjust_rig(rig, recording.cameras, detections, target.geometry, moving=config.moving_target)


def _adjustment_note(joint: JointRig | None) -> dict[str, Any]:
    if joint is None:
        return {}
    note = {
        "residual_scale": joint.scale,
        "rejected_views": {name: list(frames) for name, frames in joint.rejected.items()},
        "odd_markers": {str(marker): ratio for marker, ratio in joint.odd_markers.items()},
    }
    return {"adjusted": note}


def align(rig: RigEstimate, faces: Sequence[Face], config: AlignConfig, *, moving: bool) -> tuple[Pose, dict[str, Any]]:
    """The turn T_aligned_world into an upright world, and what to note about it; the identity unless asked for."""
    if not config.enabled:
        return np.eye(4), {}
    T_world_cam = {name: placement.T_world_cam for name, placement in rig.cameras.items()}
    wish = {"ground_face": config.ground_face, "ground_marker_id": config.ground_marker_id}
    if moving:
        decision = find_up_moved(T_world_cam, rig.T_world_target, faces, **wish)
    else:
        decision = alignment.find_up(T_world_cam, faces, **wish)
    aligned = alignment.align_world(T_world_cam, decision, up_axis=config.up_axis)
    note = {
        "ground_face": decision.ground_face,
        "up_in_target": [float(x) for x in decision.up_target],
        "margin": decision.margin,
        "camera_up": {name: [float(-x) for x in T[:3, 1]] for name, T in aligned.T_world_cam.items()},
    }
    return make_pose(aligned.R_align, np.zeros(3)), {"aligned": note}


def _used_detections(rig: RigEstimate, seen: Mapping[str, Seen]) -> dict[str, dict[int, Any]]:
    return {name: {f: seen[name].detections[f] for f in p.frames} for name, p in rig.cameras.items()}


def _camera_pose(
    name: str,
    placement: Placement,
    residuals: Reprojection,
    seen: Seen,
    joint: JointRig | None,
    T_aligned_world: Pose,
) -> CameraPose:
    return CameraPose(
        camera=name,
        T_world_cam=placement.T_world_cam,
        n_frames=len(placement.frames),
        n_markers=len({i for f in placement.frames for i in seen.detections[f].ids.tolist()}),
        rms_px=residuals.rms_px,
        spread_m=placement.spread_m,
        spread_rad=placement.spread_rad,
        covariance=None if joint is None else carried(joint.covariance[name], T_aligned_world),
        warnings=tuple(diagnosis.warnings(placement, residuals, seen)),
    )


def _notes(
    recording: Recording,
    target: Target,
    config: CalibrateConfig,
    sync: SyncResult,
    groups: NDArray[np.int64],
    seen: Mapping[str, Seen],
) -> dict[str, Any]:
    from rigcal import __version__

    frames = {
        name: {
            "recorded": s.counts.recorded,
            "unpaired": s.counts.unpaired,
            "read": s.counts.read,
            "unreadable": s.counts.bad,
            "with_markers": s.counts.with_markers,
        }
        for name, s in seen.items()
    }
    clock = {
        "tolerance_ms": sync.tolerance_ns / 1e6,
        "groups": len(sync.groups),
        "used": len(groups),
        "median_skew_ms": sync.median_span_ns / 1e6,
        "worst_skew_ms": sync.worst_span_ns / 1e6,
    }
    inputs = {camera.name: digest_of(seen[camera.name], camera) for camera in recording.cameras}
    provenance = {
        "rigcal": __version__,
        "options": config.as_dict(),
        "inputs_sha256": {"marker_map": target.digest, "cameras": inputs},
    }
    return {"frames": frames, "sync": clock, "provenance": provenance}
