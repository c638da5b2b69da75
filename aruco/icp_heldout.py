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
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from aruco.icp_equations import weighted
from aruco.icp_normal import Normal, derivatives, free_inverse, scaled_inverse, summed
from aruco.icp_rows import POSE, Index, Rows
from aruco.icp_solve import Registration
from aruco.pose_math import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

N_FOLDS = 4  # shares of the scene that are held out in turn
# Side of a patch [m]. Depth errors of neighbours, and windows that normals were fitted in, reach 0.1 to 0.2 m at 3 to
# 4 m: what a patch shares with those around it is its rim.
PATCH_M = 0.6
# Patches in which no gap changes by this share of its sigma say nothing, and need not be looked at. Much larger shares
# would leave out what in sum decides.
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
class Estimate:
    """What some rows and what is known beforehand say of all unknowns."""

    x: Array  # (size,)
    P: Array  # (size, size) covariance

    def way(self, A: Array, b: Array) -> Array:
        """(size,) from here to the estimate under the constraint ``A x = b``."""
        return -self.P @ A.T @ scaled_inverse(A @ self.P @ A.T) @ (A @ self.x - b)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class HeldOut:
    """A registration's rows in shares that are held out in turn."""

    registration: Registration
    patch: Index  # (m,) of the scene, of each row
    fold: Index  # (m,) 0 to N_FOLDS - 1, one for each patch
    without: tuple[Normal, ...]  # of all rows but those of a fold, and of what is known beforehand
    estimates: tuple[Estimate, ...]  # by each of these
    J: csr_array  # (m, N_FOLDS * size) of gaps by the unknowns of their own fold's estimate
    shared: csr_array  # (m, c) of gaps by the errors that they share with others of their patch
    gap_m: Array  # (m,) gaps that the solution without a row's own share predicts for it
    # What has been found already: asked for again and again.
    memo: dict[frozenset[str], Comparison] = field(default_factory=dict)

    def compared(self, cameras: Collection[str]) -> Comparison:
        """Whether gaps shrink from some cameras' standing at their start to nobody's doing so but the reference.

        The floor's own rows do not count. Both are judged by the same weights, those of the larger gap of each row:
        what loses weight under one solution must not be worth more under the other.
        """
        key = frozenset(cameras)
        if key not in self.memo:
            self.memo[key] = self._compared(key)
        return self.memo[key]

    def _compared(self, cameras: frozenset[str]) -> Comparison:
        reg = self.registration
        back = self._back(cameras)
        new, change = self.gap_m, self._changes(back)
        old = new + change
        changed = np.abs(change) > _CHANGE * np.sqrt(reg.rows.variance)
        here = np.flatnonzero(~reg.rows.is_floor & np.isin(self.patch, self.patch[changed]))
        if not len(here):
            return Comparison(gain=0.0, share=0.0, sigma=math.inf)
        rows = weighted(reg.rows.only(here), np.maximum(np.abs(old), np.abs(new))[here], reg.scale)
        # The way counts less where it is doubted; see _doubted.
        weight = _weighted(rows, self.shared[here], self._changes(self._doubted(back))[here])
        patch = np.unique(self.patch[here], return_inverse=True)[1].ravel()
        sums = np.stack([np.bincount(patch, weight * gaps[here]) for gaps in (old, change)], axis=1)
        return compared_scores(sums / reg.scale**2)

    def median_mm(self, camera: str, cameras: Collection[str] = ()) -> float:
        """Median of absolute gaps between one camera's cloud and all others; NaN without any. See gaps."""
        rows = self.registration.rows
        here = rows.of(self.registration.layout.cameras.index(camera)) & ~rows.is_floor
        return 1e3 * float(np.median(np.abs(self.gaps(cameras)[here]))) if here.any() else float("nan")

    def gaps(self, cameras: Collection[str] = ()) -> Array:
        """(m,) gaps [m] that the solution without a row's own share predicts for it.

        Args:
            cameras: Who stands at their start, relative to the reference; depth errors are estimated with them there.
        """
        return self.gap_m + self._changes(self._back(frozenset(cameras)))

    def _changes(self, x: Array) -> Array:
        """(m,) what changes (N_FOLDS, size) of the unknowns without each share make of the gaps in it [m]."""
        return np.asarray(self.J @ x.ravel())

    def _back(self, cameras: frozenset[str]) -> Array:
        """(N_FOLDS, size) the way from the solutions to those with some cameras at their start."""
        reg, one = self.registration, np.eye(self.registration.layout.size)
        names = sorted(cameras - {reg.reference})
        A = np.concatenate([one[:0], *(one[reg.layout.pose(n)] - one[reg.layout.pose(reg.reference)] for n in names)])
        b = np.concatenate([np.zeros(0), *(reg.back[name] for name in names)])
        return np.stack([estimate.way(A, b) for estimate in self.estimates])

    def _doubted(self, way: Array) -> Array:
        """(N_FOLDS, size) a way between solutions, less of it where only the share that is held out knows the way.

        A prediction has an error of its own, A C A^T with A the share's rows and C the covariance of what is free
        without the share. With R of the gaps, (R + A C A^T)^-1 A x = R^-1 A y where y = (C^-1 + A^T R^-1 A)^-1 C^-1 x.
        """
        P = self.registration.joint
        return np.stack([P @ (normal.H @ x) for normal, x in zip(self.without, way)])


def held_out(registration: Registration, *, seed: int = 0) -> HeldOut:
    """Shares of the scene, drawn by chance, and what the rest of it says."""
    patch = patches(registration.rows)
    return held_out_by(registration, patch, _folds(patch, np.random.default_rng(seed))[patch])


def held_out_by(registration: Registration, patch: Index, fold: Index) -> HeldOut:
    """The same with given shares.

    Args:
        registration: Of which something is held out.
        patch: (m,) of the scene, of each of its rows.
        fold: (m,) 0 to N_FOLDS - 1, one for each patch.
    """
    rows, layout = registration.rows, registration.layout
    n_cells = int(max(rows.cell_a.max(initial=-1), rows.cell_b.max(initial=-1))) + 1
    parts = [summed(rows.only(fold != k), layout, n_cells, scale=registration.scale) for k in range(N_FOLDS)]
    without = tuple(part + registration.prior for part in parts)
    estimates = tuple(_estimate(registration, normal) for normal in without)
    J = _by_fold(derivatives(rows, layout), layout.size, fold)
    return HeldOut(
        registration=registration,
        patch=patch,
        fold=fold,
        without=without,
        estimates=estimates,
        J=J,
        shared=_shared(rows, patch, n_cells),
        gap_m=rows.gap_m + J @ np.concatenate([estimate.x for estimate in estimates]),
    )


def _estimate(registration: Registration, normal: Normal) -> Estimate:
    """The best of all unknowns but those that are frozen."""
    P = free_inverse(normal.H, registration.frozen)
    return Estimate(x=-P @ normal.g, P=P)


def _by_fold(J: csr_array, size: int, fold: Index) -> csr_array:
    """(m, N_FOLDS * size) derivatives (m, size) by what is unknown of each row's own fold."""
    from scipy.sparse import csr_array

    entries = J.tocoo()
    row, column = entries.coords
    return csr_array((entries.data, (row, column + size * fold[row])), shape=(len(fold), N_FOLDS * size))


def _shared(rows: Rows, patch: Index, n_cells: int) -> csr_array:
    """(m, c) of gaps by the errors of cells; a cell that reaches into two patches is one in each. None of the floor."""
    from scipy.sparse import csr_array

    m = np.flatnonzero(~rows.is_floor)
    keys = np.concatenate([patch[m] * n_cells + rows.cell_a[m], patch[m] * n_cells + rows.cell_b[m]])
    found, cell = np.unique(keys, return_inverse=True)
    errors = np.concatenate([rows.shared_a[m], -rows.shared_b[m]])
    return csr_array((errors, (np.concatenate([m, m]), cell.ravel())), shape=(len(patch), len(found)))


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


def _weighted(rows: Rows, shared: csr_array, way: Array) -> Array:
    """(m,) a way of gaps (m,) by the inverse of their covariance, what they share (m, c) allowed for."""
    from scipy.sparse import csr_array, eye_array
    from scipy.sparse.linalg import splu

    W = 1.0 / (rows.own + rows.variance * (1.0 / rows.weight - 1.0))
    cells = np.unique(shared.indices)
    shared = csr_array(shared[:, cells])
    pull = csr_array(shared.multiply(W[:, None])).T.tocsr()
    A = (eye_array(len(cells)) + pull @ shared).tocsc()
    known = splu(A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0).solve(pull @ way)
    return W * way - pull.T @ known
