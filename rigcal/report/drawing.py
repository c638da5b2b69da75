"""What the pages about a rig draw alike: colours of cameras, the world with its height upwards, clouds of points.

Owns      these, and that the same figure gives the same bytes.
Leaves    what is drawn to floor_page and icp_page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from aruco.pose_math import Array

if TYPE_CHECKING:
    import plotly.graph_objects as go

Kind = TypeVar("Kind", bound=np.generic)
# Told apart by people who see red and green alike (Okabe and Ito), reused beyond eight cameras.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8A7A00")
# From farther away than by default, which cuts the nearest corner off.
_EYE = {"eye": {"x": 1.65, "y": 1.65, "z": 1.1}, "center": {"x": 0, "y": 0, "z": -0.1}}
MARGIN = {"l": 0, "r": 0, "t": 40, "b": 0}
LEGEND = {"itemsizing": "constant", "title": {"text": "camera"}}


def colours_of(cameras: Sequence[str]) -> dict[str, str]:
    """A colour each."""
    return {camera: COLOURS[k % len(COLOURS)] for k, camera in enumerate(cameras)}


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnWorld:
    """Where things of the levelled world go in a picture whose third axis points up."""

    up_y: int
    floor_y: float

    def drawn(self, points: Array) -> tuple[Array, Array, Array]:
        """x, z and height above the floor [m] of points (n, 3)."""
        return points[:, 0], points[:, 2], self.up_y * (points[:, 1] - self.floor_y)

    def scene(self, **height_axis: Any) -> dict[str, Any]:
        """A scene whose horizontal axes are x and z."""
        # x, z, y is left-handed where y points up: the z axis runs the other way, or left and right would be exchanged.
        z_axis = {"title": {"text": "z m"}, **({"autorange": "reversed"} if self.up_y > 0 else {})}
        return {"xaxis": {"title": {"text": "x m"}}, "yaxis": z_axis, "zaxis": height_axis, "camera": _EYE}


def cloud(x: Array, y: Array, z: Array, colour: str, name: str, hover: str) -> go.Scatter3d:
    """Points of one camera, whose legend entry switches all that is drawn of it."""
    import plotly.graph_objects as go

    small = (np.asarray(values, dtype=np.float32) for values in (x, y, z))
    return go.Scatter3d(
        **dict(zip("xyz", small)),
        mode="markers",
        marker={"size": 1.6, "color": colour},
        name=name,
        legendgroup=name,
        hovertemplate=f"{name}: {hover}<extra></extra>",
    )


def some(points: NDArray[Kind], most: int) -> NDArray[Kind]:
    """At most so many of points (n, ...), evenly from all of them."""
    step = max(1, math.ceil(len(points) / most))
    return points[::step]


def as_html(figure: go.Figure, name: str, *, with_library: bool = False) -> str:
    """A figure as part of a page; its name makes the same figure give the same bytes."""
    return figure.to_html(full_html=False, include_plotlyjs=with_library, div_id=name)
