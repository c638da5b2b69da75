"""Rigs for the formats of upright worlds, and what their cameras see."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from aruco.model import UpAxis
from aruco.pose_math import Array, Pose, make_pose
from rigcal.formats.rig import Rig

K = np.array([[1050.0, 0.0, 960.0], [0.0, 1050.0, 540.0], [0.0, 0.0, 1.0]])
SERIALS = ("34563472", "13870389", "4294967295")
# Arithmetic of 1e-16 on metres and pixels of a thousand; a wrong sign or order is off by hundreds of pixels.
SAME_PX = 1e-6
# Two products of rotations of float64, on metres.
SAME = 1e-12


def random_rig(seed: int, *, names: tuple[str, ...] = SERIALS, up: UpAxis | None = "+y") -> Rig:
    """Cameras that stand anywhere and look anywhere."""
    rng = np.random.default_rng(seed)
    turns = Rotation.from_quat(rng.normal(size=(len(names), 4))).as_matrix()
    poses = {name: make_pose(R, rng.normal(scale=3.0, size=3)) for name, R in zip(names, turns)}
    return Rig(T_world_cam=poses, up=up, origin="target")


def level_camera(height_m: float) -> Pose:
    """A camera in a world with Y up that looks level along -z, its own y down."""
    return make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, height_m, 0.0]))


def points_before(T_world_cam: Pose) -> Array:
    """(50, 3) points of the world that the camera has before it."""
    rng = np.random.default_rng(7)
    points_cam = rng.uniform([-1.0, -1.0, 1.0], [1.0, 1.0, 5.0], size=(50, 3))
    return points_cam @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]


def pixels(points: Array, R_world_cam: Array, t_world_cam: Array) -> Array:
    """(n, 2) pixels of points of any world, by nothing but the definition of a pinhole."""
    points_cam = (points - t_world_cam) @ R_world_cam
    projected = points_cam @ K.T
    return projected[:, :2] / projected[:, 2:]


def farthest(a: Mapping[str, Pose], b: Mapping[str, Pose]) -> float:
    """The largest difference of any number of poses of the same cameras."""
    assert list(a) == list(b)
    return max(float(np.abs(a[name] - b[name]).max()) for name in a)
