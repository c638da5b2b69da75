"""Clouds of a rig's cameras brought together, without making a calibration worse.

Owns      refine_with_icp: who takes part, the order of the steps, what is answered; the names that users import.
Leaves    clouds to icp_cloud, meeting to icp_match, the joint estimate to icp_solve, whether a move is believed to
          icp_gates, cameras that were bumped to icp_bumped, pairs of plain Open3D clouds and their graph to icp_pair
          and icp_graph.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from loguru import logger
from threadpoolctl import threadpool_limits

from aruco.depth_bias import DepthBias
from aruco.errors import InputError
from aruco.floor_plane import FloorPlane
from aruco.ground_plane import unproject_depth_to_points
from aruco.icp_band import compute_overlap_xz, extract_near_floor_band
from aruco.icp_bumped import believed, found_elsewhere, found_prior
from aruco.icp_cloud import Cloud, cloud_of
from aruco.icp_gates import Verdict, judge, set_aside
from aruco.icp_graph import apply_gravity_constraint, build_pose_graph, optimize_pose_graph
from aruco.icp_match import overlapping_pairs
from aruco.icp_pair import pairwise_icp
from aruco.icp_prior import Prior, Scales
from aruco.icp_solve import Registration, register
from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics, ICPResult
from aruco.pose_math import Array, Pose, checked_pose, invert_transform, rotation_angle

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

Pair = tuple[str, str]
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
        biases=biases or {},
        config=config,
    )
    with _one_thread():
        if not config.global_init:
            return _brought_together(asked, {})
        floor = _common_floor(floor_planes, poses)
        found = found_elsewhere(camera_data, poses, floor, asked.biases, config)
        return believed(poses, found, lambda elsewhere: _brought_together(asked, elsewhere))


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
    biases: Mapping[str, DepthBias]
    config: ICPConfig


def _brought_together(asked: _Asked, elsewhere: Mapping[str, Pose]) -> tuple[dict[str, Pose], ICPMetrics]:
    """Everything once, with some cameras taken up elsewhere than where they are said to stand."""
    poses, data = dict(asked.poses), asked.camera_data
    at = {**poses, **elsewhere}
    # A floor seen by a camera that stands elsewhere lies elsewhere.
    floor = _common_floor({name: plane for name, plane in asked.floor_planes.items() if name not in elsewhere}, at)
    clouds, left_out = _clouds(data, at, floor, asked.biases, asked.config)
    left_out |= dict.fromkeys(poses.keys() - data.keys(), "there is no depth of it")
    pairs = overlapping_pairs(clouds, at, asked.config)
    metrics = ICPMetrics(success=False, num_pairs_attempted=len(pairs), reference_camera=min(poses, default=""))
    if not pairs:
        return poses, replace(metrics, message=_why_not(poses, clouds, left_out), cameras=_unmoved(left_out))
    given = _Given(
        clouds=clouds,
        start=poses,
        begin=elsewhere,
        priors={name: found_prior(elsewhere[name]) if name in elsewhere else asked.priors[name] for name in clouds},
        floor=floor,
        config=asked.config,
    )
    parts = [_refined(given, part, pairs) for part in _linked(pairs)]
    return _answered(given, parts, left_out, metrics)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Given:
    """What registration works on."""

    clouds: Mapping[str, Cloud]
    start: Mapping[str, Pose]
    begin: Mapping[str, Pose]  # where cameras are taken up that stand elsewhere
    priors: Mapping[str, Prior]
    floor: FloorPlane | None
    config: ICPConfig


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Part:
    """Cameras that overlapping clouds link with each other, brought together."""

    cameras: tuple[str, ...]
    verdict: Verdict
    pairs: dict[Pair, ICPResult]

    @property
    def result(self) -> Registration:
        """What was believed."""
        return self.verdict.registration


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
    normal = np.mean([plane.normal for plane in planes], axis=0)
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
            left_out[name] = str(error)
            continue
        logger.debug("camera {}: {} samples, {} of them floor", name, len(cloud), int(cloud.is_floor.sum()))
        if len(cloud) < LEAST_SAMPLES:
            left_out[name] = f"{len(cloud)} samples of its depth can be used in region {config.region}, too few"
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


def _refined(given: _Given, part: tuple[str, ...], pairs: Mapping[Pair, float]) -> _Part:
    """A group brought together by the pairs that meet well enough."""
    clouds = {name: given.clouds[name] for name in part}
    within = {pair: area for pair, area in pairs.items() if pair[0] in part}
    everything = _registered(given, clouds, within, ())
    good = {p: area for p, area in within.items() if everything.pairs[p].fitness >= given.config.min_fitness}

    def again(kept: Collection[str], silent: Collection[str] = ()) -> Registration:
        # A cloud that is set aside may have been why errors were thought to be large.
        scales = everything.scales if kept and not silent else None
        return _registered(given, *set_aside(clouds, good, silent), kept, scales)

    first = everything if len(good) == len(within) else again(())
    verdict = judge(
        first,
        clouds,
        given.start,
        given.priors,
        given.config,
        floor=given.floor,
        register=again,
        alone=given.begin.keys(),
    )
    results = {
        pair: _pair_result(given, pair, everything, verdict.registration, meets=pair in good) for pair in sorted(within)
    }
    return _Part(cameras=part, verdict=verdict, pairs=results)


def _registered(
    given: _Given,
    clouds: Mapping[str, Cloud],
    pairs: Mapping[Pair, float],
    kept: Collection[str],
    scales: Scales | None = None,
) -> Registration:
    return register(
        clouds,
        {name: given.start[name] for name in clouds},
        given.priors,
        pairs,
        given.config,
        floor=given.floor,
        reference=min(clouds),
        kept=kept,
        begin=given.begin,
        scales=scales,
    )


def _pair_result(given: _Given, pair: Pair, tried: Registration, believed: Registration, *, meets: bool) -> ICPResult:
    """What became of a pair: as it ended if it was used, else as it was tried."""
    used = pair in believed.pairs
    about = (believed if used else tried).pairs[pair]
    source, target = pair
    T_before = invert_transform(given.start[target]) @ given.start[source]
    T_after = invert_transform(believed.T_world_cam[target]) @ believed.T_world_cam[source]
    turn = T_after[:3, :3] @ T_before[:3, :3].T
    if not meets:
        share, least = 100 * about.fitness, 100 * given.config.min_fitness
        verdict = f"not used: of the points that could meet {share:.0f} % do, want {least:.0f} %"
    elif not used:
        verdict = "set aside with a camera whose move was refused"
    else:
        verdict = "used, and left as it was" if np.array_equal(T_before, T_after) else "used, and moved"
    return ICPResult(
        transformation=T_after,
        fitness=about.fitness,
        inlier_rmse=about.rmse,
        information_matrix=about.information,
        converged=meets,
        overlap_m2=about.overlap_m2,
        n_points=about.n_points,
        rotation_deg=math.degrees(rotation_angle(turn)),
        translation_mm=1e3 * float(np.linalg.norm(T_after[:3, 3] - T_before[:3, 3])),
        unobservable=about.unobservable,
        verdict=verdict,
    )


def _answered(
    given: _Given, parts: list[_Part], left_out: Mapping[str, str], metrics: ICPMetrics
) -> tuple[dict[str, Pose], ICPMetrics]:
    """The poses and figures of all groups together."""
    poses = dict(given.start)
    cameras = _unmoved(left_out)
    alone = given.clouds.keys() - {name for part in parts for name in part.cameras}
    cameras |= _unmoved(dict.fromkeys(alone, "its cloud overlaps no other camera's"))
    covariances: dict[str, Array] = {}
    biases: dict[str, DepthBias] = {}
    for part in parts:
        poses |= part.result.T_world_cam
        cameras |= part.verdict.moves
        covariances |= part.result.covariance
        if given.config.depth_bias:
            heard = {name for pair in part.result.pairs for name in pair} - {*part.verdict.left_out}
            biases |= {name: _bias(given.clouds[name], part.result, name) for name in sorted(heard)}
    results = {pair: result for part in parts for pair, result in part.pairs.items()}
    # The group of the reference camera; where that overlaps nobody, the largest.
    main = max(parts, key=lambda part: (metrics.reference_camera in part.cameras, len(part.cameras)))
    tilt_deg, rise_m = _floor_after(main.result, given)
    used = sum(result.converged for result in results.values())
    answer = replace(
        metrics,
        success=used > 0,
        num_pairs_converged=used,
        num_cameras_optimized=len(main.cameras),
        num_disconnected=len(poses) - len(main.cameras),
        per_pair_results=results,
        reference_camera=main.cameras[0],
        cameras=dict(sorted(cameras.items())),
        covariances=covariances,
        biases=biases,
        floor_tilt_deg=tilt_deg,
        floor_rise_m=rise_m,
    )
    return poses, replace(answer, message=_message(answer))


def _unmoved(reasons: Mapping[str, str]) -> dict[str, CameraMove]:
    return {name: CameraMove(accepted=False, reason=why) for name, why in sorted(reasons.items())}


def _bias(cloud: Cloud, result: Registration, camera: str) -> DepthBias:
    """A camera's whole depth bias: what was given and what clouds add; leaning stays in the estimate."""
    given = cloud.given_bias or DepthBias(focal_baseline=cloud.focal_baseline)
    scale, second = (float(x) for x in result.bias[camera][:2])
    covariance = result.bias_covariance[camera][:2, :2]
    whole = {"scale": given.scale + scale, "covariance": (covariance + covariance.T) / 2}
    if given.model == "offset":
        return replace(given, offset_m=given.offset_m + second, **whole)
    return replace(given, inverse_depth=given.inverse_depth + second, **whole)


def _floor_after(result: Registration, given: _Given) -> tuple[float, float]:
    """Tilt [deg] and rise [m] of the common floor by registration, beneath the middle of the rig."""
    if result.floor is None or given.floor is None:
        return math.nan, math.nan
    cosine = float(np.clip(result.floor.normal @ given.floor.normal, -1.0, 1.0))
    middle = np.mean([T[:3, 3] for T in result.T_world_cam.values()], axis=0)[None]
    return math.degrees(math.acos(cosine)), float((given.floor.distances(middle) - result.floor.distances(middle))[0])


def _message(metrics: ICPMetrics) -> str:
    """One sentence or two about all of it."""
    used, tried, n = metrics.num_pairs_converged, metrics.num_pairs_attempted, len(metrics.cameras)
    meet = f"{used} of {tried} pairs of clouds meet"
    if not used:
        return f"{meet} well enough to be used; every camera keeps its pose."
    moved = [metrics.cameras[name] for name in metrics.moved]
    if not moved:
        return f"{meet}; every camera keeps its pose, each for the reason told of it."
    turn, shift = max(move.rotation_deg for move in moved), max(move.translation_mm for move in moved)
    return f"{meet}; {len(moved)} of {n} cameras moved, by up to {turn:.2f} degrees and {shift:.1f} mm."


def _why_not(poses: Mapping[str, Pose], clouds: Mapping[str, Cloud], left_out: Mapping[str, str]) -> str:
    """Why nothing can be registered."""
    if len(poses) < 2:
        return f"Clouds of two cameras and more can be brought together, and there is a pose of {len(poses)}."
    if len(clouds) < 2:
        why = "; ".join(f"{name}: {reason.rstrip('.')}" for name, reason in sorted(left_out.items()))
        return f"Clouds of two cameras and more can be brought together, and {len(clouds)} can be used ({why})."
    return (
        "No two cameras' clouds overlap: see that the poses are right and in metres, that cameras share a part of the "
        "room, and that min_overlap_area is not too large."
    )
