"""Which way is up for a target that is moved: it lies level in some frames and is held askew in others.

Owns      finding the frames in which the target lies level.
Leaves    judging one frame's directions to alignment.

Frames in which the target stands on the floor put one of its axes in one and the same direction, however it is turned
or whichever face it rests on; a target in somebody's hands points elsewhere each time. So the direction that most
frames share is up, as long as it also explains the cameras as upright.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from loguru import logger

from aruco.alignment import UpCandidate, UpDecision, face_axes, find_up, rank_candidates, specified_face
from aruco.marker_geometry import Face
from aruco.pose_math import Array, Pose, invert_transform

# Two frames of a target on one floor differ by the noise of single poses, about a degree for a small cube.
AGREE_DEG = 2.0
# How far the direction that the cameras like best may be from the true one: their roll is their mounting's.
SEARCH_DEG = 20.0
# Fewer frames than this share of all may agree by chance.
MIN_SHARE = 0.1
MIN_FRAMES = 3
# More frames than this do not make the vote surer.
MAX_FRAMES = 300


def find_up_moved(
    T_world_cam: Mapping[str, Pose],
    T_world_target: Mapping[int, Pose],
    faces: Sequence[Face],
    *,
    ground_face: str | None = None,
    ground_marker_id: int | None = None,
) -> UpDecision:
    """Decide which way is up in the world of a moved target.

    Args:
        T_world_cam: Camera -> pose.
        T_world_target: Frame -> pose of the target.
        faces: The target's faces.
        ground_face: Name of a face that is level where the target lies.
        ground_marker_id: Id of a marker on such a face; ignored when ``ground_face`` is given.

    Returns:
        The decision, its directions in the world's frame.

    Raises:
        InputError: The face or marker is not in the map, or the map has no flat face.
        CalibrationError: Two directions explain the cameras about equally well.
    """
    frames = list(T_world_target)[:: -(-len(T_world_target) // MAX_FRAMES)]
    named = specified_face(faces, ground_face, ground_marker_id)
    axes = face_axes(faces if named is None else [named])
    seen = [_directions(T_world_cam, T_world_target[f], axes, faces) for f in frames] if axes else []
    if len(frames) < MIN_FRAMES or not seen:
        level, shared = frames[0], None
    else:
        level, shared = _most_shared(frames, seen)
    T_target_cam = {name: invert_transform(T_world_target[level]) @ T for name, T in T_world_cam.items()}
    decision = find_up(T_target_cam, faces, ground_face=ground_face, ground_marker_id=ground_marker_id)
    return _in_world(decision, T_world_target[level][:3, :3], shared)


def _directions(
    T_world_cam: Mapping[str, Pose], T_world_target: Pose, axes: Sequence, faces: Sequence[Face]
) -> list[tuple[Array, float]]:
    """Every axis direction of the target in one frame, in the world, with its score."""
    T_target_world = invert_transform(T_world_target)
    T_target_cam = {name: T_target_world @ T for name, T in T_world_cam.items()}
    ranked = rank_candidates(T_target_cam, axes, lowest_of=faces)
    return [(T_world_target[:3, :3] @ candidate.up_target, candidate.score) for candidate in ranked]


def _most_shared(frames: Sequence[int], seen: Sequence[Sequence[tuple[Array, float]]]) -> tuple[int, Array | None]:
    """A frame in which the target lies level, and the mean direction of all of them; else the first frame."""
    best = [max(directions, key=lambda d: d[1]) for directions in seen]
    liked = max(best, key=lambda d: d[1])[0]
    near = [max((up for up, _ in directions), key=lambda up: float(up @ liked)) for directions in seen]
    ups = np.array(near)
    agree = ups @ ups.T > np.cos(np.radians(AGREE_DEG))
    agree &= (ups @ liked > np.cos(np.radians(SEARCH_DEG)))[None, :]
    votes = agree.sum(axis=1)
    k = int(np.argmax(votes))
    if votes[k] < max(MIN_FRAMES, MIN_SHARE * len(frames)):
        logger.warning(
            "no direction is shared by several frames, as if the target was never put down: up is taken from frame {}",
            frames[0],
        )
        return frames[0], None
    logger.info("up direction: the target lies level in {} of {} frames", int(votes[k]), len(frames))
    return frames[k], _robust_mean(ups[agree[k]])


def _robust_mean(ups: Array) -> Array:
    """The mean of unit vectors (n, 3) without those beyond three times the median distance: held nearly level."""
    mean = np.median(ups, axis=0)
    for _ in range(5):
        distance = np.linalg.norm(ups - mean, axis=1)
        mean = ups[distance <= 3 * np.median(distance) + 1e-6].mean(axis=0)
    return mean / np.linalg.norm(mean)


def _in_world(decision: UpDecision, R_world_target: Array, shared: Array | None) -> UpDecision:
    """The decision with its directions in the world, the best one averaged over all level frames."""
    turned = [replace(c, up_target=R_world_target @ c.up_target) for c in decision.candidates]
    if shared is not None and float(turned[0].up_target @ shared) > np.cos(np.radians(2 * AGREE_DEG)):
        turned[0] = UpCandidate(
            up_target=shared, ground_face=turned[0].ground_face, log_likelihoods=turned[0].log_likelihoods
        )
    return UpDecision(candidates=tuple(turned), is_guess=shared is None)
