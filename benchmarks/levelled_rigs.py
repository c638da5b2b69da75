"""Simulated rigs with depth, their poses disturbed on purpose, to see what levelling makes of them.

Owns      depth of a simulated room without its pictures, disturbed poses, errors of levelled ones against the truth.
Leaves    levelling to aruco.ground_plane.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from aruco.depth_bias import DepthBias
from aruco.floor_model import centre_jacobian
from aruco.ground_plane import GroundPlaneConfig, GroundPlaneMetrics, refine_ground_from_depth
from aruco.model import Camera
from aruco.pose_math import Array, Pose, exp_so3, make_pose, transform_points
from benchmarks.furnished_rooms import things_amid_cameras
from rigcal.quality.truth import pair_errors
from rigcal.sim import Simulation, simulate
from rigcal.sim.noise import DepthBias as SimulatedBias
from rigcal.sim.noise import DepthNoise, Purpose, fixed_error, generator, grow_edges, measure_depth
from rigcal.sim.render import render_depth
from rigcal.sim.room import floor_panel, furniture_panels, wall_panels
from rigcal.sim.scene import Panel, Scene, target_panels
from rigcal.sim.simulation import focal_baseline

N_POOLED = 10
# Rigs of which depth is kept: a suite asks for the same one several times over, one after the other.
_KEPT = 4
# Of the chance that furnishes rooms, apart from the simulator's own.
_FURNISHED = 91


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthRig:
    """Cameras of known pose, and the depth that each measured of the room."""

    T_world_cam: dict[str, Pose]  # the truth: the floor is y = 0, +Y is up
    camera_data: dict[str, dict[str, Any]]
    bias: dict[str, SimulatedBias]
    target_m: Array  # (3,) the middle of the target


@lru_cache(_KEPT)
def _simulated(seed: int, furnished: bool = False) -> tuple[Simulation, Any, dict[str, Any]]:
    """A rig, its twin without bias, and each camera's exact depth."""
    simulation, unbiased = (simulate("box-static", seed=seed, depth_bias=biased) for biased in (True, False))
    panels = [*_room(simulation), *target_panels(simulation.target, simulation.T_world_target[0])]
    if furnished:
        panels += things_amid_cameras(_target_m(simulation), np.random.default_rng([_FURNISHED, seed]))
    scene, cameras = Scene(panels=tuple(panels)), simulation.recording.cameras
    exact = {camera.name: render_depth(scene, camera, simulation.T_world_cam[camera.name]) for camera in cameras}
    return simulation, unbiased, exact


def depth_rig(seed: int, *, biased: bool, furnished: bool = False) -> DepthRig:
    """A simulated rig's depth, pooled over ten frames, without rendering any picture.

    Args:
        seed: Of the rig, its room and its noise.
        biased: Whether each camera's depth is off by a scale and a disparity of its own.
        furnished: Whether things stand amid the cameras too: see furnished_rooms.
    """
    with_bias, without, exact = _simulated(seed, furnished)
    simulation = with_bias if biased else without
    data = measured_data(simulation.recording.cameras, exact, simulation.depth_bias, simulation.rig.depth_noise, seed)
    return DepthRig(
        T_world_cam=simulation.T_world_cam,
        camera_data=data,
        bias=simulation.depth_bias,
        target_m=_target_m(simulation),
    )


def _target_m(simulation: Simulation) -> Array:
    """The middle (3,) of the target at its first place, world [m]."""
    return transform_points(simulation.T_world_target[0], simulation.target.centre_m)


def measured_data(
    cameras: Sequence[Camera],
    exact: Mapping[str, Any],
    bias: Mapping[str, SimulatedBias],
    noise: DepthNoise,
    seed: int,
) -> dict[str, dict[str, Any]]:
    """What cameras measure of exact depth (h, w) by name, pooled over ten frames, as ground_plane takes it."""
    pooled = replace(noise, sigma_px=noise.sigma_px / N_POOLED**0.5)
    data: dict[str, dict[str, Any]] = {}
    for k, camera in enumerate(cameras):
        depth = _measured(exact[camera.name], pooled, bias[camera.name], focal_baseline(camera), seed, k)
        K = camera.K_depth
        data[camera.name] = {"depth": depth, "K": K, "baseline": camera.baseline_m, "n_frames": N_POOLED}
    return data


def _room(simulation: Simulation) -> list[Panel]:
    centres = [T[:3, 3] for T in simulation.T_world_cam.values()]
    places = [transform_points(T, simulation.target.centre_m) for T in simulation.T_world_target]
    furniture = furniture_panels(centres, places, generator(simulation.seed, Purpose.FURNITURE))
    return [floor_panel(), *wall_panels(), *furniture]


def _measured(exact: Any, noise: DepthNoise, bias: SimulatedBias, fB: float, seed: int, camera: int) -> Any:
    fixed = fixed_error(exact.shape, noise, generator(seed, Purpose.FIXED_DEPTH, camera))
    grown = grow_edges(exact, noise, fB)
    return measure_depth(grown, fixed, noise, bias, fB, generator(seed, Purpose.DEPTH, camera, 0))


def true_bias(rig: DepthRig, camera: str) -> DepthBias:
    """The bias that a camera's depth was simulated with, as the tools write it."""
    data, bias = rig.camera_data[camera], rig.bias[camera]
    fB = float(data["K"][0, 0]) * float(data["baseline"])
    return DepthBias(scale=bias.scale, inverse_depth=bias.disparity_px / fB, focal_baseline=fB)


def disturbed(
    T_world_cam: Mapping[str, Pose], *, turn_deg: float, shift_m: float, rng: np.random.Generator, exact: bool = False
) -> dict[str, Pose]:
    """Poses turned about their centres and shifted.

    Args:
        T_world_cam: The truth.
        turn_deg: Standard deviation about each axis, or with ``exact`` the angle itself, about a chance axis.
        shift_m: Likewise, of the centre.
        rng: Chance.
        exact: See above.
    """
    moved = {}
    for name, T in sorted(T_world_cam.items()):
        turn, shift = rng.standard_normal(3), rng.standard_normal(3)
        if exact:
            turn, shift = turn / np.linalg.norm(turn), shift / np.linalg.norm(shift)
        moved[name] = make_pose(exp_so3(np.radians(turn_deg) * turn) @ T[:3, :3], T[:3, 3] + shift_m * shift)
    return moved


def known_covariances(
    T_world_cam: Mapping[str, Pose], *, turn_deg: float, shift_m: float, exact: bool = False
) -> dict[str, Array]:
    """The covariances that belong to disturbed poses."""
    share = 1.0 / 3.0 if exact else 1.0
    S = share * np.diag([np.radians(turn_deg) ** 2] * 3 + [shift_m**2] * 3)
    back = {name: centre_jacobian(T[:3, 3], inverse=True) for name, T in T_world_cam.items()}
    return {name: J @ S @ J.T for name, J in back.items()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Levelled:
    """A rig before and after, against the truth."""

    tilts_deg: Array  # (n,) of up in each camera's frame
    heights_mm: Array  # (n,) signed errors of the cameras' heights above the floor
    pair_before_mm: float  # median error of relative poses
    pair_after_mm: float
    T_world_cam: dict[str, Pose]
    metrics: GroundPlaneMetrics


def levelled(
    rig: DepthRig,
    T_world_cam: Mapping[str, Pose],
    covariances: Mapping[str, Array] | None = None,
    *,
    config: GroundPlaneConfig = GroundPlaneConfig(),  # noqa: B008 frozen
) -> Levelled:
    """Level a rig's disturbed poses, and measure what came out."""
    new, metrics = refine_ground_from_depth(rig.camera_data, T_world_cam, config, covariances=covariances)
    names, truth = sorted(rig.T_world_cam), rig.T_world_cam
    up = np.array([0.0, 1.0, 0.0])
    tilts = [np.linalg.norm(np.cross(new[n][:3, :3].T @ up, truth[n][:3, :3].T @ up)) for n in names]
    heights = [float((new[n][:3, 3] - truth[n][:3, 3]) @ up) for n in names]
    return Levelled(
        tilts_deg=np.degrees(np.arcsin(tilts)),
        heights_mm=1e3 * np.array(heights),
        pair_before_mm=median_mm(T_world_cam, truth),
        pair_after_mm=median_mm(new, truth),
        T_world_cam=new,
        metrics=metrics,
    )


def median_mm(T_world_cam: Mapping[str, Pose], truth: Mapping[str, Pose]) -> float:
    """Median error of the relative poses of all pairs of cameras [mm]."""
    return 1e3 * float(np.median([distance for _, distance in pair_errors(T_world_cam, truth).values()]))
