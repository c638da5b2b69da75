"""Which of the level surfaces that a rig's cameras see is the floor.

Owns      agreement of planes between cameras, the choice.
Leaves    finding planes to floor_view, their weighted mean to floor_fusion.

A table top or a ceiling may fill one camera's image; the floor is what most cameras agree about. Of surfaces that
equally many cameras see, it is the lowest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aruco.floor_plane import FloorPlane
from aruco.floor_view import SeenPlane
from aruco.pose_math import Array, Pose

# Poses up to MAX_ROTATION_DEG off may be corrected, two of them against each other; tables stand 0.4 m high.
AGREE_DEG = 8.0
AGREE_M = 0.12
# A slope that is wrong by one degree moves a floor seen from elsewhere by this share of the distance.
AGREE_SLOPE = math.radians(1.0)
# Of equally many cameras' surfaces the lowest wins unless it is this much smaller: mirrors and glass show planes below.
COMPARABLE_SHARE = 0.15


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Consensus:
    """The surface that most cameras agree about."""

    floor: FloorPlane  # in the world, as the most central of its cameras sees it
    planes: Mapping[str, SeenPlane]  # camera -> its own plane of that surface
    share: float  # of the samples of all these cameras, summed


def choose_floor(
    planes: Mapping[str, Sequence[SeenPlane]], T_world_cam: Mapping[str, Pose], up: Array
) -> Consensus | None:
    """The floor among the level planes of all cameras; None where there is no plane at all.

    Args:
        planes: Camera -> what it sees, camera frame.
        T_world_cam: Camera -> pose in an upright world.
        up: (3,) unit.
    """
    groups = [
        _group(plane.in_world(T_world_cam[camera]), camera, planes, T_world_cam)
        for camera, seen in planes.items()
        for plane in seen
    ]
    if not groups:
        return None
    most = max(len(members) for _, members, _ in groups)
    candidates = [group for group in groups if len(group[1]) == most]
    floors = [Consensus(floor=f, planes=m, share=sum(p.share for p in m.values())) for f, m, _ in candidates]
    enough = COMPARABLE_SHARE * max(c.share for c in floors)
    middle = _middle(T_world_cam)
    lowest = min(_height_at(c.floor, middle, up) for c in floors if c.share >= enough)
    # The lowest surface as all its cameras describe it: of these descriptions the most central.
    level = [
        (misfit, k)
        for k, (c, (_, _, misfit)) in enumerate(zip(floors, candidates))
        if c.share >= enough and _height_at(c.floor, middle, up) <= lowest + AGREE_M
    ]
    return floors[min(level)[1]]


def _group(
    floor: FloorPlane, camera: str, planes: Mapping[str, Sequence[SeenPlane]], T_world_cam: Mapping[str, Pose]
) -> tuple[FloorPlane, dict[str, SeenPlane], float]:
    """A surface, each camera's plane of it, and how far these are off it in units of what is allowed."""
    members: dict[str, SeenPlane] = {}
    total = 0.0
    for other, seen in planes.items():
        distance = float(np.linalg.norm(T_world_cam[other][:3, 3] - T_world_cam[camera][:3, 3]))
        misfits = [_misfit(floor, plane, T_world_cam[other], distance) for plane in seen]
        if misfits and min(misfits) <= 1.0:
            best = int(np.argmin(misfits))
            members[other] = seen[best]
            total += misfits[best]
    return floor, members, total


def _misfit(floor: FloorPlane, plane: SeenPlane, T_world_cam: Pose, distance_m: float) -> float:
    """How far a camera's plane is off a floor: the larger of tilt and height, each as a share of what is allowed."""
    tilt, rise = offset_of(floor, plane, T_world_cam)
    return max(math.degrees(tilt) / AGREE_DEG, abs(rise) / (AGREE_M + AGREE_SLOPE * distance_m))


def offset_of(floor: FloorPlane, plane: SeenPlane, T_world_cam: Pose) -> tuple[float, float]:
    """Angle [rad] of a camera's plane with a floor, and its height above that floor under the camera [m]."""
    normal = T_world_cam[:3, :3] @ plane.normal
    angle = math.atan2(float(np.linalg.norm(np.cross(normal, floor.normal))), float(normal @ floor.normal))
    clearance = float(floor.distances(T_world_cam[:3, 3]))
    return angle, clearance - plane.distance_m


def _middle(T_world_cam: Mapping[str, Pose]) -> Array:
    return np.mean([T[:3, 3] for T in T_world_cam.values()], axis=0)


def _height_at(floor: FloorPlane, place: Array, up: Array) -> float:
    """Height along up of a floor straight below a place (3,) [m]."""
    return float(place @ up) - float(floor.distances(place)) / float(floor.normal @ up)
