"""Rigs without images for the joint adjustment: sightings of a box or a board, their truth, and a rough start."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from marker_pictures import make_camera
from numpy.typing import NDArray
from target_views import any_pose, box, looking_at, sight

from aruco import lens
from aruco.box_target import SIDES, corner_faces
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, exp_se3, invert_transform, make_pose, pose_distance, transform_points
from aruco.rig_estimate import Placement, RigEstimate
from rigcal.solve.adjust import Gauge
from rigcal.solve.problem import Poses, Sightings, gather

MIDDLE = np.array([0.0, 0.6, 0.0])
Seen = dict[str, dict[int, Detection]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimRig:
    """What cameras saw, and what is true."""

    cameras: tuple[Camera, ...]
    detections: Seen
    geometry: Mapping[int, Array]
    truth: Poses  # in the world of the first frame's target
    frames: tuple[int, ...]

    def sightings(self) -> Sightings:
        return gather(self.cameras, self.detections, self.geometry)

    def gauge(self) -> Gauge:
        """The first frame carries the world."""
        return Gauge(np.zeros(len(self.cameras), dtype=bool), np.arange(len(self.frames)) == 0)

    def start(self, rng: np.random.Generator, sigma: float = 3e-3) -> Poses:
        """The truth, shaken by 3 mrad and 3 mm a coordinate: an average of single views."""
        cameras, targets = (np.array([exp_se3(sigma * rng.standard_normal(6)) @ T for T in k]) for k in self._poses())
        targets[0] = self.truth.T_world_target[0]
        return Poses(cameras, targets)

    def _poses(self) -> tuple[Pose, Pose]:
        return self.truth.T_world_cam, self.truth.T_world_target

    def estimate(self, start: Poses) -> RigEstimate:
        """The start as the averages would hand it over."""
        placements = {
            camera.name: Placement(
                T_world_cam=T,
                spread_rad=1e-3,
                spread_m=1e-3,
                frames=tuple(self.detections[camera.name]),
                n_views=len(self.detections[camera.name]),
                n_ambiguous=0,
            )
            for camera, T in zip(self.cameras, start.T_world_cam)
        }
        targets = dict(zip(self.frames, start.T_world_target))
        return RigEstimate(cameras=placements, lost={}, T_world_target=targets, world_frame=self.frames[0])

    def with_detections(self, detections: Seen) -> SimRig:
        return replace(self, detections=detections)


def ring(n: int, radius_m: float, rng: np.random.Generator) -> list[Pose]:
    """T_world_cam of cameras all around, looking at the middle."""
    angles = 2 * np.pi * (np.arange(n) + rng.uniform(-0.2, 0.2, n)) / n
    return [
        looking_at(np.array([radius_m * np.sin(a), rng.uniform(0.9, 1.7), radius_m * np.cos(a)]), MIDDLE)
        for a in angles
    ]


def box_rig(
    rng: np.random.Generator,
    *,
    n_cam: int = 4,
    n_frame: int = 12,
    sigma_px: float = 0.05,
    lens_model: str = "pinhole",
    geometry: Mapping[int, Array] | None = None,
) -> SimRig:
    """A box carried through the middle of a ring of cameras; in one frame only, it rests."""
    geometry = box(0.6) if geometry is None else geometry
    targets = [make_pose(any_pose(rng)[:3, :3], MIDDLE + 0.2 * rng.standard_normal(3)) for _ in range(n_frame)]
    cameras = [make_camera(f"c{k}", lens_model) for k in range(n_cam)]
    places = ring(n_cam, 2.4, rng)
    seen = {
        camera.name: {
            f: sight(camera, invert_transform(T) @ target, geometry, sigma_px, rng) for f, target in enumerate(targets)
        }
        for camera, T in zip(cameras, places)
    }
    return _in_first(cameras, places, targets, seen, geometry)


def rich_box() -> dict[int, Array]:
    """A box with four markers on each of its six sides: every view has redundancy."""
    ids = {side: range(10 * k, 10 * k + 4) for k, side in enumerate(SIDES)}
    return {marker: c for face in corner_faces(0.6, 0.24, 0.3, ids) for marker, c in zip(face.ids, face.corners)}


def board(columns: int = 8, rows: int = 6, pitch_m: float = 0.08) -> dict[int, Array]:
    """Point id -> (1, 3), a grid in the plane z = 0 seen upright by a camera that looks along +z."""
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    points = pitch_m * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return {k: p[None] for k, p in enumerate(points)}


def board_rig(rng: np.random.Generator, *, n_frame: int = 25, sigma_px: float = 0.1) -> SimRig:
    """Four cameras side by side, 2 m from a board that is held out to all of them, tilted in turn."""
    geometry = board()
    cameras = [make_camera(f"c{k}") for k in range(4)]
    across = enumerate((-1.0, -0.35, 0.35, 1.0))
    places = [looking_at(np.array([x, 0.6 + 0.2 * (-1) ** k, -2.0]), MIDDLE) for k, x in across]
    # A rotation of half a turn about z: images have y down, the world has it up.
    upright = np.diag([-1.0, -1.0, 1.0])
    targets = [
        make_pose(any_pose(rng, 0.6)[:3, :3] @ upright, MIDDLE + 0.15 * rng.standard_normal(3)) for _ in range(n_frame)
    ]
    points = np.concatenate(list(geometry.values()))

    def sighted(camera: Camera, T_cam_target: Pose) -> Detection:
        pixels = lens.project(camera, transform_points(T_cam_target, points))
        inside = ((pixels > 5) & (pixels < [camera.width - 6, camera.height - 6])).all(axis=1)
        noisy = (pixels + sigma_px * rng.standard_normal(pixels.shape))[inside]
        return Detection(
            ids=np.flatnonzero(inside), corners_px=noisy[:, None], sigma_px=np.full((len(noisy), 1), sigma_px)
        )

    seen = {
        camera.name: {f: sighted(camera, invert_transform(T) @ target) for f, target in enumerate(targets)}
        for camera, T in zip(cameras, places)
    }
    return _in_first(cameras, places, targets, seen, geometry)


def _in_first(
    cameras: list[Camera], places: list[Pose], targets: list[Pose], seen: Seen, geometry: Mapping[int, Array]
) -> SimRig:
    """In the world of the first frame's target; views without a marker are none."""
    T_first_world = invert_transform(targets[0])
    return SimRig(
        cameras=tuple(cameras),
        detections={name: {f: d for f, d in by_frame.items() if len(d)} for name, by_frame in seen.items()},
        geometry=geometry,
        truth=Poses(np.array([T_first_world @ T for T in places]), np.array([T_first_world @ T for T in targets])),
        frames=tuple(range(len(targets))),
    )


def exchanged(rig: SimRig, camera: str, first: int, second: int) -> SimRig:
    """The same with two frames of one camera exchanged."""
    mine = dict(rig.detections[camera])
    mine[first], mine[second] = mine[second], mine[first]
    return rig.with_detections({**rig.detections, camera: mine})


def with_outliers(detections: Seen, share: float, rng: np.random.Generator, size_px: float = 20.0) -> Seen:
    """Corners, each with a chance of ``share``, thrown off by some ``size_px``."""

    def spoilt(d: Detection) -> Detection:
        gross = rng.random(d.sigma_px.shape) < share
        corners = d.corners_px + gross[..., None] * size_px * rng.standard_normal(d.corners_px.shape)
        return Detection(ids=d.ids, corners_px=corners, sigma_px=d.sigma_px)

    return {name: {f: spoilt(d) for f, d in by_frame.items()} for name, by_frame in detections.items()}


def promised(detections: Seen, factor: float) -> Seen:
    """The same corners with sigmas ``factor`` times what they were."""
    return {
        name: {f: Detection(ids=d.ids, corners_px=d.corners_px, sigma_px=factor * d.sigma_px) for f, d in views.items()}
        for name, views in detections.items()
    }


def flat(n: int, k: int) -> NDArray[np.bool_]:
    """A mask (n,) that is true at k."""
    return np.arange(n) == k


def pair_errors(T_world_cam: Pose, truth: Pose) -> tuple[Array, Array]:
    """Degrees and millimetres of every relative pose."""
    errors = [
        pose_distance(invert_transform(T_world_cam[i]) @ T_world_cam[j], invert_transform(truth[i]) @ truth[j])
        for i, j in combinations(range(len(truth)), 2)
    ]
    angle, shift = np.array(errors).T
    return np.degrees(angle), 1e3 * shift
