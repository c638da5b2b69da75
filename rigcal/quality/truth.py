"""A calibration beside the truth: what is wrong with it, in numbers that no choice of world can flatter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from aruco.pose_math import Pose, invert_transform, pose_distance


def pair_errors(estimated: Mapping[str, Pose], true: Mapping[str, Pose]) -> dict[tuple[str, str], tuple[float, float]]:
    """Errors of relative poses, which do not depend on where either world has its origin.

    Args:
        estimated: Camera -> T_world_cam.
        true: Likewise, in any world.

    Returns:
        Pair of cameras -> (angle [rad], distance [m]) between both values of T_i_j.
    """
    names = sorted(estimated.keys() & true.keys())
    return {
        (i, j): pose_distance(invert_transform(estimated[i]) @ estimated[j], invert_transform(true[i]) @ true[j])
        for i, j in combinations(names, 2)
    }


def tilt_error(estimated: Mapping[str, Pose], true: Mapping[str, Pose], up: Sequence[int]) -> float:
    """The largest angle [rad], over cameras, between the estimated up and +Y of the true world."""
    angles = []
    for name in estimated.keys() & true.keys():
        up_in_true = true[name][:3, :3] @ estimated[name][:3, :3].T @ np.array(up, dtype=np.float64)
        angles.append(float(np.arctan2(np.hypot(up_in_true[0], up_in_true[2]), up_in_true[1])))
    return max(angles)
