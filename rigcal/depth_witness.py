"""What the rig's own depth says about a solved rig, and what it corrects.

Owns      the order: compare depth with the target, correct poses and depth by it if that is wished, compare again.
Leaves    sampling to depth_samples, the comparison to aruco.depth_verify, the correction to depth_refining.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from loguru import logger

from aruco.camera_depth import CameraDepth
from aruco.depth_bias import DepthBias, bias_from_dict
from aruco.depth_patches import FaceDepth
from aruco.depth_verify import DepthAgreement, verify_depth
from aruco.pose_math import Array
from aruco.rig_estimate import RigEstimate
from rigcal.depth_refining import DepthRefinement, refine_with_depth
from rigcal.depth_samples import depth_cameras, face_depths
from rigcal.evidence import Evidence
from rigcal.kept import KeptRig
from rigcal.solve.joint import JointRig

Faces = Mapping[str, Sequence[FaceDepth]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthTestimony:
    """What was found, and the rig after it."""

    rig: RigEstimate
    covariance: Mapping[str, Array] = field(default_factory=dict)  # of cameras that were corrected
    agreement: Mapping[str, DepthAgreement] = field(default_factory=dict)  # of depth with the rig as it was
    corrected: Mapping[str, DepthAgreement] = field(default_factory=dict)  # after a correction of poses or depth
    notes: Mapping[str, Any] = field(default_factory=dict)  # entries of _meta


def hear_depth(
    average: RigEstimate, rig: RigEstimate, joint: JointRig | None, evidence: Evidence, kept: KeptRig
) -> DepthTestimony:
    """Compare the rig with its depth, and correct it if that is wished and proves better.

    Args:
        average: Where the adjustment started.
        rig: The solved rig.
        joint: Its adjustment, maybe with cameras that the rig refuses; None where the average was kept, which is not
            corrected.
        evidence: With pooled depth.
        kept: Cameras that stay, with the biases that their file knows.
    """
    wish = evidence.config.depth
    if not wish.verify or not evidence.pooled:
        return DepthTestimony(rig=rig)
    known = {n: bias_from_dict(b, f"{kept.file}: camera {n}") for n, b in kept.meta.get("depth_bias", {}).items()}
    faces = face_depths(evidence, rig, evidence.pooled)
    before = _agreement(faces, rig, evidence, known)
    if not wish.refine or joint is None:
        return DepthTestimony(rig=rig, agreement=before, notes={"depth_verified": _told(before)})
    refined = refine_with_depth(
        average,
        replace(joint, rig=rig),
        evidence,
        {name: _unbiased(of_camera, known.get(name)) for name, of_camera in faces.items()},
        {name: _pooled_unbiased(depth, known.get(name)) for name, depth in evidence.pooled.items()},
        known=known,
        model=wish.model,
        baseline_m=wish.baseline_m,
        max_rotation_deg=wish.max_rotation_deg,
        max_translation_m=wish.max_translation_m,
    )
    notes = {"depth_verified": _told(before), "depth_refined": refined.as_dict()}
    for name, why in refined.left_out.items():
        logger.warning("camera {}: {}", name, why)
    if not refined.accepted:
        logger.warning("depth corrects nothing: {}", refined.reason)
        return DepthTestimony(rig=rig, agreement=before, notes=notes)
    if not refined.poses_accepted:
        logger.warning("depth moves no pose: {}", refined.reason)
    moved = _corrected(rig, refined) if refined.poses_accepted else rig
    found = {name: bias for name, bias in sorted(refined.biases.items()) if name not in known}
    biases = {**found, **known}
    after = _agreement(faces, moved, evidence, biases)
    notes["depth_refined"]["verified"] = _told(after)
    notes["depth_bias"] = {name: bias.as_dict() for name, bias in found.items()}
    return DepthTestimony(rig=moved, covariance=refined.covariance, agreement=before, corrected=after, notes=notes)


def _unbiased(faces: Sequence[FaceDepth], bias: DepthBias | None) -> list[FaceDepth]:
    """Faces without a bias that an earlier calibration knows."""
    if bias is None:
        return list(faces)
    return [
        replace(face, measured_m=bias.corrected(face.measured_m), corner_depth_m=bias.corrected(face.corner_depth_m))
        for face in faces
    ]


def _pooled_unbiased(depth: CameraDepth, bias: DepthBias | None) -> CameraDepth:
    """Pooled depth likewise."""
    return depth if bias is None else replace(depth, depth=bias.corrected(depth.depth).astype(np.float32))


def _agreement(
    faces: Faces, rig: RigEstimate, evidence: Evidence, biases: Mapping[str, DepthBias]
) -> dict[str, DepthAgreement]:
    return verify_depth(faces, rig, depth_cameras(evidence), biases)


def _told(agreement: Mapping[str, DepthAgreement]) -> dict[str, Any]:
    return {name: of_camera.as_dict() for name, of_camera in sorted(agreement.items())}


def _corrected(rig: RigEstimate, refined: DepthRefinement) -> RigEstimate:
    """The rig with the poses that depth has corrected."""
    cameras = {n: replace(p, T_world_cam=refined.T_world_cam.get(n, p.T_world_cam)) for n, p in rig.cameras.items()}
    return replace(rig, cameras=cameras, T_world_target={**rig.T_world_target, **refined.T_world_target})
