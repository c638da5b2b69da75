"""Cameras whose clouds contradict the others' by more than poses and depth are off.

Owns      contradictions between pairs of clouds, the most cameras that agree among themselves, who contradicts them;
          whether a camera that was found elsewhere fits there as well as cameras do that were never in doubt.
Leaves    where the others stand to icp_global; held-out distances, bounds and the floor to icp_gates, which judges a
          place first.

A surface that another camera looks through is a contradiction, however well clouds meet elsewhere. Cameras that stand
well contradict each other too, at the edges of things; after a bump of many degrees most samples do. Small bumps pass:
they are the business of the gates.

Gates compare a place with where the camera stood before, and nearly any place is better than that, even one where most
samples contradict other clouds. At right places hardly one does once the depth errors estimated there are taken out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from aruco import icp_words as words
from aruco.floor_model import centre_jacobian
from aruco.icp_agreement import MOST_ANGLE_DEG, Witness, gaps
from aruco.icp_prior import DEFAULT_SHIFT_M, DEFAULT_TURN_RAD, Prior
from aruco.icp_types import ICPMetrics, Pair
from aruco.pose_math import Array, Pose, invert_transform

# What windows and voxels of a few centimetres make of edges.
_BLUR_M = 0.03
# Depth and poses may be off by so many of their sigmas.
_SIGMAS = 3.0
# Of samples that meet or contradict, at least so many must before they count, and so large a share must contradict:
# midway, in odds, between the fifth that edges may make of a crowded room and the majority after a bump.
LEAST_SAMPLES = 20
MOST_AGAINST = 0.37
# Contradictions that are left at the edges of things, of what could meet, or as many as other cameras have among
# themselves where people walk about; never as many as of a bumped one.
MOST_LEFT = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class Meeting:
    """How the clouds of two cameras get on, both ways together; floor upon floor does not count."""

    met: int
    against: int

    @property
    def tells(self) -> bool:
        """Whether there is enough of it."""
        return self.met + self.against >= LEAST_SAMPLES

    @property
    def share(self) -> float:
        """Of what contradicts; 0 where nothing meets or contradicts."""
        return self.against / max(self.met + self.against, 1)

    @property
    def contradicts(self) -> bool:
        """Whether at least one of the two cannot stand where it is said to."""
        return self.tells and self.share > MOST_AGAINST


def meetings(
    clouds: Mapping[str, Witness], T_world_cam: Mapping[str, Pose], priors: Mapping[str, Prior]
) -> dict[Pair, Meeting]:
    """How each pair (a < b) of cameras gets on, as well as their poses are known.

    Args:
        clouds: Camera -> its cloud.
        T_world_cam: Where each is taken to stand.
        priors: How well that is known. Without a covariance: the default.
    """
    known = {name: _covariance(T_world_cam[name], priors.get(name)) for name in clouds}
    return {
        (a, b): meeting(clouds[a], clouds[b], (T_world_cam[a], T_world_cam[b]), known[a] + known[b])
        for a, b in combinations(sorted(clouds), 2)
    }


def meeting(a: Witness, b: Witness, T_world_cam: tuple[Pose, Pose], covariance: Array) -> Meeting:
    """How two clouds get on.

    Args:
        a: One cloud.
        b: The other.
        T_world_cam: Their poses.
        covariance: (6, 6) of both poses together, left perturbation (rotation, translation) in world axes.
    """
    T_world_a, T_world_b = T_world_cam
    there = _one_way(a, b, T_world_b, invert_transform(T_world_b) @ T_world_a, covariance)
    back = _one_way(b, a, T_world_a, invert_transform(T_world_a) @ T_world_b, covariance)
    return Meeting(met=there[0] + back[0], against=there[1] + back[1])


def _one_way(
    source: Witness, target: Witness, T_world_target: Pose, T_target_source: Pose, covariance: Array
) -> tuple[int, int]:
    """Samples that meet and that contradict."""
    found = gaps(source, target, T_target_source)
    n = found.normal @ T_world_target[:3, :3].T
    p = found.point @ T_world_target[:3, :3].T + T_world_target[:3, 3]
    J = np.hstack([np.cross(p, n), n])
    by_pose = np.einsum("ij,jk,ik->i", J, covariance, J)
    reach = _BLUR_M + _SIGMAS * np.sqrt(found.doubt_m**2 + np.maximum(by_pose, 0.0))
    counts = ~found.floor_on_floor
    met = counts & (np.abs(found.gap_m) <= reach) & (found.facing >= math.cos(math.radians(MOST_ANGLE_DEG)))
    return int(met.sum()), int((counts & (found.gap_m > reach)).sum())


def _covariance(T_world_cam: Pose, prior: Prior | None) -> Array:
    if prior is not None and prior.covariance is not None:
        return prior.covariance
    back = centre_jacobian(T_world_cam[:3, 3], inverse=True)
    return back @ np.diag([DEFAULT_TURN_RAD**2] * 3 + [DEFAULT_SHIFT_M**2] * 3) @ back.T


def agreeing(cameras: frozenset[str], met: Mapping[Pair, Meeting], reference: str) -> frozenset[str]:
    """The most cameras of which no two contradict each other, and those that hardly contradict these.

    Of sets as large, those with the reference come first, then those in which least contradicts. So of two cameras
    that contradict each other it is never the reference that was bumped: nobody knows, and it cannot be moved.
    """
    against = {name: frozenset(b for b in cameras if _pair(met, name, b).contradicts) for name in cameras}
    core = _most(cameras, against, met, reference)
    return core | {name for name in cameras - core if not together(_pair(met, name, b) for b in core).contradicts}


def _most(
    left: frozenset[str], against: Mapping[str, frozenset[str]], met: Mapping[Pair, Meeting], reference: str
) -> frozenset[str]:
    """Either the most contradicted camera is not one of them, or none that it contradicts is."""
    worst = max(left, key=lambda name: (len(against[name] & left), name), default="")
    if not left or not against[worst] & left:
        return left
    ways = (_most(way, against, met, reference) for way in (left - {worst}, left - against[worst]))
    return max(ways, key=lambda way: (len(way), reference in way, -_within(way, met).share))


def _within(cameras: frozenset[str], met: Mapping[Pair, Meeting]) -> Meeting:
    return together(m for pair, m in met.items() if cameras.issuperset(pair))


def together(some: Iterable[Meeting]) -> Meeting:
    """How several pairs get on."""
    all_ = list(some)
    return Meeting(met=sum(m.met for m in all_), against=sum(m.against for m in all_))


def _pair(met: Mapping[Pair, Meeting], a: str, b: str) -> Meeting:
    return met.get((min(a, b), max(a, b)), Meeting(met=0, against=0))


def doubt_about(
    camera: str, clouds: Mapping[str, Witness], T_world_cam: Mapping[str, Pose], metrics: ICPMetrics
) -> str:
    """What speaks against a found place, in words; empty: nothing.

    Args:
        camera: Which.
        clouds: Camera -> its cloud, the depth bias of this answer taken out.
        T_world_cam: Poses of this answer.
        metrics: Of this answer, in which the camera was moved.
    """
    unclear = metrics.cameras[camera].unobservable
    if unclear:
        return words.unclear(unclear)
    sure = {name: Prior(T_world_cam=T, covariance=np.zeros((6, 6))) for name, T in T_world_cam.items()}
    met = meetings(clouds, T_world_cam, sure)
    others = [_share(name, {pair: m for pair, m in met.items() if camera not in pair}) for name in clouds]
    most = min(max([MOST_LEFT, *others]), MOST_AGAINST)
    own = _share(camera, met)
    return words.contradicts_there(own, most) if own > most else ""


def _share(camera: str, met: Mapping[Pair, Meeting]) -> float:
    """Of a camera's samples that contradict any other."""
    return together(m for pair, m in met.items() if camera in pair).share
