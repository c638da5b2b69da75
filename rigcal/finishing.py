"""From the averaged rig to the finished poses of one connected part.

Owns      adjusting, refusing what does not fit, turning upright, the verdict, what is said of every camera.
Leaves    each of these to its room; which parts there are, and what all of them share, to pipeline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from loguru import logger

from aruco import alignment
from aruco.errors import CalibrationError
from aruco.gravity import UpByAccelerometers
from aruco.marker_geometry import Face
from aruco.model import Calibration, CameraPose
from aruco.moved_alignment import find_up_moved
from aruco.pose_math import Pose, make_pose
from aruco.reprojection import Reprojection, reproject
from aruco.rig_estimate import RigEstimate
from aruco.uncertainty import camera_sigma, carried, least_known
from rigcal import diagnosis, notes
from rigcal.config import AlignConfig
from rigcal.depth_scale import scale_from_depth
from rigcal.depth_witness import DepthTestimony, hear_depth
from rigcal.detecting import Seen
from rigcal.evidence import Evidence
from rigcal.gravity_witness import GravityTestimony, beside_world, hear_gravity, require_upright, trusted_up
from rigcal.kept import KeptRig
from rigcal.kept_check import NOTHING_COMPARED, KeptCheck
from rigcal.listeners import NOBODY, Listeners
from rigcal.placing import adjust_placed
from rigcal.quality.gates import Quality
from rigcal.solve.joint import JointRig
from rigcal.validation import validate
from rigcal.verdict import depth_below_target, quality_of


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Solved:
    """A part whose cameras fit, and how well."""

    rig: RigEstimate
    joint: JointRig | None  # None: the average was kept
    residuals: Mapping[str, Reprojection]  # also of cameras that were refused for them


def finish(
    average: RigEstimate,
    evidence: Evidence,
    kept: KeptRig,
    check: KeptCheck = NOTHING_COMPARED,
    listeners: Listeners = NOBODY,
) -> Calibration:
    """One connected part of the rig: adjusted, checked, turned upright if that is wished.

    Args:
        average: Where it starts.
        evidence: What was seen.
        kept: Cameras that stay, if the part is in their world.
        check: What was found out about them.
        listeners: Are told how depth agrees with it.

    Raises:
        CalibrationError: The views contradict each other, no kept camera fits, or up is ambiguous.
    """
    config, faces = evidence.config, evidence.target.faces
    solved = _solve(average, evidence, kept)
    depth = hear_depth(average, solved.rig, solved.joint, evidence, kept)
    listeners.agreement(depth.agreement, depth.corrected)
    solved = _corrected(solved, depth, evidence)
    heard = hear_gravity(evidence.recording, solved.rig)
    T_aligned_world, about = align(solved.rig, faces, config.align, moving=config.target_moves, heard=heard)
    gravity = None if heard is None else beside_world(heard, T_aligned_world[:3, :3], config.align, kept.up)
    about.update(depth.notes)
    if gravity is not None:
        about["accelerometers"] = gravity.as_dict()
    rig = solved.rig.turned(T_aligned_world[:3, :3])
    if solved.joint is not None:
        about["adjusted"] = notes.adjustment(solved.joint)
        told = replace(solved.joint, rig=replace(solved.joint.rig, lost=rig.lost))
        guess = bool(about.get("aligned", {}).get("is_guess", False))
        about["quality"] = assess(average, told, rig, evidence, check, up_is_guess=guess, gravity=gravity).as_dict()
    stale = {name: check.doubtful.get(name, why) for name, why in _no_longer_fitting(average, rig, kept).items()}
    for name, why in stale.items():
        logger.warning("camera {} keeps its pose, but took no part: {}", name, why)
    return Calibration(
        cameras=_camera_poses(replace(solved, rig=rig), evidence, T_aligned_world, kept),
        lost={name: reason for name, reason in rig.lost.items() if name not in stale},
        up=config.align.up_axis if config.align.enabled else kept.up,
        origin=kept.origin,
        frames={name: evidence.seen[name].counts for name in rig.cameras},
        notes=about,
        idle=stale,
        stale=frozenset(stale),
    )


def _solve(average: RigEstimate, evidence: Evidence, kept: KeptRig) -> _Solved:
    config, fixed = evidence.config, kept.T_world_cam.keys()
    joint = adjust_placed(average, evidence, kept) if config.joint else None
    rig = average if joint is None else joint.rig
    residuals = _reprojected(rig, joint, evidence)
    rig = diagnosis.refuse_misfits(rig, residuals, evidence)
    if fixed and not fixed & rig.cameras.keys():
        reasons = "; ".join(f"camera {name}: {rig.lost[name]}" for name in sorted(fixed & rig.lost.keys()))
        raise CalibrationError(
            f"No camera of {kept.file} fits where that puts it, so nothing ties the others to its world. {reasons}."
        )
    return _Solved(rig=rig, joint=joint, residuals=residuals)


def _reprojected(rig: RigEstimate, joint: JointRig | None, evidence: Evidence) -> dict[str, Reprojection]:
    """How far each camera's corners are from where the rig puts them."""
    seen = evidence.detections if joint is None else joint.corners.taken_out_of(evidence.detections)
    used = {name: {f: seen[name][f] for f in p.frames} for name, p in rig.cameras.items()}
    return reproject({camera.name: camera for camera in evidence.cameras}, rig, used, evidence.target.geometry)


def _corrected(solved: _Solved, depth: DepthTestimony, evidence: Evidence) -> _Solved:
    """The part as depth has corrected it, or as it was."""
    if depth.rig is solved.rig or solved.joint is None:
        return solved
    before = solved.joint
    corrected = replace(
        before.rig,
        cameras={**before.rig.cameras, **depth.rig.cameras},
        T_world_target={**before.rig.T_world_target, **depth.rig.T_world_target},
    )
    joint = replace(before, rig=corrected, covariance={**before.covariance, **depth.covariance})
    residuals = {**solved.residuals, **_reprojected(depth.rig, joint, evidence)}
    return _Solved(rig=depth.rig, joint=joint, residuals=residuals)


def _no_longer_fitting(average: RigEstimate, rig: RigEstimate, kept: KeptRig) -> dict[str, str]:
    """Kept cameras that views place, but not where they are kept."""
    return {name: rig.lost[name] for name in sorted(kept.T_world_cam) if name in rig.lost and name not in average.lost}


def assess(
    average: RigEstimate,
    joint: JointRig,
    rig: RigEstimate,
    evidence: Evidence,
    check: KeptCheck,
    *,
    up_is_guess: bool = False,
    gravity: GravityTestimony | None = None,
) -> Quality:
    """The verdict, from what was held out; ``rig`` is the finished one, in its upright world if it has one."""
    config, geometry = evidence.config, evidence.target.geometry
    seen = evidence.detections
    validation = validate(
        average, joint, evidence.cameras, seen, geometry, moving=config.target_moves, times_s=_times_s(evidence)
    )
    up = (0, 1 if config.align.up_axis == "+y" else -1, 0)
    below = depth_below_target(rig, geometry, up=up) if config.align.enabled else None
    depth = scale_from_depth(evidence, rig)
    return quality_of(
        validation,
        below_target_m=below,
        kept=check,
        depth_scale=depth,
        up_is_guess=up_is_guess,
        up_by_imu=config.align.up_from == "imu",
        gravity=gravity,
        target_estimated=config.refine_target,
    )


def _times_s(evidence: Evidence) -> dict[int, float] | None:
    """When each frame was taken, since the first; None for stretches in which the target rests."""
    if evidence.config.still:
        return None
    stamps = {
        f: evidence.moments.stamp_ns(evidence.recording, name, f)
        for name, seen in evidence.seen.items()
        for f in seen.detections
    }
    first = min(stamps.values(), default=0)
    return {f: 1e-9 * (stamp - first) for f, stamp in stamps.items()}


def align(
    rig: RigEstimate,
    faces: Sequence[Face],
    config: AlignConfig,
    *,
    moving: bool,
    heard: UpByAccelerometers | None = None,
) -> tuple[Pose, dict[str, Any]]:
    """The turn T_aligned_world into an upright world, and what to note about it; the identity unless asked for."""
    if not config.enabled:
        return np.eye(4), {}
    T_world_cam = {name: placement.T_world_cam for name, placement in rig.cameras.items()}
    if config.up_from == "imu":
        up_world = trusted_up(heard)
        require_upright(T_world_cam, up_world)
        aligned = alignment.turn_upright(T_world_cam, up_world, up_axis=config.up_axis)
        note: dict[str, Any] = {"up_from": "imu", "is_guess": False}
    else:
        decision = _up_of_target(rig, T_world_cam, faces, config, moving=moving, heard=heard)
        aligned = alignment.align_world(T_world_cam, decision, up_axis=config.up_axis)
        note = {
            "up_from": "target",
            "ground_face": decision.ground_face,
            "up_in_target": [float(x) for x in decision.up_target],
            "margin": decision.margin,
            "is_guess": decision.is_guess,
        }
    note["camera_up"] = {name: [float(-x) for x in T[:3, 1]] for name, T in aligned.T_world_cam.items()}
    return make_pose(aligned.R_align, np.zeros(3)), {"aligned": note}


def _up_of_target(
    rig: RigEstimate,
    T_world_cam: Mapping[str, Pose],
    faces: Sequence[Face],
    config: AlignConfig,
    *,
    moving: bool,
    heard: UpByAccelerometers | None,
) -> alignment.UpDecision:
    wish = {"ground_face": config.ground_face, "ground_marker_id": config.ground_marker_id}
    try:
        if moving:
            return find_up_moved(T_world_cam, rig.T_world_target, faces, **wish)
        return alignment.find_up(T_world_cam, faces, **wish)
    except CalibrationError as error:
        if heard is None or heard.up_world is None:
            raise
        raise CalibrationError(f"{error} Or take up from the accelerometers with --up-from imu.") from error


def _camera_poses(solved: _Solved, evidence: Evidence, T_aligned_world: Pose, kept: KeptRig) -> tuple[CameraPose, ...]:
    """The finished cameras, in order of their names."""
    rig, joint, residuals = solved.rig, solved.joint, solved.residuals
    seen, config = evidence.seen, evidence.config.align
    up = np.array([0.0, 1.0 if config.up_axis == "+y" else -1.0, 0.0]) if config.enabled else None
    doubtful = [c for c in evidence.cameras if c.name in rig.cameras and diagnosis.is_doubtful(residuals[c.name])]
    faults = {camera.name: diagnosis.intrinsics_fault(camera, evidence) for camera in doubtful}
    known = {} if joint is None else {n: S for n, S in joint.covariance.items() if n not in kept.T_world_cam}
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
            kept=name in kept.T_world_cam,
            warnings=tuple(diagnosis.warnings(placement, residuals[name], seen[name], up, faults.get(name, ""))),
        )
        for name, placement in sorted(rig.cameras.items())
    )


def _least_known(name: str, rig: RigEstimate, covariance: np.ndarray, T_aligned_world: Pose, seen: Seen) -> str:
    """The least observable direction of a camera in words; turns count at the distance of the target."""
    sigma = camera_sigma(carried(covariance, T_aligned_world), rig.cameras[name].T_world_cam)
    reach_m = float(np.median([np.linalg.norm(view.best.T_cam_target[:3, 3]) for view in seen.views]))
    return least_known(name, sigma, reach_m)
