"""The rig's own depth on the target: which frames are read, and what they measure on every marker.

Owns      choosing and reading depth images; faces frame by frame, or all at once where the target rests.
Leaves    where faces lie in an image to aruco.depth_patches; what they say to depth_verify, depth_refine, depth_scale.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from loguru import logger

from aruco.depth_noise import DepthNoise
from aruco.depth_patches import MAX_FRAMES, FaceDepth, face_depth, patches, spread_frames
from aruco.depth_pool import pool_depth
from aruco.depth_save import CameraDepth, camera_depth
from aruco.depth_verify import DepthCamera
from aruco.merged_detection import merge_detections
from aruco.model import Camera, Detection, Frame, Recording
from aruco.pose_math import Array
from aruco.rig_estimate import RigEstimate
from rigcal.evidence import Evidence

# Every frame of a moved target shows it at another range and in another part of the image.
MAX_FRAMES_MOVED = 12


def face_depths(
    evidence: Evidence, rig: RigEstimate, pooled: Mapping[str, CameraDepth] | None = None
) -> dict[str, list[FaceDepth]]:
    """What every camera's depth measures on the target.

    Args:
        evidence: The recording, and the target in it.
        rig: Poses of cameras and target, and the views that took part.
        pooled: Camera -> its depth over time, which a resting target is looked up in; None: a few images are pooled.

    Returns:
        Camera -> faces, for every camera that has depth on the target: of a few frames where the target is moved, else
        of all frames at once, under the number of the frame that carries the world. Empty for stretches of rest
        (--still): they are no frames.
    """
    if evidence.config.still:
        logger.warning(
            "--verify-depth has nothing to compare with --still: a stretch of rest is no single image, so no depth "
            "image belongs to it, and depth on the target is left out; run without --still to compare it."
        )
        return {}
    images = frame_images(evidence)
    found: dict[str, list[FaceDepth]] = {}
    for camera in evidence.cameras:
        if camera.name not in rig.cameras:
            continue
        indices = images.get(camera.name, {})
        if evidence.config.target_moves:
            seen, geometry = evidence.detections[camera.name], evidence.target.geometry
            faces = faces_by_frame(evidence.recording, camera, rig, seen, indices, geometry, at_most=MAX_FRAMES_MOVED)
        else:
            if pooled is not None and camera.name not in pooled:
                continue
            faces = _resting_faces(evidence, camera, rig, indices, pooled[camera.name] if pooled else None)
        if faces:
            found[camera.name] = faces
    return found


def depth_cameras(evidence: Evidence) -> dict[str, DepthCamera]:
    """Camera -> intrinsics of its depth image, and how noisy its depth is."""
    told = evidence.config.depth.baseline_m
    found: dict[str, DepthCamera] = {}
    for camera in evidence.cameras:
        K, baseline_m = camera.K_depth, camera.baseline_m or told
        noise = DepthNoise(focal_baseline=None if baseline_m is None else float(K[0, 0]) * baseline_m)
        found[camera.name] = DepthCamera(K=K, noise=noise)
    return found


def frame_images(evidence: Evidence) -> dict[str, dict[int, int]]:
    """Camera -> frame -> index into the camera's stamps."""
    moments = evidence.moments
    return {
        name: {frame: int(index) for frame, index in enumerate(moments.groups[:, c]) if index >= 0}
        for c, name in enumerate(moments.sync.cameras)
    }


def faces_by_frame(
    recording: Recording,
    camera: Camera,
    rig: RigEstimate,
    detections: Mapping[int, Detection],
    images: Mapping[int, int],
    geometry: Mapping[int, Array],
    *,
    at_most: int = MAX_FRAMES,
) -> list[FaceDepth]:
    """Every marker in a few spread frames of one camera, one frame in memory at a time.

    Args:
        recording: Where the depth is.
        camera: Whose.
        rig: Poses of cameras and target, and the views that took part.
        detections: Frame -> corners.
        images: Frame -> index into the camera's stamps.
        geometry: Marker id -> (k, 3) points [m], target frame.
        at_most: How many frames.
    """
    chosen = _chosen_images(recording, camera, rig, detections, images, at_most)
    faces: list[FaceDepth | None] = []
    for index, frame in _with_depth(recording, camera, list(chosen)):
        f, depth_m = chosen[index], np.asarray(frame.depth_m)
        for patch in patches(camera, detections[f], geometry):
            found = face_depth(patch, depth_m, camera=camera.name, frame=f, confidence=frame.confidence)
            faces.append(found)
    return [face for face in faces if face is not None]


def _chosen_images(
    recording: Recording,
    camera: Camera,
    rig: RigEstimate,
    detections: Mapping[int, Detection],
    images: Mapping[int, int],
    at_most: int,
) -> dict[int, int]:
    """Index into the camera's stamps -> frame, ascending: views that took part, spread over the recording."""
    used = rig.cameras[camera.name].frames
    measured = set(recording.depth_indices(camera.name).tolist())
    frames = {
        f: len(detections[f]) for f in used if f in detections and images.get(f) in measured and f in rig.T_world_target
    }
    return dict(sorted((images[f], f) for f in spread_frames(frames, at_most=at_most)))


def _with_depth(recording: Recording, camera: Camera, order: list[int]) -> Iterator[tuple[int, Frame]]:
    """The frames at ascending indices that can be read and have depth."""
    for index, frame in zip(order, recording.frames(camera.name, order, depth=True)):
        if isinstance(frame, Frame) and frame.depth_m is not None:
            yield index, frame


def _resting_faces(
    evidence: Evidence, camera: Camera, rig: RigEstimate, images: Mapping[int, int], pooled: CameraDepth | None
) -> list[FaceDepth]:
    """Every marker once: mean corners over all frames in which the target rests, depth pooled over time."""
    seen = evidence.detections[camera.name]
    used = [seen[f] for f in rig.cameras[camera.name].frames if f in seen]
    whole = _pooled_briefly(evidence, camera, rig, images) if pooled is None else pooled
    if whole is None or not used:
        return []
    found = (
        face_depth(
            patch,
            whole.depth,
            camera=camera.name,
            frame=rig.world_frame,
            confidence=whole.confidence,
            count=np.full(whole.depth.shape, whole.n_frames) if whole.count is None else whole.count,
        )
        for patch in patches(camera, merge_detections(used), evidence.target.geometry)
    )
    return [face for face in found if face is not None]


def _pooled_briefly(
    evidence: Evidence, camera: Camera, rig: RigEstimate, images: Mapping[int, int]
) -> CameraDepth | None:
    """A few spread images of a resting scene as one; None where the camera has no depth."""
    chosen = _chosen_images(evidence.recording, camera, rig, evidence.detections[camera.name], images, MAX_FRAMES)
    frames = [
        (frame.stamp_ns, np.asarray(frame.depth_m), frame.confidence)
        for _, frame in _with_depth(evidence.recording, camera, list(chosen))
    ]
    if not frames:
        return None
    K = camera.K_depth
    return camera_depth(pool_depth(frames, where=f"camera {camera.name}: depth"), K=K)
