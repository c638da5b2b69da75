"""Which samples of one camera's cloud meet which of another's, and by how much they miss.

Owns      Matches, projective association of two clouds, which pairs of clouds are worth it.
Leaves    clouds to icp_cloud, what gaps say about poses to icp_solve.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from aruco.icp_band import compute_overlap_xz
from aruco.icp_cloud import Cloud
from aruco.icp_surface import RADIUS_M
from aruco.icp_types import ICPConfig, Pair
from aruco.pose_math import Array, Pose, invert_transform, transform_points

MAX_ANGLE_DEG = 40.0
# Noise may part what belongs together by more than the distance that is asked for: far from the cameras by much more.
_REACH_SIGMAS = 3.0
# Stray points lie beyond these quantiles of a cloud; its box does not reach to them.
_BOX_QUANTILES = (0.01, 0.99)
# Whether clouds meet at all shows in every so many samples, of which at least so many must: 160 in all, three cells.
_EVERY = 8
_LEAST_MATCHES = 20
# Of small clouds every sample is asked.
_FEW = 4000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matches:
    """Samples of a source that meet a target, at one relative pose."""

    source: str
    target: str
    i: NDArray[np.intp]  # (m,) samples of the source
    j: NDArray[np.intp]  # (m,) samples of the target
    gap_m: Array  # (m,) n . (T_target_source p_i - p_j) along the target's normal n
    n_candidates: int  # samples of the source that could have met: something is measured there, and does not hide them

    def __len__(self) -> int:
        """How many there are."""
        return len(self.i)


def match(
    source: Cloud,
    target: Cloud,
    T_target_source: Pose,
    max_distance_m: float,
    *,
    max_angle_deg: float = MAX_ANGLE_DEG,
    every: int = 1,
) -> Matches:
    """The samples of a source that meet a target's surface.

    Each sample is looked up in the target's image. It meets what is measured there when it is near along the target's
    normal, and when both surfaces face the same way. Farther behind it is hidden and says nothing; farther in front it
    contradicts.

    Args:
        source: Whose samples are looked up.
        target: Whose surface they meet.
        T_target_source: Relative pose of the cameras.
        max_distance_m: How far apart along the normal. Where three sigma of the noise of both are more, those count.
        max_angle_deg: Between the normals, beyond two sigma of what is known of the source's.
        every: Only every so many samples of the source, where a rough answer is enough.
    """
    R = T_target_source[:3, :3]
    rays = source.rays[::every] @ R.T
    points = rays * source.depth_m[::every, None] + T_target_source[:3, 3]
    i, j = looked_up(points, target)
    n = target.normals[j]
    off = points[i] - target.points[j]
    gap = (off * n).sum(axis=1)
    # What noise along either line of sight does along the normal.
    by_source = source.sigma_m[::every][i] * (rays[i] * n).sum(axis=1)
    by_target = target.sigma_m[j] * (target.rays[j] * n).sum(axis=1)
    reach = np.maximum(max_distance_m, _REACH_SIGMAS * np.hypot(by_source, by_target))
    beside = (off**2).sum(axis=1) - gap**2
    # A plane goes on, the surroundings of a normal do not: beyond them lies another part of the surface.
    far = (target.normal_sigma[j] > 0) & (beside > max(2 * max_distance_m, RADIUS_M) ** 2)
    allowed = math.radians(max_angle_deg) + 2 * source.normal_sigma[::every][i]
    alike = ((source.normals[::every][i] @ R.T) * n).sum(axis=1) >= np.cos(np.minimum(allowed, math.pi))
    met = (np.abs(gap) <= reach) & alike & ~far
    return Matches(
        source=source.camera,
        target=target.camera,
        i=every * i[met],
        j=j[met],
        gap_m=gap[met],
        n_candidates=int((gap >= -reach).sum()),
    )


def looked_up(points: Array, target: Cloud) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Which points (target's frame) project onto a sample of the target, and onto which."""
    front = np.flatnonzero(points[:, 2] > 0)
    p = points[front]
    u = (p @ target.K[0]) / p[:, 2]
    v = (p @ target.K[1]) / p[:, 2]
    inside = (u > -0.5) & (v > -0.5) & (u < target.shape[1] - 0.5) & (v < target.shape[0] - 0.5)
    front = front[inside]
    row = np.floor((v[inside] + 0.5) / target.stride).astype(np.intp)
    column = np.floor((u[inside] + 0.5) / target.stride).astype(np.intp)
    j = target.grid[row, column].astype(np.intp)
    return front[j >= 0], j[j >= 0]


def overlapping_pairs(
    clouds: Mapping[str, Cloud], T_world_cam: Mapping[str, Pose], config: ICPConfig
) -> dict[Pair, float]:
    """Pairs (a < b) of cameras whose clouds share floor seen from above, and surfaces.

    Args:
        clouds: Camera -> its cloud.
        T_world_cam: Camera -> pose, y up or down.
        config: Least area, margin, and voxel size, four of which and the distance factor are how near surfaces must be.

    Returns:
        Pair -> area [m^2] of ``shared_areas``.
    """
    pairs: dict[Pair, float] = {}
    for (a, b), area in shared_areas(clouds, T_world_cam, config).items():
        if area > 0 and area >= config.min_overlap_area:
            T_b_a = invert_transform(T_world_cam[b]) @ T_world_cam[a]
            if _meet(clouds[a], clouds[b], T_b_a, config):
                pairs[a, b] = area
    return pairs


def shared_areas(clouds: Mapping[str, Cloud], T_world_cam: Mapping[str, Pose], config: ICPConfig) -> dict[Pair, float]:
    """Pair (a < b), of all clouds that are not empty -> area [m^2] of compute_overlap_xz.

    Stray points do not count: boxes reach from the 1st to the 99th percentile.
    """
    boxes = {
        name: np.quantile(transform_points(T_world_cam[name], cloud.points), _BOX_QUANTILES, axis=0)
        for name, cloud in clouds.items()
        if len(cloud)
    }
    margin = config.overlap_margin
    return {(a, b): compute_overlap_xz(boxes[a], boxes[b], margin) for a, b in combinations(sorted(boxes), 2)}


def _meet(a: Cloud, b: Cloud, T_b_a: Pose, config: ICPConfig) -> bool:
    """Whether some samples meet at the coarsest scale."""
    reach = 4 * config.voxel_size * config.max_correspondence_distance_factor
    every = _EVERY if min(len(a), len(b)) > _FEW else 1
    there = match(a, b, T_b_a, reach, every=every)
    back = match(b, a, invert_transform(T_b_a), reach, every=every)
    return len(there) + len(back) >= _LEAST_MATCHES
