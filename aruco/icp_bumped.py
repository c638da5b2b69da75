"""Cameras that were bumped, taken up where their surroundings place them instead of where they are said to stand.

Owns      what is known of a camera that was found, that a place which is refused leaves no trace, what is told of it.
Leaves    who looks bumped and where it fits to icp_looking, whether a camera is moved there to icp_gates and
          icp_suspects, sentences to icp_words.

What was known of such a camera's pose is void: where clouds contradict it, it was not bumped by a few of its sigmas.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from loguru import logger

from aruco import icp_words as words
from aruco.depth_bias import DepthBias
from aruco.floor_model import centre_jacobian
from aruco.floor_plane import FloorPlane
from aruco.icp_looking import Looked, bounds_of, looked_again, looked_at, search_clouds, way
from aruco.icp_prior import Prior
from aruco.icp_suspects import doubt_about
from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics
from aruco.pose_math import Array, Pose

Answer = tuple[dict[str, Pose], ICPMetrics]
# What is known of a camera that was found elsewhere, one sigma: more than proposals are off (see icp_global), so that
# they hold where clouds say nothing, and else give way.
FOUND_TURN_RAD = math.radians(2.0)
FOUND_SHIFT_M = 0.1


def looked_for(
    camera_data: Mapping[str, Mapping[str, Any]],
    poses: Mapping[str, Pose],
    priors: Mapping[str, Prior],
    floor: FloorPlane | None,
    biases: Mapping[str, DepthBias],
    config: ICPConfig,
    refined: Callable[[Mapping[str, Pose]], Answer],
) -> Answer:
    """The registration in which bumped cameras are taken up where they were found.

    Args:
        camera_data: As of icp_registration.refine_with_icp.
        poses: Camera -> T_world_cam as given.
        priors: Camera -> what is known of it.
        floor: Common floor in that world; None: there is none.
        biases: Camera -> depth bias in place of that of its data.
        config: As of the registration. Everything in sight takes part in the search, whatever the region; see LOOK_DEG
            for its bounds.
        refined: Does the registration, with some cameras taken up elsewhere.
    """
    clouds = search_clouds(camera_data, poses, floor, biases, config)
    looked = looked_at(clouds, poses, priors, config)

    def doubts(at: Mapping[str, Pose], metrics: ICPMetrics, name: str) -> str:
        known = {**biases, **metrics.biases}
        return doubt_about(name, search_clouds(camera_data, at, floor, known, config), at, metrics)

    answer, refused = _believed(looked.found, refined, doubts)
    again = looked_again(clouds, poses, answer[1], looked, refused, config)
    if again.found.keys() != looked.found.keys():
        left = {name: T for name, T in again.found.items() if name not in refused}
        answer, more = _believed(left, refined, doubts)
        refused |= more
    return answer[0], _told(answer[1], (poses, answer[0]), again, refused, bounds_of(config))


def found_prior(T_world_cam: Pose) -> Prior:
    """What is known of a camera that was found at a place: as a bumped one's given pose is no knowledge, only that.

    It says nothing of how well marker poses are known.
    """
    back = centre_jacobian(T_world_cam[:3, 3], inverse=True)
    at_centre: Array = np.diag([FOUND_TURN_RAD**2] * 3 + [FOUND_SHIFT_M**2] * 3)
    return Prior(T_world_cam=T_world_cam, covariance=back @ at_centre @ back.T, scaled=False)


# ---------------------------------------------------------------------------------------------------- what is believed


def _believed(
    found: Mapping[str, Pose],
    refined: Callable[[Mapping[str, Pose]], Answer],
    doubts: Callable[[Mapping[str, Pose], ICPMetrics, str], str],
) -> tuple[Answer, dict[str, tuple[Pose, str]]]:
    """The answer in which all cameras that are taken up elsewhere are also moved there, and why others are not.

    A place that is refused must not have pulled anybody: all is done again as if it had never been proposed.

    Args:
        found: Camera -> where it seems to stand.
        refined: Does the registration, with cameras taken up elsewhere.
        doubts: What speaks against a camera's place in an answer; empty: nothing.
    """
    left, refused = dict(found), dict[str, tuple[Pose, str]]()
    while True:
        poses, metrics = refined(left)
        out = {name: why for name in left if (why := _refusal(name, metrics))}
        # Doubts only where nobody stands at a wrong start meanwhile, whom the others follow in part.
        out = out or {name: why for name in left if (why := doubts(poses, metrics, name))}
        if not out:
            return (poses, metrics), refused
        for name, why in out.items():
            refused[name] = found[name], why
            logger.info("camera {}: the place found is refused: {}", name, why)
            del left[name]


def _refusal(camera: str, metrics: ICPMetrics) -> str:
    """Why the gates did not let a camera go where it was found."""
    if camera in metrics.moved:
        return ""
    return metrics.cameras[camera].reason if camera in metrics.cameras else metrics.message


# ----------------------------------------------------------------------------------------------------- what is told


def _told(
    metrics: ICPMetrics,
    before_after: tuple[Mapping[str, Pose], Mapping[str, Pose]],
    looked: Looked,
    refused: Mapping[str, tuple[Pose, str]],
    within: tuple[float, float],
) -> ICPMetrics:
    given, new = before_after
    cameras = dict(metrics.cameras)

    def retold(name: str, reason: Callable[[str], str]) -> None:
        before = cameras.get(name, CameraMove(accepted=False, reason=metrics.message))
        cameras[name] = replace(before, reason=reason(before.reason))

    gone = {name: way(given[name], new[name]) for name in sorted(looked.found.keys() - refused.keys())}
    for name, moved in gone.items():
        cameras[name] = _found(cameras[name], moved, _known_to(metrics.covariances.get(name), new[name]))
    for name, (T, why) in refused.items():
        retold(name, partial(words.found_and_refused, way=way(given[name], T), why=why))
    for name in looked.nowhere:
        retold(name, partial(words.found_nowhere, others=looked.against[name], within=within))
    if looked.reference is not None:
        T = looked.T_reference
        seen = None if T is None else way(given[looked.reference], T)
        others = looked.against[looked.reference]
        retold(looked.reference, partial(words.reference_bumped, others=others, way=seen))
    told = words.summary_of_bumped(gone, sorted(refused), sorted(looked.nowhere), looked.reference)
    return replace(
        metrics,
        cameras=dict(sorted(cameras.items())),
        message=" ".join([metrics.message, *told]),
        warnings=(*metrics.warnings, *told),
    )


def _known_to(covariance: Array | None, T_world_cam: Pose) -> tuple[float, float] | None:
    """Standard deviations [deg], [m] of a pose in the direction that is known least."""
    if covariance is None:
        return None
    J = centre_jacobian(T_world_cam[:3, 3])
    S = J @ covariance @ J.T
    turn, shift = (math.sqrt(max(float(np.linalg.eigvalsh(part)[-1]), 0.0)) for part in (S[:3, :3], S[3:, 3:]))
    return math.degrees(turn), shift


def _found(seen: CameraMove, moved: tuple[float, float], known: tuple[float, float] | None) -> CameraMove:
    """A move from where the camera was said to stand; that pose was not asked."""
    reason = words.found(*moved, seen.held_out_before_mm, seen.held_out_after_mm, seen.gain_sigmas, known)
    return replace(seen, reason=reason, rotation_deg=moved[0], translation_mm=1e3 * moved[1], prior_sigmas=math.nan)
