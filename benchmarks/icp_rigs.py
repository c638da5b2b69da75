"""Simulated rigs for registration: how wrong they start, a floor with nothing on it, a hall with many cameras.

Owns      starts, what each camera says of its floor, the command's way from poses to registration, the hall.
Leaves    a furnished room's depth to levelled_rigs, registration to aruco.icp_registration.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from aruco.ground_plane import FloorPlane, GroundPlaneConfig, refine_ground_from_depth
from aruco.icp_types import ICPConfig
from aruco.model import Camera
from aruco.pose_math import Array, Pose, exp_so3, invert_transform, make_pose
from benchmarks.levelled_rigs import DepthRig, disturbed, known_covariances, measured_data
from rigcal.ground_note import DepthFile
from rigcal.icp_note import Registration
from rigcal.icp_refining import register_clouds
from rigcal.levelled_file import RigFile
from rigcal.levelled_rig import Levelling
from rigcal.sim import simulate
from rigcal.sim.noise import DepthBias, DepthNoise, generator
from rigcal.sim.noise import Purpose as Why
from rigcal.sim.placement import look_at
from rigcal.sim.render import render_depth
from rigcal.sim.scene import Panel, Scene, box_panels

# Standard deviations of a camera's turn about each axis and of its place along each.
STARTS = {"rough": (0.6, 0.012), "good": (0.03, 0.002)}  # [deg], [m]
# A floor whose end no camera sees.
_WIDE_M = 40.0
# A hall: cameras along both long walls by turns, so far from the next one, looking across and down.
HALL_WIDTH_M, HALL_STEP_M, HALL_HEIGHT_M = 6.0, 2.0, 3.0
_CAMERA_HEIGHT_M, _CAMERA_FROM_WALL_M = 2.2, 0.3
_HALL_SIZE, _HALL_FOCAL_PX, _HALL_BASELINE_M = (640, 360), 350.0, 0.12
_CARTONS_A_CAMERA = 2


def start_poses(rig: DepthRig, name: str, seed: int) -> tuple[dict[str, Pose], dict[str, Array]]:
    """A rig's poses as wrong as a start of this name, and the covariances (6, 6) that belong to them."""
    turn_deg, shift_m = STARTS[name]
    poses = disturbed(rig.T_world_cam, turn_deg=turn_deg, shift_m=shift_m, rng=np.random.default_rng([7, seed]))
    return poses, known_covariances(poses, turn_deg=turn_deg, shift_m=shift_m)


def floors_seen(rig: DepthRig, T_world_cam: Mapping[str, Pose]) -> dict[str, FloorPlane]:
    """The floor that each camera measures, in the world of its own given pose."""
    levelled, metrics = refine_ground_from_depth(rig.camera_data, T_world_cam)
    back = {name: T_world_cam[name] @ invert_transform(levelled[name]) for name in metrics.camera_planes}
    return {name: plane.moved(back[name]) for name, plane in metrics.camera_planes.items()}


def commanded(
    rig: DepthRig, T_world_cam: Mapping[str, Pose], covariances: Mapping[str, Array] | None, config: ICPConfig
) -> Registration:
    """What refine-ground-plane --icp makes of poses, with covariances (6, 6) in their file or without."""
    given = RigFile(
        name="poses", digest="", content={}, T_world_cam=T_world_cam, covariance=covariances or {}, depth_bias={},
        up="+y", up_is_assumed=False,
    )  # fmt: skip
    floor = GroundPlaneConfig()
    levelled, metrics = refine_ground_from_depth(rig.camera_data, T_world_cam, floor, covariances=covariances)
    levelling = Levelling(
        given=given, depth_file=DepthFile(name="depth", digest="depth"), data=rig.camera_data, config=floor,
        T_world_cam=levelled, metrics=metrics,
    )  # fmt: skip
    found = register_clouds(levelling, config).registration
    assert found is not None
    return found


def bare_rig(seed: int, *, biased: bool) -> DepthRig:
    """Four cameras over a floor on which nothing stands, and which ends nowhere."""
    simulation = simulate("box-static", seed=seed, depth_bias=biased)
    cameras, poses = simulation.recording.cameras, simulation.T_world_cam
    scene = Scene(panels=(_rectangle(_WIDE_M, _WIDE_M),))
    exact = {camera.name: render_depth(scene, camera, poses[camera.name]) for camera in cameras}
    data = measured_data(cameras, exact, simulation.depth_bias, simulation.rig.depth_noise, seed)
    return DepthRig(T_world_cam=poses, camera_data=data, bias=simulation.depth_bias, target_m=np.zeros(3))


def hall_rig(n_cameras: int, seed: int = 0) -> DepthRig:
    """Cameras of 640 x 360 along a hall that is the longer the more there are; each sees some neighbours only."""
    rng = generator(seed, Why.PLACEMENT, n_cameras)
    length = HALL_STEP_M * (n_cameras + 1)
    cameras = [_hall_camera(k) for k in range(n_cameras)]
    poses = {camera.name: _hall_pose(k, length, rng) for k, camera in enumerate(cameras)}
    scene = Scene(panels=tuple(_hall_panels(length, n_cameras, rng)))
    exact = {camera.name: render_depth(scene, camera, poses[camera.name]) for camera in cameras}
    bias = {camera.name: DepthBias() for camera in cameras}
    data: dict[str, dict[str, Any]] = measured_data(cameras, exact, bias, DepthNoise(), seed)
    return DepthRig(T_world_cam=poses, camera_data=data, bias=bias, target_m=np.zeros(3))


def _hall_camera(index: int) -> Camera:
    width, height = _HALL_SIZE
    K = np.array([[_HALL_FOCAL_PX, 0, (width - 1) / 2], [0, _HALL_FOCAL_PX, (height - 1) / 2], [0, 0, 1]])
    return Camera(name=f"cam{index:02d}", width=width, height=height, K=K, baseline_m=_HALL_BASELINE_M)


def _hall_pose(index: int, length: float, rng: np.random.Generator) -> Pose:
    side = 1.0 if index % 2 else -1.0
    x = HALL_STEP_M * (index + 1) - length / 2 + rng.uniform(-0.3, 0.3)
    z = side * (HALL_WIDTH_M / 2 - _CAMERA_FROM_WALL_M)
    at = np.array([x + rng.uniform(-0.5, 0.5), 0.0, -0.2 * z])
    return look_at(np.array([x, _CAMERA_HEIGHT_M, z]), at, rng.normal(0.0, np.deg2rad(2)))


def _hall_panels(length: float, n_cameras: int, rng: np.random.Generator) -> list[Panel]:
    panels = [_rectangle(length, HALL_WIDTH_M)]
    for half, across in ((length / 2, 1), (HALL_WIDTH_M / 2, 0)):
        span = HALL_WIDTH_M / 2 if across else length / 2
        for sign in (-1.0, 1.0):
            a, b = (np.array([sign * half, 0.0, s * span] if across else [s * span, 0.0, sign * half]) for s in (-1, 1))
            top = np.array([0.0, HALL_HEIGHT_M, 0.0])
            panels.append(Panel(vertices=np.array([a, b, b + top, a + top]), albedo=0.55))
    for _ in range(_CARTONS_A_CAMERA * n_cameras):
        size = rng.uniform([0.25, 0.3, 0.25], [0.5, 0.9, 0.5]).tolist()
        reach = np.array([length / 2 - 0.5, HALL_WIDTH_M / 2 - 0.9])
        x, z = rng.uniform(-reach, reach)
        turn = exp_so3(np.array([0.0, rng.uniform(0, 2 * np.pi), 0.0]))
        panels += box_panels(size, make_pose(turn, np.array([x, size[1] / 2, z])), 0.5)
    return panels


def _rectangle(length: float, width: float) -> Panel:
    """A floor at y = 0."""
    x, z = length / 2, width / 2
    return Panel(vertices=np.array([[-x, 0, -z], [x, 0, -z], [x, 0, z], [-x, 0, z]]), albedo=0.42)
