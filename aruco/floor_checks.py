"""Floor, cameras and target as each other's witnesses: what cannot all be true is an error and no result.

Owns      worlds upside down, mirrored or not upright, cameras and targets below the floor.
Leaves    the floor itself to floor_consensus.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from aruco.errors import CalibrationError
from aruco.floor_consensus import AGREE_M, Consensus
from aruco.floor_plane import FloorPlane
from aruco.floor_view import FloorSamples, SeenPlane, level_planes
from aruco.pose_math import Array, Pose

# Targets lie level to a degree, floors are flat, and worlds aligned by a target are off by what the target is.
MAX_UP_ERROR_DEG = 5.0
# A target that lies on the floor has its lowest corners there, within what poses and depth are off.
TARGET_BELOW_M = 0.1
# A mirror needs three cameras: any two heights are mirrored about their mean.
_MIRROR_CAMERAS = 3
# A reflection in an upright plane keeps pitch and height and turns roll over: floors that are aslant to each other by
# more than poses ever are, and level once rolls are turned over, tell it. Without any roll it cannot be told.
_ASLANT_DEG = 1.0
_MIRRORED_RATIO = 4.0
_MIRROR = np.array([-1.0, 1.0, 1.0])


def check_not_upside_down(
    samples: Mapping[str, FloorSamples], T_world_cam: Mapping[str, Pose], up: Array, seed: int
) -> None:
    """Where no camera sees anything level below itself: do they see it above?

    Raises:
        CalibrationError: Most cameras do.
    """
    rng = np.random.default_rng(seed)
    above = [
        name
        for name, seen in samples.items()
        if level_planes(seen, -T_world_cam[name][:3, :3].T @ up, threshold_m=None, rng=rng)
    ]
    if samples and 2 * len(above) > len(samples):
        raise CalibrationError(
            f"{_cameras(above)} {_verb(above, 'sees', 'see')} the floor above and nothing level below: this world is "
            "upside down; check _meta.world.up, or run calibrate-extrinsics --auto-align again."
        )


def check_not_mirrored(
    planes: Mapping[str, Sequence[SeenPlane]], consensus: Consensus, T_world_cam: Mapping[str, Pose], up: Array
) -> None:
    """Whether the cameras' heights make sense only when turned over.

    Raises:
        CalibrationError: They do.
    """
    names = [name for name in planes if planes[name]]
    if len(names) < _MIRROR_CAMERAS:
        return
    seen = {name: consensus.planes.get(name, planes[name][0]).normal for name in names}
    aslant, mirrored = (
        _scatter_deg(np.array([side * (T_world_cam[name][:3, :3] @ (side * n)) for name, n in seen.items()]))
        for side in (np.ones(3), _MIRROR)
    )
    if aslant > max(_ASLANT_DEG, _MIRRORED_RATIO * mirrored):
        raise CalibrationError(
            f"The cameras' floors are {aslant:.1f} degrees aslant to each other, and {mirrored:.1f} once left and "
            f"right are exchanged ({_cameras(names)}): the world is mirrored; check the order of corners in the marker "
            "map, and whether the images were mirrored."
        )
    if 2 * len(consensus.planes) > len(names):
        return
    heights = np.array([float(T_world_cam[name][:3, 3] @ up) for name in names])
    clearances = np.array([planes[name][0].distance_m for name in names])
    if np.ptp(heights + clearances) < AGREE_M < np.ptp(heights - clearances):
        raise CalibrationError(
            f"The higher a camera stands in this world the nearer it is to its floor ({_cameras(names)}): the world is "
            "mirrored; check the order of corners in the marker map and _meta.world.up."
        )


def _scatter_deg(normals: Array) -> float:
    """Root mean square of the angles of unit vectors (n, 3) from their mean."""
    mean = normals.mean(axis=0)
    across = np.linalg.norm(np.cross(normals, mean / np.linalg.norm(mean)), axis=1)
    return math.degrees(float(np.sqrt(np.mean(across**2))))


def check_floor(
    floor: FloorPlane, T_world_cam: Mapping[str, Pose], up: Array, target_points: Array | None = None
) -> None:
    """Whether a floor can be that of this world.

    Args:
        floor: In the world.
        T_world_cam: All cameras.
        up: (3,) unit, away from gravity.
        target_points: (n, 3) of the calibration target, in the world.

    Raises:
        CalibrationError: It is far from level, or cameras or the target are below it.
    """
    tilt_deg = math.degrees(math.acos(min(1.0, float(floor.normal @ up))))
    if tilt_deg > MAX_UP_ERROR_DEG:
        raise CalibrationError(
            f"The floor that the cameras see is {tilt_deg:.1f} degrees off this world's up, more than "
            f"{MAX_UP_ERROR_DEG:g}: the target did not lie level, or the world is not upright; run "
            "calibrate-extrinsics --auto-align again, with the target on the floor."
        )
    below = sorted(name for name, T in T_world_cam.items() if float(floor.distances(T[:3, 3])) <= 0.0)
    if below:
        raise CalibrationError(
            f"{_cameras(below)} {_verb(below, 'stands', 'stand')} below the floor that the others see: a pose is "
            "wrong, or that surface is no floor; look at the calibration's report, or give --height-range."
        )
    if target_points is not None and len(target_points):
        highest = float(floor.distances(np.asarray(target_points)).max())
        if highest < -TARGET_BELOW_M:
            raise CalibrationError(
                f"The whole target lies {-highest:.2f} m or more below the surface that most cameras see: that is a "
                "table, not the floor; give --height-range."
            )


def _cameras(names: Sequence[str]) -> str:
    return f"Camera {names[0]}" if len(names) == 1 else f"Cameras {', '.join(sorted(names))}"


def _verb(names: Sequence[str], one: str, many: str) -> str:
    return one if len(names) == 1 else many
