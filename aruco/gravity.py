"""Which way is up by the cameras' accelerometers: every camera's measurement in the world, and what they agree on.

Owns      comparing and averaging them, naming those that contradict the others.
Leaves    reading accelerometers to the recordings (model.KnowsUp), turning the world to alignment.

An accelerometer at rest measures the push that keeps it from falling, so it points up. Its reading and the camera's
pose together say where up is in the world. The images have no part in it: it is an independent witness both of a world
that was put upright by its target and of every camera's tilt.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.pose_math import Array, Pose

# Accelerometers that nobody calibrated are within one degree, so two differ by two; poses and their mounting on the
# camera's board add up to less than another one.
AGREE_DEG = 3.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class UpByAccelerometers:
    """What the accelerometers of a rig say about up."""

    up_world: Array | None  # (3,) unit, against gravity; None: no direction that more cameras share than any other
    up_cam: Mapping[str, Array]  # camera -> (3,) unit, as measured in its axes
    disagreement_deg: Mapping[str, float]  # camera -> from up_world; where that is None, from the nearest other camera
    odd: tuple[str, ...]  # cameras that no part of up_world comes from; all where that is None

    @property
    def spread_deg(self) -> float:
        """The largest disagreement of a camera that up_world comes from; NaN where it is None."""
        return max((d for name, d in self.disagreement_deg.items() if name not in self.odd), default=float("nan"))

    def turned(self, R_new_world: Array) -> UpByAccelerometers:
        """The same in a world that was turned by a (3, 3) rotation."""
        up = None if self.up_world is None else R_new_world @ self.up_world
        return replace(self, up_world=up)


def up_by_accelerometers(T_world_cam: Mapping[str, Pose], up_cam: Mapping[str, Array]) -> UpByAccelerometers | None:
    """What most accelerometers say.

    The largest group of cameras that agree with one of them within AGREE_DEG is averaged on the sphere, once more with
    all that agree with that average. Where another group without common members is as large, nobody knows.

    Args:
        T_world_cam: Camera -> (4, 4) pose.
        up_cam: Camera -> (3,) direction against gravity in the camera's axes; cameras without a pose are passed over,
            and so are vectors that are none.

    Returns:
        None where no camera with a pose has measured it.
    """
    measured = {
        name: np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
        for name, up in sorted(up_cam.items())
        if name in T_world_cam and np.isfinite(up).all() and np.linalg.norm(up) > 0.0
    }
    if not measured:
        return None
    vectors = np.array([T_world_cam[name][:3, :3] @ up for name, up in measured.items()])
    apart_deg = angle_deg(vectors[:, None], vectors[None])
    members = _largest_group(apart_deg)
    if members is None:
        nearest = (apart_deg + np.diag(np.full(len(measured), np.inf))).min(axis=1)
        off = dict(zip(measured, nearest.tolist()))
        return UpByAccelerometers(up_world=None, up_cam=measured, disagreement_deg=off, odd=tuple(measured))
    members = angle_deg(vectors, _mean(vectors[members])) <= AGREE_DEG
    up_world = _mean(vectors[members])
    off = dict(zip(measured, angle_deg(vectors, up_world).tolist()))
    for name, off_deg in off.items():
        logger.debug("accelerometer of camera {}: {:.2f} degrees from what most say", name, off_deg)
    odd = tuple(name for name, good in zip(measured, members) if not good)
    return UpByAccelerometers(up_world=up_world, up_cam=measured, disagreement_deg=off, odd=odd)


def _largest_group(apart_deg: Array) -> NDArray[np.bool_] | None:
    """The mask (n,) of the cameras near one of them; None if others apart from these are as many."""
    agree = apart_deg <= AGREE_DEG
    # Of equals the one whose neighbours are nearest.
    best = int(np.lexsort(((apart_deg * agree).sum(axis=1), -agree.sum(axis=1)))[0])
    members, rest = agree[best], ~agree[best]
    rival = int((agree & rest)[rest].sum(axis=1).max(initial=0))
    return members if rival < members.sum() else None


def _mean(vectors: Array) -> Array:
    """The unit vector (3,) nearest to unit vectors (n, 3) that lie within a few degrees."""
    total = vectors.sum(axis=0)
    return total / np.linalg.norm(total)


def angle_deg(a: Array, b: Array) -> Array:
    """The angle [deg] between unit vectors (..., 3); exact near zero and near a half turn."""
    return np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))
