"""One adjustment of a given size in a process of its own, so that its memory can be weighed.

Owns      sightings without images of a box or a board, and timing their adjustment.
Leaves    judging the figures to suite.joint, which runs this file as a module.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.box_target import corner_faces
from aruco.model import Camera
from aruco.pose_math import Array, Pose, exp_se3, exp_so3, invert_transform, make_pose, transform_points
from rigcal.quality.truth import pair_errors
from rigcal.sim.placement import look_at
from rigcal.solve.adjust import Gauge
from rigcal.solve.judge import adjust_judging
from rigcal.solve.problem import Poses, Sightings

SIGMA_PX = 0.1
MIDDLE = np.array([0.0, 0.8, 0.0])
MARKERS_SEEN = 8


def main(cameras: int, frames: int, target: str, repeats: int) -> None:
    """Print a line of JSON: seconds of the fastest of some runs, and how far its worst pair is from the truth."""
    rng = np.random.default_rng(0)
    sightings, truth = simulated(rng, cameras, frames, target)
    start = Poses(_shaken(rng, truth.T_world_cam), _shaken(rng, truth.T_world_target))
    start.T_world_target[0] = truth.T_world_target[0]
    gauge = Gauge(np.zeros(cameras, dtype=bool), np.arange(frames) == 0)
    seconds, found = zip(*(_timed(sightings, start, gauge) for _ in range(repeats)))
    errors = pair_errors(_named(found[0].T_world_cam), _named(truth.T_world_cam))
    worst_mm = 1e3 * max(shift for _, shift in errors.values())
    sys.stdout.write(json.dumps({"seconds": min(seconds), "worst_mm": worst_mm}) + "\n")


def _timed(sightings: Sightings, start: Poses, gauge: Gauge) -> tuple[float, Poses]:
    before = time.perf_counter()
    judged = adjust_judging(sightings, start, gauge)
    return time.perf_counter() - before, judged.adjustment.poses


def _named(T_world_cam: Pose) -> dict[str, Pose]:
    return {f"{k:02d}": T for k, T in enumerate(T_world_cam)}


def _shaken(rng: np.random.Generator, T: Pose) -> Pose:
    """Poses (k, 4, 4) with 3 mrad and 3 mm a coordinate on top: an average of single views."""
    return np.array([exp_se3(3e-3 * rng.standard_normal(6)) @ pose for pose in T])


def simulated(rng: np.random.Generator, cameras: int, frames: int, target: str) -> tuple[Sightings, Poses]:
    """Every camera sees the whole board, or the 8 best markers of a box, in every frame."""
    K = np.array([[700.0, 0.0, 639.5], [0.0, 700.0, 359.5], [0.0, 0.0, 1.0]])
    bodies = [Camera(name=f"{k:02d}", width=1280, height=720, K=K) for k in range(cameras)]
    markers = _board() if target == "board" else _box()
    angles = np.linspace(-0.5, 0.5, cameras) if target == "board" else 2 * np.pi * np.arange(cameras) / cameras
    places = [
        look_at(np.array([2 * np.sin(a), 1.0 + 0.2 * rng.uniform(-1, 1), 2 * np.cos(a)]), MIDDLE, 0.0) for a in angles
    ]
    turns = [exp_so3(rng.uniform(-0.4, 0.4, 3) if target == "board" else rng.uniform(-2, 2, 3)) for _ in range(frames)]
    targets = [make_pose(R, MIDDLE + 0.1 * rng.standard_normal(3)) for R in turns]
    points, pixels, marker = [], [], []
    for body, place in zip(bodies, places):
        for T_world_target in targets:
            T_cam_target = invert_transform(place) @ T_world_target
            ids = _best(transform_points(T_cam_target, markers), len(markers) if target == "board" else MARKERS_SEEN)
            seen = markers[ids].reshape(-1, 3)
            points.append(seen)
            pixels.append(lens.project(body, transform_points(T_cam_target, seen)))
            marker.append(np.repeat(ids, markers.shape[1]))
    sizes = [len(p) for p in points]
    n = sum(sizes)
    sightings = Sightings(
        cameras=tuple(bodies),
        frames=tuple(range(frames)),
        view_camera=np.repeat(np.arange(cameras), frames),
        view_frame=np.tile(np.arange(frames), cameras),
        start=np.concatenate([[0], np.cumsum(sizes)]),
        points=np.concatenate(points),
        pixels=np.concatenate(pixels) + SIGMA_PX * rng.standard_normal((n, 2)),
        sigma_px=np.full(n, SIGMA_PX),
        marker=np.concatenate(marker),
    )
    T_first_world = invert_transform(targets[0])
    return sightings, Poses(T_first_world @ np.array(places), T_first_world @ np.array(targets))


def _board() -> Array:
    """(48, 1, 3) points of a board, 80 mm apart, seen from +z."""
    x, y = np.meshgrid(np.arange(8) - 3.5, np.arange(6) - 2.5)
    return 0.08 * np.stack([x.ravel(), y.ravel(), np.zeros(48)], axis=1)[:, None]


def _box() -> Array:
    """(24, 4, 3) corners of a box with four markers a side."""
    sides = ("bottom", "back", "top", "front", "left", "right")
    faces = corner_faces(0.6, 0.24, 0.30, {side: range(4 * k, 4 * k + 4) for k, side in enumerate(sides)})
    return np.concatenate([face.corners for face in faces])


def _best(in_camera: Array, n: int) -> NDArray[np.intp]:
    """Indices, ascending, of the n markers that face the camera most."""
    if in_camera.shape[1] < 4:
        return np.arange(n, dtype=np.intp)
    into = np.cross(in_camera[:, 1] - in_camera[:, 0], in_camera[:, 3] - in_camera[:, 0])
    middle = in_camera.mean(axis=1)
    cosine = np.einsum("ij,ij->i", into, middle) / np.linalg.norm(into, axis=1) / np.linalg.norm(middle, axis=1)
    return np.sort(np.argsort(-cosine, kind="stable")[:n])


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], int(sys.argv[4]))
