"""What a covariance of a camera's pose means: in other worlds, at the camera's centre, and in words.

Owns      carrying covariances along, standard deviations in the camera's own axes, the least known direction.

A covariance is (6, 6), order (rotation [rad], translation [m]), of the left perturbation in world axes:
``T_true = Exp(xi) @ T_estimate``. The translation part of xi moves the world's origin, not the camera; the camera's
centre c moves by ``v + omega x c``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from aruco.pose_math import Array, Pose, adjoint, skew

ROTATIONS = ("pitch", "yaw", "roll")  # about the camera's x, y and z axis
DIRECTIONS = ("sideways", "up and down", "along its optical axis")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraSigma:
    """Standard deviations of one camera's pose, in its own axes."""

    rotation_rad: Array  # (3,) pitch, yaw, roll
    centre_m: Array  # (3,) sideways, up and down, along the optical axis

    @property
    def total_rad(self) -> float:
        """Root of the summed variances of the three rotations."""
        return float(np.linalg.norm(self.rotation_rad))

    @property
    def total_m(self) -> float:
        """Root of the summed variances of the centre's coordinates."""
        return float(np.linalg.norm(self.centre_m))


def carried(covariance: Array, T_new_world: Pose) -> Array:
    """The covariance after the world has moved: ``Ad(C) S Ad(C)^T``."""
    A = adjoint(T_new_world)
    return A @ covariance @ A.T


def at_camera(covariance: Array, T_world_cam: Pose) -> Array:
    """(6, 6) covariance of (turn, shift of the centre), both in the camera's axes."""
    R = T_world_cam[:3, :3]
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = R.T
    J[3:, :3] = -R.T @ skew(T_world_cam[:3, 3])
    return J @ covariance @ J.T


def camera_sigma(covariance: Array, T_world_cam: Pose) -> CameraSigma:
    """Standard deviations of turn and centre in the camera's axes."""
    sigma = np.sqrt(np.maximum(np.diag(at_camera(covariance, T_world_cam)), 0.0))
    return CameraSigma(rotation_rad=sigma[:3], centre_m=sigma[3:])


def least_known(camera: str, sigma: CameraSigma, reach_m: float) -> str:
    """The least observable direction in words.

    Args:
        camera: Its name.
        sigma: What is known about it.
        reach_m: Distance at which a turn counts as a shift: that of the target.
    """
    turn, shift = int(np.argmax(sigma.rotation_rad)), int(np.argmax(sigma.centre_m))
    if sigma.rotation_rad[turn] * reach_m > sigma.centre_m[shift]:
        degrees = math.degrees(sigma.rotation_rad[turn])
        return f"{ROTATIONS[turn]} of camera {camera} is known only to {degrees:.2g} degrees"
    return f"the place of camera {camera} {DIRECTIONS[shift]} is known only to {1e3 * sigma.centre_m[shift]:.2g} mm"
