"""Rows of equations summed up, and solved.

Owns      Normal: normal equations with the errors of cells taken out exactly; the solution over what is free.
Leaves    rows to icp_equations, priors to icp_prior.

Every row has two errors that other rows share: those of a cell of each camera. They are unknowns of variance one like
the others, only that nobody wants to know them: eliminating them (Schur's complement of a sparse matrix) leaves what
the rows say when everything that they share, across directions, pairs and the floor, is counted once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from aruco.floor_plane import Mask
from aruco.icp_rows import PER_CAMERA, Layout, Rows
from aruco.pose_math import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Normal:
    """Normal equations ``H x = -g``: chi-square is ``chi2 + 2 g . x + x . H x``."""

    H: Array  # (size, size)
    g: Array  # (size,)
    chi2: float  # at x = 0

    def __add__(self, other: Normal) -> Normal:
        """What both say."""
        return Normal(H=self.H + other.H, g=self.g + other.g, chi2=self.chi2 + other.chi2)

    def scaled(self, weight: float) -> Normal:
        """What is said, of this weight."""
        return Normal(H=weight * self.H, g=weight * self.g, chi2=weight * self.chi2)


def summed(rows: Rows, layout: Layout, n_cells: int, *, scale: float = 1.0) -> Normal:
    """What rows say, where their noise is ``scale`` times what is promised."""
    from scipy.sparse import csr_array, eye_array
    from scipy.sparse.linalg import splu

    # A row of less weight is one with more noise of its own.
    W = 1.0 / (rows.own + rows.variance * (1.0 / rows.weight - 1.0))
    m = np.arange(len(rows.gap_m))
    second = rows.cell_b >= 0
    shared = csr_array(
        (
            np.concatenate([rows.shared_a, -rows.shared_b[second]]),
            (np.concatenate([m, m[second]]), np.concatenate([rows.cell_a, rows.cell_b[second]])),
        ),
        shape=(len(m), n_cells),
    )
    weighted = csr_array(shared.multiply(W[:, None])).T.tocsr()  # (n_cells, m)
    # Sparse products add up in one order, BLAS in another for each number of threads. And of many cameras each cell
    # meets few.
    J = derivatives(rows, layout)
    WJ = csr_array(J.multiply(W[:, None]))
    H, g, mixed = (J.T @ WJ).toarray(), WJ.T @ rows.gap_m, csr_array(weighted @ J)
    gap = weighted @ rows.gap_m
    chi2 = float(np.sum(W * rows.gap_m**2))
    if len(m):
        factor = splu(
            (eye_array(n_cells) + weighted @ shared).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0
        )
        solved = factor.solve(np.column_stack([mixed.toarray(), gap]))
        H -= mixed.T @ solved[:, :-1]
        g -= mixed.T @ solved[:, -1]
        chi2 -= float(np.sum(gap * solved[:, -1]))
    H, g = H / scale**2, g / scale**2
    return Normal(H=(H + H.T) / 2, g=g, chi2=chi2 / scale**2)


def derivatives(rows: Rows, layout: Layout) -> csr_array:
    """(m, size) of gaps by all unknowns."""
    from scipy.sparse import csr_array

    first, second = rows.columns(layout)
    places = np.concatenate([k[:, None] + np.arange(PER_CAMERA) for k in (first, second)], axis=1)
    values = np.hstack([rows.by_a, rows.by_b])
    # The floor has fewer unknowns than a camera; what is beyond the last of them is zero.
    inside = places < layout.size
    m = np.broadcast_to(np.arange(len(values))[:, None], places.shape)
    return csr_array((values[inside], (m[inside], places[inside])), shape=(len(values), layout.size))


def solved(normal: Normal, M: Array) -> Array:
    """(size,) the best ``x = M z`` over all z."""
    return -M @ (scaled_inverse(M.T @ normal.H @ M) @ (M.T @ normal.g))


def free_inverse(A: Array, frozen: Mask) -> Array:
    """(size, size) the inverse of a symmetric matrix over unknowns that are not frozen (size,); zero at those."""
    free = np.ix_(~frozen, ~frozen)
    inverse = np.zeros_like(A)
    inverse[free] = scaled_inverse(A[free])
    return inverse


def scaled_inverse(A: Array) -> Array:
    """The inverse of a symmetric matrix whose unknowns have different units; directions without any say stay put."""
    d = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-30))
    inverse = np.linalg.pinv(A * np.outer(d, d), rcond=1e-14, hermitian=True) * np.outer(d, d)
    return np.asarray((inverse + inverse.T) / 2)
