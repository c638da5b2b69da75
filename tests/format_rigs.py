"""A rig for tests of formats: tilted cameras with every kind of lens, and points that they see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from aruco.lens import project
from aruco.model import Camera, DistortionModel, UpAxis
from aruco.pose_math import exp_so3, invert_transform, make_pose, transform_points
from rigcal.formats.rig import Rig

LENSES: Mapping[str, tuple[DistortionModel, Sequence[float]]] = {
    "pinhole": ("plumb_bob", ()),
    "brown": ("plumb_bob", (-0.17, 0.03, 0.0007, -0.0011, 0.0)),
    "brown_k3": ("plumb_bob", (-0.17, 0.03, 0.0007, -0.0011, 0.002)),
    "rational": ("rational_polynomial", (0.4, -0.2, 0.0005, -0.0004, 0.01, 0.6, -0.15, 0.02)),
    "fisheye": ("equidistant", (-0.012, 0.003, -0.002, 0.0004)),
}


def lens(name: str, kind: str) -> Camera:
    """A camera whose numbers are all different, so that no two can be exchanged unnoticed."""
    model, distortion = LENSES[kind]
    K = np.array([[701.3 + len(name), 0, 655.7], [0, 698.9, 348.2], [0, 0, 1]])
    return Camera(
        name=name,
        width=1280,
        height=720,
        K=K,
        distortion_model=model,
        distortion=np.array(distortion),
    )


def format_rig(kinds: Mapping[str, str], up: UpAxis | None = "+y") -> Rig:
    """Cameras (name -> kind of lens) in a circle, looking inwards and down, each rolled a little."""
    rng = np.random.default_rng(7)
    poses = {}
    for k, name in enumerate(kinds):
        yaw = 2 * np.pi * k / max(len(kinds), 2)
        # A level OpenCV camera in a world with +Y up that looks along -z, then down, then about the vertical.
        R = exp_so3(np.array([0, yaw, 0])) @ exp_so3(np.array([-0.4, 0, 0])) @ np.diag([1.0, -1.0, -1.0])
        R = R @ exp_so3(rng.normal(0, 0.1, 3))
        t = np.array([2.5 * np.sin(yaw), 1.2 + 0.3 * k, 2.5 * np.cos(yaw)])
        poses[name] = make_pose(R, t)
    if up == "-y":
        poses = {name: np.diag([1.0, -1.0, -1.0, 1.0]) @ T for name, T in poses.items()}
    cameras = {name: lens(name, kind) for name, kind in kinds.items()}
    return Rig(T_world_cam=poses, up=up, origin="target", cameras=cameras)


def points_before(rig: Rig, name: str, n: int = 50) -> np.ndarray:
    """World points (n, 3) that a camera sees, over its whole image."""
    rng = np.random.default_rng(11)
    z = rng.uniform(0.5, 4.0, n)
    x, y = rng.uniform(-0.8, 0.8, n), rng.uniform(-0.45, 0.45, n)
    return transform_points(rig.T_world_cam[name], np.stack([x * z, y * z, z], axis=1))


def pixels(rig: Rig, name: str, points_world: np.ndarray) -> np.ndarray:
    """Where a rig's camera sees points, in pixels whose centres are whole numbers."""
    return project(rig.cameras[name], transform_points(invert_transform(rig.T_world_cam[name]), points_world))


def worst_pose_difference(a: Rig, b: Rig) -> float:
    """The largest difference of any entry of any pose; the cameras are the same."""
    assert list(a.T_world_cam) == list(b.T_world_cam)
    return max(float(np.abs(a.T_world_cam[n] - b.T_world_cam[n]).max()) for n in a.T_world_cam)
