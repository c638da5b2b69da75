"""The story: what happens, in which order, from recordings to poses.

Owns      the order of the steps.
Leaves    every step to the tools in aruco and the rooms of rigcal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from aruco import alignment, moved_target, resting_target
from aruco.errors import CalibrationError
from aruco.marker_geometry import Face
from aruco.model import SILENT, Calibration, Camera, CameraPose, Detection, Progress, Recording
from aruco.moved_alignment import find_up_moved
from aruco.pose_math import Array, Pose, make_pose
from aruco.reprojection import Reprojection, reproject
from aruco.rig_estimate import RigEstimate
from aruco.still import merge_stretches, still_stretches
from aruco.uncertainty import camera_sigma, carried, least_known
from aruco.view_pose import solve_view, variance_factor
from rigcal import diagnosis, notes
from rigcal.config import AlignConfig, CalibrateConfig, Resources
from rigcal.detecting import OnFrame, Seen, watch
from rigcal.frames import Moments, each_alone, synchronised
from rigcal.preview_writer import PreviewWriter
from rigcal.quality.gates import Quality
from rigcal.solve.graph import graph_health
from rigcal.solve.joint import JointRig, adjust_rig
from rigcal.sources import open_recordings
from rigcal.target import Target, board_target, marker_target_from_file
from rigcal.validation import validate
from rigcal.verdict import depth_below_target, quality_of


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
        target: What stands in them.
        config: What changes the result.
        resources: What changes only time and memory.
        progress: Is told how far the long steps have come.
        on_frame: Is called with every image that was read, from several threads.

    Raises:
        InputError: The recording or an option cannot be used.
        CalibrationError: No camera could be placed, or up is ambiguous.
    """
    moments = (each_alone if config.still else synchronised)(recording, config.frames)
    jobs = (resources or Resources()).jobs
    seen = watch(
        recording,
        moments,
        target,
        min_markers=config.detect.min_markers,
        jobs=jobs,
        progress=progress,
        on_frame=on_frame,
    )
    diagnosis.require_views(recording, target, config.detect, seen)
    if config.still:
        seen = still_moments(recording, target, moments, seen)
    rig = place_cameras(recording.cameras, seen, target.geometry, moving=config.target_moves)
    average = rig
    joint = adjust(rig, recording, seen, target, config) if config.joint else None
    rig = rig if joint is None else joint.rig
    used = {name: {f: seen[name].detections[f] for f in p.frames} for name, p in rig.cameras.items()}
    residuals = reproject({camera.name: camera for camera in recording.cameras}, rig, used, target.geometry)
    rig = diagnosis.refuse_misfits(rig, residuals, recording.cameras)
    T_aligned_world, aligned = align(rig, target.faces, config.align, moving=config.target_moves)
    rig = rig.turned(T_aligned_world[:3, :3])
    about: dict[str, Any] = {"frames": notes.frame_counts(seen), "sync": notes.clock(moments)}
    if joint is not None:
        about["adjusted"] = notes.adjustment(joint)
        about["quality"] = assess(average, joint, rig, recording, seen, target, config).as_dict()
    if len(seen) > 1 and config.moving_target:
        about["connections"] = graph_health({name: s.detections for name, s in seen.items()}).as_dict()
    return Calibration(
        cameras=_camera_poses(rig, seen, residuals, joint, T_aligned_world, config.align),
        lost={**diagnosis.cameras_without_views(recording, moments.sync, seen), **rig.lost},
        up=config.align.up_axis if config.align.enabled else None,
        frames={name: s.counts for name, s in seen.items()},
        notes={**aligned, **about, "provenance": notes.provenance(recording, target, config, seen)},
    )


def calibrate_files(
    paths: Sequence[Path],
    markers: Path | None,
    config: CalibrateConfig,
    *,
    board: str | None = None,
    jobs: int | None = None,
    progress: Progress = SILENT,
    preview: Path | None = None,
) -> Calibration:
    """The same, from files: recordings, a marker map or a board, and a folder for previews if they are wished."""
    if board is None:
        assert markers is not None, "the command asks for one of them"
        target = marker_target_from_file(markers, config.detect.dictionary)
    else:
        target = board_target(board)
    if config.align.enabled:
        alignment.specified_face(target.faces, config.align.ground_face, config.align.ground_marker_id)
    recording = open_recordings(paths)
    on_frame = None if preview is None else PreviewWriter(preview, target.geometry)
    resources = Resources() if jobs is None else Resources(jobs=jobs)
    return calibrate(recording, target, config, resources=resources, progress=progress, on_frame=on_frame)


def still_moments(recording: Recording, target: Target, moments: Moments, seen: Mapping[str, Seen]) -> dict[str, Seen]:
    """What was seen, with the stretches in which the target rests in the place of single frames.

    Raises:
        CalibrationError: It never rests.
    """
    tracks = {
        name: [(moments.stamp_ns(recording, name, f), detection) for f, detection in sorted(s.detections.items())]
        for name, s in seen.items()
    }
    stretches = still_stretches(tracks)
    if not stretches:
        raise CalibrationError(
            "The target never rests for 0.3 s while a camera sees it: put it down for a moment wherever two cameras "
            "see it, or leave out --still."
        )
    merged = merge_stretches(tracks, stretches)
    models = {camera.name: camera for camera in recording.cameras}
    return {name: _at_stretches(s, models[name], merged[name], target.geometry) for name, s in seen.items()}


def _at_stretches(seen: Seen, camera: Camera, merged: Mapping[int, Detection], geometry: Mapping[int, Array]) -> Seen:
    views = [solve_view(camera, number, detection, geometry) for number, detection in merged.items()]
    return replace(seen, detections=merged, views=tuple(view for view in views if view is not None))


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
    moving = config.target_moves
    return adjust_rig(rig, recording.cameras, detections, target.geometry, moving=moving)


def assess(
    average: RigEstimate,
    joint: JointRig,
    rig: RigEstimate,
    recording: Recording,
    seen: Mapping[str, Seen],
    target: Target,
    config: CalibrateConfig,
) -> Quality:
    """The verdict, from what was held out; ``rig`` is the finished one, in its upright world if it has one."""
    validation = validate(
        average,
        joint,
        recording.cameras,
        {name: s.detections for name, s in seen.items()},
        target.geometry,
        moving=config.target_moves,
    )
    up = (0, 1 if config.align.up_axis == "+y" else -1, 0)
    below = depth_below_target(rig, target.geometry, up=up) if config.align.enabled else None
    return quality_of(validation, below_target_m=below)


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


def _least_known(name: str, joint: JointRig, seen: Seen) -> str:
    """The least observable direction of a camera in words; turns count at the distance of the target."""
    sigma = camera_sigma(joint.covariance[name], joint.rig.cameras[name].T_world_cam)
    reach_m = float(np.median([np.linalg.norm(view.best.T_cam_target[:3, 3]) for view in seen.views]))
    return least_known(name, sigma, reach_m)


def _camera_poses(
    rig: RigEstimate,
    seen: Mapping[str, Seen],
    residuals: Mapping[str, Reprojection],
    joint: JointRig | None,
    T_aligned_world: Pose,
    config: AlignConfig,
) -> tuple[CameraPose, ...]:
    """The finished cameras, in order of their names."""
    up = np.array([0.0, 1.0 if config.up_axis == "+y" else -1.0, 0.0]) if config.enabled else None
    return tuple(
        CameraPose(
            camera=name,
            T_world_cam=placement.T_world_cam,
            n_frames=len(placement.frames),
            n_markers=len({i for f in placement.frames for i in seen[name].detections[f].ids.tolist()}),
            rms_px=residuals[name].rms_px,
            spread_m=placement.spread_m,
            spread_rad=placement.spread_rad,
            covariance=None if joint is None else carried(joint.covariance[name], T_aligned_world),
            least_known="" if joint is None else _least_known(name, joint, seen[name]),
            warnings=tuple(diagnosis.warnings(placement, residuals[name], seen[name], up)),
        )
        for name, placement in sorted(rig.cameras.items())
    )
