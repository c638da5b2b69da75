"""What registration of clouds answers: poses, every pair and camera, biases, the floor.

Owns      Given, Part, how figures of the parts of a rig come together.
Leaves    estimating to icp_solve, believing to icp_gates, sentences about the whole rig to icp_headline.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aruco.depth_bias import DepthBias
from aruco.floor_plane import FloorPlane, plane_axes
from aruco.icp_cloud import Cloud
from aruco.icp_equations import floor_parameters
from aruco.icp_gates import Verdict
from aruco.icp_headline import (
    NO_OVERLAP,
    RigParts,
    message_of,
    reference_of_part,
    remarks_of,
    warnings_of,
    why_nothing,
)
from aruco.icp_match import shared_areas
from aruco.icp_prior import Prior
from aruco.icp_solve import Registration
from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics, ICPResult, Pair
from aruco.pose_math import Array, Pose, invert_transform, make_pose, rotation_angle, skew

Answer = tuple[dict[str, Pose], ICPMetrics]
# A pair that shares nothing says nothing of any direction.
_ALL = ("turn about x", "yaw", "turn about z", "shift along x", "height", "shift along z")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Given:
    """What registration works on."""

    clouds: Mapping[str, Cloud]
    start: Mapping[str, Pose]
    begin: Mapping[str, Pose]  # where cameras are taken up that stand elsewhere
    priors: Mapping[str, Prior]
    start_covariances: Mapping[str, Array]  # (6, 6) of start, where that is not the prior's
    floor: FloorPlane | None
    config: ICPConfig


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """Cameras that overlapping clouds link with each other, brought together."""

    cameras: tuple[str, ...]
    verdict: Verdict
    pairs: dict[Pair, ICPResult]

    @property
    def result(self) -> Registration:
        """What was believed."""
        return self.verdict.registration


def pair_result(given: Given, pair: Pair, tried: Registration, believed: Registration, *, meets: bool) -> ICPResult:
    """What became of a pair: as it ended if it was used, else as it was tried."""
    used = pair in believed.pairs
    about = (believed if used else tried).pairs[pair]
    T_before, T_after = _relative(given.start, pair), _relative(believed.T_world_cam, pair)
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


def pairs_apart(
    met: Collection[Pair], areas: Mapping[Pair, float], poses: Mapping[str, Pose], config: ICPConfig
) -> dict[Pair, ICPResult]:
    """The pairs that were not looked at, with nothing to tell of them but where they stand and what they share.

    Args:
        met: Pairs that were looked at.
        areas: Of all pairs of clouds, seen from above [m^2].
        poses: Camera -> T_world_cam.
        config: Least area.
    """
    return {
        pair: ICPResult(
            transformation=_relative(poses, pair),
            fitness=0.0,
            inlier_rmse=math.nan,
            information_matrix=np.zeros((6, 6)),
            converged=False,
            overlap_m2=area,
            unobservable=_ALL,
            verdict=_why_apart(area, config),
            overlaps=False,
        )
        for pair, area in areas.items()
        if pair not in met
    }


def _why_apart(area_m2: float, config: ICPConfig) -> str:
    if area_m2 < config.min_overlap_area or area_m2 <= 0:
        return f"do not overlap: seen from above they share less than {config.min_overlap_area:g} m2 ({area_m2:.1f})"
    return "do not meet: they share an area seen from above, but hardly any surface in it"


def _relative(poses: Mapping[str, Pose], pair: Pair) -> Pose:
    """T_target_source."""
    source, target = pair
    return invert_transform(poses[target]) @ poses[source]


def unmoved(reasons: Mapping[str, str]) -> dict[str, CameraMove]:
    """Cameras of which no cloud can be used."""
    return {name: CameraMove(accepted=False, reason=why, refusal="no_cloud") for name, why in sorted(reasons.items())}


def nothing_met(
    poses: Mapping[str, Pose],
    clouds: Mapping[str, Cloud],
    left_out: Mapping[str, str],
    metrics: ICPMetrics,
    config: ICPConfig,
) -> ICPMetrics:
    """What is told where no two clouds overlap."""
    alone = {name: CameraMove(accepted=False, reason=NO_OVERLAP, refusal="unlinked", n_samples=len(cloud))
             for name, cloud in clouds.items() if len(clouds) > 1}  # fmt: skip
    return replace(
        metrics,
        message=why_nothing(len(poses), len(clouds), left_out, config),
        cameras=dict(sorted({**unmoved(left_out), **alone}.items())),
        per_pair_results=pairs_apart((), shared_areas(clouds, poses, config), poses, config),
    )


def answered(given: Given, parts: Sequence[Part], left_out: Mapping[str, str], metrics: ICPMetrics) -> Answer:
    """The poses and figures of all parts together."""
    poses = dict(given.start)
    covariances: dict[str, Array] = {}
    biases: dict[str, DepthBias] = {}
    for part in parts:
        poses |= part.result.T_world_cam
        covariances |= part.result.covariance
        if given.config.depth_bias:
            heard = {name for pair in part.result.pairs for name in pair} - {*part.verdict.left_out}
            biases |= {name: _bias(given.clouds[name], part.result, name) for name in sorted(heard)}
    results = {pair: result for part in parts for pair, result in part.pairs.items()}
    # The part of the reference camera; where that overlaps nobody, the largest.
    main = max(parts, key=lambda part: (metrics.reference_camera in part.cameras, len(part.cameras)))
    alone = sorted(given.clouds.keys() - {name for part in parts for name in part.cameras})
    tilt_deg, rise_m, sigmas = _floor_after(main.result, given)
    used = sum(result.converged for result in results.values())
    areas = shared_areas(given.clouds, {**given.start, **given.begin}, given.config)
    apart = pairs_apart(results, areas, poses, given.config)
    answer = replace(
        metrics,
        success=True,
        num_pairs_converged=used,
        num_cameras_optimized=len(main.cameras),
        num_disconnected=len(poses) - len(main.cameras),
        per_pair_results=dict(sorted((results | apart).items())),
        reference_camera=main.cameras[0],
        cameras=dict(sorted(_cameras(given, parts, main, alone, left_out).items())),
        covariances=covariances,
        biases=biases,
        floor_tilt_deg=tilt_deg,
        floor_rise_m=rise_m,
        floor_sigmas=sigmas,
        settled=all(part.result.settled for part in parts),
    )
    rig = RigParts(parts=[part.cameras for part in parts], alone=alone)
    told = {"warnings": warnings_of(answer, rig, given.config), "remarks": remarks_of(answer)}
    return poses, replace(answer, message=message_of(answer, given.begin.keys()), **told)


def _cameras(
    given: Given, parts: Sequence[Part], main: Part, alone: Sequence[str], left_out: Mapping[str, str]
) -> dict[str, CameraMove]:
    cameras = unmoved(left_out)
    for name in alone:
        cameras[name] = CameraMove(accepted=False, reason=NO_OVERLAP, refusal="unlinked")
    for part in parts:
        cameras |= part.verdict.moves
        first = cameras[part.cameras[0]]
        if not first.refusal:
            reason = first.reason if part is main else reference_of_part(part.cameras[1:])
            cameras[part.cameras[0]] = replace(first, reason=reason, refusal="reference")
    return {
        name: replace(move, n_samples=len(given.clouds[name])) if name in given.clouds else move
        for name, move in cameras.items()
    }


def _bias(cloud: Cloud, result: Registration, camera: str) -> DepthBias:
    """A camera's whole depth bias: what was given and what clouds add; leaning stays in the estimate."""
    given = cloud.given_bias or DepthBias(focal_baseline=cloud.focal_baseline)
    scale, second = (float(x) for x in result.bias[camera][:2])
    covariance = result.bias_covariance[camera][:2, :2]
    whole = {"scale": given.scale + scale, "covariance": (covariance + covariance.T) / 2}
    if given.model == "offset":
        return replace(given, offset_m=given.offset_m + second, **whole)
    return replace(given, inverse_depth=given.inverse_depth + second, **whole)


def _floor_after(result: Registration, given: Given) -> tuple[float, float, float]:
    """Tilt [deg] and rise [m] of the common floor by registration, beneath the middle of the rig, and how many sigma.

    The reference does not move. So where it stood aslant or too high itself, the floor of all is now found to lie
    otherwise than the levelling by its own depth had it.
    """
    if result.floor is None or given.floor is None:
        return math.nan, math.nan, math.nan
    up = np.asarray(given.config.up, dtype=np.float64)
    T_middle_world = make_pose(np.eye(3), -np.mean([T[:3, 3] for T in result.T_world_cam.values()], axis=0))
    before, after = (floor_parameters(plane.moved(T_middle_world), up) for plane in (given.floor, result.floor))
    off = after - before
    S = _floor_covariance(result, up)
    sigmas = math.sqrt(max(float(off @ np.linalg.lstsq(S, off, rcond=None)[0]), 0.0))
    cosine = float(np.clip(result.floor.normal @ given.floor.normal, -1.0, 1.0))
    return math.degrees(math.acos(cosine)), float(off[2]), sigmas


def _floor_covariance(result: Registration, up: Array) -> Array:
    """(3, 3) of the common floor's slopes and rise as it lies in the frame of the reference camera."""
    layout = result.layout
    turn, shift = np.split(np.arange(layout.size)[layout.pose(result.reference)], 2)
    J = np.zeros((3, layout.size))
    J[:, layout.floor] = np.eye(3)
    # Moved back by a twist (w, v) of the reference a plane turns by -w and sinks by v.
    J[:2, turn] = -plane_axes(up) @ skew(up)
    J[2, shift] = -up
    return J @ result.joint @ J.T
