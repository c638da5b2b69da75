"""Which cameras of a rig look bumped, and where they fit the others.

Owns      Looked: by contradictions of clouds, and by estimates that contradict poses; clouds fit for the search, its
          bounds; what is said on the way.
Leaves    contradictions to icp_suspects, the search of one camera to icp_global, what comes of it to icp_bumped.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from loguru import logger

from aruco.depth_bias import DepthBias
from aruco.errors import InputError
from aruco.floor_plane import FloorPlane
from aruco.icp_agreement import Witness, witness
from aruco.icp_cloud import cloud_of
from aruco.icp_global import global_start
from aruco.icp_headline import by_far
from aruco.icp_prior import Prior
from aruco.icp_suspects import Meeting, agreeing, meetings
from aruco.icp_types import ICPConfig, ICPMetrics, Pair
from aruco.icp_words import move
from aruco.pose_math import Pose, pose_distance

# How far around a bumped camera is looked for: a tripod that is knocked against turns and goes about so far without
# falling. A user who allows moves that are larger has a reason to look farther.
LOOK_DEG, LOOK_M = 30.0, 0.6
# Clouds that are to be recognised want a sample every so far at such a distance [m], not each pixel.
_SPACING_M, _AT_M = 0.05, 4.0
# Kinds of refusal that mean: it stands elsewhere.
_CONTRADICTS = ("prior", "too_far")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Looked:
    """Who looks bumped."""

    found: dict[str, Pose] = field(default_factory=dict)  # where they seem to stand
    nowhere: tuple[str, ...] = ()  # looked for in vain
    against: dict[str, tuple[str, ...]] = field(default_factory=dict)  # whom each of all of these contradicts
    reference: str | None = None  # if that is the one
    T_reference: Pose | None = None  # where the others place it


def search_clouds(
    camera_data: Mapping[str, Mapping[str, Any]],
    poses: Mapping[str, Pose],
    floor: FloorPlane | None,
    biases: Mapping[str, DepthBias],
    config: ICPConfig,
) -> dict[str, Witness]:
    """Everything that cameras see, whatever the region; of which no cloud can be made is not among them."""
    clouds: dict[str, Witness] = {}
    for name in sorted(poses.keys() & camera_data.keys()):
        data = camera_data[name]
        try:
            full = replace(config, region="full", stride=_stride(data, config))
            cloud = cloud_of(name, data, full, T_world_cam=poses[name], floor=floor, bias=biases.get(name))
        except InputError:  # said when clouds are made to be registered
            continue
        if len(cloud):
            clouds[name] = witness(cloud)
    return clouds


def _stride(data: Mapping[str, Any], config: ICPConfig) -> int:
    focal_px = np.asarray(data.get("K", np.eye(3)), dtype=np.float64)
    coarse = focal_px.flat[0] * _SPACING_M / _AT_M if focal_px.size and math.isfinite(focal_px.flat[0]) else 0.0
    return max(config.stride, int(coarse))


def looked_at(
    clouds: Mapping[str, Witness], poses: Mapping[str, Pose], priors: Mapping[str, Prior], config: ICPConfig
) -> Looked:
    """Who contradicts the most cameras that agree, and where each fits these.

    Args:
        clouds: As of search_clouds.
        poses: Camera -> T_world_cam as given.
        priors: Camera -> what is known of it.
        config: Of the registration; see LOOK_DEG.
    """
    reference = min(clouds, default="")
    met = meetings(clouds, poses, priors)
    well = agreeing(frozenset(clouds), met, reference)
    against = {name: _contradicted(name, met, well) for name in sorted(clouds.keys() - well)}
    if not against:
        logger.info("no two clouds contradict each other by so much that a camera looks bumped")
        return Looked()
    if reference not in well:
        # To move all others to where they fit it would tilt and shift the world, which they hold rightly.
        T_reference = _place(reference, clouds, well, poses, config)
        return Looked(reference=reference, T_reference=T_reference, against=against)
    places = {name: _place(name, clouds, well, poses, config) for name in against}
    found = {name: T for name, T in places.items() if T is not None}
    return Looked(found=found, nowhere=tuple(sorted(places.keys() - found.keys())), against=against)


def looked_again(
    clouds: Mapping[str, Witness],
    poses: Mapping[str, Pose],
    metrics: ICPMetrics,
    looked: Looked,
    refused: Collection[str],
    config: ICPConfig,
) -> Looked:
    """With cameras that were bumped by so little that only the estimate has shown that they contradict their poses."""
    reference = min(clouds, default="")
    away = [name for name, move in metrics.cameras.items() if move.refusal in _CONTRADICTS and name in clouds]
    away = [name for name in away if name != reference and name not in looked.against]
    if not away or looked.reference is not None:
        return looked
    first = by_far({name: metrics.cameras[name] for name in away})
    if first is not None:
        away = [first]
    if len(away) > 1 and len(away) == len(clouds) - 1:
        logger.info(
            "every pose is contradicted but that of the reference {}, which looks bumped",
            reference,
        )
        return Looked(reference=reference, against={reference: tuple(away)})
    taken = {name: T for name, T in looked.found.items() if name not in refused}
    well = frozenset(clouds.keys() - {*away, *(looked.against.keys() - taken.keys())})
    places = {name: _place(name, clouds, well, {**poses, **taken}, config) for name in away}
    found = {name: T for name, T in places.items() if T is not None}
    return replace(looked, found={**looked.found, **found}) if found else looked


def bounds_of(config: ICPConfig) -> tuple[float, float]:
    """How far around [deg], [m]."""
    return max(config.max_rotation_deg, LOOK_DEG), max(config.max_translation_m, LOOK_M)


def _contradicted(camera: str, met: Mapping[Pair, Meeting], well: frozenset[str]) -> tuple[str, ...]:
    pairs = [pair for pair, m in sorted(met.items()) if camera in pair and m.contradicts]
    return tuple(name for pair in pairs for name in pair if name != camera and name in well)


def _place(
    camera: str,
    clouds: Mapping[str, Witness],
    well: frozenset[str],
    poses: Mapping[str, Pose],
    config: ICPConfig,
) -> Pose | None:
    """Where a camera fits those that stand well."""
    others = sorted(well - {camera})
    wide = replace(config, max_rotation_deg=bounds_of(config)[0], max_translation_m=bounds_of(config)[1])
    logger.info("camera {} looks bumped; looking where it fits the clouds of {}", camera, ", ".join(others))
    T = global_start(clouds[camera], [clouds[name] for name in others], poses, wide)
    where = "nowhere else" if T is None else f"{move(*way(poses[camera], T))} from where it is said to stand"
    logger.info("camera {} is found {}", camera, where)
    return T


def way(T_from: Pose, T_to: Pose) -> tuple[float, float]:
    """Turn [deg] and shift [m]."""
    turn, shift = pose_distance(T_from, T_to)
    return math.degrees(turn), shift
