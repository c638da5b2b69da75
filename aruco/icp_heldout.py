"""How far clouds are apart where they were not fitted, under one set of poses and another.

Owns      the patches of the scene that are held out, solutions without them, the comparison of two solutions there.
Leaves    rows and their sum to icp_rows and icp_normal, which comparison decides what to icp_gates.

What is held out is a share of the scene, not of one image: the two directions of a pair, and other cameras that see the
same patch, share its errors of depth. Each solution is found without a share and predicts the gaps in it. A gap's
errors that cells share are taken out as in icp_normal, within each patch; patches are the units of chance.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from aruco.icp_cloud import N_FOLDS
from aruco.icp_equations import weighted
from aruco.icp_normal import Normal, solved, summed
from aruco.icp_rows import POSE, Index, Rows, followers
from aruco.icp_solve import Registration
from aruco.pose_math import Array

# Side of a patch [m]. Depth errors of neighbours, and windows that normals were fitted in, reach 0.1 to 0.2 m at 3 to
# 4 m: what a patch shares with those around it is its rim.
PATCH_M = 0.6
# Patches in which no gap changes by this share of its sigma say nothing, and need not be looked at.
_CHANGE = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Two solutions, each predicting what it was not fitted to."""

    gain: float  # by how much squared distances shrink from the one to the other, in their variances
    share: float  # of the way from the one to the other that what was held out asks for itself; 1: all of it
    sigma: float  # of that share
    n_patches: int

    @property
    def sigmas(self) -> float:
        """How surely distances shrink: they do where more than half of the way is asked for."""
        return (self.share - 0.5) / self.sigma if self.sigma > 0 else 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeldOut:
    """A registration's rows in shares that are held out in turn."""

    registration: Registration
    patch: Index  # (m,) of the scene, of each row
    fold: Index  # (m,) 0 to N_FOLDS - 1, one for each patch
    without: tuple[Normal, ...]  # of all rows but those of a fold

    def gaps(self, kept: Collection[str] = ()) -> Array:
        """(m,) gaps [m] that the solution without a row's own share predicts for it.

        Args:
            kept: Cameras that stand at their start, relative to the reference, besides those that the registration
                keeps; their depth errors are estimated.
        """
        reg = self.registration
        away = {*reg.kept, *kept} - {reg.reference}
        M = followers(reg.layout, away, reg.reference, reg.frozen)
        x0 = np.zeros(reg.layout.size)
        for name in away:
            x0[reg.layout.pose(name)] = reg.back[name]
        gaps = np.zeros(len(reg.rows.gap_m))
        for k, normal in enumerate(self.without):
            here = self.fold == k
            gaps[here] = reg.rows.only(here).gaps(solved(normal + reg.prior, M, x0), reg.layout)
        return gaps

    def compared(self, before: Array, after: Array) -> Comparison:
        """Whether gaps (m,) shrink from one prediction to another; the floor's own rows do not count.

        Both are judged by the same weights, those of the larger gap of each row: what loses weight under one solution
        must not be worth more under the other.
        """
        reg = self.registration
        changed = np.abs(before - after) > _CHANGE * np.sqrt(reg.rows.variance)
        here = ~reg.rows.is_floor & np.isin(self.patch, self.patch[changed])
        if not here.any():
            return Comparison(gain=0.0, share=0.0, sigma=math.inf, n_patches=0)
        old, new = before[here], after[here]
        rows = weighted(reg.rows.only(here), np.maximum(np.abs(old), np.abs(new)), reg.scale)
        patch = np.unique(self.patch[here], return_inverse=True)[1].ravel()
        return compared_squares(_squares_by_patch(rows, patch, old, new) / reg.scale**2)

    def median_mm(self, camera: str, gaps: Array) -> float:
        """Median of absolute gaps (m,) between one camera's cloud and all others; NaN without any."""
        rows = self.registration.rows
        here = rows.of(self.registration.layout.cameras.index(camera)) & ~rows.is_floor
        return 1e3 * float(np.median(np.abs(gaps[here]))) if here.any() else float("nan")


def held_out(registration: Registration, *, seed: int = 0) -> HeldOut:
    """Shares of the scene, drawn by chance, and what the rest of it says."""
    rows = registration.rows
    patch = patches(rows)
    fold = _folds(patch, np.random.default_rng(seed))[patch]
    n_cells = int(max(rows.cell_a.max(initial=-1), rows.cell_b.max(initial=-1))) + 1
    return HeldOut(
        registration=registration,
        patch=patch,
        fold=fold,
        without=tuple(
            summed(rows.only(fold != k), registration.layout, n_cells, scale=registration.scale) for k in range(N_FOLDS)
        ),
    )


def patches(rows: Rows) -> Index:
    """(m,) numbers from 0 of the patches that rows lie in.

    Rows know their place but for how far it is along the normal (by_a holds n and p x n), which is enough on surfaces.
    """
    normal = rows.by_a[:, 3:POSE]
    length = np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    place = np.cross(normal, rows.by_a[:, :3]) / length**2
    facing = np.argmax(np.abs(normal), axis=1)
    key = np.column_stack([np.rint(place / PATCH_M).astype(np.int64), facing])
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()


def _folds(patch: Index, rng: np.random.Generator) -> Index:
    """(k,) the fold of each patch: of each N_FOLDS patches of about the same size, one for each fold."""
    order = np.argsort(-np.bincount(patch), kind="stable")
    fold = np.empty(len(order), dtype=np.intp)
    for k in range(0, len(order), N_FOLDS):
        some = order[k : k + N_FOLDS]
        fold[some] = rng.permutation(N_FOLDS)[: len(some)]
    return fold


def compared_squares(squares: Array) -> Comparison:
    """What squares by patch (k, 3) of old gaps, of new ones, and products of both say.

    Along the way from the old solution to the new one each patch has a score and an information. Their sums tell how
    far to go, the patches' scores about that how surely: the sandwich of a regression through the origin, each patch
    left out in turn (HC3 of MacKinnon and White, 1985), so that one patch alone proves nothing. Nor is it ever surer
    than the noise that is promised.
    """
    old, new, both = squares.T
    score, information = old - both, old - 2.0 * both + new
    total = float(information.sum())
    if total <= 0:
        return Comparison(gain=0.0, share=0.0, sigma=math.inf, n_patches=len(squares))
    share = float(score.sum()) / total
    left = (score - share * information) / np.maximum(1.0 - information / total, 1e-9)
    sigma = math.sqrt(max(float(left @ left) / total**2, 1.0 / total))
    return Comparison(gain=float((old - new).sum()), share=share, sigma=sigma, n_patches=len(squares))


def _squares_by_patch(rows: Rows, patch: Index, old: Array, new: Array) -> Array:
    """(k, 3) sums of old^2, new^2 and old new (m,) in their variances, with what rows of a patch share allowed for."""
    from scipy.sparse import csr_array, eye_array
    from scipy.sparse.linalg import splu

    n, m = int(patch.max()) + 1, np.arange(len(patch))
    W = 1.0 / (rows.own + rows.variance * (1.0 / rows.weight - 1.0))
    # A cell that reaches into two patches is one in each.
    n_cells = int(max(rows.cell_a.max(), rows.cell_b.max())) + 1
    keys = np.concatenate([patch * n_cells + rows.cell_a, patch * n_cells + rows.cell_b])
    found, cell = np.unique(keys, return_inverse=True)
    shared = csr_array(
        (np.concatenate([rows.shared_a, -rows.shared_b]), (np.concatenate([m, m]), cell.ravel())),
        shape=(len(m), len(found)),
    )
    pull = csr_array(shared.multiply(W[:, None])).T.tocsr()
    A = (eye_array(len(found)) + pull @ shared).tocsc()
    pulled = pull @ np.column_stack([old, new])
    known = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0).solve(pulled)
    sums = []
    for i, j, product in ((0, 0, old**2), (1, 1, new**2), (0, 1, old * new)):
        whole = np.bincount(patch, W * product, n)
        sums.append(whole - np.bincount(found // n_cells, pulled[:, i] * known[:, j], n))
    return np.stack(sums, axis=1)
