"""Moving one camera so that its floor becomes the floor: pitch, roll and height about its centre, nothing else.

Owns      FloorCorrection, the motion of a tilt and a height, bounds.
Leaves    how far to believe the floor to floor_fusion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from aruco.floor_plane import UP, FloorPlane, Mat44, Vec3
from aruco.pose_math import Array, exp_so3, make_pose, rotation_angle

MAX_ROTATION_DEG = 5.0
MAX_TRANSLATION_M = 0.1
# Of what a floor asks for; less is nothing that one would call levelling this camera.
KEPT_GAIN = 0.25


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FloorCorrection:
    """How one camera was moved beyond the common motion, or why it was not."""

    T_world_new_old: Mat44 = field(default_factory=lambda: np.eye(4))  # left motion in the levelled world
    accepted: bool = True
    reason: str = ""  # why it was rejected, or in what way it is special
    rotation_deg: float = 0.0  # of the motion asked for, whether accepted or not
    translation_m: float = 0.0  # change of height asked for
    gain: float = 1.0  # 0..1: how much of what the floor asked for was done; the geometric mean over directions
    plane_before: FloorPlane | None = None  # this camera's floor after the common motion alone
    plane_after: FloorPlane | None = None  # in the returned world
    rms_before_m: float = math.nan  # of its floor points' heights above the floor, after the common motion alone
    rms_after_m: float = math.nan
    tilt_before_deg: float = math.nan  # of its floor against the common one
    tilt_after_deg: float = math.nan
    height_before_m: float = math.nan  # of its floor below the camera, above (+) the common one
    height_after_m: float = math.nan

    @property
    def is_kept(self) -> bool:
        """Whether hardly anything was done, because the pose is known better than what its camera sees of the floor."""
        return self.accepted and self.gain < KEPT_GAIN


def camera_motion(centre: Vec3, rotation_rad: Array, rise_m: float, up: Vec3) -> Mat44:
    """The left motion that turns about a centre (3,) by a rotation vector (3,), and raises along up."""
    R = exp_so3(rotation_rad)
    return make_pose(R, centre - R @ centre + rise_m * up)


def compute_floor_correction(
    plane: FloorPlane,
    target_floor_y: float = 0.0,
    max_rotation_deg: float = MAX_ROTATION_DEG,
    max_translation_m: float = MAX_TRANSLATION_M,
    *,
    centre: Vec3 | None = None,
    up: Sequence[float] | Array = UP,
) -> FloorCorrection:
    """The whole correction that makes a floor plane level and puts it to its height.

    Args:
        plane: As the camera places it in the world.
        target_floor_y: y of the floor in that world, whichever way y points [m].
        max_rotation_deg: A larger turn is rejected.
        max_translation_m: So is a larger change of height.
        centre: (3,) the camera's, which it turns about; default: the origin.
        up: (3,) away from gravity: +Y or -Y.

    Returns:
        A turn about a level axis and a rise; the identity, with the reason, where it is out of bounds.
    """
    vertical = np.asarray(up, dtype=np.float64) / np.linalg.norm(up)
    pivot = np.zeros(3) if centre is None else np.asarray(centre, dtype=np.float64)
    rotation = turn_between(plane.normal, vertical)
    # Distances from the turning point stay: after the turn the floor lies that far below it.
    clearance = float(plane.normal @ pivot) + plane.d
    rise = target_height(target_floor_y, vertical) + clearance - float(pivot @ vertical)
    return bounded(
        camera_motion(pivot, rotation, rise, vertical),
        rise,
        max_rotation_deg=max_rotation_deg,
        max_translation_m=max_translation_m,
    )


def target_height(target_floor_y: float, up: Vec3) -> float:
    """Height along up [m] of a floor at a given y."""
    return target_floor_y * (1.0 if up[1] >= 0 else -1.0)


def turn_between(from_unit: Vec3, to_unit: Vec3) -> Array:
    """The shortest rotation vector (3,) that turns one unit vector onto another one less than 180 degrees away."""
    axis = np.cross(from_unit, to_unit)
    sine = float(np.linalg.norm(axis))
    angle = math.atan2(sine, float(from_unit @ to_unit))
    return axis * (angle / sine if sine > 0 else 0.0)


def bounded(
    T_world_new_old: Mat44, rise_m: float, *, max_rotation_deg: float, max_translation_m: float
) -> FloorCorrection:
    """A correction, or the identity and a sentence where the motion is larger than it may be."""
    rotation_deg = math.degrees(rotation_angle(T_world_new_old[:3, :3]))
    reason = ""
    if rotation_deg > max_rotation_deg:
        reason = (
            f"its floor asks for a turn of {rotation_deg:.2g} degrees, more than the {max_rotation_deg:g} allowed; "
            "calibrate this camera again, or raise --max-rotation-deg"
        )
    elif abs(rise_m) > max_translation_m:
        reason = (
            f"its floor asks for {1e3 * rise_m:+.0f} mm of height, more than the {1e3 * max_translation_m:g} mm "
            "allowed; calibrate this camera again, or raise --max-translation-m"
        )
    return FloorCorrection(
        T_world_new_old=np.eye(4) if reason else T_world_new_old,
        accepted=not reason,
        reason=reason,
        rotation_deg=rotation_deg,
        translation_m=rise_m,
        gain=0.0 if reason else 1.0,
    )
