"""A box on a floor between cameras, without images: tiles of their depth, what markers know, and the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from target_views import looking_at

from aruco.depth_bias import DepthBias
from aruco.depth_fusion import DepthSensor, MarkerEquations
from aruco.depth_noise import bias_prior
from aruco.depth_tiles import FLOOR, Tiles
from aruco.depth_trial import HeldOutMarkers, MarkerHalf
from aruco.pose_math import Array, Pose, exp_se3, invert_transform, log_se3

FOCAL_BASELINE = 84.0
FLOOR_PLANE = (np.array([0.0, 1.0, 0.0]), -0.3)
SENSOR = DepthSensor(
    model="stereo", focal_baseline=FOCAL_BASELINE, prior=bias_prior(FOCAL_BASELINE), lean_unit=1 / FOCAL_BASELINE
)
# Of the marker poses: about the camera's own centre, 0.012 degrees and half a millimetre.
SIGMA_TURN_RAD = 2e-4
SIGMA_SHIFT_M = 5e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Room:
    """What is true, and what is told."""

    truth: Pose  # (c, 4, 4)
    bias: Array  # (c, 2) scale, inverse depth
    markers: MarkerEquations
    tiles: Tiles
    sensors: dict[str, DepthSensor]

    def halves(self) -> list[MarkerHalf]:
        """Each half of the markers knows half as much; held-out ones are off the truth by one sigma, in twenty ways."""
        half, rng = replace(self.markers, H=self.markers.H / 2), np.random.default_rng(0)
        n, k = len(self.truth), 20
        noise = rng.standard_normal((k, n, 6))

        def held_out(T_world_cam: Pose, T_world_target: Pose) -> HeldOutMarkers:
            at = [whitened(half.H, c, T, t) for c, (T, t) in enumerate(zip(T_world_cam, self.truth))]
            off = (np.array(at) / np.sqrt(k) + noise).reshape(-1, 2)
            marker = np.repeat(np.arange(k * n), 3)
            return HeldOutMarkers(camera=marker % n, marker=marker, off=off, off_px=0.05 * off)

        return [MarkerHalf(train=half, trained=np.ones(1, dtype=bool), held_out=held_out)] * 2


def whitened(H: Array, camera: int, T: Pose, truth: Pose) -> Array:
    """The distance (6,) of a camera's pose from the truth, in what markers know of it."""
    mine = slice(6 * camera, 6 * camera + 6)
    return np.linalg.cholesky(H[mine, mine]).T @ log_se3(T @ invert_transform(truth))


def box_room(
    rng: np.random.Generator,
    *,
    n_cameras: int = 4,
    biased: bool = True,
    floor: bool = True,
    lean_px: float = 0.0,
    sigma_px: float = 0.06,
    shaken: bool = True,
) -> Room:
    """Cameras 2 to 3 m from a box of 0.6 m; floor to 5 m."""
    angles = 2 * np.pi * (np.arange(n_cameras) + rng.uniform(-0.2, 0.2, n_cameras)) / n_cameras
    truth = np.array([looking_at(_place(a, rng.uniform(2.0, 3.0), rng.uniform(0.9, 1.6)), np.zeros(3)) for a in angles])
    size = [0.003, 0.15 / FOCAL_BASELINE] if biased else [0.0, 0.0]
    bias = rng.standard_normal((n_cameras, 2)) * size
    lean = rng.standard_normal((n_cameras, 2)) * lean_px / FOCAL_BASELINE
    tiles = _all_tiles(truth, bias, lean, sigma_px / FOCAL_BASELINE, rng, floor=floor)
    H, told = _markers(truth, rng, shaken=shaken)
    names = tuple(f"c{k}" for k in range(n_cameras))
    markers = MarkerEquations(
        cameras=names,
        targets=(0,),
        T_world_cam=told,
        T_world_target=np.eye(4)[None],
        free=np.append(np.ones(n_cameras, dtype=bool), False),
        H=H,
        g=np.zeros(len(H)),
    )
    return Room(truth=truth, bias=bias, markers=markers, tiles=tiles, sensors=dict.fromkeys(names, SENSOR))


def _place(angle: float, distance_m: float, height_m: float) -> Array:
    return np.array([distance_m * np.sin(angle), height_m, distance_m * np.cos(angle)])


def _markers(truth: Pose, rng: np.random.Generator, *, shaken: bool) -> tuple[Array, Pose]:
    """Information on left twists, and poses drawn from it."""
    n = len(truth)
    H, told = np.zeros((6 * n + 6, 6 * n + 6)), truth.copy()
    for c, T in enumerate(truth):
        J = np.zeros((6, 6))  # twist -> turn and shift of the camera's centre
        J[:3, :3] = J[3:, 3:] = np.eye(3)
        x, y, z = T[:3, 3]
        J[3:, :3] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        root = J / np.repeat([SIGMA_TURN_RAD, SIGMA_SHIFT_M], 3)[:, None]
        H[6 * c : 6 * c + 6, 6 * c : 6 * c + 6] = root.T @ root
        if shaken:
            told[c] = exp_se3(np.linalg.solve(root, rng.standard_normal(6))) @ T
    return H, told


def _all_tiles(truth: Pose, bias: Array, lean: Array, sigma: float, rng: np.random.Generator, *, floor: bool) -> Tiles:
    """Every 40 pixels of 1280 x 720, f = 700 px, what the ray meets first: a side of the box, or the floor to 5 m."""
    u, v = np.meshgrid(np.arange(-620, 640, 40) / 700, np.arange(-340, 360, 40) / 700)
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    column, row = np.meshgrid(np.arange(u.shape[1]) // 3, np.arange(u.shape[0]) // 3)
    blocks = (4096 * row + column).ravel()
    parts = []
    for c, T in enumerate(truth):
        along = rays @ T[:3, :3].T
        z, normal, offset = _first_surface(along, T[:3, 3])
        on_floor = np.abs(normal).max(axis=1) == 0
        seen = np.isfinite(z) & (z < 5.0) & (floor | ~on_floor)
        r = rays[seen]
        exact = 1.0 / z[seen] + bias[c, 1] + r[:, :2] @ lean[c]
        n = int(seen.sum())
        measured = (exact + sigma * rng.standard_normal(n)) / (1.0 + bias[c, 0])
        target = np.where(on_floor[seen], FLOOR, 0)
        sigmas = (np.full(n, sigma), np.full(n, sigma))
        parts.append((np.full(n, c), target, normal[seen], offset[seen], r, measured, *sigmas, blocks[seen]))
    names = ("camera", "target", "normal", "offset_m", "ray", "inverse", "sigma", "alone", "block")
    return Tiles(**{name: np.concatenate(column) for name, column in zip(names, zip(*parts))})


def _first_surface(along: Array, centre: Array) -> tuple[Array, Array, Array]:
    """Depth (n,), normal (n, 3) and offset (n,) of what rays (n, 3) of the world meet; a zero normal is the floor."""
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(along[:, 1] < 0, (FLOOR_PLANE[1] - centre[1]) / along[:, 1], np.inf)
        normals, offsets = np.zeros_like(along), np.zeros(len(along))
        for axis in range(3):
            for side in (-1.0, 1.0):
                hit = (0.3 * side - centre[axis]) / along[:, axis]
                points = centre + hit[:, None] * along
                others = np.delete(np.abs(points), axis, axis=1).max(axis=1)
                near = (hit > 0) & (hit < z) & (others < 0.25)
                z = np.where(near, hit, z)
                normals[near], offsets[near] = side * np.eye(3)[axis], 0.3
    return z, normals, offsets


def true_bias(room: Room, camera: int) -> DepthBias:
    """A camera's bias as it is."""
    scale, inverse = room.bias[camera]
    return DepthBias(scale=float(scale), inverse_depth=float(inverse), focal_baseline=FOCAL_BASELINE)
