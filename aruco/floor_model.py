"""The equations of floors and poses: what a camera at a corrected pose should see of the floor, and its derivatives.

Owns      one camera's measurement and prior, the state of the estimate, predictions; pose errors where none are given.
Leaves    solving to floor_fusion, the size of pose errors to floor_evidence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from aruco.floor_plane import plane_axes
from aruco.pose_math import Array, Pose, exp_so3, skew

# Pose errors where nobody has said them, one sigma; their size is then scaled by the evidence. A target seen from
# 2 or 3 m turns camera and place together, so a turn comes with a shift of 2.5 m times as much.
DEFAULT_TURN_RAD = math.radians(0.4)
DEFAULT_LEVER_M = 2.5
# No covariance is believed beyond this: tripods creep, lenses breathe, and it keeps the equations solvable.
LEAST_TURN_RAD = math.radians(0.005)
LEAST_RISE_M = 0.0002


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sight:
    """One camera's measurement of the floor, and what is known of its pose."""

    camera: str
    T_world_cam: Pose
    a: Array  # (3,) the plane, camera frame, as in floor_view
    noise: Array  # (3, 3) covariance of it from noise
    bias: Array  # (3, 3) covariance of it from what is not known of the depth's bias
    prior: Array  # (3, 3) of (turn about both level axes [rad], rise [m]) about its centre
    given: bool  # whether somebody has said the prior, or it is the default


def default_pose_covariance(T_world_cam: Pose) -> Array:
    """(6, 6) covariance of a pose of which nothing is known, left perturbation in world axes."""
    at_centre = np.diag([DEFAULT_TURN_RAD**2] * 3 + [(DEFAULT_LEVER_M * DEFAULT_TURN_RAD) ** 2] * 3)
    J = centre_jacobian(T_world_cam[:3, 3], inverse=True)
    return J @ at_centre @ J.T


def centre_jacobian(centre: Array, *, inverse: bool = False) -> Array:
    """(6, 6) from a left twist to (turn, shift of the centre), both in world axes; or back."""
    J = np.eye(6)
    J[3:, :3] = skew(centre) if inverse else -skew(centre)
    return J


def level_rows(up: Array) -> Array:
    """(3, 6): (turn about both level axes, rise) of (turn, shift of the centre)."""
    rows = np.zeros((3, 6))
    rows[:2, :3] = plane_axes(up)
    rows[2, 3:] = up
    return rows


def level_prior(covariance: Array, T_world_cam: Pose, up: Array) -> Array:
    """(3, 3) of (turn about both level axes, rise) about a camera's centre, of the covariance of its pose (6, 6)."""
    J = level_rows(up) @ centre_jacobian(T_world_cam[:3, 3])
    return J @ covariance @ J.T + np.diag([LEAST_TURN_RAD**2, LEAST_TURN_RAD**2, LEAST_RISE_M**2])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloorState:
    """Where the estimate stands."""

    up: Array  # (3,) unit
    pivot: Array  # (3,) the floor's height is that below this point
    floor: Array  # (3,) two slopes, and height along up [m]
    corrections: Array  # (n, 3) of each camera: turn about both level axes [rad], rise [m]

    @property
    def normal(self) -> Array:
        """(3,) unit normal of the floor."""
        n = self.up + self.floor[:2] @ plane_axes(self.up)
        return n / np.linalg.norm(n)

    @property
    def anchor(self) -> Array:
        """(3,) the floor's point on the vertical through the pivot."""
        return self.pivot + (self.floor[2] - self.pivot @ self.up) * self.up


def predicted_plane(T_world_cam: Pose, state: FloorState, correction: Array) -> tuple[Array, Array, Array]:
    """A camera's ``a`` (3,) and its derivatives (3, 3) by the floor and by the camera's own correction."""
    axes, up, n = plane_axes(state.up), state.up, state.normal
    R = exp_so3(correction[:2] @ axes) @ T_world_cam[:3, :3]
    n_cam = R.T @ n
    lever = T_world_cam[:3, 3] + correction[2] * up - state.anchor
    h = float(n @ lever)
    length = float(np.linalg.norm(up + state.floor[:2] @ axes))
    by_normal = -R.T / h + np.outer(n_cam, lever) / h**2
    by_rise = (n_cam * (float(n @ up) / h**2))[:, None]
    by_slopes = by_normal @ ((np.eye(3) - np.outer(n, n)) @ axes.T / length)
    by_turn = -R.T @ skew(n) @ axes.T / h
    by_floor, by_camera = np.hstack([by_slopes, -by_rise]), np.hstack([by_turn, by_rise])
    return np.asarray(-n_cam / h, dtype=np.float64), by_floor.astype(np.float64), by_camera.astype(np.float64)
