"""The story: what happens, in which order, from recordings to poses.

Owns      the order of the steps.
Leaves    every step to the tools in aruco and the rooms of rigcal.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from loguru import logger

from aruco import alignment, moved_target, resting_target
from aruco.errors import CalibrationError
from aruco.marker_geometry import Face, corrected_faces
from aruco.model import SILENT, Calibration, CameraPose, Progress, Recording
from aruco.moved_alignment import find_up_moved
from aruco.pose_math import Pose, make_pose
from aruco.reprojection import Reprojection, reproject
from aruco.rig_estimate import RigEstimate
from aruco.uncertainty import camera_sigma, carried, least_known
from rigcal import diagnosis, notes
from rigcal.config import AlignConfig, CalibrateConfig, Resources
from rigcal.detecting import OnFrame, Seen
from rigcal.evidence import Evidence, at_rest, look
from rigcal.kept import KeptRig, kept_from_file
from rigcal.preview_writer import PreviewWriter
from rigcal.quality.gates import Quality
from rigcal.solve.graph import GraphHealth, graph_health
from rigcal.solve.joint import JointRig, adjust_rig
from rigcal.solve.joint_target import refine_rig_target
from rigcal.sources import open_recordings
from rigcal.target import Target, board_target, marker_target_from_file
from rigcal.validation import validate
from rigcal.verdict import depth_below_target, quality_of

NOTHING_KEPT = KeptRig(T_world_cam={})
# Called with the faces of a target whose map was corrected.
OnTarget = Callable[[Sequence[Face]], object]


def calibrate(
    recording: Recording,
    target: Target,
    config: CalibrateConfig,
    *,
    kept: KeptRig = NOTHING_KEPT,
    resources: Resources | None = None,
    progress: Progress = SILENT,
    on_frame: OnFrame | None = None,
    on_target: OnTarget = lambda faces: None,
) -> Calibration:
    """Every camera's pose in the target's world.

    Args:
        recording: Synchronised or to be synchronised images of one or more cameras.
        target: What stands in them.
        config: What changes the result.
        kept: Cameras that stay where an earlier calibration put them; their world is that of the result.
        resources: What changes only time and memory.
        progress: Is told how far the long steps have come.
        on_frame: Is called with every image that was read, from several threads.
        on_target: Is called with the target's corrected faces, if they were estimated.

    Raises:
        InputError: The recording or an option cannot be used.
        CalibrationError: No camera could be placed, or up is ambiguous.
    """
    jobs = (resources or Resources()).jobs
    evidence = look(recording, target, config, jobs=jobs, progress=progress, on_frame=on_frame)
    diagnosis.require_views(recording, target, config.detect, evidence.seen)
    if config.still:
        evidence = at_rest(evidence)
    health = _connections(evidence)
    refined: dict[str, Any] = {}
    first, *others = place_cameras(evidence, kept)
    if config.refine_target:
        evidence, refined = correct_target(first, evidence, kept)
        on_target(evidence.target.faces)
        first, *others = place_cameras(evidence, kept)
    calibration = finish(first, evidence, kept)
    about = {
        "frames": notes.frame_counts(evidence.seen),
        "sync": notes.clock(evidence.moments),
        **refined,
        **({} if health is None else {"connections": health.as_dict()}),
        "provenance": notes.provenance(evidence, kept),
    }
    return replace(
        calibration,
        lost={**diagnosis.cameras_without_views(recording, evidence.moments.sync, evidence.seen), **calibration.lost},
        frames={name: s.counts for name, s in evidence.seen.items()},
        notes={**calibration.notes, **about},
        parts=tuple(part for rig in others if (part := _other_part(rig, evidence)) is not None),
    )


def calibrate_files(
    paths: Sequence[Path],
    markers: Path | None,
    config: CalibrateConfig,
    *,
    board: str | None = None,
    fix: Path | None = None,
    jobs: int | None = None,
    progress: Progress = SILENT,
    preview: Path | None = None,
    on_target: OnTarget = lambda faces: None,
) -> Calibration:
    """The same, from files: recordings, a marker map or a board, and a folder for previews if they are wished."""
    if board is None:
        assert markers is not None, "the command asks for one of them"
        target = marker_target_from_file(markers, config.detect.dictionary)
    else:
        target = board_target(board)
    if config.align.enabled:
        alignment.specified_face(target.faces, config.align.ground_face, config.align.ground_marker_id)
    kept = NOTHING_KEPT if fix is None else kept_from_file(fix)
    recording = open_recordings(paths)
    on_frame = None if preview is None else PreviewWriter(preview, target.geometry)
    resources = Resources() if jobs is None else Resources(jobs=jobs)
    return calibrate(
        recording,
        target,
        config,
        kept=kept,
        resources=resources,
        progress=progress,
        on_frame=on_frame,
        on_target=on_target,
    )


def _connections(evidence: Evidence) -> GraphHealth | None:
    """Who sees the moved target together with whom, said before anything is solved."""
    if not evidence.config.target_moves or len(evidence.seen) < 2:
        return None
    health = graph_health({name: s.detections.keys() for name, s in evidence.seen.items()})
    logger.info(health.summary)
    if health.suggestion:
        logger.warning(health.suggestion)
    return health


def place_cameras(evidence: Evidence, kept: KeptRig) -> list[RigEstimate]:
    """The rig from averaged views; of a moved target also the parts that nothing connects with the first.

    Raises:
        CalibrationError: No camera could be placed, or a target that should rest was moved.
    """
    views, scale2, known = evidence.views, evidence.scale2, kept.T_world_cam
    diagnosis.require_kept(evidence.recording, evidence.seen, known)
    if evidence.config.target_moves:
        rigs = moved_target.place_parts(views, scale2, known)
    else:
        geometry = evidence.target.geometry
        detections = evidence.detections
        rigs = [resting_target.place_cameras(evidence.cameras, views, detections, geometry, scale2, known)]
    if not rigs[0].cameras:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in rigs[0].lost.items())
        raise CalibrationError(f"No camera could be placed. {reasons}.")
    return rigs


def correct_target(average: RigEstimate, evidence: Evidence, kept: KeptRig) -> tuple[Evidence, dict[str, Any]]:
    """The same evidence on a corrected map of the target, and what to note about it."""
    target, seen = evidence.target, evidence.detections
    moving, fixed = evidence.config.target_moves, kept.T_world_cam.keys()
    found = refine_rig_target(average, evidence.cameras, seen, target.geometry, moving=moving, fixed=fixed)
    corrected = replace(target, geometry=found.geometry, faces=corrected_faces(target.faces, found.geometry))
    note = notes.corrected_target(found, target.geometry)
    for sentence in note["warnings"]:
        logger.warning(sentence)
    return evidence.with_target(corrected), {"target_refined": note}


def finish(average: RigEstimate, evidence: Evidence, kept: KeptRig) -> Calibration:
    """One connected part of the rig: adjusted, checked, turned upright if that is wished.

    Raises:
        CalibrationError: The views contradict each other, or up is ambiguous.
    """
    config, target = evidence.config, evidence.target
    moving, fixed = config.target_moves, kept.T_world_cam.keys()
    joint = None
    if config.joint:
        joint = adjust_rig(
            average,
            evidence.cameras,
            evidence.detections,
            target.geometry,
            moving=moving,
            fixed=fixed,
            shape_unknown=config.refine_target,
        )
    rig = average if joint is None else joint.rig
    seen = evidence.detections if joint is None else joint.corners.taken_out_of(evidence.detections)
    used = {name: {f: seen[name][f] for f in p.frames} for name, p in rig.cameras.items()}
    residuals = reproject({camera.name: camera for camera in evidence.cameras}, rig, used, target.geometry)
    rig = diagnosis.refuse_misfits(rig, residuals, evidence)
    T_aligned_world, about = align(rig, target.faces, config.align, moving=moving)
    rig = rig.turned(T_aligned_world[:3, :3])
    if joint is not None:
        about["adjusted"] = notes.adjustment(joint)
        told = replace(joint, rig=replace(joint.rig, lost=rig.lost))
        about["quality"] = assess(average, told, rig, evidence).as_dict()
    unmoved = kept if fixed & rig.cameras.keys() else NOTHING_KEPT
    for name in fixed & rig.lost.keys():
        logger.warning("camera {} keeps its pose, but took no part: {}", name, rig.lost[name])
    return Calibration(
        cameras=_camera_poses(rig, evidence, residuals, joint, T_aligned_world, unmoved),
        lost={name: reason for name, reason in rig.lost.items() if name not in unmoved.T_world_cam},
        up=config.align.up_axis if config.align.enabled else unmoved.up,
        origin=str(unmoved.world.get("origin", "target")),
        frames={name: evidence.seen[name].counts for name in rig.cameras},
        notes=about,
        unused={name: entry for name, entry in unmoved.entries.items() if name not in rig.cameras},
    )


def _other_part(rig: RigEstimate, evidence: Evidence) -> Calibration | None:
    """A part that nothing connects with the first, in a world of its own; its failure costs the first nothing."""
    try:
        return finish(rig, evidence, NOTHING_KEPT)
    except CalibrationError as error:
        logger.warning("cameras {} could not be placed on their own: {}", ", ".join(rig.cameras), error)
        return None


def assess(average: RigEstimate, joint: JointRig, rig: RigEstimate, evidence: Evidence) -> Quality:
    """The verdict, from what was held out; ``rig`` is the finished one, in its upright world if it has one."""
    config, geometry = evidence.config, evidence.target.geometry
    seen = evidence.detections
    validation = validate(average, joint, evidence.cameras, seen, geometry, moving=config.target_moves)
    up = (0, 1 if config.align.up_axis == "+y" else -1, 0)
    below = depth_below_target(rig, geometry, up=up) if config.align.enabled else None
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


def _camera_poses(
    rig: RigEstimate,
    evidence: Evidence,
    residuals: Mapping[str, Reprojection],
    joint: JointRig | None,
    T_aligned_world: Pose,
    kept: KeptRig,
) -> tuple[CameraPose, ...]:
    """The finished cameras, in order of their names."""
    seen, config = evidence.seen, evidence.config.align
    up = np.array([0.0, 1.0 if config.up_axis == "+y" else -1.0, 0.0]) if config.enabled else None
    unmoved = kept.T_world_cam
    doubtful = [c for c in evidence.cameras if c.name in rig.cameras and diagnosis.is_doubtful(residuals[c.name])]
    faults = {camera.name: diagnosis.intrinsics_fault(camera, evidence) for camera in doubtful}
    known = {} if joint is None else {n: S for n, S in joint.covariance.items() if n not in unmoved}
    return tuple(
        CameraPose(
            camera=name,
            T_world_cam=placement.T_world_cam,
            n_frames=len(placement.frames),
            n_markers=len({i for f in placement.frames for i in seen[name].detections[f].ids.tolist()}),
            rms_px=residuals[name].rms_px,
            spread_m=placement.spread_m,
            spread_rad=placement.spread_rad,
            covariance=carried(known[name], T_aligned_world) if name in known else kept.covariance.get(name),
            least_known=_least_known(name, rig, known[name], T_aligned_world, seen[name]) if name in known else "",
            kept=name in unmoved,
            warnings=tuple(diagnosis.warnings(placement, residuals[name], seen[name], up, faults.get(name, ""))),
        )
        for name, placement in sorted(rig.cameras.items())
    )


def _least_known(name: str, rig: RigEstimate, covariance: np.ndarray, T_aligned_world: Pose, seen: Seen) -> str:
    """The least observable direction of a camera in words; turns count at the distance of the target."""
    sigma = camera_sigma(carried(covariance, T_aligned_world), rig.cameras[name].T_world_cam)
    reach_m = float(np.median([np.linalg.norm(view.best.T_cam_target[:3, 3]) for view in seen.views]))
    return least_known(name, sigma, reach_m)
