"""Whether floors stay as level and as common under a registration as they were before it.

Owns      a camera's own floor against that of all before and after, the tilt of that; limits of both.
Leaves    who is blamed to icp_objections.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from aruco.floor_plane import FloorPlane, plane_axes
from aruco.icp_cloud import Cloud
from aruco.pose_math import Array, Pose

# A camera's own floor may be worse by this and three sigma of what it knows of it: a move that is right in all else is
# not refused for what depth cannot tell.
MAX_TILT_GROWTH_DEG = 0.1
MAX_RISE_GROWTH_M = 0.003
FLOOR_SIGMAS = 3.0
# The reference does not move, so where its own tilt was wrong the common floor leans in the world returned. Levelling
# by biased depth leaves some tenths of a degree of that; beyond half a degree no world is level.
MAX_COMMON_TILT_DEG = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorGrowth:
    """How far a camera's own floor is off the common one, as (angle [deg], distance [m])."""

    before: tuple[float, float]
    after: tuple[float, float]
    excess: float  # of what grew, in its limit


def floor_growth(
    cloud: Cloud, bias: Array, *, before: tuple[Pose, FloorPlane], after: tuple[Pose, FloorPlane]
) -> FloorGrowth | None:
    """What becomes of a camera's own floor; None where it sees none.

    Args:
        cloud: What it sees.
        bias: (4,) its depth error as it was estimated, which is taken out afterwards.
        before: Its pose T_world_cam and the common floor before.
        after: And as estimated.
    """
    plane, plane_before = _own_floor(cloud, bias), _own_floor(cloud, np.zeros_like(bias))
    if plane is None or plane_before is None:
        return None
    a, noise = plane
    was, now = _off_floor(plane_before[0], *before), _off_floor(a, *after)
    sigma_tilt_deg, sigma_m = _floor_sigmas(a, noise)
    limits = (MAX_TILT_GROWTH_DEG + FLOOR_SIGMAS * sigma_tilt_deg, MAX_RISE_GROWTH_M + FLOOR_SIGMAS * sigma_m)
    return FloorGrowth(before=was, after=now, excess=max((now[k] - was[k]) / limits[k] for k in range(2)))


def common_tilts_deg(
    planes: tuple[FloorPlane, FloorPlane], up: Array, reference: Cloud, bias: Array, T_world_reference: Pose
) -> tuple[float, float]:
    """Tilt of the common floor before and after.

    Where the reference was not level itself the world cannot be, for it stays: then its own floor's tilt counts before.

    Args:
        planes: The common floor before and after.
        up: (3,) unit vector.
        reference: What the reference sees.
        bias: (4,) its depth error as it was estimated.
        T_world_reference: Its pose.
    """
    before, after = (_tilt_deg(plane.normal, up) for plane in planes)
    seen = _own_floor(reference, bias)
    own = 0.0 if seen is None else _tilt_deg(-T_world_reference[:3, :3] @ seen[0], up)
    return max(before, own), after


def _own_floor(cloud: Cloud, bias: Array) -> tuple[Array, Array] | None:
    """A camera's floor ``1 / z = a . r`` (3,) with a depth error taken out, and the covariance (3, 3) of its noise."""
    here = np.flatnonzero(cloud.is_floor)
    if cloud.floor is None or len(here) < 3:
        return None
    depth = cloud.depth_m[here] + bias @ cloud.slopes[:, here]
    root = depth**2 / cloud.sigma_m[here]  # of the weight of an inverse depth
    a = np.linalg.lstsq(cloud.rays[here] * root[:, None], root / depth, rcond=None)[0]
    return a, cloud.floor.noise


def _off_floor(a: Array, T_world_cam: Pose, floor: FloorPlane) -> tuple[float, float]:
    """Angle [deg] of a camera's plane with a floor, and how far it is off it [m] below the camera."""
    length = float(np.linalg.norm(a))
    tilt_deg = _tilt_deg(-T_world_cam[:3, :3] @ a, floor.normal)
    return tilt_deg, abs(float(floor.distances(T_world_cam[:3, 3])) - 1.0 / length)


def _floor_sigmas(a: Array, noise: Array) -> tuple[float, float]:
    """Standard deviations of a plane's angle [deg] and distance [m]."""
    h = 1.0 / float(np.linalg.norm(a))
    normal = -a * h
    tilt = h**2 * np.trace(plane_axes(normal) @ noise @ plane_axes(normal).T)
    return math.degrees(math.sqrt(float(tilt))), h**2 * math.sqrt(float(normal @ noise @ normal))


def _tilt_deg(normal: Array, up: Array) -> float:
    """Angle of a normal of any length with up."""
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(normal, up))), float(normal @ up)))
