"""The shape of a target whose map is only roughly right, estimated together with all cameras and poses.

Owns      the markers' unknown poses, which of them the views determine, and what the map's frame means afterwards.
Leaves    residuals and derivatives to problem; the robust loss and its minimisation to adjust.

Every marker keeps its own shape and size, which fixes the scale, and only moves rigidly in the target: a corner X of
marker m, where the map has it, is predicted at

    p = project_c(T_cam_world @ T_world_target[f] @ T_target_map[m] @ X)

A marker's left twist eta in the target's axes moves the corner as the world twist ``Ad(T_world_target[f]) @ eta`` of
the target does. So with one row of Sightings for each marker of a view, the same sums W and g of problem serve: with
A = Ad(T_world_target[f]) they are ``A^T W A`` and ``A^T g`` for the marker, ``A^T W`` between marker and target, and
``-W A`` between camera and marker. Targets are eliminated frame by frame; cameras and markers remain.

All markers together could move in the target's frame, and all targets the other way. The frame is therefore held where
the corrected markers, as one rigid body, fit the map best (least squares over corners; Kabsch 1976): every step is
tangent to that, and the second order is taken back after each. So nothing depends on one marker being right. The same
holds for each part of a target whose parts the views do not tie together: it stays as a body where the map has it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from aruco.errors import CalibrationError
from aruco.pose_math import Array, Pose, adjoint, invert_transform, make_pose, skew, transform_points
from rigcal.solve import adjust as solver
from rigcal.solve.adjust import Gauge, optimise
from rigcal.solve.problem import Poses, Sightings, ViewSums, view_sums
from rigcal.solve.repetition import places, repetition

# A marker whose place or direction relative to the others the views leave open by more than this is better known from
# a map that is right to some millimetres and degrees.
MAX_SIGMA_M = 0.05
MAX_SIGMA_RAD = 0.05
# A pose in space needs so many corners that do not lie on one line; a marker has four.
MIN_CORNERS = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinedTarget:
    """The corrected target, and the cameras and poses that go with it."""

    geometry: Mapping[int, Array]  # all markers of the map -> (k, 3) corners [m], target frame; refined ones moved
    poses: Poses  # what the gauge fixes has not moved by a bit
    moved_m: Mapping[int, float]  # refined marker -> root mean square displacement of its corners in the target frame
    sigma_m: Mapping[int, float]  # refined marker -> standard deviation of its centre (root of summed variances)
    unrefined: Mapping[int, str]  # marker that stays as the map has it -> why
    parts: tuple[tuple[int, ...], ...]  # refined markers that views tie to each other; of two, only the map knows how
    scale: float  # robust standard deviation of a residual coordinate, in the corners' standard deviations
    covariance: Array  # (6 c, 6 c) as Adjustment's, the shape of the target being as unknown as it is
    steps: int


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """The unknowns: all poses, and where each marker is, seen from where the map has it."""

    poses: Poses
    T_target_map: Pose  # (m, 4, 4)


def refine_target(sightings: Sightings, start: Poses, gauge: Gauge, geometry: Mapping[int, Array]) -> RefinedTarget:
    """Minimise the robust reprojection error over all free poses and the relative poses of the markers.

    Args:
        sightings: Corners of views that belong, gathered with ``geometry``; every free camera needs one view at least.
        start: Poses near the optimum of the rough map.
        gauge: Either some cameras, or the target of one frame; in the latter case that target stays where it is, so
            that a world which is its frame remains so for the corrected map. Cameras without a view may be fixed too.
        geometry: Marker id -> (k, 3) points [m], target frame: the rough map.

    Returns:
        The corrected map in a frame in which it, or each of its parts, fits the given one best. The covariance is
        relative to the gauge, the target's frame being this best fit; of cameras that see only another part than the
        first it does not know how wrong the map may be.

    Raises:
        CalibrationError: There is not one view.
    """
    if not sightings.n_views:
        raise CalibrationError("No view of the target is left to refine it from: check the marker map.")
    _refuse_two_worlds(sightings, gauge)
    problem = _split(sightings, gauge)
    problem = replace(problem, part=problem.parts(start))
    found = optimise(problem, Shape(start, np.tile(np.eye(4), (len(problem.ids), 1, 1))))
    shape = found.unknowns
    covariance = problem.covariance(shape, solver.KAPPA * found.scale)
    refined = [(m, int(problem.ids[m])) for m in np.flatnonzero(problem.part >= 0).tolist()]
    corrected = {i: transform_points(shape.T_target_map[m], geometry[i]) for m, i in refined}
    n = 6 * len(sightings.cameras)
    return RefinedTarget(
        geometry={marker: corrected.get(marker, corners) for marker, corners in geometry.items()},
        poses=shape.poses,
        moved_m={i: float(np.sqrt(((new - geometry[i]) ** 2).sum(axis=1).mean())) for i, new in corrected.items()},
        sigma_m={i: _sigmas(covariance, n + 6 * m, corrected[i])[1] for m, i in refined},
        unrefined={i: _why_unrefined(i, problem, corners) for i, corners in geometry.items() if i not in corrected},
        parts=tuple(tuple(problem.ids[problem.part == k].tolist()) for k in range(problem.n_parts)),
        scale=found.scale,
        covariance=covariance[:n, :n],
        steps=found.steps,
    )


def rigid_fit(points_a: Array, points_b: Array) -> Pose:
    """T_a_b with which points (n, 3) of b lie on those of a best, in least squares (Kabsch 1976)."""
    middle_a, middle_b = points_a.mean(axis=0), points_b.mean(axis=0)
    U, _, Vt = np.linalg.svd((points_a - middle_a).T @ (points_b - middle_b))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return make_pose(R, middle_a - R @ middle_b)


def _refuse_two_worlds(sightings: Sightings, gauge: Gauge) -> None:
    cameras, frames = gauge.fixed_cameras[sightings.view_camera].any(), int(gauge.fixed_frames.sum())
    if (cameras and frames) or frames > 1:
        raise ValueError("want either fixed cameras or one fixed frame: a target of unknown shape cannot carry both")


def _why_unrefined(marker: int, problem: ShapeProblem, corners: Array) -> str:
    if marker not in problem.ids:
        return "no view of it takes part"
    if len(corners) < MIN_CORNERS:
        return "it is a single point, which has no shape that fixes the scale"
    return (
        "the views tie it to no other marker: show it and another one to one camera at a time, or turn the target more "
        "from frame to frame"
    )


def _split(sightings: Sightings, gauge: Gauge) -> ShapeProblem:
    """The problem with one row for each marker of each view, and no marker that moves."""
    view = sightings.corner_view
    begins = np.concatenate([[True], (np.diff(view) != 0) | (np.diff(sightings.marker) != 0)])
    first = np.flatnonzero(begins)
    ids, marker = np.unique(sightings.marker[first], return_inverse=True)
    rows = replace(
        sightings,
        view_camera=sightings.view_camera[view[first]],
        view_frame=sightings.view_frame[view[first]],
        start=np.append(first, len(view)),
    )
    return ShapeProblem(rows=rows, marker=marker, ids=ids, part=np.full(len(ids), -1), gauge=gauge)


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations: k = c + m poses that all frames share, and the targets."""

    H: Array  # (k, 6, 6) the diagonal blocks
    between: Array  # (6 c, 6 m) of cameras and markers
    g: Array  # (6 k,)
    H_target: Array  # (f, 6, 6)
    g_target: Array  # (f, 6)
    E: Array  # (f, 6 k, 6) coupling of both


@dataclass(frozen=True, kw_only=True, eq=False)
class ShapeProblem:
    """An adjust.Problem over Shape; c cameras, m markers, r rows."""

    rows: Sightings  # a "view" is one marker in one view; points as the map has them
    marker: NDArray[np.int64]  # (r,) index into ids
    ids: NDArray[np.int64]  # (m,) markers that are seen
    part: NDArray[np.int64]  # (m,) which part of the target each belongs to; -1 for markers that do not move
    gauge: Gauge

    @property
    def n_parts(self) -> int:
        """How many parts there are."""
        return int(self.part.max()) + 1

    @property
    def least_scale(self) -> float:
        """As that of the views."""
        return self.rows.least_scale

    @property
    def dof(self) -> int:
        """Residuals beyond the unknowns; six of each part's are fixed by the map."""
        n_moving = int((self.part >= 0).sum()) - self.n_parts
        return max(solver.degrees_of_freedom(self.rows, self.gauge) - 6 * n_moving, 0)

    def sums(self, unknowns: Shape, kappa: float, power: int = 1) -> ViewSums:
        """Sums of every row."""
        return view_sums(self.placed(unknowns), unknowns.poses, kappa, power)

    def placed(self, unknowns: Shape) -> Sightings:
        """The rows with their corners where the shape has them."""
        points = self.rows.points.copy()
        for m in np.flatnonzero(self.part >= 0):
            mine = self._corners[m]
            points[mine] = transform_points(unknowns.T_target_map[m], points[mine])
        return replace(self.rows, points=points)

    def step(self, unknowns: Shape, sums: ViewSums, damping: float) -> tuple[Array, Array]:
        """The damped step of cameras and markers (c + m, 6), tangent to the best fit, and of targets (f, 6)."""
        normal = self.normal(unknowns, sums)
        inverse = solver.inverse_targets(solver.damped(normal.H_target, damping), self.gauge)
        S, Y = self._reduced(normal, solver.damped(normal.H, damping), inverse)
        right = normal.g - np.einsum("fij,fj->i", Y, normal.g_target)
        basis = self.basis(unknowns)
        shared = -basis @ np.linalg.solve(basis.T @ S @ basis, basis.T @ right)
        targets = -np.einsum("fij,fj->fi", inverse, normal.g_target + np.einsum("fij,i->fj", normal.E, shared))
        return shared.reshape(-1, 6), targets

    def moved(self, unknowns: Shape, shared: Array, targets: Array) -> Shape:
        """The shape after a step, every part where it fits the map best again, the target's frame with the first."""
        n_cam, poses = len(self.rows.cameras), unknowns.poses
        T_world_cam = solver.left_moved(poses.T_world_cam, shared[:n_cam])
        T_world_target = solver.left_moved(poses.T_world_target, targets)
        T_target_map = solver.left_moved(unknowns.T_target_map, shared[n_cam:])
        new = self._new(T_target_map)
        old, number = self._old
        fits = [rigid_fit(old[mine], new[mine]) for mine in (self.part[number] == k for k in range(self.n_parts))]
        for k, T_fit_target in enumerate(fits):
            T_target_map[self.part == k] = T_fit_target @ T_target_map[self.part == k]
        if fits:
            T_world_cam, T_world_target = self._reframed(T_world_cam, T_world_target, fits[0])
        return Shape(Poses(T_world_cam, T_world_target), T_target_map)

    def _reframed(self, T_world_cam: Pose, T_world_target: Pose, T_fit_target: Pose) -> tuple[Pose, Pose]:
        """Poses after the target's frame has moved; where a frame carries the world, the world follows."""
        held = self.gauge.fixed_frames
        reframed = T_world_target @ invert_transform(T_fit_target)
        if not held.any():
            return T_world_cam, reframed
        f = int(np.argmax(held))
        T_new_world = T_world_target[f] @ invert_transform(reframed[f])
        cameras = np.where(self.gauge.fixed_cameras[:, None, None], T_world_cam, T_new_world @ T_world_cam)
        return cameras, np.where(held[:, None, None], T_world_target, T_new_world @ reframed)

    def normal(self, unknowns: Shape, sums: ViewSums) -> _Normal:
        """Normal equations of all cameras, markers and targets, of fixed ones too."""
        rows, n_cam, n_marker, n_frame = self.rows, len(self.rows.cameras), len(self.ids), len(self.rows.frames)
        A = np.array([adjoint(T) for T in unknowns.poses.T_world_target])
        A_T = A.transpose(0, 2, 1)
        c, f, m = rows.view_camera, rows.view_frame, self.marker
        W_frame_cam = _summed(sums.W, f * n_cam + c, n_frame * n_cam).reshape(n_frame, n_cam, 6, 6)
        W_frame_marker = _summed(sums.W, f * n_marker + m, n_frame * n_marker).reshape(n_frame, n_marker, 6, 6)
        g_frame_marker = _summed(sums.g, f * n_marker + m, n_frame * n_marker).reshape(n_frame, n_marker, 6)
        E_marker = A_T[:, None] @ W_frame_marker
        between = _summed(sums.W @ A[f], c * n_marker + m, n_cam * n_marker).reshape(n_cam, n_marker, 6, 6)
        return _Normal(
            H=np.concatenate([W_frame_cam.sum(axis=0), (E_marker @ A[:, None]).sum(axis=0)]),
            between=-between.transpose(0, 2, 1, 3).reshape(6 * n_cam, 6 * n_marker),
            g=np.concatenate(
                [-_summed(sums.g, c, n_cam).ravel(), np.einsum("fij,fmj->mi", A_T, g_frame_marker).ravel()]
            ),
            H_target=W_frame_cam.sum(axis=1),
            g_target=g_frame_marker.sum(axis=1),
            E=np.concatenate([-W_frame_cam, E_marker], axis=1).reshape(n_frame, -1, 6),
        )

    def _reduced(self, normal: _Normal, H: Array, inverse: Array) -> tuple[Array, Array]:
        """The system of cameras and markers after the targets are eliminated, and Y (see adjust)."""
        S, Y = solver.schur(H, inverse, normal.E)
        n = len(normal.between)
        S[:n, n:] += normal.between
        S[n:, :n] += normal.between.T
        return S, Y

    def basis(self, unknowns: Shape) -> Array:
        """(6 (c + m), d) steps of cameras and markers: of free ones, and of markers tangent to the best fit.

        Corners q fit the map's p best where ``sum (q - p) = 0`` and ``sum p x q = 0``; a step of q has to keep both.
        """
        n = 6 * len(self.rows.cameras)
        cameras = np.eye(n + 6 * len(self.ids))[:, :n][:, np.repeat(~self.gauge.fixed_cameras, 6)]
        blocks = [cameras]
        old, number = self._old
        both = np.einsum("nki,nkj->nij", _shifts(old), _shifts(self._new(unknowns.T_target_map)))
        for k in range(self.n_parts):
            mine = np.flatnonzero(self.part == k)
            constraint = np.concatenate([both[number == m].sum(axis=0) for m in mine], axis=1)
            tangent = np.linalg.qr(constraint.T, mode="complete")[0][:, 6:]
            block = np.zeros((len(cameras), tangent.shape[1]))
            block[n:][np.repeat(self.part == k, 6)] = tangent
            blocks.append(block)
        return np.concatenate(blocks, axis=1)

    def covariance(self, unknowns: Shape, kappa: float) -> Array:
        """(6 (c + m), 6 (c + m)) of cameras and markers, as adjust's; zero for what does not move."""
        sums = self.sums(unknowns, kappa, power=2)
        normal = self.normal(unknowns, sums)
        S, _ = self._reduced(normal, normal.H, solver.inverse_targets(normal.H_target, self.gauge))
        basis = self.basis(unknowns)
        covariance = basis @ np.linalg.inv(basis.T @ S @ basis) @ basis.T
        variance = solver.residual_variance(sums.squares, self.dof, kappa)
        variance *= self._repetition(unknowns, normal, S, self.sums(unknowns, kappa).g, variance)
        return variance * (covariance + covariance.T) / 2

    def _repetition(self, unknowns: Shape, normal: _Normal, S: Array, g: Array, variance: float) -> float:
        """How much corners of one frame repeat each other in what they say about the cameras."""
        rows, n_cam, n_frame = self.rows, len(self.rows.cameras), len(self.rows.frames)
        cameras = slice(0, 6 * n_cam)
        E = normal.E[:, cameras]
        free = np.repeat(~self.gauge.fixed_cameras, 6)
        P = np.zeros((6 * n_cam, 6 * n_cam))
        P[np.ix_(free, free)] = np.linalg.inv(S[cameras, cameras][np.ix_(free, free)])
        g_frame_cam = _summed(g, rows.view_frame * n_cam + rows.view_camera, n_frame * n_cam)
        W, g = -E.reshape(n_frame, n_cam, 6, 6), g_frame_cam.reshape(n_frame, n_cam, 6)
        place, held = places(unknowns.poses.T_world_target), bool(self.gauge.fixed_frames.any())
        Y = E @ solver.inverse_targets(normal.H_target, self.gauge.without_frames())
        return repetition(W, g, E, Y, P, variance, place, frame_held=held)

    def parts(self, poses: Poses) -> NDArray[np.int64]:
        """Which part of the target every marker (m,) belongs to; -1 for points and for markers that are tied to none.

        Parts gather around the markers with most corners; the one with most corners comes first.
        """
        corners = np.array([len(mine) for mine in self._corners])
        solid = np.bincount(self._old[1], minlength=len(self.ids)) >= MIN_CORNERS
        shape = Shape(poses, np.tile(np.eye(4), (len(self.ids), 1, 1)))
        normal = self.normal(shape, self.sums(shape, np.inf))
        S, _ = self._reduced(normal, normal.H, solver.inverse_targets(normal.H_target, self.gauge))
        left, found = solid.copy(), []
        while left.any():
            anchor = int(np.argmax(np.where(left, corners, 0)))
            tied = left & self._tied(S, anchor, solid)
            left &= ~tied
            if tied.sum() > 1:
                found.append(tied)
        part = np.full(len(self.ids), -1)
        for k, tied in enumerate(sorted(found, key=lambda tied: -int(corners[tied].sum()))):
            part[tied] = k
        return part

    def _tied(self, S: Array, anchor: int, solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which markers (m,) the corners' own sigmas determine relative to one, the cameras being unknown as well.

        Everything unknown is given standard deviations of a metre and a radian to begin with, so that what no view
        determines stays that uncertain.
        """
        moving = solid & (np.arange(len(self.ids)) != anchor)
        free = np.repeat(np.concatenate([~self.gauge.fixed_cameras, moving]), 6)
        covariance = np.zeros_like(S)
        covariance[np.ix_(free, free)] = np.linalg.inv(S[np.ix_(free, free)] + np.eye(int(free.sum())))
        n = 6 * len(self.rows.cameras)
        sigmas = [_sigmas(covariance, n + 6 * m, self.rows.points[mine]) for m, mine in enumerate(self._corners)]
        return np.all(np.array(sigmas) < [MAX_SIGMA_RAD, MAX_SIGMA_M], axis=1)

    def _new(self, T_target_map: Pose) -> Array:
        """The corners (k, 3) of _old, where the shape has them."""
        old, number = self._old
        return np.einsum("nij,nj->ni", T_target_map[number, :3, :3], old) + T_target_map[number, :3, 3]

    @cached_property
    def _corners(self) -> list[NDArray[np.intp]]:
        """Which corners belong to each of the markers."""
        of_corner = np.repeat(self.marker, self.rows.corners_per_view)
        return np.split(np.argsort(of_corner, kind="stable"), np.cumsum(np.bincount(of_corner))[:-1])

    @cached_property
    def _old(self) -> tuple[Array, NDArray[np.intp]]:
        """Corners (k, 3) of all markers, each once, where the map has them, and whose they are."""
        row = np.unique(self.marker, return_index=True)[1]
        own = [self.rows.points[self.rows.start[r] : self.rows.start[r + 1]] for r in row]
        return np.concatenate(own), np.repeat(np.arange(len(own)), [len(p) for p in own])


def _summed(values: Array, group: NDArray[np.int64], n: int) -> Array:
    """Sums (n, ...) of values (r, ...) by group (r,)."""
    from scipy.sparse import csr_array

    select = csr_array((np.ones(len(group)), (group, np.arange(len(group)))), shape=(n, len(group)))
    return (select @ values.reshape(len(values), -1)).reshape(n, *values.shape[1:])


def _shifts(points: Array) -> Array:
    """(n, 3, 6) how a left twist moves points (n, 3)."""
    return np.concatenate([-skew(points), np.broadcast_to(np.eye(3), (len(points), 3, 3))], axis=2)


def _sigmas(covariance: Array, first: int, corners: Array) -> tuple[float, float]:
    """Standard deviations of a marker's direction [rad] and centre [m]: roots of summed variances."""
    own = covariance[first : first + 6, first : first + 6]
    J = _shifts(corners.mean(axis=0)[None])[0]
    return float(np.sqrt(np.trace(own[:3, :3]))), float(np.sqrt(np.trace(J @ own @ J.T)))
