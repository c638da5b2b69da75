"""Clouds of a rig's cameras brought together, without making a calibration worse.

Owns      refine_with_icp: who takes part, the order of the steps; the names that users import.
Leaves    clouds to icp_cloud, meeting to icp_match, the joint estimate to icp_solve, whether a move is believed to
          icp_gates, cameras that were bumped to icp_bumped, what is answered to icp_answer, pairs of plain Open3D
          clouds and their graph to icp_pair and icp_graph.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from loguru import logger
from threadpoolctl import threadpool_limits

from aruco.depth_bias import DepthBias
from aruco.errors import InputError
from aruco.floor_plane import FloorPlane
from aruco.ground_plane import unproject_depth_to_points
from aruco.icp_answer import Answer, Given, Pair, Part, answered, nothing_met, pair_result
from aruco.icp_band import compute_overlap_xz, extract_near_floor_band
from aruco.icp_bumped import found_prior, looked_for
from aruco.icp_cloud import Cloud, cloud_of
from aruco.icp_gates import judge, set_aside
from aruco.icp_graph import apply_gravity_constraint, build_pose_graph, optimize_pose_graph
from aruco.icp_headline import too_few
from aruco.icp_match import overlapping_pairs
from aruco.icp_pair import pairwise_icp
from aruco.icp_prior import Prior
from aruco.icp_solve import Registration, register
from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics, ICPResult
from aruco.pose_math import Array, Pose, checked_pose

__all__ = [
    "CameraMove",
    "ICPConfig",
    "ICPMetrics",
    "ICPResult",
    "apply_gravity_constraint",
    "build_pose_graph",
    "compute_overlap_xz",
    "extract_near_floor_band",
    "optimize_pose_graph",
    "pairwise_icp",
    "refine_with_icp",
    "unproject_depth_to_points",
]

# Fewer samples make no surface whose direction is known.
LEAST_SAMPLES = 100


def refine_with_icp(
    camera_data: Mapping[str, Mapping[str, Any]],
    extrinsics: Mapping[str, Pose],
    floor_planes: Mapping[str, FloorPlane],
    config: ICPConfig = ICPConfig(),  # noqa: B008 frozen
    *,
    covariances: Mapping[str, Array] | None = None,
    biases: Mapping[str, DepthBias] | None = None,
    priors: Mapping[str, Pose] | None = None,
    start_covariances: Mapping[str, Array] | None = None,
) -> tuple[dict[str, Pose], ICPMetrics]:
    """Move cameras so that their clouds meet, as far as clouds know better than the given poses.

    All cameras whose clouds overlap are estimated together with their depth errors, each given pose counting by its
    covariance. A camera's move is kept only if clouds then meet better where they were not fitted, too; see icp_gates.

    Args:
        camera_data: Camera -> ``depth`` (h, w) [m] and ``K`` (3, 3); optional ``confidence`` (h, w), ``baseline`` [m],
            ``n_frames`` that were pooled, ``bias`` (a DepthBias, which is taken out).
        extrinsics: Camera -> T_world_cam in an upright, levelled world: where registration starts.
        floor_planes: Camera -> the floor that it sees, in that world (GroundPlaneMetrics.camera_planes);
            may be empty.
        config: See ICPConfig. With ``global_init`` cameras that were bumped are looked for within its bounds.
        covariances: Camera -> (6, 6) of its pose in ``priors``, left perturbation (rotation, translation) in world
            axes. Cameras without one get a default whose size the clouds tell.
        biases: Camera -> its depth bias, in place of the one in its data.
        priors: Camera -> T_world_cam as it was known before any depth was looked at; default: ``extrinsics``.
        start_covariances: Camera -> (6, 6) of its pose in ``extrinsics``, where depth has made that another than in
            ``priors``: what is told of cameras that stay, and of what all others are moved against.

    Returns:
        The poses of all of ``extrinsics``, the first in sorted order as it was, and what was done. Where nothing can be
        done: the poses as they were, and metrics without success.

    Raises:
        InputError: A pose is none, or a covariance.
    """
    poses = {name: _checked_rigid(name, T) for name, T in extrinsics.items()}
    known = {**poses, **{name: _checked_rigid(name, T) for name, T in (priors or {}).items() if name in poses}}
    asked = _Asked(
        camera_data=camera_data,
        poses=poses,
        floor_planes=floor_planes,
        priors={
            name: Prior(T_world_cam=T, covariance=_checked_covariance(name, (covariances or {}).get(name)))
            for name, T in known.items()
        },
        start_covariances={
            name: S
            for name, given in (start_covariances or {}).items()
            if name in poses and (S := _checked_covariance(name, given)) is not None
        },
        biases=biases or {},
        config=config,
    )
    with _one_thread():
        if not config.global_init:
            return _brought_together(asked, {})
        floor = _common_floor(floor_planes, poses)
        return looked_for(
            camera_data,
            poses,
            asked.priors,
            floor,
            asked.biases,
            config,
            lambda elsewhere: _brought_together(asked, elsewhere),
        )


def _one_thread() -> threadpool_limits:
    """Sums of several threads differ in their last bits from those of one.

    Only libraries that are loaded can be told; those that scipy brings are loaded late everywhere else.
    """
    import scipy.linalg
    import scipy.sparse.linalg  # noqa: F401

    return threadpool_limits(1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Asked:
    """What refine_with_icp is called with, checked."""

    camera_data: Mapping[str, Mapping[str, Any]]
    poses: Mapping[str, Pose]
    floor_planes: Mapping[str, FloorPlane]
    priors: Mapping[str, Prior]
    start_covariances: Mapping[str, Array]
    biases: Mapping[str, DepthBias]
    config: ICPConfig


def _brought_together(asked: _Asked, elsewhere: Mapping[str, Pose]) -> Answer:
    """Everything once, with some cameras taken up elsewhere than where they are said to stand."""
    poses, data = dict(asked.poses), asked.camera_data
    at = {**poses, **elsewhere}
    # A floor seen by a camera that stands elsewhere lies elsewhere.
    floor = _common_floor({name: plane for name, plane in asked.floor_planes.items() if name not in elsewhere}, at)
    clouds, left_out = _clouds(data, at, floor, asked.biases, asked.config)
    left_out |= dict.fromkeys(poses.keys() - data.keys(), "There is no depth of it.")
    pairs = overlapping_pairs(clouds, at, asked.config)
    metrics = ICPMetrics(success=False, num_pairs_attempted=len(pairs), reference_camera=min(poses, default=""))
    if not pairs:
        return poses, nothing_met(poses, clouds, left_out, metrics, asked.config)
    given = Given(
        clouds=clouds,
        start=poses,
        begin=elsewhere,
        priors={name: found_prior(elsewhere[name]) if name in elsewhere else asked.priors[name] for name in clouds},
        start_covariances=asked.start_covariances,
        floor=floor,
        config=asked.config,
    )
    parts = [_refined(given, part, pairs) for part in _linked(pairs)]
    return answered(given, parts, left_out, metrics)


def _checked_rigid(name: str, T: Any) -> Pose:
    try:
        return checked_pose(T, f"camera {name}")
    except ValueError as error:
        raise InputError(f"{error}; repair its pose or leave the camera out.") from None


def _checked_covariance(name: str, given: Any) -> Array | None:
    if given is None:
        return None
    S = np.asarray(given, dtype=np.float64)
    if S.shape != (6, 6) or not np.isfinite(S).all() or not np.allclose(S, S.T, rtol=1e-6, atol=1e-12):
        raise InputError(
            f"camera {name}: its covariance is no symmetric matrix (6, 6) of finite numbers; leave it out."
        )
    if np.linalg.eigvalsh((S + S.T) / 2)[0] < -1e-9 * np.trace(S):
        raise InputError(f"camera {name}: its covariance has a negative variance in some direction; leave it out.")
    return (S + S.T) / 2


def _common_floor(floor_planes: Mapping[str, FloorPlane], poses: Mapping[str, Pose]) -> FloorPlane | None:
    """The floor amid the planes that cameras see, beneath the middle of the rig; None if nobody sees one."""
    planes = [floor_planes[name] for name in sorted(floor_planes)]
    if not planes:
        return None
    # Medians: the plane of a camera that was bumped may be among them.
    normal = np.median([plane.normal for plane in planes], axis=0)
    normal /= np.linalg.norm(normal)
    middle = np.mean([T[:3, 3] for T in poses.values()], axis=0)
    above_m = float(np.median([plane.distances(middle[None])[0] for plane in planes]))
    return FloorPlane(normal, above_m - float(middle @ normal))


def _clouds(
    camera_data: Mapping[str, Mapping[str, Any]],
    poses: Mapping[str, Pose],
    floor: FloorPlane | None,
    biases: Mapping[str, DepthBias],
    config: ICPConfig,
) -> tuple[dict[str, Cloud], dict[str, str]]:
    """The clouds that can be used, and why others cannot."""
    clouds: dict[str, Cloud] = {}
    left_out: dict[str, str] = {}
    for name in sorted(poses.keys() & camera_data.keys()):
        try:
            cloud = cloud_of(
                name, camera_data[name], config, T_world_cam=poses[name], floor=floor, bias=biases.get(name)
            )
        except InputError as error:
            left_out[name] = str(error).removeprefix(f"camera {name}: ")
            continue
        logger.debug("camera {}: {} samples, {} of them floor", name, len(cloud), int(cloud.is_floor.sum()))
        if len(cloud) < LEAST_SAMPLES:
            left_out[name] = too_few(len(cloud), LEAST_SAMPLES, config)
        else:
            clouds[name] = cloud
    return clouds, left_out


def _linked(pairs: Collection[Pair]) -> list[tuple[str, ...]]:
    """Cameras that pairs link, directly or over others, in groups; each group and all of them sorted."""
    groups: list[set[str]] = []
    for pair in sorted(pairs):
        touched = [group for group in groups if group & set(pair)]
        groups = [group for group in groups if not group & set(pair)] + [set(pair).union(*touched)]
    return sorted(tuple(sorted(group)) for group in groups)


def _refined(given: Given, part: tuple[str, ...], pairs: Mapping[Pair, float]) -> Part:
    """A group brought together by the pairs that meet well enough."""
    clouds = {name: given.clouds[name] for name in part}
    within = {pair: area for pair, area in pairs.items() if pair[0] in part}
    everything = _registered(given, clouds, within)
    good = {p: area for p, area in within.items() if everything.pairs[p].fitness >= given.config.min_fitness}

    def again(silent: Collection[str]) -> Registration:
        return _registered(given, *set_aside(clouds, good, silent))

    verdict = judge(
        everything if len(good) == len(within) else again(()),
        clouds,
        # A bumped camera's move counts from where it was found; nobody else is blamed for how far that is.
        {**given.start, **given.begin},
        given.priors,
        given.config,
        floor=given.floor,
        register=again,
        alone=given.begin.keys(),
    )
    results = {
        pair: pair_result(given, pair, everything, verdict.registration, meets=pair in good) for pair in sorted(within)
    }
    return Part(cameras=part, verdict=verdict, pairs=results)


def _registered(given: Given, clouds: Mapping[str, Cloud], pairs: Mapping[Pair, float]) -> Registration:
    return register(
        clouds,
        {name: given.start[name] for name in clouds},
        given.priors,
        pairs,
        given.config,
        floor=given.floor,
        reference=min(clouds),
        begin=given.begin,
        start_covariances=given.start_covariances,
    )
