"""Where many uncertain matches agree that a camera stands.

Owns      voted_poses: turns about gravity and shifts, by votes of pairs of matches.
Leaves    matches to icp_features, believing any of it to icp_global.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.pose_math import Array, Pose, exp_so3, make_pose

# Pairs that are drawn; of true ones two in a thousand are left where only one match in twenty is right.
_PAIRS = 400_000
# Two places must lie this far apart to tell a turn: 6 cm of error over 0.5 m are 7 degrees, over 2 m below 2.
_LEAST_APART_M = 0.5
_MOST_STRETCH_M = 0.06
TURN_STEP_DEG = 2.0
SHIFT_STEP_M = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bounds:
    """How far a camera may have been moved."""

    turn_rad: float
    shift_m: float


def voted_poses(
    p: Array, q: Array, T_world_cam: Pose, bounds: Bounds, rng: np.random.Generator, most: int
) -> list[Pose]:
    """Poses that bring many places onto their matches, those with most votes first.

    Each pair of matches whose places are equally far apart votes for the turn about gravity and the shift that bring
    one pair onto the other.

    Args:
        p: (n, 3) places that the camera sees, where its pose puts them in the world [m].
        q: (n, 3) the places that each might be.
        T_world_cam: That pose, level.
        bounds: Of the turn about the camera's centre and of that centre's shift.
        rng: Chance.
        most: So many poses at most.
    """
    if len(p) < 2:
        return []
    a, b = rng.integers(0, len(p), (2, _PAIRS))
    turn, fits = _turns(p[b] - p[a], q[b] - q[a], bounds.turn_rad)
    a, b, turn = a[fits], b[fits], turn[fits]
    centre = T_world_cam[:3, 3]
    middle = 0.5 * (p[a] + p[b]) - centre
    shift = 0.5 * (q[a] + q[b]) - centre - _turned(middle, turn)
    near = np.linalg.norm(shift, axis=1) <= bounds.shift_m
    return [
        make_pose(exp_so3(angle * np.array([0.0, 1.0, 0.0])) @ T_world_cam[:3, :3], centre + step)
        for angle, step in _most_voted(turn[near], shift[near], most)
    ]


def _turns(from_: Array, to: Array, most_rad: float) -> tuple[Array, NDArray[np.bool_]]:
    """Turns (n,) about y that bring level directions onto others, and which of them are possible."""
    x, z, u, w = from_[:, 0], from_[:, 2], to[:, 0], to[:, 2]
    before, after = np.hypot(x, z), np.hypot(u, w)
    turn = np.arctan2(z * u - x * w, x * u + z * w)
    fits = (before >= _LEAST_APART_M) & (np.abs(before - after) <= _MOST_STRETCH_M) & (np.abs(turn) <= most_rad)
    return turn, fits & (np.abs(from_[:, 1] - to[:, 1]) <= _MOST_STRETCH_M)


def _turned(v: Array, turn: Array) -> Array:
    """Vectors (n, 3), each turned about y."""
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([c * v[:, 0] + s * v[:, 2], v[:, 1], c * v[:, 2] - s * v[:, 0]], axis=1)


def _most_voted(turn: Array, shift: Array, most: int) -> list[tuple[float, Array]]:
    """Means of the fullest bins of turn and level shift."""
    steps = np.array([np.radians(TURN_STEP_DEG), SHIFT_STEP_M, SHIFT_STEP_M])
    bins = np.round(np.column_stack([turn, shift[:, [0, 2]]]) / steps).astype(np.int64)
    _, member, votes = np.unique(bins, axis=0, return_inverse=True, return_counts=True)
    member = member.ravel()
    sums = np.stack([np.bincount(member, values, len(votes)) for values in (turn, *shift.T)], axis=1)
    means = sums / votes[:, None]
    fullest = np.argsort(-votes, kind="stable")[:most]
    return [(float(means[k, 0]), means[k, 1:]) for k in fullest]
