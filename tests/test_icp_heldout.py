"""Whether held-out distances ask for a move: as rarely by chance as is said, and as often as it is worth."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from aruco.icp_gates import JOINT_SIGMAS, MAX_GROWTH, MAX_GROWTH_SIGMAS
from aruco.icp_heldout import N_FOLDS, Comparison, HeldOut, compared_scores, held_out_by
from aruco.icp_normal import Normal, summed
from aruco.icp_rows import PER_CAMERA, Layout, Rows
from aruco.icp_solve import Registration
from aruco.pose_math import Array

# --------------------------------------------------------------------------------------------------- sums over patches


def patch_sums(truth: float, rng: np.random.Generator, information: Array) -> Array:
    """(k, 2) score and information by patch of a way of length one, of which the truth is a share."""
    # Whitened: old gaps are truth * d + noise along a way d of length sqrt(information).
    d = np.sqrt(information)
    return np.column_stack([d * (truth * d + rng.normal(size=len(d))), d**2])


@pytest.mark.parametrize("uneven", [False, True])
def test_moves_that_are_worth_nothing_pass_as_rarely_as_said(uneven: bool):
    rng = np.random.default_rng(3)
    information = 0.3 * (rng.pareto(1.5, 120) if uneven else np.ones(120))
    # A truth half way is as far from the old as from the new: 2.3 % are above two sigma by chance.
    sigmas = [compared_scores(patch_sums(0.5, rng, information)).sigmas for _ in range(3000)]
    assert np.mean(np.array(sigmas) > 2.0) < 0.03
    # At the old place itself hardly any is.
    at_old = [compared_scores(patch_sums(0.0, rng, information)).sigmas for _ in range(3000)]
    assert np.mean(np.array(at_old) > 1.0) < 0.01


def test_moves_that_are_right_pass_by_what_they_are_worth():
    rng = np.random.default_rng(4)
    # Squares shrink by 24, as six unknowns do of which clouds know four times more than the prior.
    sigmas = [compared_scores(patch_sums(1.0, rng, np.full(120, 0.2))).sigmas for _ in range(1000)]
    # Half the way is 0.5 / (1 / sqrt(24)) = 2.45 sigma.
    assert np.mean(sigmas) == pytest.approx(2.45, abs=0.25)
    assert np.mean(np.array(sigmas) > 1.0) > 0.85


def test_one_patch_alone_proves_nothing():
    rng = np.random.default_rng(5)
    information = np.append(np.full(40, 0.01), 100.0)
    alone = compared_scores(patch_sums(1.0, rng, information))
    assert abs(alone.sigmas) < 1.0
    # The same over many patches does.
    assert compared_scores(patch_sums(1.0, rng, np.full(41, 2.5))).sigmas > 3.0
    # And the naive measure takes it: squares shrink by a hundred.
    assert alone.gain > 50


def test_errors_that_a_patch_shares_make_it_no_surer():
    rng = np.random.default_rng(6)
    passed = 0
    for _ in range(500):
        shared = np.repeat(rng.normal(size=30), 10)  # 300 gaps, ten of one error each
        d = np.full(300, 0.3)
        sums = np.column_stack([d * (0.5 * d + shared), d**2]).reshape(30, 10, 2).sum(axis=1)
        passed += compared_scores(sums).sigmas > 2.0
    assert passed / 500 < 0.05
    naive = 0.0
    for _ in range(500):
        shared = np.repeat(rng.normal(size=30), 10)
        gain = 2 * 0.3 * shared  # of each gap, whose variance is said to be one
        naive += gain.sum() > 2.0 * 2 * 0.3 * np.sqrt(300)
    # Counting each gap by itself takes chance for proof in a quarter of all cases.
    assert naive / 500 > 0.2


# ----------------------------------------------------------------------------------------- predictions and their errors

PAIR = Layout(("cam0", "cam1"))
X, Y = PER_CAMERA + 3, PER_CAMERA + 4  # what is free: shifts of cam1
PRIOR_M, NOISE_M = np.array([0.003, 0.02]), 0.005


def shifted(rng: np.random.Generator) -> HeldOut:
    """A camera off by chance: most of the scene shows its x and hardly its y, which one share alone shows well."""
    patch = np.repeat(np.arange(42), 12)
    # Two patches, of one face of a box, are all that shows y.
    fold = np.where(patch < 40, patch % (N_FOLDS - 1), N_FOLDS - 1)
    by_b = np.zeros((len(patch), PER_CAMERA))
    by_b[:, 3], by_b[:, 4] = (
        np.where(patch < 40, 1.0, 0.0),
        np.where(patch < 40, 0.02 * rng.normal(size=len(patch)), 1.0),
    )
    truth = rng.normal(0, PRIOR_M)
    n = np.arange(len(patch))
    rows = Rows(
        a=np.zeros_like(n),
        b=np.ones_like(n),
        gap_m=rng.normal(0, NOISE_M, len(n)) - by_b[:, 3:5] @ truth,
        by_a=np.zeros_like(by_b),
        by_b=by_b,
        cell_a=n,
        cell_b=len(n) + n,
        shared_a=np.full(len(n), 1e-6),
        shared_b=np.full(len(n), 1e-6),
        own=np.full(len(n), NOISE_M**2),
        weight=np.ones(len(n)),
        n_points=np.ones_like(n),
    )
    frozen = np.ones(PAIR.size, dtype=bool)
    frozen[[X, Y]] = False
    H = np.zeros((PAIR.size, PAIR.size))
    H[[X, Y], [X, Y]] = PRIOR_M**-2
    prior = Normal(H=H, g=np.zeros(PAIR.size), chi2=0.0)
    clouds, free = summed(rows, PAIR, 2 * len(n)), np.ix_(~frozen, ~frozen)
    joint = np.zeros_like(H)
    joint[free] = np.linalg.inv((clouds.H + H)[free])
    registration: Any = SimpleNamespace(
        rows=rows,
        layout=PAIR,
        clouds=clouds,
        joint=joint,
        prior=prior,
        reference="cam0",
        frozen=frozen,
        back={"cam1": np.zeros(6)},
        scale=1.0,
    )
    return held_out_by(cast(Registration, registration), patch, fold)


def drawn(n: int) -> list[Comparison]:
    rng = np.random.default_rng(8)
    return [shifted(rng).compared(["cam1"]) for _ in range(n)]


def off(found: list[Comparison]) -> Array:
    """How far what is asked for is from all of the way, which is right to a millimetre, in standard errors."""
    return np.array([(comparison.share - 1.0) / comparison.sigma for comparison in found])


def test_predictions_of_what_only_the_held_out_share_shows_count_by_what_they_are_worth(
    monkeypatch: pytest.MonkeyPatch,
):
    # Moves of 20 mm in y, of which the rest of the scene predicts y to 10 mm.
    found = drawn(60)
    assert np.abs(off(found)).max() < 3.0
    # Of x they are 3 mm, known to 0.3 mm: most are proved.
    assert np.mean([comparison.sigmas > JOINT_SIGMAS for comparison in found]) > 0.6
    # Taken for sure, predictions of y that are no better than the start speak against moves that are right.
    monkeypatch.setattr(HeldOut, "_doubted", lambda self, way: way)
    naive = drawn(60)
    assert np.mean(off(naive) < -3.0) > 0.1
    assert any(c.sigmas < -MAX_GROWTH_SIGMAS and c.gain < -MAX_GROWTH for c in naive)
    assert not any(c.sigmas < -MAX_GROWTH_SIGMAS and c.gain < -MAX_GROWTH for c in found)
