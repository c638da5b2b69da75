"""How well a camera's place fits what all cameras see, rough as the place may be.

Owns      Witness, gaps, agreement: surfaces that meet, less surfaces that stand where another camera looks through.
Leaves    exact association with noise to icp_match, proposing places to icp_votes.

Clouds alone forgive too much: any place where walls meet walls looks well. What a camera sees through is empty.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.icp_cloud import Cloud
from aruco.icp_match import looked_up
from aruco.pose_math import Array, Pose, invert_transform, transform_points

# One sample counts for each such cube, so that near surfaces do not outvote far ones by their number.
_VOXEL_M = 0.2
MOST_ANGLE_DEG = 35.0
# Biases of two cameras may part what belongs together by this many sigmas.
_DOUBT_SIGMAS = 2.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Witness:
    """One camera's cloud, and the few samples of it that are asked."""

    cloud: Cloud
    points: Array  # (n, 3) of the cloud, camera frame
    doubt_m: Array  # (n,) how far depth may be off by noise and bias, one sigma
    asked: NDArray[np.intp]  # (m,) samples, one of each cube

    @property
    def camera(self) -> str:
        """Whose cloud it is."""
        return self.cloud.camera


def witness(cloud: Cloud) -> Witness:
    """A cloud made ready for ``agreement``."""
    points = cloud.points
    by_bias = ((cloud.bias_covariance @ cloud.slopes) * cloud.slopes).sum(axis=0)
    doubt_m = np.sqrt(cloud.sigma_m**2 + by_bias)
    return Witness(cloud=cloud, points=points, doubt_m=doubt_m, asked=first_of_voxels(points, _VOXEL_M))


def first_of_voxels(points: Array, voxel_m: float) -> NDArray[np.intp]:
    """Ascending indices of the first of the points (n, 3) in each voxel."""
    _, first = np.unique(np.floor(points / voxel_m).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)


def agreement(
    source: Witness, targets: Sequence[Witness], T_world_cam: Mapping[str, Pose], places: Sequence[Pose], reach_m: float
) -> Array:
    """How well each of a camera's possible places agrees with the other cameras.

    Args:
        source: The camera.
        targets: The others.
        T_world_cam: The others' poses.
        places: (k) poses T_world_cam of the source.
        reach_m: How far apart surfaces may be that meet, besides doubt in their depth; beyond, the one in front
            contradicts.

    Returns:
        (k,) samples that meet, the nearer the better, less samples that contradict; both ways. Floors are left out,
        because they meet anywhere, and samples count less whose depth is known less well than ``reach_m``.
    """
    total = np.zeros(len(places))
    for target in targets:
        T_target_world = invert_transform(T_world_cam[target.camera])
        for k, T in enumerate(places):
            T_target_source = T_target_world @ T
            total[k] += _tally(source, target, T_target_source, reach_m)
            total[k] += _tally(target, source, invert_transform(T_target_source), reach_m)
    return total


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gaps:
    """Samples of a source that are asked, and what a target measures on the same lines of sight."""

    gap_m: Array  # (n,) along the target's normal; positive: in front of its surface
    doubt_m: Array  # (n,) of both depths, one sigma
    facing: Array  # (n,) cosine between the normals
    point: Array  # (n, 3) of the target, in its frame
    normal: Array  # (n, 3) likewise
    on_floor: NDArray[np.bool_]  # (n,) one of both is floor
    floor_on_floor: NDArray[np.bool_]  # (n,) both are


def gaps(source: Witness, target: Witness, T_target_source: Pose) -> Gaps:
    """Where the asked samples of a source stand before and behind what a target measures."""
    points = transform_points(T_target_source, source.points[source.asked])
    at, j = looked_up(points, target.cloud)
    i, n = source.asked[at], target.cloud.normals[j]
    return Gaps(
        gap_m=((points[at] - target.points[j]) * n).sum(axis=1),
        doubt_m=np.hypot(source.doubt_m[i], target.doubt_m[j]),
        facing=(source.cloud.normals[i] @ T_target_source[:3, :3].T * n).sum(axis=1),
        point=target.points[j],
        normal=n,
        on_floor=source.cloud.is_floor[i] | target.cloud.is_floor[j],
        floor_on_floor=source.cloud.is_floor[i] & target.cloud.is_floor[j],
    )


def _tally(source: Witness, target: Witness, T_target_source: Pose, reach_m: float) -> float:
    found = gaps(source, target, T_target_source)
    reach = reach_m + _DOUBT_SIGMAS * found.doubt_m
    counts = 1.0 / (1.0 + (found.doubt_m / reach_m) ** 2)
    met = (np.abs(found.gap_m) <= reach) & (found.facing >= math.cos(math.radians(MOST_ANGLE_DEG)))
    met &= ~found.on_floor
    nearness = counts * (1.0 - (found.gap_m / reach) ** 2)
    return float(nearness[met].sum()) - float(counts[found.gap_m > reach].sum())
