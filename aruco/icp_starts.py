"""Where the way to a registration may begin, besides the poses as they are given.

Owns      starts drawn from what is not known of poses, how badly clouds meet at the end of a coarse way.
Leaves    the way itself to icp_steps.

Clouds may come to rest where they meet wrongly: the side of one carton on that of its neighbour. From poses that are
off by less than clouds reach for each other that does not happen. From others the way is gone several times, and the
one at whose end clouds contradict each other least is gone on with: what is matched is chosen by the pose, so a wrong
pose shows less in the gaps of what meets than in what does not meet any more.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from aruco.floor_model import centre_jacobian
from aruco.icp_cloud import Cloud
from aruco.icp_match import Matches
from aruco.icp_prior import ASPECTS, Known, Scales, default_of
from aruco.icp_rows import Rows
from aruco.pose_math import Array, Pose, exp_so3, make_pose

# Draws, each followed by its opposite: if the one is worse than the given poses, the other is likely to be better.
_N_DRAWS = 2
# Poses of which nobody has said anything may be off by twice what is taken for usual.
_UNKNOWN = 2.0
# Nothing that meets is farther off than this many sigma.
_MOST_SIGMAS = 3.0


def other_starts(
    known: Known, T_world_cam: Mapping[str, Pose], free: tuple[str, ...], reach_m: float, *, seed: int
) -> Iterator[dict[str, Pose]]:
    """Poses drawn about given ones, as far as these are not known to what a match reaches.

    Only yaw, x and z are drawn: the floor puts tilt and height right in the first step.

    Args:
        known: What is known of poses and clouds, in the world of the poses.
        T_world_cam: Camera -> pose to draw about.
        free: Cameras that may move.
        reach_m: How far apart on the finest scale what meets may be. Where one sigma moves what a camera sees by less
            than half of it, the given pose is good enough to begin with.
        seed: Of chance.

    Yields:
        Camera -> pose. Nothing at all where all poses are good enough.
    """
    spread = {name: _plan_covariance(known, name, T_world_cam[name]) for name in free}
    loose = [name for name in free if _shown_m(spread[name], known.clouds[name]) > reach_m / 2]
    for k in range(_N_DRAWS if loose else 0):
        rng = np.random.default_rng([seed, k])
        ways = {name: np.linalg.cholesky(spread[name]) @ rng.standard_normal(3) for name in loose}
        for sign in (1.0, -1.0):
            moved = {name: _moved(T_world_cam[name], sign * way) for name, way in ways.items()}
            yield {**T_world_cam, **moved}


def contradiction(rows: Rows, matches: Mapping[tuple[str, str], Matches]) -> float:
    """How badly clouds meet: squared gaps in their variances; what does not meet counts as the largest gap."""
    unmet = sum(found.n_candidates - len(found) for found in matches.values())
    gaps = np.minimum(rows.gap_m**2 / rows.variance, _MOST_SIGMAS**2)
    return float(gaps.sum()) + _MOST_SIGMAS**2 * unmet


def _plan_covariance(known: Known, camera: str, T_world_cam: Pose) -> Array:
    """(3, 3) of yaw and of x and z of a camera's centre."""
    unknown = Scales(default={default_of(aspect, camera): _UNKNOWN for aspect in ASPECTS})
    J = centre_jacobian(T_world_cam[:3, 3])[list(ASPECTS["plan"])]
    return J @ known.covariance(camera, unknown) @ J.T


def _shown_m(plan: Array, cloud: Cloud) -> float:
    """By how much one sigma moves what a camera sees, at the middle of its depths."""
    return float(np.sqrt(plan[0, 0] * np.median(cloud.depth_m) ** 2 + plan[1, 1] + plan[2, 2]))


def _moved(T_world_cam: Pose, way: Array) -> Pose:
    """A pose turned about its centre by yaw, and shifted by x and z."""
    at_centre = np.zeros(6)
    at_centre[list(ASPECTS["plan"])] = way
    return make_pose(exp_so3(at_centre[:3]) @ T_world_cam[:3, :3], T_world_cam[:3, 3] + at_centre[3:])
