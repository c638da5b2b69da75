"""Edges that look shifted: by tone curves, sharpening, glare. One unknown a camera, estimated with all poses.

Owns      the shift, its prior, and what not knowing it exactly costs the poses.
Leaves    the poses under a given shift to adjust.

Cameras do not record light but a bent curve of it, and sharpen. A blurred edge then lies some tenths of a pixel towards
its dark side, all markers of a camera look smaller by one rim, and a marker that looks smaller looks farther away.
With two markers in view their distance tells size from shift. So each camera has a shift d of its edges, outwards in
pixels, that moves a corner by ``d s`` with ``n1 . s = n2 . s = 1`` for the outward normals of its two edges.

It enters the residuals linearly. At the optimum of the poses for given shifts, one Gauss-Newton step of all unknowns
gives the change of the shifts by the Schur complement of cameras and targets, and the poses follow; a few rounds
converge. Shifts of one rig resemble each other: they have a common mean of COMMON_PX, and SPREAD_PX about it.

Where lens and map are wrong by more than the shift, it may be an image of their errors: then it is not applied, and
the covariance contains what it would do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from aruco.pose_math import Array
from rigcal.solve.adjust import KAPPA, Adjustment, Gauge, adjust, blocks, by_frame, inverse_targets, schur
from rigcal.solve.problem import Sightings, direction_sums, view_sums

# The sRGB curve alone shifts an edge blurred by half a pixel by 0.4 px; sharpening and exposure take or add as much.
COMMON_PX = 0.4
# Lenses of one rig differ in sharpness, and cameras in exposure.
SPREAD_PX = 0.1
MAX_ROUNDS = 8
SETTLED_PX = 1e-3
# A shift below this many standard deviations is none.
SIGNIFICANT = 5.0
# More than any curve and lens do to an edge that can be fitted: the markers are of another size.
MAX_PX = 0.8
# It is found from so many views as well as from all.
MAX_VIEWS = 2000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeShift:
    """The shifts of all cameras, as far as views tell."""

    shift_px: Array  # (c,) outwards: markers look larger
    covariance_px2: Array  # (c, c)

    @property
    def is_significant(self) -> bool:
        """Whether there is a shift at all."""
        d = self.shift_px
        return bool(d @ np.linalg.solve(self.covariance_px2, d) > len(d) * SIGNIFICANT**2)

    @property
    def is_plausible(self) -> bool:
        """Whether edges can be shifted by so much."""
        return bool(np.abs(self.shift_px).max() < MAX_PX)

    @property
    def size_px(self) -> float:
        """Root mean square of the shifts."""
        return float(np.sqrt(np.mean(self.shift_px**2)))


def outwards(sightings: Sightings) -> Array:
    """How far each corner (n, 2) moves when the edges of its marker move outwards by a pixel; zero for single points.

    Corners of one marker stand together, in their order around it.
    """
    direction = np.zeros_like(sightings.pixels)
    corners = _first_of_four(sightings)[:, None] + np.arange(4)
    direction[corners] = outward_moves(sightings.pixels[corners])
    return direction


def outward_moves(quads: Array) -> Array:
    """How far corners of quadrilaterals (n, 4, 2), in order around them, move when all edges do by one, outwards."""
    along = np.roll(quads, -1, axis=1) - quads  # edge k: from corner k to k + 1
    turn = np.sign(_cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]))
    length = np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-9)
    normal = turn[:, None, None] * np.stack([along[..., 1], -along[..., 0]], axis=2) / length
    # n1 . s = n2 . s = 1 lies on the bisector; the angle of a printed corner is never so sharp that this grows large.
    both = normal + np.roll(normal, 1, axis=1)
    return 2.0 * both / np.maximum((both**2).sum(axis=2, keepdims=True), 0.1)


def _first_of_four(sightings: Sightings) -> np.ndarray:
    """The index of the first corner of every marker with four corners."""
    marker, view = sightings.marker, sightings.corner_view
    new = np.ones(len(marker), dtype=bool)
    new[1:] = (marker[1:] != marker[:-1]) | (view[1:] != view[:-1])
    first = np.flatnonzero(new)
    return first[np.diff(np.append(first, len(marker))) == 4]


def _cross(a: Array, b: Array) -> Array:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def shifted(sightings: Sightings, shift_px: Array, direction: Array) -> Sightings:
    """The corners where they would be seen without the shifts (c,)."""
    camera = sightings.view_camera[sightings.corner_view]
    return replace(sightings, pixels=sightings.pixels - shift_px[camera, None] * direction)


def find_shift(sightings: Sightings, adjustment: Adjustment, gauge: Gauge) -> EdgeShift:
    """The shifts of all cameras.

    Args:
        sightings: Corners that belong.
        adjustment: Their optimum without shifts.
        gauge: What carried the world.
    """
    some, gauge = _fewer(sightings, gauge)
    direction = outwards(some)
    shift, found = np.zeros(len(some.cameras)), adjustment
    system = _reduced(some, found, gauge, direction, shift)
    for _ in range(MAX_ROUNDS):
        step = -np.linalg.solve(system.information, system.gradient)
        shift = shift + step
        corrected = shifted(some, shift, direction)
        found = adjust(corrected, found.poses, gauge)
        system = _reduced(corrected, found, gauge, direction, shift)
        if np.abs(step).max() < SETTLED_PX:
            break
    return EdgeShift(shift_px=shift, covariance_px2=np.linalg.inv(system.information))


def cost_of_not_knowing(sightings: Sightings, adjustment: Adjustment, gauge: Gauge, missed_px: Array) -> Array:
    """What shifts that are not known exactly add to the covariance of all cameras, (6 c, 6 c).

    Args:
        sightings: Corners that belong, shifts taken out where they are believed.
        adjustment: Their optimum.
        gauge: What carried the world.
        missed_px: (c,) shifts that were seen but not taken out.
    """
    system = _reduced(sightings, adjustment, gauge, outwards(sightings), np.zeros(len(sightings.cameras)))
    left = np.linalg.inv(system.information) + np.outer(missed_px, missed_px)
    return system.response @ left @ system.response.T


def _fewer(sightings: Sightings, gauge: Gauge) -> tuple[Sightings, Gauge]:
    """Evenly spread frames of a long recording; the gauge is then a camera, whose frame is as good as any."""
    step = -(-sightings.n_views // MAX_VIEWS)
    if step == 1:
        return sightings, gauge
    some = sightings.only_views(sightings.view_frame % step == 0)
    seen = np.bincount(some.view_camera, minlength=len(some.cameras)) > 0
    fixed = gauge.fixed_cameras | ~seen
    if (fixed == ~seen).all():
        fixed = fixed | (np.arange(len(seen)) == np.argmax(seen))
    return some, Gauge(fixed, np.zeros(len(some.frames), dtype=bool))


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    """The shifts' own system, poses eliminated."""

    information: Array  # (c, c) of data and prior
    gradient: Array  # (c,)
    response: Array  # (6 c, c) how cameras follow the shifts


def _reduced(sightings: Sightings, at: Adjustment, gauge: Gauge, direction: Array, shift: Array) -> _Reduced:
    kappa = KAPPA * at.scale
    sums, extra = view_sums(sightings, at.poses, kappa), direction_sums(sightings, at.poses, kappa, direction)
    H_cam, _, H_target, _, E = blocks(sightings, sums)
    inverse = inverse_targets(H_target, gauge)
    S, Y = schur(H_cam, inverse, E)
    h, n_cam = by_frame(sightings, extra.h), len(sightings.cameras)
    # The shift moves what is seen, r = predicted - seen + d s: coupled to targets by h, to cameras by -h.
    G_target = h.transpose(0, 2, 1)  # (f, 6, c)
    G_cam = np.zeros((n_cam, 6, n_cam))
    G_cam[np.arange(n_cam), :, np.arange(n_cam)] = -h.sum(axis=0)
    G_cam = G_cam.reshape(6 * n_cam, n_cam)
    free = np.repeat(~gauge.fixed_cameras, 6)
    X = np.zeros_like(G_cam)
    right = G_cam - np.einsum("fij,fjk->ik", Y, G_target)
    if free.any():
        X[free] = np.linalg.solve(S[np.ix_(free, free)], right[free])
    V = inverse @ (G_target - E.transpose(0, 2, 1) @ X)
    q = np.bincount(sightings.view_camera, extra.q, minlength=n_cam)
    t = np.bincount(sightings.view_camera, extra.t, minlength=n_cam)
    data = np.diag(q) - G_cam.T @ X - np.einsum("fjk,fjl->kl", G_target, V)
    prior = np.linalg.inv(SPREAD_PX**2 * np.eye(n_cam) + COMMON_PX**2)
    return _Reduced(
        information=(data + data.T) / (2 * at.variance) + prior,
        gradient=t / at.variance + prior @ shift,
        response=-X,
    )
