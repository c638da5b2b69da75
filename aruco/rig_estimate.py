"""What an estimate of a whole rig says: the placed cameras, the lost ones, where the target was.

Owns      the types that resting_target and moved_target return.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from aruco.pose_math import Array, Pose, make_pose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placement:
    """Where one camera stands, and which views say so."""

    T_world_cam: Pose
    spread_rad: float  # root mean square of single views about the average
    spread_m: float
    frames: tuple[int, ...]  # views that took part
    n_views: int  # views there were
    n_ambiguous: int  # of these, with a rival that the view alone cannot rule out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigEstimate:
    """Every camera that could be placed in one world, why others could not, and the target of every frame used."""

    cameras: Mapping[str, Placement]
    lost: Mapping[str, str]  # camera -> reason
    T_world_target: Mapping[int, Pose]  # frame -> pose
    world_frame: int = 0  # the frame whose target carries the world

    def turned(self, R_new_world: Array) -> RigEstimate:
        """The same rig in a world that is turned about its origin by a (3, 3) rotation."""
        turn = make_pose(R_new_world, np.zeros(3))
        cameras = {name: replace(p, T_world_cam=turn @ p.T_world_cam) for name, p in self.cameras.items()}
        target = {frame: turn @ T for frame, T in self.T_world_target.items()}
        return replace(self, cameras=cameras, T_world_target=target)
