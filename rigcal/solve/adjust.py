"""Joint adjustment: the camera and target poses under which all corners lie best.

Owns      Levenberg-Marquardt on the Schur complement, the robust loss and its scale, the covariance.
Leaves    residuals and derivatives to problem; which views take part to judge.

Targets are eliminated frame by frame (Schur complement), so a step costs a little for each view and a small dense
system for the cameras: cost grows linearly with frames (Triggs et al., "Bundle adjustment: a modern synthesis", 2000).
Corners are weighed by a Cauchy loss, ``k^2 log(1 + e / k^2)`` for the squared distance e, whose k follows the data:
KAPPA robust standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from aruco.errors import CalibrationError
from aruco.merged_detection import RAYLEIGH_MEDIAN
from aruco.pose_math import Array, Pose, exp_so3
from rigcal.solve.problem import Poses, Sightings, ViewSums, residuals, view_sums
from rigcal.solve.repetition import places, repetition

# 95 % efficient for clean Gaussian corners (Holland and Welsch 1977: 2.385), deaf to gross errors.
KAPPA = 2.385
MAX_STEPS = 60
RESCALINGS = 6
SETTLED_SCALE = 0.02
CONVERGED_COST = 1e-9  # relative
CONVERGED_STEP = 1e-10  # radians and metres
START_DAMPING = 1e-6
MAX_DAMPING = 1e8
# What the corners' own sigmas are worth when residuals are few: as much as this many residuals.
PRIOR_DOF = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Adjustment:
    """The optimum, and what is known about it."""

    poses: Poses
    residuals: Array  # (n, 2) predicted minus seen, in the corners' standard deviations
    scale: float  # robust standard deviation of a residual coordinate, in the corners' standard deviations
    covariance: Array  # (6 c, 6 c) of the left perturbations of all cameras, world axes; zero rows for fixed ones
    absorbed: float  # by how much the unknowns have lowered the squares of the residuals
    variance: float  # of a residual coordinate in the corners' variances, larger where corners repeat each other
    steps: int


@dataclass(frozen=True, slots=True, eq=False)
class Gauge:
    """What does not move: it carries the world."""

    fixed_cameras: NDArray[np.bool_]  # (c,)
    fixed_frames: NDArray[np.bool_]  # (f,)

    def without_frames(self) -> Gauge:
        """The same cameras, and no frame: what is left tells relative poses only."""
        return Gauge(self.fixed_cameras, np.zeros_like(self.fixed_frames))


Unknowns = TypeVar("Unknowns")


class Problem(Protocol[Unknowns]):
    """What is minimised: corners whose residuals depend on some unknowns, which move in steps of two kinds."""

    @property
    def dof(self) -> int:
        """Residuals beyond the unknowns."""
        ...

    @property
    def least_scale(self) -> float:
        """As that of Sightings."""
        ...

    def sums(self, unknowns: Unknowns, kappa: float) -> ViewSums:
        """See problem.view_sums."""
        ...

    def step(self, unknowns: Unknowns, sums: ViewSums, damping: float) -> tuple[Array, Array]:
        """The damped step (k, 6) of what all frames share, and that of the targets (f, 6)."""
        ...

    def moved(self, unknowns: Unknowns, shared: Array, targets: Array) -> Unknowns:
        """The unknowns after a step."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Optimum(Generic[Unknowns]):
    """Where the robust loss is least."""

    unknowns: Unknowns
    scale: float  # as Adjustment's
    steps: int


@dataclass(frozen=True, slots=True, eq=False)
class _PosesOnly:
    """The problem of adjust."""

    sightings: Sightings
    gauge: Gauge

    @property
    def dof(self) -> int:
        return degrees_of_freedom(self.sightings, self.gauge)

    @property
    def least_scale(self) -> float:
        return self.sightings.least_scale

    def sums(self, unknowns: Poses, kappa: float) -> ViewSums:
        return view_sums(self.sightings, unknowns, kappa)

    def step(self, unknowns: Poses, sums: ViewSums, damping: float) -> tuple[Array, Array]:
        return _solve(self.sightings, sums, self.gauge, damping)

    def moved(self, unknowns: Poses, shared: Array, targets: Array) -> Poses:
        return Poses(left_moved(unknowns.T_world_cam, shared), left_moved(unknowns.T_world_target, targets))


def adjust(sightings: Sightings, start: Poses, gauge: Gauge) -> Adjustment:
    """Minimise the robust reprojection error over all poses that the gauge leaves free.

    Args:
        sightings: Corners; every free camera needs at least one view.
        start: Poses near the optimum.
        gauge: Fixed cameras and frames, at least one of them.

    Raises:
        CalibrationError: The corners leave a camera's pose open.
    """
    try:
        found = optimise(_PosesOnly(sightings, gauge), start)
        covariance, variance = _covariance(sightings, found.unknowns, gauge, KAPPA * found.scale)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(
            "The corners leave a camera's pose open: record more frames, with more of the target in view."
        ) from error
    return Adjustment(
        poses=found.unknowns,
        residuals=residuals(sightings, found.unknowns),
        scale=found.scale,
        covariance=covariance,
        variance=variance,
        absorbed=_absorbed(len(sightings.points), degrees_of_freedom(sightings, gauge)),
        steps=found.steps,
    )


def optimise(problem: Problem[Unknowns], start: Unknowns) -> Optimum[Unknowns]:
    """The least robust loss near the start; its scale follows the residuals until both agree."""
    unknowns, steps = start, 0
    squares, dof = problem.sums(start, np.inf).squares, problem.dof
    for _ in range(RESCALINGS):
        scale = max(_scale(squares, dof), problem.least_scale)
        unknowns, squares, took = _minimise(problem, unknowns, KAPPA * scale)
        steps += took
        if abs(max(_scale(squares, dof), problem.least_scale) - scale) < SETTLED_SCALE * scale:
            break
    return Optimum(unknowns, max(_scale(squares, dof), problem.least_scale), steps)


def degrees_of_freedom(sightings: Sightings, gauge: Gauge) -> int:
    """Residuals beyond the unknowns."""
    seen = np.zeros(len(sightings.frames), dtype=bool)
    seen[sightings.view_frame] = True
    n_free = 6 * int((~gauge.fixed_cameras).sum() + (seen & ~gauge.fixed_frames).sum())
    return max(2 * len(sightings.points) - n_free, 0)


def _scale(squares: Array, dof: int) -> float:
    """Robust standard deviation of a residual coordinate; what the unknowns have absorbed is given back."""
    return float(np.sqrt(np.median(squares) * _absorbed(len(squares), dof))) / RAYLEIGH_MEDIAN


def _absorbed(n_corners: int, dof: int) -> float:
    """By how much the unknowns have lowered the squares of residuals."""
    return (2 * n_corners + PRIOR_DOF) / (dof + PRIOR_DOF)


def _minimise(problem: Problem[Unknowns], unknowns: Unknowns, kappa: float) -> tuple[Unknowns, Array, int]:
    """Levenberg-Marquardt with a fixed loss: the optimum near ``unknowns``, squared distances, steps tried."""
    sums = problem.sums(unknowns, kappa)
    cost = _cost(sums.squares, kappa)
    damping = START_DAMPING
    for step in range(1, MAX_STEPS + 1):
        shared, targets = problem.step(unknowns, sums, damping)
        moved = problem.moved(unknowns, shared, targets)
        tried = problem.sums(moved, kappa)
        tried_cost = _cost(tried.squares, kappa)
        if not tried_cost <= cost:
            damping *= 10
            if damping > MAX_DAMPING or max(np.abs(shared).max(), np.abs(targets).max()) < CONVERGED_STEP:
                return unknowns, sums.squares, step
            continue
        done = cost - tried_cost <= CONVERGED_COST * cost
        unknowns, sums, cost, damping = moved, tried, tried_cost, max(damping / 10, 1e-12)
        if done:
            return unknowns, sums.squares, step
    return unknowns, sums.squares, MAX_STEPS


def _cost(squares: Array, kappa: float) -> float:
    """The Cauchy loss of all corners; infinite with a corner behind its camera."""
    cost = float(np.log1p(squares / kappa**2).sum())
    return kappa**2 * cost if np.isfinite(cost) else np.inf


def left_moved(T: Pose, xi: Array) -> Pose:
    """Poses (k, 4, 4) after left steps (k, 6): to first order ``Exp(xi) @ T``, which is all that a step is good for."""
    R = exp_so3(xi[:, :3])
    moved = T.copy()
    moved[:, :3] = R @ T[:, :3]
    moved[:, :3, 3] += xi[:, 3:]
    still = ~xi.any(axis=1)
    moved[still] = T[still]
    return moved


def _solve(sightings: Sightings, system: ViewSums, gauge: Gauge, damping: float) -> tuple[Array, Array]:
    """The damped step of cameras (c, 6) and targets (f, 6)."""
    H_cam, g_cam, H_target, g_target, E = blocks(sightings, system)
    H_cam = damped(H_cam, damping)
    inverse = inverse_targets(damped(H_target, damping), gauge)
    S, Y = schur(H_cam, inverse, E)
    right = g_cam.ravel() - np.einsum("fij,fj->i", Y, g_target)
    free = np.repeat(~gauge.fixed_cameras, 6)
    d_cam = np.zeros(len(free))
    if free.any():
        d_cam[free] = -np.linalg.solve(S[np.ix_(free, free)], right[free])
    d_target = -np.einsum("fij,fj->fi", inverse, g_target + np.einsum("fij,i->fj", E, d_cam))
    return d_cam.reshape(-1, 6), d_target


def blocks(sightings: Sightings, system: ViewSums) -> tuple[Array, Array, Array, Array, Array]:
    """H and g of cameras and targets, and the coupling E (f, 6 c, 6)."""
    W, g = by_frame(sightings, system.W), by_frame(sightings, system.g)
    n_frame, n_cam = W.shape[:2]
    E = -W.reshape(n_frame, 6 * n_cam, 6)
    # A camera's derivative is the target's with the other sign.
    return W.sum(axis=0), -g.sum(axis=0), W.sum(axis=1), g.sum(axis=1), E


def by_frame(sightings: Sightings, of_views: Array) -> Array:
    """Values of the views (v, ...) as (f, c, ...), zero where there is none: a frame and a camera have one or none."""
    values = np.zeros((len(sightings.frames), len(sightings.cameras), *of_views.shape[1:]))
    values[sightings.view_frame, sightings.view_camera] = of_views
    return values


def damped(H: Array, damping: float) -> Array:
    """Blocks (k, 6, 6) with their diagonals raised by a share of themselves."""
    diagonal = np.einsum("kii->ki", H)
    return H + damping * np.maximum(diagonal, 1e-12)[:, :, None] * np.eye(6)


def inverse_targets(H_target: Array, gauge: Gauge) -> Array:
    """Inverses of the targets' blocks; zero for fixed targets and for frames without a view."""
    seen = np.einsum("kii->k", H_target) > 1e-9
    free = seen & ~gauge.fixed_frames
    inverse = np.zeros_like(H_target)
    inverse[free] = np.linalg.pinv(H_target[free], rcond=1e-14, hermitian=True)
    return inverse


def schur(H_cam: Array, inverse: Array, E: Array) -> tuple[Array, Array]:
    """The cameras' system (6c, 6c) after the targets are eliminated, and ``Y = E H_target^-1`` (f, 6c, 6)."""
    Y = E @ inverse
    n = E.shape[1]
    S = -(Y.transpose(1, 0, 2).reshape(n, -1) @ E.transpose(1, 0, 2).reshape(n, -1).T)
    for k, block in enumerate(H_cam):
        S[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += block
    return S, Y


def _covariance(sightings: Sightings, poses: Poses, gauge: Gauge, kappa: float) -> tuple[Array, float]:
    """(6c, 6c) covariance of all cameras' left perturbations, scaled by the residuals, and the variance used for it.

    For an M-estimator with psi(r) = w(r) r it is E[psi^2] / E[psi']^2 (X^T X)^-1 (Huber, "Robust statistics", 1981,
    ch. 7); for the Cauchy loss in two dimensions the mean of psi' is the mean of w^2, which here stays inside the
    normal equations so that a view full of outliers counts little. Corners of a frame that err together repeat each
    other, and count less.
    """
    system = view_sums(sightings, poses, kappa, power=2)
    H_cam, _, H_target, _, E = blocks(sightings, system)
    S, _ = schur(H_cam, inverse_targets(H_target, gauge), E)
    free = np.repeat(~gauge.fixed_cameras, 6)
    P = np.zeros_like(S)
    if free.any():
        inverse = np.linalg.inv(S[np.ix_(free, free)])
        P[np.ix_(free, free)] = (inverse + inverse.T) / 2
    variance = residual_variance(system.squares, degrees_of_freedom(sightings, gauge), kappa)
    W, g = by_frame(sightings, system.W), by_frame(sightings, view_sums(sightings, poses, kappa).g)
    place, held = places(poses.T_world_target), bool(gauge.fixed_frames.any())
    Y = E @ inverse_targets(H_target, gauge.without_frames())
    variance *= repetition(W, g, E, Y, P, variance, place, frame_held=held)
    return variance * P, variance


def residual_variance(squares: Array, dof: int, kappa: float) -> float:
    """Variance of a residual coordinate in the corners' variances, from the residuals and a little from the sigmas."""
    w2 = (1.0 + squares / kappa**2) ** -2
    return float(((w2 * squares).sum() + PRIOR_DOF) / (dof + PRIOR_DOF) / w2.mean())
