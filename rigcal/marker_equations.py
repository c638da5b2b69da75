"""What the corners of a solved rig know about its poses, as equations that further knowledge can join.

Owns      the joint adjustment's normal equations at its optimum, with what edges that may be shifted leave open; the
          same of halves of the markers.
Leaves    the sums to rigcal.solve, what joins them to aruco.depth_fusion.

Targets of frames that nothing else measures are eliminated; they follow the cameras. Shifts of edges (see
solve.edge_shift) are unknowns of their own that are eliminated too, so that the covariance of all cameras is that
which the adjustment told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aruco.depth_fusion import MarkerEquations, inverse_over
from aruco.depth_trial import HeldOutMarkers, MarkerHalf
from aruco.pose_math import Array, Pose, exp_se3, invert_transform, log_se3
from rigcal.solve.adjust import KAPPA, Adjustment, Gauge, adjust, blocks, by_frame, inverse_targets
from rigcal.solve.edge_shift import COMMON_PX, SPREAD_PX, find_shift, outwards
from rigcal.solve.problem import DirectionSums, Poses, Sightings, ViewSums, direction_sums, residuals, view_sums
from rigcal.validation_case import Case

# A half that knows a pose by less than this share of what all corners know does not carry a test.
MIN_SHARE = 0.001


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Markers:
    """The equations of all corners or some, and how the targets that were eliminated follow the cameras."""

    equations: MarkerEquations
    poses: Poses  # about which they hold
    kept: NDArray[np.int64]  # (k,) frames whose targets are unknowns
    seen: NDArray[np.bool_]  # (f,) frames with a corner, and the one that carries the world
    followers: Array  # (f, 6, 6 c) -H_target^-1 E^T
    settled: Array  # (f, 6) -H_target^-1 g_target

    def targets(self, T_world_cam: Pose, T_world_target: Pose) -> Pose:
        """All targets (f, 4, 4) for poses of the cameras (c, 4, 4) and of the targets that are unknowns (k, 4, 4)."""
        moves = [log_se3(new @ invert_transform(old)) for new, old in zip(T_world_cam, self.poses.T_world_cam)]
        steps = self.settled + self.followers @ np.concatenate(moves)
        T = np.array([exp_se3(xi) @ T if xi.any() else T for xi, T in zip(steps, self.poses.T_world_target)])
        T[self.kept] = T_world_target
        return T


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Scaled:
    """What the adjustment of all corners says about their errors."""

    gauge: Gauge
    kappa: float
    variance: float
    missed_px: Array  # (c,) shifts of edges that were seen, but not taken out


def marker_equations(
    case: Case, kept: Sequence[int], world: int | None, inflate: Array | None = None
) -> tuple[Markers, list[MarkerHalf]]:
    """The equations of all corners, and of two halves of them.

    Args:
        case: The solved rig with its corners.
        kept: Indices of frames whose targets stay unknowns.
        world: Index of the frame whose target carries the world; None: cameras that were kept do.
        inflate: (6 c, 6 c) covariance that the adjustment has found beyond that of corners and edges.
    """
    n_cam, n_frame = len(case.cameras), len(case.sightings.frames)
    held = np.array([camera.name in case.joint.fixed for camera in case.cameras], dtype=bool)
    gauge = Gauge(held, np.arange(n_frame) == (-1 if world is None else world))
    found = adjust(case.sightings, case.poses, gauge)
    scaled = _Scaled(
        gauge=gauge,
        kappa=KAPPA * found.scale,
        variance=found.variance,
        missed_px=_missed_px(case, found, gauge),
    )
    numbers = np.array(kept, dtype=np.int64)
    whole = _equations(case, case.sightings, numbers, scaled)
    if inflate is not None:
        whole = replace(whole, equations=_inflated(whole.equations, inflate, n_cam))
    return whole, [_half(case, whole, found, half, scaled) for half in _halves(case.sightings)]


def _missed_px(case: Case, found: Adjustment, gauge: Gauge) -> Array:
    """Shifts (c,) of edges that corners show, where the adjustment did not believe them."""
    if case.joint.corners.shift_px or not outwards(case.sightings).any():
        return np.zeros(len(case.cameras))
    return find_shift(case.sightings, found, gauge).shift_px


def camera_covariance(equations: MarkerEquations) -> Array:
    """(6 c, 6 c) covariance of all cameras as the adjustment tells it; zero for those that may not move."""
    n = 6 * len(equations.cameras)
    P = inverse_over(equations.H, np.repeat(equations.free, 6))[:n, :n]
    return P if equations.doubt is None else P + equations.doubt[:n] @ equations.doubt[:n].T


def _equations(case: Case, sightings: Sightings, kept: NDArray[np.int64], scaled: _Scaled) -> Markers:
    poses, gauge = case.poses, scaled.gauge
    # As in rigcal.solve.adjust: squared weights for what is known, plain ones for the gradient and the shifts.
    curved, plain = (view_sums(sightings, poses, scaled.kappa, power=k) for k in (2, 1))
    extra = direction_sums(sightings, poses, scaled.kappa, outwards(sightings))
    A, right, seen = _assembled(sightings, plain, extra, kept, gauge)
    H = _assembled(sightings, curved, extra, kept, gauge)[0]
    free = np.concatenate([~gauge.fixed_cameras, (seen & ~gauge.fixed_frames)[kept]])
    mask, m = np.repeat(free, 6), 6 * len(free)
    doubt = _of_shifts(A / scaled.variance, mask, scaled.missed_px)
    _, _, H_target, g_target, E = blocks(sightings, plain)
    inverse = inverse_targets(H_target, gauge)
    return Markers(
        equations=MarkerEquations(
            cameras=tuple(camera.name for camera in case.cameras),
            targets=tuple(sightings.frames[f] for f in kept),
            T_world_cam=poses.T_world_cam,
            T_world_target=poses.T_world_target[kept],
            free=free,
            H=np.where(np.outer(mask, mask), H[:m, :m] / scaled.variance, 0.0),
            g=right[:m] / scaled.variance,
            doubt=doubt,
        ),
        poses=poses,
        kept=kept,
        seen=seen | gauge.fixed_frames,
        followers=-np.einsum("fij,fkj->fik", inverse, E),
        settled=-np.einsum("fij,fj->fi", inverse, g_target),
    )


def _assembled(
    sightings: Sightings, sums: ViewSums, extra: DirectionSums, kept: NDArray[np.int64], gauge: Gauge
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Equations of cameras, kept targets and every camera's shift, other targets eliminated; the frames seen (f,)."""
    H_cam, g_cam, H_target, g_target, E = blocks(sightings, sums)
    h, n_cam = by_frame(sightings, extra.h), len(H_cam)  # (f, c, 6)
    n, m = 6 * n_cam, 6 * n_cam + 6 * len(kept)
    A, right = np.zeros((m + n_cam, m + n_cam)), np.zeros(m + n_cam)
    for k, block in enumerate(H_cam):
        A[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = block
        A[6 * k : 6 * k + 6, m + k] = -h[:, k].sum(axis=0)
    for k, f in enumerate(kept):
        mine = slice(n + 6 * k, n + 6 * k + 6)
        A[mine, mine], A[:n, mine], A[mine, m:], right[mine] = H_target[f], E[f], h[f].T, g_target[f]
    A[np.arange(m, m + n_cam), np.arange(m, m + n_cam)] = np.bincount(sightings.view_camera, extra.q, minlength=n_cam)
    A = np.triu(A) + np.triu(A, 1).T
    right[:n] = g_cam.ravel()
    gone = np.ones(len(sightings.frames), dtype=bool)
    gone[kept] = False
    # Of every target that is eliminated: what couples it with cameras and shifts.
    coupling, inverse = np.concatenate([E[gone], h[gone]], axis=1), inverse_targets(H_target, gauge)[gone]
    others = np.concatenate([np.arange(n), np.arange(m, m + n_cam)])
    gain = coupling @ inverse
    A[np.ix_(others, others)] -= np.tensordot(gain, coupling, axes=([0, 2], [0, 2]))
    right[others] -= np.tensordot(gain, g_target[gone], axes=([0, 2], [0, 1]))
    return A, right, np.einsum("fii->f", H_target) > 0


def _of_shifts(A: Array, free: NDArray[np.bool_], missed_px: Array) -> Array:
    """How far edges move the poses (m, c + 1): by shifts that are not known, and by those seen but not taken out."""
    m, n = len(free), len(missed_px)
    C = A[:m, m:]
    response = -inverse_over(A[:m, :m], free) @ C
    prior = np.linalg.inv(SPREAD_PX**2 * np.eye(n) + COMMON_PX**2)
    left = np.linalg.inv(A[m:, m:] + C.T @ response + prior)
    return response @ np.column_stack([np.linalg.cholesky((left + left.T) / 2), missed_px])


def _inflated(equations: MarkerEquations, beyond: Array, n_cam: int) -> MarkerEquations:
    free = np.repeat(equations.free, 6)
    P = inverse_over(equations.H, free)
    values, vectors = np.linalg.eigh((beyond + beyond.T) / 2)
    P[: 6 * n_cam, : 6 * n_cam] += (vectors * np.maximum(values, 0.0)) @ vectors.T
    return replace(equations, H=inverse_over(P, free))


# --- halves ---------------------------------------------------------------------------------------------------------


def _halves(sightings: Sightings) -> list[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Corners (n,) to solve and corners to test, twice: every second marker of a view, in turns by frame.

    The only marker that a camera sees is solved both times and never tested.
    """
    group = _groups(sightings)
    first = np.flatnonzero(np.diff(np.append(-1, group)))
    view = sightings.corner_view[first]
    rank = np.arange(len(first)) - np.searchsorted(view, view)
    odd = (rank + sightings.view_frame[view]) % 2
    camera = sightings.view_camera[view]
    in_half = np.array([np.bincount(camera[odd == k], minlength=len(sightings.cameras)) for k in (0, 1)])
    alone = (in_half == 0).any(axis=0)[camera]
    return [(((odd == k) | alone)[group], ((odd != k) & ~alone)[group]) for k in (0, 1)]


def _groups(sightings: Sightings) -> NDArray[np.int64]:
    """The number (n,) of every corner's marker in its view; they stand together."""
    new = np.ones(len(sightings.marker), dtype=bool)
    view = sightings.corner_view
    new[1:] = (sightings.marker[1:] != sightings.marker[:-1]) | (view[1:] != view[:-1])
    return np.cumsum(new) - 1


def _half(
    case: Case,
    whole: Markers,
    found: Adjustment,
    half: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    scaled: _Scaled,
) -> MarkerHalf:
    train, test = (only_corners(case.sightings, corners) for corners in half)
    markers = _equations(case, train, whole.kept, scaled)
    if not _carries(markers, whole):
        train, test = case.sightings, only_corners(case.sightings, np.zeros(len(case.sightings.points), dtype=bool))
        markers = _equations(case, train, whole.kept, scaled)
    test = test.only_views(markers.seen[test.view_frame])
    camera, marker = test.view_camera[test.corner_view], _groups(test)

    def held_out(T_world_cam: Pose, T_world_target: Pose) -> HeldOutMarkers:
        poses = Poses(T_world_cam, markers.targets(T_world_cam, T_world_target))
        off = np.nan_to_num(residuals(test, poses), nan=1e6)
        return HeldOutMarkers(
            camera=camera, marker=marker, off=off / math.sqrt(scaled.variance), off_px=off * test.sigma_px[:, None]
        )

    return MarkerHalf(train=markers.equations, trained=markers.seen[markers.kept], held_out=held_out)


def _carries(half: Markers, whole: Markers) -> bool:
    """Whether a half knows every camera not much worse than all corners do."""
    P_half, P_whole = (camera_covariance(k.equations) for k in (half, whole))
    free = np.diag(P_whole) > 0
    known = np.diag(P_half)[free]
    return bool((known > 0).all() and (MIN_SHARE * known < np.diag(P_whole)[free]).all())


def only_corners(sightings: Sightings, keep: NDArray[np.bool_]) -> Sightings:
    """The corners where a mask (n,) is true; views without one are left out."""
    count = np.bincount(sightings.corner_view[keep], minlength=sightings.n_views)
    views = count > 0
    return replace(
        sightings,
        view_camera=sightings.view_camera[views],
        view_frame=sightings.view_frame[views],
        start=np.concatenate([[0], np.cumsum(count[views])]).astype(np.int64),
        points=sightings.points[keep],
        pixels=sightings.pixels[keep],
        sigma_px=sightings.sigma_px[keep],
        marker=sightings.marker[keep],
    )
