"""What clouds say of relative poses, and of what they say nothing.

Owns      PairInformation, the information of one pair, directions that are not observed, in words.
Leaves    equations to icp_equations and icp_normal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aruco.floor_model import centre_jacobian
from aruco.icp_match import Matches
from aruco.icp_normal import scaled_inverse, summed
from aruco.icp_rows import Layout, Rows
from aruco.pose_math import Array, Pose, adjoint

# Of a turn or shift in the world, about the camera's centre.
_AXES = ("x", "y", "z")
# Share of what was not known beforehand that is still not known: above this, clouds say less than the given pose.
_LEFT = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PairInformation:
    """What the clouds of two cameras say about their relative pose, depth errors marginalised under their prior."""

    information: Array  # (6, 6) of a left twist (rotation, translation) of T_target_source, in the target's frame
    unobservable: tuple[str, ...]  # directions in which it says less than the given poses, in words
    fitness: float  # both directions together
    rmse: float  # [m] of the gaps that met
    n_points: int
    overlap_m2: float


def pair_information(
    rows: Rows,
    layout: Layout,
    errors: Sequence[Array],
    pair: tuple[str, str],
    T_world_cam: Mapping[str, Pose],
    prior: Array,
    *,
    scale: float,
) -> tuple[Array, tuple[str, ...]]:
    """Information (6, 6) of T_target_source, and the directions of which there is less than in the prior.

    Args:
        rows: Of all pairs.
        layout: Of the unknowns.
        errors: Of source and target: covariance (4, 4) of depth errors beforehand.
        pair: Source and target.
        T_world_cam: In the equations' world.
        prior: (6, 6) covariance of the given relative pose, as a twist in the equations' world.
        scale: Factor on noise.
    """
    source, target = pair
    places = layout.cameras.index(source), layout.cameras.index(target)
    two, own, n_cells = _of_two(rows, places, pair)
    normal = summed(own, two, n_cells, scale=scale)
    at = two.pose(source)
    H = normal.H[at, at]
    both = np.r_[two.bias(source), two.bias(target)]
    known = np.zeros((8, 8))
    known[:4, :4] = np.linalg.inv(errors[0])
    known[4:, 4:] = np.linalg.inv(errors[1])
    C = normal.H[at, both]
    H = H - C @ np.linalg.solve(normal.H[np.ix_(both, both)] + known, C.T)
    Ad, centre = adjoint(T_world_cam[target]), T_world_cam[source][:3, 3]
    # What the prior ties to a tilt, such as the other camera's times a lever, becomes known with it: clouds alone say
    # nothing of that.
    J, back = centre_jacobian(centre), centre_jacobian(centre, inverse=True)
    apart = back @ np.diag(np.diag(J @ prior @ J.T)) @ back.T
    words = unobserved(apart, scaled_inverse(H + np.linalg.inv(apart)), centre)
    information = Ad.T @ H @ Ad
    return (information + information.T) / 2, words


def _of_two(rows: Rows, places: tuple[int, int], pair: tuple[str, str]) -> tuple[Layout, Rows, int]:
    """One pair's rows and cells as if there were no other cameras: those cost time and say nothing."""
    own = rows.only((rows.a == places[0]) & (rows.b == places[1]))
    cells, numbers = np.unique(np.stack([own.cell_a, own.cell_b]), return_inverse=True)
    cell_a, cell_b = numbers.reshape(2, -1)
    n = np.zeros(len(cell_a), dtype=np.intp)
    return Layout(pair), replace(own, a=n, b=n + 1, cell_a=cell_a, cell_b=cell_b), len(cells)


def unobserved(before: Array, after: Array, centre: Array) -> tuple[str, ...]:
    """Turns and shifts of a camera that are hardly better known afterwards, in words.

    Args:
        before: (6, 6) covariance of a left twist in the world.
        after: (6, 6) likewise, with the clouds.
        centre: (3,) of the camera.
    """
    J = centre_jacobian(centre)
    share = np.diag(J @ after @ J.T) / np.maximum(np.diag(J @ before @ J.T), 1e-30)
    turns = [("yaw" if k == 1 else f"turn about {_AXES[k]}") for k in range(3) if share[k] > _LEFT]
    shifts = [("height" if k == 1 else f"shift along {_AXES[k]}") for k in range(3) if share[3 + k] > _LEFT]
    return (*turns, *shifts)


def fit_of(there: Matches, back: Matches) -> tuple[float, float, int]:
    """Fitness and rmse [m] of both directions together, and how many samples of the source met."""
    met, could = len(there) + len(back), there.n_candidates + back.n_candidates
    squares = float(there.gap_m @ there.gap_m + back.gap_m @ back.gap_m)
    return (met / could if could else 0.0), (squares / met) ** 0.5 if met else float("nan"), len(there)
