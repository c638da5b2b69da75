"""Rotations as other people's files state them: matrices of few digits, quaternions, roll, pitch and yaw.

Owns      the nearest rotation to what a file says, quaternions in the order xyzw, URDF's roll, pitch and yaw, numbers
          in words that C++ readers take.
Leaves    rotation vectors to aruco.pose_math.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from aruco.errors import InputError
from aruco.pose_math import Array, Pose, log_so3, make_pose, skew

# Files of four decimals are this far from a rotation; what is further is not one that was rounded.
ROUNDED = 1e-3
# What is nearer to a rotation than this is left as it is, to the bit.
_EXACT = 1e-12
# Rounding of float64, in entries of a rotation.
_NOISE = 1e-15
# C++ readers that parse float or double throw, or read nothing, where a number underflows (float32: 1e-38).
_TINY = 1e-30


def nearest_rotation(R: Array, where: str) -> Array:
    """The rotation nearest to a (3, 3) matrix that was rounded; ``where`` names file and camera.

    Raises:
        InputError: The matrix is no rotation, even allowing for four decimals.
    """
    off = float(np.abs(R @ R.T - np.eye(3)).max()) if np.isfinite(R).all() else math.inf
    if not off <= ROUNDED or np.linalg.det(R) < 0:
        raise InputError(f"{where}: its rotation is not a proper rotation; mend it or leave the camera out.")
    if off <= _EXACT:
        return R
    U, _, Vt = np.linalg.svd(R)
    return U @ Vt


def rigid_pose(T: Array, where: str) -> Pose:
    """The rigid transform nearest to a (4, 4) matrix that was rounded.

    Raises:
        InputError: It is none.
    """
    if T.shape != (4, 4) or not np.isfinite(T).all() or np.abs(T[3] - [0.0, 0.0, 0.0, 1.0]).max() > ROUNDED:
        raise InputError(f"{where}: not the 4 x 4 matrix of a rigid transform; mend it or leave the camera out.")
    return make_pose(nearest_rotation(T[:3, :3], where), T[:3, 3])


def xyzw_of_rotation(R: Array) -> Array:
    """The unit quaternion (4,) in the order xyzw of a (3, 3) rotation, with w >= 0."""
    rvec = log_so3(R)
    half = 0.5 * float(np.linalg.norm(rvec))
    q = np.append(0.5 * np.sinc(half / np.pi) * rvec, max(math.cos(half), 0.0))
    return q / np.linalg.norm(q)


def rotation_of_xyzw(xyzw: Array, where: str) -> Array:
    """The (3, 3) rotation of a quaternion (4,) in the order xyzw; both signs mean the same.

    Raises:
        InputError: Its length is not one, even allowing for few digits.
    """
    length = float(np.linalg.norm(xyzw))
    if not abs(length - 1.0) <= 0.01:  # 0.71 0.71 0 0, the coarsest that people write, is off by 0.004
        raise InputError(f"{where}: the quaternion's length is {length:.4g}, not 1; mend it or leave the camera out.")
    W = skew(xyzw[:3] / length)
    return np.eye(3) + 2.0 * float(xyzw[3]) / length * W + 2.0 * W @ W


def rotation_of_rpy(rpy: Array) -> Array:
    """The (3, 3) rotation ``Rz(yaw) @ Ry(pitch) @ Rx(roll)``: about the fixed axes x, y, z in this order [rad]."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rpy_of_rotation(R: Array) -> Array:
    """Roll, pitch and yaw (3,) [rad] of a (3, 3) rotation; see rotation_of_rpy.

    With the pitch a right angle only the sum or the difference of the two others is known: whatever yaw is taken, the
    roll is measured in the axes that it leaves, so that the three together still give the rotation.
    """
    along = math.hypot(R[0, 0], R[1, 0])
    yaw = math.atan2(R[1, 0], R[0, 0]) if along > _NOISE else 0.0
    pitch = math.atan2(-R[2, 0], along)
    s, c = math.sin(yaw), math.cos(yaw)
    roll = math.atan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return np.array([roll, pitch, yaw])


def steady(values: Array) -> Array:
    """Numbers without those so tiny that other readers stumble over them, and without negative zeros."""
    return np.where(np.abs(values) < _TINY, 0.0, values)


def words(values: Iterable[float]) -> list[str]:
    """Numbers, each in as many digits as read back as the same float64."""
    return [repr(float(value)) for value in steady(np.array(list(values), dtype=np.float64))]
