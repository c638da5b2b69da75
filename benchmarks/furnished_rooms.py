"""Things that stand amid the cameras of a simulated rig, where several of them see the same sides.

Owns      what stands around the target, and where.
Leaves    the room itself and what a piece of furniture looks like to rigcal.sim.room.

The simulator's own furniture keeps clear of every line from a camera to the target, because its pictures are for
markers. That leaves it where cameras look past each other: they share floor and walls and next to nothing that stands
upright between them, so that nothing holds clouds in yaw, x and z. Rooms in which people record have things amid the
cameras. Both kinds are measured; the one without is the harder one.
"""

from __future__ import annotations

import numpy as np

from aruco.pose_math import Array, exp_so3, make_pose
from rigcal.sim.room import carton, cylinder, table
from rigcal.sim.scene import Panel

# Not on the target, and nearer to it than the cameras are.
NEAREST_M, FARTHEST_M = 0.55, 1.6
_APART_M = 0.65
_PIECES = (carton, carton, table, cylinder, carton, carton)
_TRIALS = 60


def things_amid_cameras(target_m: Array, rng: np.random.Generator) -> list[Panel]:
    """The panels of as many of six things as find a place.

    Args:
        target_m: The middle of the target (3,), world [m]; the floor is y = 0.
        rng: Where things stand, and how large they are.
    """
    taken: list[Array] = []
    panels: list[Panel] = []
    for build in _PIECES:
        place = _free_place(target_m, taken, rng)
        if place is not None:
            taken.append(place)
            panels += build(make_pose(exp_so3(np.array([0.0, rng.uniform(0, 2 * np.pi), 0.0])), place), rng)
    return panels


def _free_place(target_m: Array, taken: list[Array], rng: np.random.Generator) -> Array | None:
    """A place (3,) on the floor, evenly spread over the ring around the target."""
    for _ in range(_TRIALS):
        away = np.sqrt(rng.uniform(NEAREST_M**2, FARTHEST_M**2))
        turn = rng.uniform(0, 2 * np.pi)
        place = np.array([target_m[0] + away * np.cos(turn), 0.0, target_m[2] + away * np.sin(turn)])
        if all(np.linalg.norm(place - other) > _APART_M for other in taken):
            return place
    return None
