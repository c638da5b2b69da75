"""Cameras put beside others that stay: nearer to the truth on average than where they were, and than anywhere else."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any, cast

import numpy as np
import pytest

from aruco.icp_placing import harmonic_weights, placed
from aruco.icp_rows import Layout
from aruco.icp_solve import Registration
from aruco.pose_math import Array, Pose, adjoint, exp_se3, invert_transform, log_se3

NAMES = ("a", "b", "c", "d", "e")
CHAIN = tuple(pairwise(NAMES))
ALL = tuple(combinations(NAMES, 2))


def test_weights_of_a_chain_are_shares_of_the_way():
    # From a, which stays, to e, which stays too.
    np.testing.assert_allclose(
        harmonic_weights(CHAIN, ("b", "c", "d"), ("a", "e")), [[0.75, 0.25], [0.5, 0.5], [0.25, 0.75]], atol=1e-12
    )


def test_beside_all_others_each_camera_that_stays_counts_the_same():
    np.testing.assert_allclose(harmonic_weights(ALL, ("b", "d"), ("a", "c", "e")), 1 / 3, atol=1e-12)


def test_where_only_the_reference_stays_nothing_is_added():
    np.testing.assert_allclose(harmonic_weights(CHAIN, NAMES[1:], NAMES[:1]), 1.0, atol=1e-12)


def test_a_cameras_own_part_of_the_rig_decides():
    W = harmonic_weights(CHAIN, ("b", "e"), ("a", "c", "d"))
    np.testing.assert_allclose(W, [[0.5, 0.5, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)


def drawn(rng: np.random.Generator, P: Array, sigma: float) -> tuple[Array, Array]:
    """Errors of an estimate of the covariance P and of the start that it was made from (n,), in one dimension.

    The start's are those of the estimate and what it has taken away, which do not depend on each other; what cameras
    have in common is in that part too.
    """
    n = len(P)
    estimate = rng.multivariate_normal(np.zeros(n), P)
    return estimate, estimate + sigma * (rng.normal(size=n) + 5.0 * np.linspace(0.0, rng.normal(), n))


def squares(errors: Array, pairs: tuple[tuple[str, str], ...]) -> float:
    at = {name: k for k, name in enumerate(NAMES)}
    return float(sum((errors[at[a]] - errors[at[b]]) ** 2 for a, b in pairs))


def expected_squares(pairs: tuple[tuple[str, str], ...]) -> tuple[float, float, float]:
    """Means over draws where all stay, where those that move go where the estimate has them, and where we put them."""
    rng = np.random.default_rng(4)
    still, moving = [0, 3], [1, 2, 4]
    W = harmonic_weights(pairs, [NAMES[k] for k in moving], [NAMES[k] for k in still])
    found = []
    for _ in range(2000):
        estimate, start = drawn(rng, np.diag(np.full(5, 0.5)), 1.0)
        off = (start - estimate) - (start - estimate)[0]  # beside the reference, which is the first
        as_estimated = estimate + start[0] - estimate[0]
        as_estimated[still] = start[still]
        ours = as_estimated.copy()
        ours[moving] += W @ off[still]
        found.append([squares(errors, pairs) for errors in (start, as_estimated, ours)])
    all_stay, as_estimated, ours = np.mean(found, axis=0)
    return float(all_stay), float(as_estimated), float(ours)


@pytest.mark.parametrize("pairs", [CHAIN, ALL])
def test_expected_squares_are_least(pairs: tuple[tuple[str, str], ...]):
    all_stay, as_estimated, ours = expected_squares(pairs)
    # 2000 draws know these means to 3 %.
    assert ours < 0.9 * min(all_stay, as_estimated)


def test_cameras_put_where_the_estimate_has_them_may_stand_worse_than_where_they_were():
    all_stay, as_estimated, _ = expected_squares(CHAIN)
    assert as_estimated > all_stay


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimated:
    """Of a registration what placing asks for."""

    start: dict[str, Pose]
    start_covariance: dict[str, Array]
    T_world_cam: dict[str, Pose]
    covariance: dict[str, Array]
    reference: str
    unlinked: tuple[str, ...]
    pairs: dict[tuple[str, str], None]
    layout: Layout
    joint: Array
    back: dict[str, Array]
    T_out_own: Pose


def estimated(T_out_own: Pose, *, off: dict[str, Array], joint: Array, start_covariance: Array) -> Registration:
    """Cameras in a row, off their starts by twists of the equations' world."""
    rng = np.random.default_rng(6)
    T_own = {name: exp_se3(rng.normal(size=6)) for name in NAMES}
    Ad = adjoint(T_out_own)
    registration: Any = Estimated(
        start={name: T_out_own @ exp_se3(off[name]) @ T for name, T in T_own.items()},
        start_covariance=dict.fromkeys(NAMES, Ad @ start_covariance @ Ad.T),
        T_world_cam={name: T_out_own @ T for name, T in T_own.items()},
        covariance={},
        reference="a",
        unlinked=(),
        pairs=dict.fromkeys(CHAIN),
        layout=Layout(NAMES),
        joint=joint,
        back=off,
        T_out_own=T_out_own,
    )
    return cast(Registration, registration)


def test_a_turn_and_shift_in_common_with_a_camera_that_stays_is_taken_along_by_its_share():
    twist = np.array([0.02, -0.01, 0.03, 0.05, -0.02, 0.04])
    off: dict[str, Array] = {**dict.fromkeys(NAMES, np.zeros(6)), "e": twist}
    for T_out_own in (np.eye(4), exp_se3(np.array([0.3, -1.0, 0.4, 2.0, 1.0, -3.0]))):
        given = estimated(T_out_own, off=off, joint=np.eye(Layout(NAMES).size), start_covariance=10.0 * np.eye(6))
        found = placed(given, ["e"])
        for name, share in zip(NAMES, (0.0, 0.25, 0.5, 0.75, 1.0)):
            D = invert_transform(T_out_own) @ found.T_world_cam[name] @ invert_transform(given.T_world_cam[name])
            np.testing.assert_allclose(log_se3(D @ T_out_own), share * twist, atol=1e-12)


def test_covariances_are_those_of_what_is_put_where_over_draws():
    """Errors of estimates and starts drawn as promised, and what becomes of them."""
    layout, T_out_own = Layout(NAMES), exp_se3(np.array([0.3, -1.0, 0.4, 0.2, 0.1, -0.3]))
    rng = np.random.default_rng(2)
    A = 1e-3 * rng.normal(size=(layout.size, layout.size))
    joint = A @ A.T
    gained = 1e-4 * np.eye(6)  # what the start is worse than the estimate, of each camera
    at = [layout.pose(name) for name in NAMES]
    # Of one camera by itself the start's covariance is the sum; between cameras only the estimate's is shared.
    here = np.concatenate([np.r_[k] for k in at])
    P = joint[np.ix_(here, here)]
    given = estimated(T_out_own, off=dict.fromkeys(NAMES, np.zeros(6)), joint=joint, start_covariance=np.zeros((6, 6)))
    Ad = adjoint(T_out_own)
    starts = {n: Ad @ (P[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] + gained) @ Ad.T for k, n in enumerate(NAMES)}
    found = placed(replace(given, start_covariance=starts), ["e"])
    W = harmonic_weights(CHAIN, ("b", "c", "d"), ("a", "e"))
    x = rng.multivariate_normal(np.zeros(len(here)), P, 4000).reshape(-1, len(NAMES), 6)
    d = rng.multivariate_normal(np.zeros(6), gained, (4000, 2))  # of a and e
    for k, name in enumerate(("b", "c", "d")):
        errors = (x[:, k + 1] + np.einsum("s,nsi->ni", W[k], d)) @ Ad.T
        # 4000 draws know a variance to 2.2 %; the largest of 18 is off by three times that. Starts of two cameras are
        # promised to have nothing in common, which is 5 % more here.
        np.testing.assert_allclose(errors.var(axis=0), np.diag(found.covariance[name]), rtol=0.15)
        # Where the others stay is wrong, too.
        assert (errors.var(axis=0) > 1.2 * np.diag(Ad @ P[6 * k + 6 : 6 * k + 12, 6 * k + 6 : 6 * k + 12] @ Ad.T)).all()
    for name in ("a", "e"):
        np.testing.assert_array_equal(found.covariance[name], starts[name])
