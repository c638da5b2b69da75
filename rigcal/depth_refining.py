"""The rig's depth and its markers in one estimate: from what was recorded to the refined rig.

Owns      gathering markers, depth and floor for aruco.depth_refine, and putting the result back.
Leaves    the estimate and whether it is believed to aruco.depth_refine, the markers' equations to marker_equations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from loguru import logger

from aruco import alignment
from aruco.camera_depth import CameraDepth
from aruco.depth_bias import DepthBias, DepthModel
from aruco.depth_fusion import DepthSensor
from aruco.depth_noise import DEFAULT_FOCAL_BASELINE, DepthNoise, bias_prior
from aruco.depth_patches import FaceDepth
from aruco.depth_pool import WORST_CONFIDENCE, mask_edges, mask_grazing
from aruco.depth_refine import DepthRefinement, kept_as_it_was, refine
from aruco.depth_tiles import Tiles, face_tiles, floor_tiles, joined
from aruco.errors import CalibrationError, InputError
from aruco.model import Camera
from aruco.moved_alignment import find_up_moved
from aruco.pose_math import Array, invert_transform
from aruco.rig_estimate import RigEstimate
from aruco.shared_floor import STRIDE_PX, DepthView, find_shared_floor, floor_pixels
from rigcal.evidence import Evidence
from rigcal.marker_equations import Markers, camera_covariance, marker_equations
from rigcal.solve.joint import JointRig
from rigcal.validation_case import Case, case_of

__all__ = ["DepthRefinement", "refine_with_depth"]

# A bias without a standard deviation was estimated to about a tenth of what is usual.
KNOWN_SHARE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Eye:
    """One camera's depth image."""

    K: Array
    noise: DepthNoise
    sensor: DepthSensor


def refine_with_depth(
    average: RigEstimate,
    joint: JointRig,
    evidence: Evidence,
    faces: Mapping[str, Sequence[FaceDepth]],
    pooled: Mapping[str, CameraDepth],
    *,
    model: DepthModel = "stereo",
    baseline_m: float | None = None,
    max_rotation_deg: float = 5.0,
    max_translation_m: float = 0.1,
    known: Mapping[str, DepthBias] | None = None,
) -> DepthRefinement:
    """Correct an adjusted rig with its depth, and estimate every camera's depth bias.

    Args:
        average: Where the adjustment started.
        joint: The adjusted rig, with the cameras that are to take part; the result is in its world.
        evidence: What was seen.
        faces: Camera -> depth on the target.
        pooled: Camera -> its depth over time, for the floor; may be empty.
        model: Of the bias.
        baseline_m: Of cameras whose recording does not say.
        max_rotation_deg: If any camera were turned farther, no pose is moved.
        max_translation_m: Likewise.
        known: Biases of cameras that an earlier calibration knows; their depth comes without them.

    Returns:
        The correction, or the poses given and why; either way with the poses of all targets of the rig.
    """
    case, world = _case(average, joint, evidence)
    kept = _measured_frames(case, joint.rig, faces)
    markers, halves = marker_equations(case, kept, world, _beyond(case, joint, evidence, world))
    named = _frames_named(markers, joint.rig, case)
    eyes = {c.name: _eye(c, model, baseline_m, (known or {}).get(c.name)) for c in case.cameras}
    views = {name: _view(pooled[name], eyes[name], joint.rig, name) for name in eyes if name in pooled}
    floor = _floor(views, joint.rig, evidence)
    tiles = _tiles(named, faces, views, eyes, floor, pooled, joint.rig)
    equations = replace(markers.equations, targets=named)
    halves = [replace(half, train=replace(half.train, targets=named)) for half in halves]
    if not len(tiles):
        found = kept_as_it_was(equations, "no camera has depth on the target or on a floor")
    else:
        found = refine(
            equations,
            halves,
            tiles,
            {name: eye.sensor for name, eye in eyes.items()},
            floor,
            max_rotation_deg=max_rotation_deg,
            max_translation_m=max_translation_m,
        )
    logger.info("depth corrects {}: {}", _corrects(found), found.reason)
    for name, finding in found.findings.items():
        logger.info("camera {}: {}", name, finding)
    return replace(found, T_world_target=_all_targets(found, markers, joint.rig, case))


def _corrects(found: DepthRefinement) -> str:
    if found.poses_accepted:
        return "the poses"
    return "its biases, not the poses" if found.bias_accepted else "nothing"


def _case(average: RigEstimate, joint: JointRig, evidence: Evidence) -> tuple[Case, int | None]:
    """The corners as the adjustment had them, and the index of the frame that carries the world."""
    config = evidence.config
    detections = joint.corners.taken_out_of(evidence.detections)
    case = case_of(average, joint, evidence.cameras, detections, evidence.target.geometry, moving=config.target_moves)
    if joint.fixed:
        return case, None
    if not case.moving:
        return case, 0
    frames, world = case.sightings.frames, joint.rig.world_frame
    # Cameras that take no part may have been the only ones to see it; any other frame carries the world as well.
    return case, frames.index(world) if world in frames else 0


def _measured_frames(case: Case, rig: RigEstimate, faces: Mapping[str, Sequence[FaceDepth]]) -> list[int]:
    """Indices of the frames in which depth measures the target."""
    if not case.moving:
        return [0]
    number = {frame: k for k, frame in enumerate(case.sightings.frames)}
    asked = {face.frame for of_camera in faces.values() for face in of_camera}
    return sorted(number[frame] for frame in asked if frame in number and frame in rig.T_world_target)


def _frames_named(markers: Markers, rig: RigEstimate, case: Case) -> tuple[int, ...]:
    """The frames of the unknown targets as the rig calls them: corners of a target at rest are one frame."""
    return markers.equations.targets if case.moving else (rig.world_frame,)


def _beyond(case: Case, joint: JointRig, evidence: Evidence, world: int | None) -> Array | None:
    """What the adjustment's covariance contains beyond corners and edges: a map that was estimated too."""
    if not evidence.config.refine_target:
        return None
    names = [camera.name for camera in case.cameras]
    plain = camera_covariance(marker_equations(case, [], world)[0].equations)
    rows = [[joint.covariance[a] if a == b else joint.common[a, b] for b in names] for a in names]
    return np.block(rows) - plain


def _eye(camera: Camera, model: DepthModel, baseline_m: float | None, known: DepthBias | None) -> _Eye:
    K, B = camera.K_depth, camera.baseline_m or baseline_m
    fB = float(K[0, 0]) * B if B and model == "stereo" else None
    prior = bias_prior(fB, model)
    if known is not None:
        # What is left of a known bias is what was not known of it.
        prior = KNOWN_SHARE**2 * prior if known.covariance is None or known.model != model else known.covariance
    sensor = DepthSensor(model=model, focal_baseline=fB, prior=prior, lean_unit=1.0 / (fB or DEFAULT_FOCAL_BASELINE))
    return _Eye(K=K, noise=DepthNoise(focal_baseline=fB), sensor=sensor)


def _view(depth: CameraDepth, eye: _Eye, rig: RigEstimate, name: str) -> DepthView:
    """A camera's pooled depth without edges, grazing surfaces, and what it does not trust itself."""
    fB = eye.noise.focal_baseline
    bad = mask_edges(depth.depth, focal_baseline=fB) | mask_grazing(depth.depth, eye.K)
    if depth.confidence is not None:
        bad |= depth.confidence > WORST_CONFIDENCE
    return DepthView(
        depth_m=np.where(bad, np.nan, depth.depth),
        K=eye.K,
        T_world_cam=rig.cameras[name].T_world_cam,
        noise=eye.noise,
        bias_prior=eye.sensor.prior,
        model=DepthBias(model=eye.sensor.model),
    )


def _floor(views: Mapping[str, DepthView], rig: RigEstimate, evidence: Evidence) -> tuple[Array, float] | None:
    """A level surface that cameras see; None where nobody knows for sure which way is up."""
    if not views:
        return None
    up = _up(rig, evidence)
    floor = None if up is None else find_shared_floor(list(views.values()), up)
    if floor is None:
        logger.info("depth of a floor takes no part: {}", "up is not known" if up is None else "none is seen")
    return floor


def _up(rig: RigEstimate, evidence: Evidence) -> Array | None:
    """Away from gravity, world, as the target lies; None where that is a guess."""
    T_world_cam = {name: placement.T_world_cam for name, placement in rig.cameras.items()}
    wish = {
        "ground_face": evidence.config.align.ground_face,
        "ground_marker_id": evidence.config.align.ground_marker_id,
    }
    faces = evidence.target.faces
    try:
        if evidence.config.target_moves:
            decision, R_world = find_up_moved(T_world_cam, rig.T_world_target, faces, **wish), np.eye(3)
        else:
            T_world_target = rig.T_world_target[rig.world_frame]
            T_target_cam = {name: invert_transform(T_world_target) @ T for name, T in T_world_cam.items()}
            decision, R_world = alignment.find_up(T_target_cam, faces, **wish), T_world_target[:3, :3]
    except (CalibrationError, InputError) as error:
        logger.debug("up is not known: {}", error)
        return None
    return None if decision.is_guess else R_world @ decision.up_target


def _tiles(
    frames: Sequence[int],
    faces: Mapping[str, Sequence[FaceDepth]],
    views: Mapping[str, DepthView],
    eyes: Mapping[str, _Eye],
    floor: tuple[Array, float] | None,
    pooled: Mapping[str, CameraDepth],
    rig: RigEstimate,
) -> Tiles:
    parts: list[Tiles] = []
    for c, (name, eye) in enumerate(eyes.items()):
        T_cam_world = invert_transform(rig.cameras[name].T_world_cam)
        T_cam_target = [T_cam_world @ rig.T_world_target[f] for f in frames]
        parts.append(face_tiles(faces.get(name, ()), c, frames, T_cam_target, eye.K, eye.noise))
        if floor is not None and name in views:
            pixels, measured_m = floor_pixels(views[name], floor)
            T, n = rig.cameras[name].T_world_cam, _averaged(pooled[name])
            parts.append(floor_tiles(pixels, measured_m, c, floor, T, eye.K, eye.noise, n_averaged=n, stride=STRIDE_PX))
    return joined(parts)


def _averaged(depth: CameraDepth) -> float:
    """How many images a pooled pixel stands for."""
    if depth.count is None:
        return float(max(depth.n_frames, 1))
    counted = depth.count[depth.count > 0]
    return float(np.median(counted)) if counted.size else 1.0


def _all_targets(found: DepthRefinement, markers: Markers, rig: RigEstimate, case: Case) -> dict[int, Array]:
    """The target of every frame of the rig, moved with the cameras that saw it."""
    if not found.poses_accepted:
        return dict(rig.T_world_target)
    T_world_cam = np.array([found.T_world_cam[camera.name] for camera in case.cameras])
    T_kept = np.array(list(found.T_world_target.values())).reshape(-1, 4, 4)
    moved = markers.targets(T_world_cam, T_kept)
    if not case.moving:
        one: Array = moved[0]
        return dict.fromkeys(rig.T_world_target, one)
    return {**rig.T_world_target, **dict(zip(case.sightings.frames, moved))}
