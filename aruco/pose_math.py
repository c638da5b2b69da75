"""SE(3) on 4x4 arrays.

Owns      composing, inverting, exponential and logarithm, swing and twist, distances of poses.
Leaves    robust averages to pose_averaging; cameras and lenses to model and lens.

``T_a_b`` maps points of frame b into frame a: ``p_a = R @ p_b + t``. A twist is ``xi = (rotation [rad],
translation [m])``, and ``exp_se3(xi) @ T`` perturbs on the left, in the axes of frame a. Formulas follow
Sola, Deray and Atchuthan, "A micro Lie theory for state estimation in robotics", 2018.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]
Pose = NDArray[np.floating[Any]]  # (4, 4) rigid transform, named T_to_from

# Below this angle the difference of the angle and its sine loses digits, and four terms are exact to float64.
_SMALL_ANGLE_RAD = 0.1
# How far R @ R.T may be from the identity before a matrix no longer counts as a rotation.
_RIGID_TOLERANCE = 1e-6


def checked_pose(T: Any, name: str) -> Pose:
    """A read-only copy of a rigid transform.

    Raises:
        ValueError: T is not a finite (4, 4) proper rigid transform; the message names ``name``.
    """
    pose: Pose = np.array(T, dtype=np.float64)
    if pose.shape != (4, 4):
        raise ValueError(f"{name}: want shape (4, 4), got {pose.shape}")
    if not np.isfinite(pose).all() or not np.allclose(pose[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{name}: not a finite rigid transform")
    R = pose[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=_RIGID_TOLERANCE) or np.linalg.det(R) < 0:
        raise ValueError(f"{name}: the rotation part is not a proper rotation")
    pose.setflags(write=False)
    return pose


def make_pose(R: Array, t: Array) -> Pose:
    """The (4, 4) transform of a (3, 3) rotation and a (3,) translation [m]."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.asarray(t, dtype=np.float64).reshape(3)
    return T


def invert_transform(T_a_b: Pose) -> Pose:
    """``T_b_a``, using the transpose instead of a general inverse."""
    R_b_a = T_a_b[:3, :3].T
    return make_pose(R_b_a, -R_b_a @ T_a_b[:3, 3])


def transform_points(T_a_b: Pose, points_b: Array) -> Array:
    """Points (..., 3) of frame b [m], seen from frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def skew(v: Array) -> Array:
    """The (..., 3, 3) matrices with ``skew(v) @ w = cross(v, w)`` for vectors (..., 3)."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def exp_so3(rvec: Array) -> Array:
    """Rotations (..., 3, 3) of rotation vectors (..., 3) [rad] (Rodrigues)."""
    rvec = np.asarray(rvec, dtype=np.float64)
    angle = np.linalg.norm(rvec, axis=-1)[..., None, None]
    W = skew(rvec)
    return np.eye(3) + np.sinc(angle / np.pi) * W + _one_minus_cosine(angle) * (W @ W)


def _one_minus_cosine(angle: Array) -> Array:
    """``(1 - cos(angle)) / angle**2``, through the half angle, which keeps all digits down to zero."""
    return 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2


def log_so3(R: Array) -> Array:
    """Rotation vector (3,) [rad] of a (3, 3) rotation; its length is in [0, pi]."""
    # Through the quaternion's largest component: exact near zero and near a half turn alike.
    m = np.asarray(R, dtype=np.float64)
    trace = float(np.trace(m))
    squares = np.array([trace, m[0, 0], m[1, 1], m[2, 2]])
    k = int(np.argmax(squares))
    q = np.empty(4)  # wxyz
    if k == 0:
        q[:] = 1.0 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        i, j, l = k - 1, k % 3, (k + 1) % 3
        q[0] = m[l, j] - m[j, l]
        q[1 + i] = 1.0 + m[i, i] - m[j, j] - m[l, l]
        q[1 + j] = m[j, i] + m[i, j]
        q[1 + l] = m[l, i] + m[i, l]
    q /= np.linalg.norm(q)
    if q[0] < 0:
        q = -q
    sine = float(np.linalg.norm(q[1:]))
    if sine < 1e-12:
        return 2.0 * q[1:]
    return q[1:] * (2.0 * math.atan2(sine, float(q[0])) / sine)


def rvec_tvec_to_matrix(rvec: Array, tvec: Array) -> Pose:
    """The (4, 4) transform of OpenCV's rotation vector (3,) [rad] and translation (3,) [m]."""
    return make_pose(exp_so3(np.asarray(rvec, dtype=np.float64).reshape(3)), np.asarray(tvec))


def matrix_to_rvec_tvec(T: Pose) -> tuple[Array, Array]:
    """Rotation vector (3,) [rad] and translation (3,) [m] of a (4, 4) transform."""
    return log_so3(T[:3, :3]), T[:3, 3].copy()


def _left_jacobian(rvec: Array) -> Array:
    """The (3, 3) left Jacobian of SO(3) at a rotation vector (3,) [rad]."""
    rvec = np.asarray(rvec, dtype=np.float64)
    angle = float(np.linalg.norm(rvec))
    square = angle**2
    if angle < _SMALL_ANGLE_RAD:
        b = (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))) / 6.0
    else:
        b = (angle - math.sin(angle)) / (angle * square)
    a = float(_one_minus_cosine(np.array(angle)))
    W = skew(rvec)
    return np.eye(3) + a * W + b * (W @ W)


def exp_se3(xi: Array) -> Pose:
    """The (4, 4) transform of a twist (6,) = (rotation [rad], translation [m])."""
    xi = np.asarray(xi, dtype=np.float64)
    return make_pose(exp_so3(xi[:3]), _left_jacobian(xi[:3]) @ xi[3:])


def log_se3(T: Pose) -> Array:
    """The twist (6,) = (rotation [rad], translation [m]) of a (4, 4) transform."""
    rvec = log_so3(T[:3, :3])
    xi = np.empty(6)
    xi[:3], xi[3:] = rvec, np.linalg.solve(_left_jacobian(rvec), T[:3, 3])
    return xi


def adjoint(T_a_b: Pose) -> Array:
    """The (6, 6) matrix with ``exp_se3(adjoint(T) @ xi) = T @ exp_se3(xi) @ inv(T)``."""
    R = T_a_b[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = skew(T_a_b[:3, 3]) @ R
    return out


def swing_twist(R: Array, axis: Array) -> tuple[Array, Array]:
    """Split a rotation as ``R = swing @ twist`` with the twist about a unit axis.

    Args:
        R: (3, 3) rotation.
        axis: (3,) unit vector, for instance gravity.

    Returns:
        The (3, 3) swing, whose axis is perpendicular to ``axis``, and the (3, 3) twist about ``axis``. A swing
        of exactly half a turn leaves the twist undefined; the identity is returned for it.
    """
    rvec = log_so3(R)
    angle = float(np.linalg.norm(rvec))
    direction = rvec / angle if angle > 0.0 else axis
    # The twist's quaternion is the part of R's quaternion along the axis.
    along = math.sin(angle / 2.0) * float(direction @ axis)
    scalar = math.cos(angle / 2.0)
    if math.hypot(along, scalar) < 1e-12:
        return np.array(R, dtype=np.float64), np.eye(3)
    twist = exp_so3(2.0 * math.atan2(along, scalar) * np.asarray(axis, dtype=np.float64))
    return R @ twist.T, twist


def rotation_angle(R: Array) -> float:
    """The angle [rad] of a (3, 3) rotation, in [0, pi]."""
    return float(np.linalg.norm(log_so3(R)))


def pose_distance(T_a: Pose, T_b: Pose) -> tuple[float, float]:
    """Angle [rad] and distance of origins [m] between two poses given in one frame."""
    return rotation_angle(T_a[:3, :3].T @ T_b[:3, :3]), float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]))


def pose_text(T: Pose) -> str:
    """The sixteen numbers of a pose, row by row; each reads back as the same float64."""
    return " ".join(repr(float(number) + 0.0) for number in T.ravel())
