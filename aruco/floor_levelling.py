"""From the floor that a rig sees to a level world: one motion for all, then each camera's own within bounds.

Owns      the order of both, rejecting motions that are too large, carrying covariances along.
Leaves    finding the floor to floor_consensus, weighing to floor_fusion, contradictions to floor_checks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from loguru import logger

from aruco.errors import CalibrationError
from aruco.floor_consensus import Consensus
from aruco.floor_correction import FloorCorrection, bounded, camera_motion, target_height, turn_between
from aruco.floor_fusion import Fusion, fuse, fused_covariances, uncorrected_covariance
from aruco.floor_model import Sight, default_pose_covariance, level_prior
from aruco.floor_plane import FloorPlane, Mat44
from aruco.floor_steps import FloorStep, floor_step
from aruco.pose_math import Array, Pose, exp_so3, invert_transform, make_pose
from aruco.uncertainty import carried

# Another round moves the floor by the square of the last one's motion: three are enough.
_LEVEL = 1e-9  # rad and m


@dataclass(frozen=True, slots=True, kw_only=True)
class Bounds:
    """How far one camera may be moved beyond the common motion, and where the floor is put."""

    max_rotation_deg: float
    max_translation_m: float
    target_floor_y: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Levelling:
    """Poses on a level floor, and how they got there."""

    T_world_cam: dict[str, Pose]  # all cameras
    T_level_world: Mat44  # the common motion
    floor: FloorPlane  # the common floor in the given world
    moves: dict[str, FloorCorrection]  # of the cameras that see the floor
    covariances: dict[str, Array]  # (6, 6) of all cameras
    floor_covariance: Array  # (3, 3) the part of these that all cameras share; see Fusion
    scales: dict[str, float]  # camera -> factor on the standard deviations of its pose
    bias_scale: float  # on those of all cameras' bias


def level_world(
    consensus: Consensus,
    T_world_cam: Mapping[str, Pose],
    covariances: Mapping[str, Array],
    bounds: Bounds,
    up: Array,
) -> Levelling:
    """Level all poses on the floor and correct those of the cameras that see it.

    Args:
        consensus: The floor and its cameras.
        T_world_cam: All cameras.
        covariances: (6, 6) of as many of them as is known.
        bounds: Of single cameras' motions, and the floor's height.
        up: (3,) unit.
    """
    rejected: dict[str, FloorCorrection] = {}
    while True:
        trusted = [name for name in sorted(consensus.planes) if name not in rejected]
        attempt = _settled(trusted, consensus, T_world_cam, covariances, bounds, up)
        moves = {sight.camera: _move(attempt.fusion, sight, bounds, up) for sight in attempt.sights}
        beyond = {name: move for name, move in moves.items() if not move.accepted}
        if not beyond:
            return _levelling(attempt, {**moves, **rejected}, covariances)
        worst = max(beyond, key=lambda name: _excess(beyond[name], bounds))
        rejected[worst] = beyond[worst]


def of_one_height(
    consensus: Consensus,
    T_world_cam: Mapping[str, Pose],
    covariances: Mapping[str, Array],
    bounds: Bounds,
    up: Array,
) -> Consensus:
    """The floor without the few cameras that see another one beside it; see level_world.

    Raises:
        CalibrationError: Neither of two floors is seen by most cameras.
    """
    while len(consensus.planes) > 1:
        attempt = _settled(sorted(consensus.planes), consensus, T_world_cam, covariances, bounds, up)
        step = floor_step(attempt.sights, attempt.fusion.state)
        if step is None:
            break
        rest = {name: plane for name, plane in consensus.planes.items() if name not in step.cameras}
        if len(rest) <= len(step.cameras):
            raise CalibrationError(_two_floors(step, consensus, T_world_cam, up))
        logger.debug("cameras {} see a floor {:+.3f} m off the others'", step.cameras, step.rise_m)
        name = max(rest, key=lambda name: rest[name].share)
        consensus = replace(consensus, floor=rest[name].in_world(T_world_cam[name]), planes=rest)
    return consensus


def _two_floors(step: FloorStep, consensus: Consensus, T_world_cam: Mapping[str, Pose], up: Array) -> str:
    def told(names: Sequence[str]) -> str:
        heights = [
            float(T_world_cam[n][:3, 3] @ up) - consensus.planes[n].distance_m / float(consensus.floor.normal @ up)
            for n in names
        ]
        return f"camera{'s' if len(names) > 1 else ''} {', '.join(names)} at {np.mean(heights):.3f} m"

    others = sorted(consensus.planes.keys() - set(step.cameras))
    return (
        f"The cameras see floors of two heights that are {abs(step.rise_m):.3f} m apart, tilts allowed for, more than "
        f"poses and bias of depth explain: {told(step.cameras)}, {told(others)}, and neither is most of them; say with "
        "--height-range which one is the floor, or leave out a camera that was bumped."
    )


def _excess(move: FloorCorrection, bounds: Bounds) -> float:
    return max(move.rotation_deg / bounds.max_rotation_deg, abs(move.translation_m) / bounds.max_translation_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Attempt:
    """The estimate from the cameras that are trusted, in a world that the common motion has levelled."""

    T_level_world: Mat44
    T_world_cam: dict[str, Pose]  # all cameras, levelled
    covariances: dict[str, Array]  # (6, 6) of all cameras, carried along or the default
    sights: list[Sight]
    fusion: Fusion


def _settled(
    trusted: list[str],
    consensus: Consensus,
    T_world_cam: Mapping[str, Pose],
    covariances: Mapping[str, Array],
    bounds: Bounds,
    up: Array,
) -> _Attempt:
    """Turns about level axes only are asked of cameras, so the world is level before they are."""
    floor, scales = consensus.floor, None
    while True:
        T_level_world = common_motion(floor, bounds.target_floor_y, up)
        level: dict[str, Pose] = {name: T_level_world @ T for name, T in T_world_cam.items()}
        known = {
            name: carried(np.asarray(covariances[name]), T_level_world)
            if name in covariances
            else default_pose_covariance(T)
            for name, T in level.items()
        }
        sights = [
            Sight(
                camera=name,
                T_world_cam=level[name],
                a=consensus.planes[name].a,
                noise=consensus.planes[name].noise,
                bias=consensus.planes[name].bias,
                prior=level_prior(known[name], level[name], up),
                given=name in covariances,
            )
            for name in trusted
        ]
        fusion = fuse(sights, floor.moved(T_level_world), up, scales=scales)
        scales = fusion.scales
        before = floor
        floor = fusion.floor.moved(invert_transform(T_level_world))
        if _distance(before, floor) < _LEVEL:
            return _Attempt(
                T_level_world=T_level_world, T_world_cam=level, covariances=known, sights=sights, fusion=fusion
            )


def _distance(a: FloorPlane, b: FloorPlane) -> float:
    return float(np.linalg.norm(a.normal - b.normal)) + abs(a.d - b.d)


def _levelling(attempt: _Attempt, moves: Mapping[str, FloorCorrection], covariances: Mapping[str, Array]) -> Levelling:
    fusion, level = attempt.fusion, attempt.T_world_cam
    new = fused_covariances(fusion, {s.camera: s for s in attempt.sights}, attempt.covariances)
    largest = max((fusion.scales.honest[name] for name in fusion.cameras if name not in covariances), default=1.0)
    for name, T in level.items():
        if name not in new:
            scale = 1.0 if name in covariances else largest
            new[name] = uncorrected_covariance(fusion, T, scale**2 * attempt.covariances[name])
    return Levelling(
        T_world_cam={n: moves[n].T_world_new_old @ T if n in moves else T for n, T in level.items()},
        T_level_world=attempt.T_level_world,
        floor=fusion.floor.moved(invert_transform(attempt.T_level_world)),
        moves=dict(sorted(moves.items())),
        covariances={name: 0.5 * (new[name] + new[name].T) for name in level},
        floor_covariance=fusion.floor_covariance,
        scales=fusion.scales.poses,
        bias_scale=fusion.scales.bias,
    )


def common_motion(floor: FloorPlane, target_floor_y: float, up: Array) -> Mat44:
    """The shortest turn about the world's origin that makes a floor level, and the rise that puts it to its height."""
    return make_pose(exp_so3(turn_between(floor.normal, up)), (target_height(target_floor_y, up) - floor.height) * up)


def _move(fusion: Fusion, sight: Sight, bounds: Bounds, up: Array) -> FloorCorrection:
    rise = fusion.rises[sight.camera]
    motion = camera_motion(sight.T_world_cam[:3, 3], fusion.turns[sight.camera], rise, up)
    move = bounded(motion, rise, max_rotation_deg=bounds.max_rotation_deg, max_translation_m=bounds.max_translation_m)
    return replace(move, gain=fusion.gain(sight) if move.accepted else 0.0)
