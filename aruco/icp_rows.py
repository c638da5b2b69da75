"""What clouds measure of poses, depth errors and floor, as linear equations about one state.

Owns      where each unknown stands, the rows with what they share, what a change of the unknowns makes of the gaps.
Leaves    making rows to icp_equations, summing and solving them to icp_normal.

Unknown are of each camera a left twist (rotation, translation) of its pose and four numbers of its depth error (see
icp_cloud.Cloud.slopes), and three of the floor that all cameras see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from aruco.floor_plane import Mask
from aruco.pose_math import Array

Index = NDArray[np.intp]
POSE = 6
BIAS = 4
PER_CAMERA = POSE + BIAS
FLOOR = 3


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the unknowns of each camera stand in a vector of all of them."""

    cameras: tuple[str, ...]

    @property
    def size(self) -> int:
        """How many unknowns there are."""
        return PER_CAMERA * len(self.cameras) + FLOOR

    def pose(self, camera: str) -> slice:
        """A camera's twist, left, in the axes and about the origin of the equations' world."""
        k = PER_CAMERA * self.cameras.index(camera)
        return slice(k, k + POSE)

    def bias(self, camera: str) -> slice:
        """A camera's depth error."""
        k = PER_CAMERA * self.cameras.index(camera) + POSE
        return slice(k, k + BIAS)

    @property
    def floor(self) -> slice:
        """The floor: two slopes and a rise along up."""
        return slice(self.size - FLOOR, self.size)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Gaps averaged over what one cell of a camera sees of one cell of another, or of the floor; m rows.

    ``gap = gap_m + by_a . x_a + by_b . x_b`` for a change x of the unknowns; it should be zero up to
    ``shared_a e_a - shared_b e_b + own noise``, with e of variance one: what is wrong with the depth of a whole cell.
    """

    a: Index  # (m,) the first camera, its place in the layout
    b: Index  # (m,) the second one, or -1: the floor
    gap_m: Array  # (m,) of a beyond b, along the surface's normal
    by_a: Array  # (m, 10) derivative by (twist, depth error) of a
    by_b: Array  # (m, 10) likewise of b; by the floor (3 numbers, then zeros) where b is -1
    cell_a: Index  # (m,) numbered over all cameras
    cell_b: Index  # (m,) -1: the floor
    shared_a: Array  # (m,) [m]
    shared_b: Array  # (m,) [m]
    own: Array  # (m,) [m^2] variance of what a row shares with no other
    weight: Array  # (m,) of robust estimation, 0 to 1
    n_points: Index  # (m,) matches averaged

    @property
    def variance(self) -> Array:
        """(m,) of a gap with everything in it [m^2]."""
        return self.shared_a**2 + self.shared_b**2 + self.own

    @property
    def is_floor(self) -> Mask:
        """(m,) rows of a camera against the common floor."""
        return self.b < 0

    def columns(self, layout: Layout) -> tuple[Index, Index]:
        """First column (m,) of a's and of b's unknowns."""
        second = np.where(self.b < 0, layout.floor.start, PER_CAMERA * self.b)
        return PER_CAMERA * self.a, second

    def gaps(self, x: Array, layout: Layout) -> Array:
        """(m,) gaps [m] after a change of all unknowns (layout.size,)."""
        padded = np.append(x, np.zeros(PER_CAMERA))
        first, second = (c[:, None] + np.arange(PER_CAMERA) for c in self.columns(layout))
        return self.gap_m + (self.by_a * padded[first]).sum(axis=1) + (self.by_b * padded[second]).sum(axis=1)

    def only(self, keep: Mask | Index) -> Rows:
        """Some of the rows."""
        return Rows(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    @classmethod
    def stacked(cls, parts: Sequence[Rows]) -> Rows:
        """All rows of several, or of none."""
        parts = [cls._none(), *parts]
        return cls(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)})

    @classmethod
    def _none(cls) -> Rows:
        index, number, wide = np.zeros(0, dtype=np.intp), np.zeros(0), np.zeros((0, PER_CAMERA))
        return cls(
            a=index,
            b=index,
            gap_m=number,
            by_a=wide,
            by_b=wide,
            cell_a=index,
            cell_b=index,
            shared_a=number,
            shared_b=number,
            own=number,
            weight=number,
            n_points=index,
        )

    def of(self, camera: int) -> Mask:
        """(m,) rows in which a camera has part."""
        return (self.a == camera) | (self.b == camera)
