"""The room around a rig: floor, walls and furniture.

Owns      what stands where, apart from cameras and target.
Leaves    cameras and target to placement.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aruco.pose_math import Array, Pose, exp_so3, make_pose
from rigcal.sim.scene import Panel, box_panels, cylinder_panels

ROOM_SIDE_M = 7.6
WALL_HEIGHT_M = 2.8
# Furniture keeps this far from every line from a camera to a place of the target: half a target and some air.
_CLEARANCE_M = 0.55
_TRIALS = 60


def floor_panel() -> Panel:
    """The floor of the room, at y = 0."""
    half = ROOM_SIDE_M / 2
    square = np.array([[-half, 0, -half], [half, 0, -half], [half, 0, half], [-half, 0, half]])
    return Panel(vertices=square, albedo=0.42, contrast=0.05)


def wall_panels() -> list[Panel]:
    """Four walls around the floor; there is no ceiling."""
    half = ROOM_SIDE_M / 2
    wall = np.array([[-half, 0, -half], [half, 0, -half], [half, WALL_HEIGHT_M, -half], [-half, WALL_HEIGHT_M, -half]])
    return [
        Panel(vertices=wall @ exp_so3(np.array([0.0, quarter * np.pi / 2, 0.0])).T, albedo=albedo, contrast=0.03)
        for quarter, albedo in enumerate((0.58, 0.52, 0.62, 0.55))
    ]


def furniture_panels(cameras_m: Sequence[Array], targets_m: Sequence[Array], rng: np.random.Generator) -> list[Panel]:
    """Boxes, a table and a cylinder that hide the target from no camera.

    Args:
        cameras_m: Camera centres (3,), world [m].
        targets_m: Places of the target (3,), world [m].
        rng: Where things stand, and how large they are.

    Returns:
        The panels of as many pieces as find a free place.
    """
    pieces = [(0.65, table), (0.35, carton), (0.3, cylinder), (0.35, carton), (0.35, carton)]
    taken: list[tuple[Array, float]] = []
    panels: list[Panel] = []
    for radius_m, build in pieces:
        place = _free_place(radius_m, cameras_m, targets_m, taken, rng)
        if place is not None:
            taken.append((place, radius_m))
            turn = exp_so3(np.array([0.0, rng.uniform(0, 2 * np.pi), 0.0]))
            panels += build(make_pose(turn, np.array([place[0], 0.0, place[1]])), rng)
    return panels


def _free_place(
    radius_m: float,
    cameras_m: Sequence[Array],
    targets_m: Sequence[Array],
    taken: Sequence[tuple[Array, float]],
    rng: np.random.Generator,
) -> Array | None:
    reach = ROOM_SIDE_M / 2 - radius_m - 0.1
    for _ in range(_TRIALS):
        place = rng.uniform(-reach, reach, 2)
        apart = all(np.linalg.norm(place - other) > radius_m + r + 0.1 for other, r in taken)
        if apart and _sight_distance(place, cameras_m, targets_m) > radius_m + _CLEARANCE_M:
            return place
    return None


def _sight_distance(place: Array, cameras_m: Sequence[Array], targets_m: Sequence[Array]) -> float:
    """How far a place (2,) on the floor is from the nearest line of sight, seen from above [m]."""
    a = np.array(cameras_m)[:, None, [0, 2]]
    along = np.array(targets_m)[None, :, [0, 2]] - a
    share = np.clip(((place - a) * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(place - a - share[..., None] * along, axis=-1).min())


def _standing(size_m: Sequence[float], T_world_base: Pose, base_m: Sequence[float], albedo: float) -> list[Panel]:
    """A box whose lowest side has its centre at ``base_m`` of the piece's own frame."""
    centre = np.array([base_m[0], base_m[1] + size_m[1] / 2, base_m[2]])
    return box_panels(size_m, T_world_base @ make_pose(np.eye(3), centre), albedo)


def table(T_world_base: Pose, rng: np.random.Generator) -> list[Panel]:
    """A table with a thing on it, its feet on the y = 0 of its own frame."""
    length, width, height = rng.uniform(0.8, 1.0), rng.uniform(0.5, 0.7), rng.uniform(0.65, 0.78)
    panels = _standing((length, 0.04, width), T_world_base, (0, height - 0.04, 0), 0.42)
    for sx in (-1, 1):
        for sz in (-1, 1):
            foot = (sx * (length / 2 - 0.06), 0.0, sz * (width / 2 - 0.06))
            panels += _standing((0.05, height - 0.04, 0.05), T_world_base, foot, 0.22)
    return panels + _standing((0.3, 0.2, 0.22), T_world_base, (0.1, height, 0.05), 0.6)


def carton(T_world_base: Pose, rng: np.random.Generator) -> list[Panel]:
    """A box that stands on the y = 0 of its own frame."""
    size_m = [rng.uniform(0.25, 0.45), rng.uniform(0.3, 0.9), rng.uniform(0.25, 0.45)]
    return _standing(size_m, T_world_base, (0, 0, 0), rng.uniform(0.3, 0.6))


def cylinder(T_world_base: Pose, rng: np.random.Generator) -> list[Panel]:
    """An upright cylinder that stands on the y = 0 of its own frame."""
    return cylinder_panels(rng.uniform(0.12, 0.25), rng.uniform(0.5, 1.1), T_world_base, rng.uniform(0.25, 0.5))
