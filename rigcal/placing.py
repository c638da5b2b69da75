"""The rig from averaged views: where everything starts.

Owns      which way of averaging a target asks for, correcting the target's map with it, handing both to the adjustment.
Leaves    the averages to aruco, adjusting them to rigcal.solve.
"""

from __future__ import annotations

from dataclasses import replace

from aruco import moved_target, resting_target
from aruco.errors import CalibrationError
from aruco.marker_geometry import corrected_faces
from aruco.rig_estimate import RigEstimate
from rigcal import diagnosis
from rigcal.evidence import Evidence
from rigcal.kept import KeptRig
from rigcal.solve.joint import JointRig, adjust_rig
from rigcal.solve.joint_target import refine_rig_target
from rigcal.solve.target_shape import RefinedTarget


def place_cameras(evidence: Evidence, kept: KeptRig) -> list[RigEstimate]:
    """The rig from averaged views; of a moved target also the parts that nothing connects with the first.

    Returns:
        The part of the kept cameras or the largest, then the others; only the first may be in the kept cameras' world.

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


def place_with_target(evidence: Evidence, kept: KeptRig) -> tuple[Evidence, list[RigEstimate], RefinedTarget | None]:
    """The averaged rig, on a corrected map of the target if that is wished: the evidence then holds it.

    Raises:
        CalibrationError: As place_cameras, or the map cannot be corrected.
    """
    rigs = place_cameras(evidence, kept)
    if not evidence.config.refine_target:
        return evidence, rigs, None
    evidence, found = correct_target(rigs[0], evidence, kept)
    return evidence, place_cameras(evidence, kept), found


def adjust_placed(average: RigEstimate, evidence: Evidence, kept: KeptRig) -> JointRig:
    """An averaged rig adjusted; raises as joint.adjust_rig."""
    config = evidence.config
    return adjust_rig(
        average,
        evidence.cameras,
        evidence.detections,
        evidence.target.geometry,
        moving=config.target_moves,
        fixed=kept.T_world_cam.keys(),
        shape_unknown=config.refine_target,
    )


def correct_target(average: RigEstimate, evidence: Evidence, kept: KeptRig) -> tuple[Evidence, RefinedTarget]:
    """The same evidence on a corrected map of the target, and what was corrected."""
    target, seen = evidence.target, evidence.detections
    moving, fixed = evidence.config.target_moves, kept.T_world_cam.keys()
    found = refine_rig_target(average, evidence.cameras, seen, target.geometry, moving=moving, fixed=fixed)
    corrected = replace(target, geometry=found.geometry, faces=corrected_faces(target.faces, found.geometry))
    return evidence.with_target(corrected), found
