"""How far clouds are apart where they were not fitted, under one set of poses and another.

Owns      the patches of the scene that are held out, solutions without them, the comparison of two solutions there.
Leaves    rows and their sum to icp_rows and icp_normal, which comparison decides what to icp_gates.

What is held out is a share of the scene, not of one image: the two directions of a pair, and other cameras that see the
same patch, share its errors of depth. Each solution is found without a share and predicts the gaps in it. A gap's
errors that cells share are taken out as in icp_normal, within each patch; patches are the units of chance. A prediction
is worth what the rest of the scene knows: where all that shows a direction is held out, it is a guess, which proves
nothing against a move.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from aruco.icp_equations import weighted
from aruco.icp_normal import Normal, scaled_inverse, solved, summed
from aruco.icp_rows import POSE, Index, Rows, followers
from aruco.icp_solve import Registration
from aruco.pose_math import Array

N_FOLDS = 4  # shares of the scene that are held out in turn
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
    without: tuple[Normal, ...]  # of all rows but those of a fold, and of what is known beforehand
    memo: dict[frozenset[str], Array]

    def compared(self, before: Collection[str], after: Collection[str]) -> Comparison:
        """Whether gaps shrink from some cameras' standing at their start to fewer cameras' doing so.

        The floor's own rows do not count. Both are judged by the same weights, those of the larger gap of each row:
        what loses weight under one solution must not be worth more under the other.
        """
        reg = self.registration
        old_x, new_x = self._solutions(before), self._solutions(after)
        old, new = self._gaps(old_x), self._gaps(new_x)
        changed = np.abs(old - new) > _CHANGE * np.sqrt(reg.rows.variance)
        here = ~reg.rows.is_floor & np.isin(self.patch, self.patch[changed])
        if not here.any():
            return Comparison(gain=0.0, share=0.0, sigma=math.inf)
        rows = weighted(reg.rows.only(here), np.maximum(np.abs(old), np.abs(new))[here], reg.scale)
        patch = np.unique(self.patch[here], return_inverse=True)[1].ravel()
        way = (old - self._gaps(old_x - self._doubted(old_x - new_x, after)))[here]
        sums = _sums_by_patch(rows, patch, way, np.stack([old, old - new])[:, here])
        return compared_scores(sums / reg.scale**2)

    def median_mm(self, camera: str, kept: Collection[str] = ()) -> float:
        """Median of absolute gaps between one camera's cloud and all others; NaN without any."""
        rows = self.registration.rows
        here = rows.of(self.registration.layout.cameras.index(camera)) & ~rows.is_floor
        return 1e3 * float(np.median(np.abs(self.gaps(kept)[here]))) if here.any() else float("nan")

    def gaps(self, kept: Collection[str] = ()) -> Array:
        """(m,) gaps [m] that the solution without a row's own share predicts for it.

        Args:
            kept: Cameras that stand at their start, relative to the reference, besides those that the registration
                keeps; their depth errors are estimated.
        """
        return self._gaps(self._solutions(kept))

    def _gaps(self, solutions: Array) -> Array:
        reg, gaps = self.registration, np.zeros(len(self.fold))
        for k, x in enumerate(solutions):
            here = self.fold == k
            gaps[here] = reg.rows.only(here).gaps(x, reg.layout)
        return gaps

    def _solutions(self, kept: Collection[str]) -> Array:
        """(N_FOLDS, size) the solution without each share."""
        key = frozenset(kept)
        if key not in self.memo:
            reg, M = self.registration, self._free(key)
            x0 = np.zeros(reg.layout.size)
            for name in {*reg.kept, *key} - {reg.reference}:
                x0[reg.layout.pose(name)] = reg.back[name]
            self.memo[key] = np.stack([solved(normal, M, x0) for normal in self.without])
        return self.memo[key]

    def _doubted(self, way: Array, kept: Collection[str]) -> Array:
        """(N_FOLDS, size) a way between solutions, less of it where only the share that is held out knows the way.

        A prediction has an error of its own, A C A^T with A the share's rows and C the covariance of what is free
        without the share. With R of the gaps, (R + A C A^T)^-1 A x = R^-1 A y where y = (C^-1 + A^T R^-1 A)^-1 C^-1 x.
        """
        reg, M = self.registration, self._free(kept)
        whole = scaled_inverse(M.T @ (reg.clouds.H + reg.prior.H) @ M)
        free = way @ M / (M * M).sum(axis=0)
        return np.stack([M @ whole @ (M.T @ (normal.H @ (M @ z))) for normal, z in zip(self.without, free)])

    def _free(self, kept: Collection[str]) -> Array:
        reg = self.registration
        return followers(reg.layout, {*reg.kept, *kept} - {reg.reference}, reg.reference, reg.frozen)


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
            summed(rows.only(fold != k), registration.layout, n_cells, scale=registration.scale) + registration.prior
            for k in range(N_FOLDS)
        ),
        memo={},
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


def compared_scores(sums: Array) -> Comparison:
    """What scores (k,) and information (k,) of patches, stacked (k, 2), say about a way.

    Their sums tell how far to go, the patches' scores about that how surely: the sandwich of a regression through the
    origin, each patch left out in turn (HC3 of MacKinnon and White, 1985), so that one patch alone proves nothing. Nor
    is it ever surer than the noise that is promised.
    """
    score, information = sums.T
    total = float(information.sum())
    if total <= 0:
        return Comparison(gain=0.0, share=0.0, sigma=math.inf)
    share = float(score.sum()) / total
    left = (score - share * information) / np.maximum(1.0 - information / total, 1e-9)
    sigma = math.sqrt(max(float(left @ left) / total**2, 1.0 / total))
    return Comparison(gain=float(2.0 * score.sum() - total), share=share, sigma=sigma)


def _sums_by_patch(rows: Rows, patch: Index, way: Array, gaps: Array) -> Array:
    """(k, n) sums of way (m,) times gaps (n, m) in their variances, with what rows of a patch share allowed for."""
    from scipy.sparse import csr_array, eye_array
    from scipy.sparse.linalg import splu

    m = np.arange(len(patch))
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
    known = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0).solve(pull @ way)
    weight = W * way - pull.T @ known
    return np.stack([np.bincount(patch, weight * some).astype(np.float64) for some in gaps], axis=1)
