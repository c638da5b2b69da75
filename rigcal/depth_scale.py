"""The scale of the marker map beside the distances that depth cameras measure.

Owns      one ratio of measured to predicted depth a camera, what cameras agree on.
Leaves    sampling depth to depth_samples, limits to rigcal.quality.gates, the sentences to rigcal.verdict.

A map that is wrong by one factor everywhere puts cameras farther away by that factor, and no image shows it. Depth is
the only witness. Every stereo camera has a scale error of its own (about one percent), so cameras are asked one by one
and one that stands alone is named instead of believed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from loguru import logger

from aruco.depth_patches import FaceDepth, typical_ratio
from aruco.model import Camera, Detection, Recording
from aruco.pose_math import Array, invert_transform
from aruco.rig_estimate import RigEstimate
from rigcal.depth_samples import faces_by_frame, frame_images
from rigcal.evidence import Evidence

MIN_SAMPLES = 5  # of all cameras together
MIN_SAMPLES_OF_CAMERA = 2
# Stereo bias of one camera: 0.3 percent, and 0.15 to 0.3 px of disparity, which at 2 to 3 m is about one percent.
CAMERA_SIGMA = 0.01
# Cameras with some bias differ by two or three percent; what is farther off has another reason.
AGREEMENT = 0.05


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRatio:
    """What the depth of one camera says."""

    ratio: float  # median of measured over predicted depth
    spread: float  # robust standard deviation of single samples' ratios
    n_samples: int  # markers in frames


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthScale:
    """How much larger the depth cameras find everything than the marker map makes it."""

    scale: float  # share: 0.05 is five percent larger; NaN where cameras contradict each other
    sigma: float  # its standard error, from the differences of cameras, never below what their bias leaves
    cameras: Mapping[str, CameraRatio]
    odd: tuple[str, ...]  # cameras far off the others, or all when no two agree; not part of ``scale``


def scale_from_depth(evidence: Evidence, rig: RigEstimate) -> DepthScale | None:
    """The scale of a finished rig; see depth_scale. Stretches of rest are no frames, so they tell nothing."""
    if evidence.config.still:
        return None
    images = frame_images(evidence)
    return depth_scale(evidence.recording, rig, evidence.detections, images, evidence.target.geometry)


def depth_scale(
    recording: Recording,
    rig: RigEstimate,
    detections: Mapping[str, Mapping[int, Detection]],
    images: Mapping[str, Mapping[int, int]],
    geometry: Mapping[int, Array],
) -> DepthScale | None:
    """Measured beside predicted depth of the target, in a few frames of every camera.

    Args:
        recording: With depth, or without.
        rig: Poses of cameras and target, and the views that took part.
        detections: Camera -> frame -> corners.
        images: Camera -> frame -> index into the camera's stamps.
        geometry: Marker id -> (k, 3) points [m], target frame.

    Returns:
        The scale, or None where no camera has depth or too little of the target is seen in it.
    """
    cameras: dict[str, CameraRatio] = {}
    for camera in recording.cameras:
        if camera.name in rig.cameras:
            seen, indices = detections[camera.name], images.get(camera.name, {})
            faces = faces_by_frame(recording, camera, rig, seen, indices, geometry)
            found = np.array([_ratio(face, camera, rig) for face in faces])
            ratios = found[np.isfinite(found)]
            if len(ratios) >= MIN_SAMPLES_OF_CAMERA:
                ratio = float(np.median(ratios))
                spread = 1.4826 * float(np.median(np.abs(ratios - ratio)))
                cameras[camera.name] = CameraRatio(ratio=ratio, spread=spread, n_samples=len(ratios))
                logger.debug("camera {}: depth is {:.4f} of the map's in {} samples", camera.name, ratio, len(ratios))
    if sum(c.n_samples for c in cameras.values()) < MIN_SAMPLES:
        return None
    return agreed(cameras)


def agreed(cameras: Mapping[str, CameraRatio]) -> DepthScale:
    """What most cameras say. The map is a witness too: it decides between cameras that stand one against one."""
    logs = np.log([c.ratio for c in cameras.values()])
    together = np.abs(logs - logs[:, None]) <= AGREEMENT
    votes = together.sum(axis=1) + 0.5 * (np.abs(logs) <= AGREEMENT)
    # Of equals the one nearest to the map.
    best = int(np.lexsort((np.abs(logs), -votes))[0])
    agree = np.abs(logs - np.median(logs[together[best]])) <= AGREEMENT
    if len(logs) > 1 and votes[best] <= 1:
        return DepthScale(scale=math.nan, sigma=math.nan, cameras=cameras, odd=tuple(cameras))
    n = int(agree.sum())
    differences = float(np.std(logs[agree], ddof=1)) if n > 1 else 0.0
    return DepthScale(
        scale=math.expm1(float(logs[agree].mean())),
        sigma=max(differences, CAMERA_SIGMA) / math.sqrt(n),
        cameras=cameras,
        odd=tuple(name for name, good in zip(cameras, agree) if not good),
    )


def _ratio(face: FaceDepth, camera: Camera, rig: RigEstimate) -> float:
    """Measured over predicted depth of one marker in one frame; NaN where its pixels show several surfaces.

    What the camera itself hardly trusts is left out, as in aruco.depth_verify.
    """
    K = camera.K_depth
    T_cam_target = invert_transform(rig.cameras[camera.name].T_world_cam) @ rig.T_world_target[face.frame]
    trusted = face.trusted
    return typical_ratio(face.measured_m[trusted], face.predicted_m(T_cam_target, K)[trusted])
