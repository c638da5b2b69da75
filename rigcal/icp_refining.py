"""The story of registration: a levelled rig in, the same rig with clouds that meet out, or as it was.

Owns      what the registration is told of poses, who says how well they are known, what is said on the way.
Leaves    registering to aruco.icp_registration, layouts to icp_note.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from loguru import logger

from aruco.errors import RigError
from aruco.icp_types import ICPConfig, ICPMetrics
from aruco.pose_math import Array, Pose
from aruco.uncertainty import carried
from rigcal.icp_note import Registration
from rigcal.levelled_file import RigFile
from rigcal.levelled_rig import Levelling

__all__ = ["log_registration", "register_clouds"]


def register_clouds(levelling: Levelling, config: ICPConfig) -> Levelling:
    """The rig with its clouds registered; where that cannot be done, the levelled rig, and why.

    Args:
        levelling: The rig on its floor.
        config: How clouds are registered; which way is up the rig says.
    """
    _warn_of_input(levelling.given, levelling.depth_file.digest)
    config = replace(config, up=levelling.config.up)
    T_world_cam, metrics = _registered(levelling, config)
    registration = Registration(
        config=config,
        T_start_cam=levelling.T_world_cam,
        T_world_cam=T_world_cam,
        metrics=metrics,
        given_bias={name: data["bias"] for name, data in levelling.data.items() if "bias" in data},
    )
    return replace(levelling, registration=registration)


def log_registration(found: Registration) -> None:
    """Say what became of the rig, and what wants to be done about it: at the end, where it is read."""
    (logger.info if found.metrics.success else logger.warning)("{}", found.fact)
    for warning in found.metrics.warnings:
        logger.warning("{}", warning)


def _warn_of_input(given: RigFile, digest: str) -> None:
    if given.registered_with == digest:
        logger.warning(
            "the clouds of {} were registered with this depth before; its covariances count them twice", given.name
        )


def _registered(levelling: Levelling, config: ICPConfig) -> tuple[dict[str, Pose], ICPMetrics]:
    """The poses, and how they were found; the levelled ones where an error of the user's forbids it."""
    from aruco.icp_registration import refine_with_icp

    start = dict(levelling.T_world_cam)
    try:
        found, metrics = refine_with_icp(
            levelling.data,
            start,
            levelling.metrics.camera_planes,
            config,
            covariances=_known(levelling),
            priors=levelling.T_before_cam,
            start_covariances=levelling.covariance,
        )
    except RigError as error:
        return start, ICPMetrics(success=False, message=str(error))
    if not metrics.success:
        nothing_moved = {name: replace(move, accepted=False) for name, move in metrics.cameras.items()}
        return start, replace(metrics, cameras=nothing_moved)
    if void := sorted(levelling.metrics.doubts.odd.keys() & levelling.given.covariance.keys()):
        metrics = replace(metrics, remarks=(*metrics.remarks, _forgotten(void)))
    # A camera that was not accepted keeps its levelled pose to the bit.
    return {name: found[name] if name in metrics.moved else T for name, T in start.items()}, metrics


def _forgotten(names: Sequence[str]) -> str:
    poses, it = ("poses", "they are") if len(names) > 1 else ("pose", "it is")
    return (
        f"The floor contradicts the given {poses} of {', '.join(names)} by far more than covariances allow; they were "
        f"forgotten, and clouds told how far off {it}."
    )


def _known(levelling: Levelling) -> Mapping[str, Array]:
    """(6, 6) of the marker poses in the levelled world, left perturbation in its axes, without what the floor knows.

    The floor takes part in the registration and would count twice; so levelling tells only how much worse poses are
    than they say. Where the file says nothing the clouds tell: floors that agree say nothing of yaw, x and z. Of a
    camera that the floor contradicts where others agree nothing is known any more. Were its pose believed, clouds would
    pull at all others, and its own move be refused for being against what is known of it.
    """
    metrics, given = levelling.metrics, levelling.given.covariance
    known: dict[str, Array] = {}
    for name in sorted(given.keys() - metrics.doubts.odd.keys()):
        scale = metrics.pose_scales.get(name)
        at_least = max(1.0, 1.0 if scale is None else scale)
        known[name] = at_least**2 * carried(np.asarray(given[name]), metrics.T_level_world)
    return known
