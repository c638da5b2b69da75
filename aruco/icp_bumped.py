"""Cameras that were bumped, taken up where their surroundings place them instead of where they are said to stand.

Owns      who is found elsewhere, what is known of such a camera, that a place which is refused leaves no trace, what is
          told of it.
Leaves    the search for a place to icp_global, whether a camera is moved there to icp_gates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from loguru import logger

from aruco import icp_words as words
from aruco.depth_bias import DepthBias
from aruco.errors import InputError
from aruco.floor_model import centre_jacobian
from aruco.floor_plane import FloorPlane
from aruco.icp_cloud import Cloud, cloud_of
from aruco.icp_global import global_start
from aruco.icp_prior import Prior
from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics
from aruco.pose_math import Array, Pose, pose_distance

Answer = tuple[dict[str, Pose], ICPMetrics]
# What is known of a camera that was found elsewhere, one sigma. Proposals are off by 0.8 degrees and 4 cm in the
# median, by 1.6 degrees and 14 cm at worst (see icp_global): they hold where clouds say nothing, and else give way.
FOUND_TURN_RAD = math.radians(2.0)
FOUND_SHIFT_M = 0.1


def found_elsewhere(
    camera_data: Mapping[str, Mapping[str, Any]],
    poses: Mapping[str, Pose],
    floor: FloorPlane | None,
    biases: Mapping[str, DepthBias],
    config: ICPConfig,
) -> dict[str, Pose]:
    """Where cameras seem to stand that do not stand where they are said to; the reference is taken to stand well.

    Where several are found elsewhere, each is looked for once more without the others: one that was bumped makes those
    beside it look bumped too.

    Args:
        camera_data: As of icp_registration.refine_with_icp.
        poses: Camera -> T_world_cam as given.
        floor: Common floor in that world; None: there is none.
        biases: Camera -> depth bias in place of that of its data.
        config: Bounds of a move, seed. Everything in sight takes part, whatever the region.
    """
    full = replace(config, region="full")
    clouds = _clouds(camera_data, poses, floor, biases, full)
    suspects = _asked(clouds.keys() - {min(poses, default="")}, clouds, poses, full)
    if len(suspects) > 1:
        well = {name: cloud for name, cloud in clouds.items() if name not in suspects}
        suspects = {name: T for s in suspects for name, T in _asked([s], {**well, s: clouds[s]}, poses, full).items()}
    for name, T in suspects.items():
        logger.debug("camera {} is found {} from where it is said to stand", name, words.move(*_way(poses[name], T)))
    return suspects


def _clouds(
    camera_data: Mapping[str, Mapping[str, Any]],
    poses: Mapping[str, Pose],
    floor: FloorPlane | None,
    biases: Mapping[str, DepthBias],
    config: ICPConfig,
) -> dict[str, Cloud]:
    clouds: dict[str, Cloud] = {}
    for name in sorted(poses.keys() & camera_data.keys()):
        try:
            clouds[name] = cloud_of(
                name, camera_data[name], config, T_world_cam=poses[name], floor=floor, bias=biases.get(name)
            )
        except InputError:  # said when clouds are made to be registered
            continue
    return clouds


def _asked(
    cameras: Collection[str], clouds: Mapping[str, Cloud], poses: Mapping[str, Pose], config: ICPConfig
) -> dict[str, Pose]:
    """The proposals for some cameras among others."""
    asked = {name: global_start(clouds[name], list(clouds.values()), poses, config) for name in sorted(cameras)}
    return {name: T for name, T in asked.items() if T is not None}


def found_prior(T_world_cam: Pose) -> Prior:
    """What is known of a camera that was found at a place: as a bumped one's given pose is no knowledge, only that."""
    back = centre_jacobian(T_world_cam[:3, 3], inverse=True)
    at_centre: Array = np.diag([FOUND_TURN_RAD**2] * 3 + [FOUND_SHIFT_M**2] * 3)
    return Prior(T_world_cam=T_world_cam, covariance=back @ at_centre @ back.T)


def believed(
    given: Mapping[str, Pose], found: Mapping[str, Pose], refined: Callable[[Mapping[str, Pose]], Answer]
) -> Answer:
    """The answer in which all cameras that are taken up elsewhere are also moved there.

    A place that is refused must not have pulled anybody: all is done again as if it had never been proposed.

    Args:
        given: Camera -> T_world_cam where it is said to stand.
        found: Camera -> where it seems to stand.
        refined: Does the registration, with cameras taken up elsewhere.
    """
    left, refused = dict(found), dict[str, str]()
    while True:
        poses, metrics = refined(left)
        out = {name: metrics.cameras.get(name) for name in left if name not in metrics.moved}
        if not out:
            return poses, _told(metrics, given, left, {name: (found[name], why) for name, why in refused.items()})
        for name, move in out.items():
            refused[name] = metrics.message if move is None else move.reason
            logger.debug("camera {}: the place found is refused: {}", name, refused[name])
            del left[name]


def _told(
    metrics: ICPMetrics,
    given: Mapping[str, Pose],
    taken: Mapping[str, Pose],
    refused: Mapping[str, tuple[Pose, str]],
) -> ICPMetrics:
    cameras = dict(metrics.cameras)
    for name, T in taken.items():
        cameras[name] = _found(cameras[name], _way(given[name], T))
    for name, (T, why) in refused.items():
        move = cameras.get(name, CameraMove(accepted=False, reason=metrics.message))
        cameras[name] = replace(move, reason=words.found_and_refused(move.reason, *_way(given[name], T), why))
    message = " ".join([metrics.message, *words.bumped(sorted(taken), sorted(refused))])
    return replace(metrics, cameras=dict(sorted(cameras.items())), message=message)


def _found(move: CameraMove, way: tuple[float, float]) -> CameraMove:
    """A move from where the camera was found; its given pose was not asked."""
    reason = words.found(*way, move.held_out_before_mm, move.held_out_after_mm, move.gain_sigmas)
    return replace(move, reason=reason, prior_sigmas=math.nan)


def _way(T_from: Pose, T_to: Pose) -> tuple[float, float]:
    """Turn [deg] and shift [m]."""
    turn, shift = pose_distance(T_from, T_to)
    return math.degrees(turn), shift
