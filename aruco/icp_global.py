"""Where a camera that was bumped may stand, from what its surroundings look like instead of where it stood.

Owns      global_start: a proposal for one camera.
Leaves    features to icp_features, votes to icp_votes, how well a place fits to icp_agreement; the adjustment and every
          decision about a proposal to icp_solve and icp_gates.

The constants are chosen so that cameras turned by 20 degrees about any axis and shifted by 0.4 m are found in furnished
rooms; a place is as exact as its last steps, half a degree and a few centimetres, for the adjustment to begin from.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from loguru import logger

from aruco.floor_plane import FloorPlane, detect_floor_plane, fit_plane
from aruco.icp_agreement import Witness, agreement, first_of_voxels
from aruco.icp_cloud import Cloud
from aruco.icp_features import distinct_spots, matched_spots
from aruco.icp_types import ICPConfig
from aruco.icp_votes import Bounds, voted_poses
from aruco.pose_math import (
    Array,
    Pose,
    exp_so3,
    make_pose,
    pose_distance,
    transform_points,
)

_MOST_SPOTS_SOURCE, _MOST_SPOTS_TARGET = 600, 2000
_MOST_CANDIDATES, _MOST_CLIMBED = 60, 4
# A step of votes at 3 m: 1 degree and 5 cm are off by 10 cm.
_ROUGH_REACH_M, _FINE_REACH_M = 0.12, 0.05
# Turn [deg], shift [m] and reach [m] of the steps by which a place is improved.
_STEPS = ((2.0, 0.1, 0.12), (1.0, 0.05, 0.1), (0.5, 0.025, 0.06), (0.25, 0.0125, _FINE_REACH_M))
_MOST_STEPS = 8
# Two poses nearer than this [deg, m] are one for the adjustment, which finds from one what it finds from the other.
_SAME = (3.0, 0.1)
# And what lies within this of each other belongs to one top of the agreement, which is flat where walls are far.
_SAME_TOP = (6.0, 0.25)
# Surroundings farther off than this are noise.
_FARTHEST_M = 6.0
_FLOOR_VOXEL_M, _FLOOR_BAND_M = 0.08, 0.03
_MOST_TILT_DEG = 45.0
_LEAST_FLOOR = 300
# Of the samples asked: what a place must fit better by than the given one. Bumped cameras gain several times that.
_LEAST_GAIN = 0.05
# By how much of its own fit a place must be better than the next.
_LEAST_LEAD = 0.1
_UP = np.array([0.0, 1.0, 0.0])


def global_start(
    source: Witness, targets: Sequence[Witness], T_world_cam: Mapping[str, Pose], config: ICPConfig
) -> Pose | None:
    """The place where a camera fits best, if it fits clearly better there than where it is said to stand.

    Args:
        source: The cloud of the camera in question, best of the region "full".
        targets: Those of cameras that stand well, likewise.
        T_world_cam: Poses of all of these, in a world whose y axis is vertical.
        config: ``max_rotation_deg`` and ``max_translation_m`` bound how far the camera may have been moved; ``seed``.

    Returns:
        A proposal for T_world_cam of the source, right to a degree or two and a few centimetres, which nobody should
        take without proof; near the given place where that was off by little. None where the given place fits as well
        as any other, or nothing in sight tells places apart.
    """
    rig = _Rig(source=source, others=[t for t in targets if t.camera != source.camera], T_world_cam=T_world_cam)
    if not rig.others:
        return None
    T_given, clouds = T_world_cam[source.camera], [other.cloud for other in rig.others]
    T_level = _levelled(source.cloud, clouds, T_world_cam, config)
    candidates = _proposed(source.cloud, clouds, T_world_cam, T_level, config)
    if not candidates:
        return None
    starts = _different(candidates, rig.fit(candidates, _ROUGH_REACH_M))
    places = [T_given, *(rig.climbed(T) for T in (T_level, *starts))]
    fit = rig.fit(places, _FINE_REACH_M)
    logger.debug("camera {}: fits {:.0f} where it is, {} elsewhere", source.camera, fit[0], np.round(fit[1:]))
    bounds = (config.max_rotation_deg, config.max_translation_m)
    chosen = _chosen(places, fit, _LEAST_GAIN * len(rig.source.asked))
    return chosen if chosen is not None and _within(chosen, T_given, bounds) else None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rig:
    """A camera that is looked for, among others."""

    source: Witness
    others: list[Witness]
    T_world_cam: Mapping[str, Pose]

    def fit(self, places: Sequence[Pose], reach_m: float) -> Array:
        """How well each place agrees with the others."""
        return agreement(self.source, self.others, self.T_world_cam, places, reach_m)

    def climbed(self, T: Pose) -> Pose:
        """A place, turned about gravity and shifted step by step as long as that fits better.

        Least squares would be quicker, but walls whose depth is biased drag it away, and it is blind for free space.
        """
        for turn_deg, shift_m, reach_m in _STEPS:
            best = self.fit([T], reach_m)[0]
            for _ in range(_MOST_STEPS):
                around = _around(T, math.radians(turn_deg), shift_m)
                fits = self.fit(around, reach_m)
                k = int(np.argmax(fits))
                if fits[k] <= best:
                    break
                T, best = around[k], fits[k]
        return T


def _around(T: Pose, turn_rad: float, shift_m: float) -> list[Pose]:
    turned = [make_pose(exp_so3(angle * _UP) @ T[:3, :3], T[:3, 3]) for angle in (-turn_rad, turn_rad)]
    shifts = shift_m * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, 1.0], [0, 0, -1.0]])
    return [*turned, *(make_pose(T[:3, :3], T[:3, 3] + shift) for shift in shifts)]


def _different(candidates: Sequence[Pose], fit: Array) -> list[Pose]:
    """The candidates that fit best, of those at one place the best only."""
    kept: list[Pose] = []
    for k in np.argsort(-fit, kind="stable"):
        if len(kept) < _MOST_CLIMBED and not any(_within(candidates[k], T, _SAME) for T in kept):
            kept.append(candidates[k])
    return kept


def _levelled(source: Cloud, others: Sequence[Cloud], T_world_cam: Mapping[str, Pose], config: ICPConfig) -> Pose:
    """The source's pose, turned and raised so that the floor it sees is the others'; as it is where it sees none."""
    T, up = T_world_cam[source.camera], np.array(config.up, dtype=np.float64)
    floor = [transform_points(T_world_cam[c.camera], c.points[c.is_floor]) for c in others]
    common = fit_plane(np.concatenate(floor), up) if sum(map(len, floor)) >= _LEAST_FLOOR else None
    points = transform_points(T, source.points[first_of_voxels(source.points, _FLOOR_VOXEL_M)])
    tilt = min(_MOST_TILT_DEG, config.max_rotation_deg)
    seen = detect_floor_plane(points, up=up, threshold_m=_FLOOR_BAND_M, max_tilt_deg=tilt, seed=config.seed)
    if common is None or seen is None:
        return T
    return _onto(T, seen, common, config.max_translation_m)


def _onto(T_world_cam: Pose, seen: FloorPlane, floor: FloorPlane, most_m: float) -> Pose:
    axis = np.cross(seen.normal, floor.normal)
    sine = float(np.linalg.norm(axis))
    angle = math.atan2(sine, float(seen.normal @ floor.normal))
    R = exp_so3(axis * (angle / sine if sine > 0 else 0.0))
    centre = T_world_cam[:3, 3]
    rise = float(seen.distances(centre[None])[0] - floor.distances(centre[None])[0])
    return make_pose(R @ T_world_cam[:3, :3], centre + rise * floor.normal) if abs(rise) <= most_m else T_world_cam


def _proposed(
    source: Cloud, others: Sequence[Cloud], T_world_cam: Mapping[str, Pose], T_level: Pose, config: ICPConfig
) -> list[Pose]:
    """Places that features vote for."""
    mine = distinct_spots(*_surroundings(source, T_level), _MOST_SPOTS_SOURCE)
    if not len(mine):
        return []
    turn_rad = min(math.radians(config.max_rotation_deg), math.pi)
    lever = np.linalg.norm(mine.points - T_level[:3, 3], axis=1)
    reach = config.max_translation_m + 2.0 * math.sin(turn_rad / 2.0) * lever
    parts = [_surroundings(c, T_world_cam[c.camera]) for c in others]
    points, normals = (np.concatenate(part) for part in zip(*parts))
    near = np.linalg.norm(points - T_level[:3, 3], axis=1) <= _FARTHEST_M + float(reach.max())
    theirs = distinct_spots(points[near], normals[near], _MOST_SPOTS_TARGET)
    i, j = matched_spots(mine, theirs, reach, config.max_translation_m)
    rng = np.random.default_rng([config.seed, zlib.crc32(source.camera.encode())])
    bounds = Bounds(turn_rad=turn_rad, shift_m=config.max_translation_m)
    return voted_poses(mine.points[i], theirs.points[j], T_level, bounds, rng, _MOST_CANDIDATES)


def _surroundings(cloud: Cloud, T_world_cam: Pose) -> tuple[Array, Array]:
    near = cloud.depth_m <= _FARTHEST_M
    return transform_points(T_world_cam, cloud.points[near]), cloud.normals[near] @ T_world_cam[:3, :3].T


def _chosen(places: Sequence[Pose], fit: Array, least_gain: float) -> Pose | None:
    """The place that fits best, if that is clearly better than the first and none elsewhere fits nearly as well."""
    best = int(np.argmax(fit))
    if fit[best] - fit[0] < least_gain:
        return None
    rivals = [f for T, f in zip(places, fit) if not _within(T, places[best], _SAME_TOP)]
    return places[best] if fit[best] - max(rivals, default=-math.inf) >= _LEAST_LEAD * abs(fit[best]) else None


def _within(T_a: Pose, T_b: Pose, most: tuple[float, float]) -> bool:
    """Whether two poses are no farther apart than an angle [deg] and a distance [m]."""
    angle, distance = pose_distance(T_a, T_b)
    return math.degrees(angle) <= most[0] and distance <= most[1]
