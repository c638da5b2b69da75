"""From samples that meet to rows of equations.

Owns      the state of a registration, averaging of gaps over cells, their derivatives and noise, robust weights.
Leaves    which samples meet to icp_match, summing and solving to icp_normal.

A sample p of camera a meets q of camera b; n is the surface's normal. The gap n . (p - q) follows a left twist (w, v)
of a by ``w . (p x n) + v . n``, one of b by the opposite (its twist turns the normal along), and a depth error of a by
n . ray times the slope of its depth. Both directions of matching see the same two errors of depth: their gaps are
averaged with one another, over all samples that two cells of two images share, and count once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aruco.floor_plane import FloorPlane, Mask, plane_axes
from aruco.icp_cloud import Cloud
from aruco.icp_match import Matches
from aruco.icp_rows import FLOOR, PER_CAMERA, Index, Layout, Rows
from aruco.icp_smooth import slopes_at
from aruco.pose_math import Array, Pose, exp_se3, invert_transform, make_pose, transform_points

# Real surfaces are no planes over a cell, and samples do not lie where their neighbours' samples do.
SURFACE_M = 0.0015
# Floors bend: one sigma of a cell's height against the common plane.
FLATNESS_M = 0.002
# Within a cell errors are alike, but not the same: share of the variance that differs between parts of a cell. Small
# parts share it with the next cell's, so it averages out over samples rather than over parts: it is that of a quarter
# of a cell and more.
UNSHARED = 0.6
PART = 0.25
# Gaps beyond this many sigma lose weight with their square: as deaf to strangers as Cauchy's, blind to none within.
KAPPA = 2.5
# Gaps are smaller than promised where promises hold for poses, because cells share errors with their neighbours and
# those of a plane are smoothed: about this part of it. Less than that is depth better than the noise model, as of
# another kind of sensor. No further than to the last: errors that are smooth over patches go into poses and depth
# errors, and gaps do not tell them.
USUAL_RATIO = 0.5
LEAST_SCALE = 0.5
MEDIAN_SIGMA = (
    1.17  # relative standard deviation of a median of absolute normal numbers, times the root of their number
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class State:
    """Where the estimate stands, in the equations' world."""

    T_world_cam: dict[str, Pose]
    bias: dict[str, Array]  # (4,)
    floor: Array  # (3,) slopes along plane_axes(up), height at the origin [m]
    up: Array  # (3,)

    def moved(self, x: Array, layout: Layout) -> State:
        """After a change of all unknowns."""
        return replace(
            self,
            T_world_cam={name: _tidy(exp_se3(x[layout.pose(name)]) @ T) for name, T in self.T_world_cam.items()},
            bias={name: b + x[layout.bias(name)] for name, b in self.bias.items()},
            floor=self.floor + x[layout.floor],
        )

    @property
    def plane(self) -> FloorPlane:
        """The common floor."""
        normal = self.up - self.floor[:2] @ plane_axes(self.up)
        length = float(np.linalg.norm(normal))
        return FloorPlane(normal / length, -float(self.floor[2]) / length)


def floor_parameters(plane: FloorPlane, up: Array) -> Array:
    """(3,) of State.floor of a plane."""
    upward = float(plane.normal @ up)
    return np.append(-plane_axes(up) @ plane.normal, -plane.d) / upward


def _tidy(T: Pose) -> Pose:
    """A product of many rotations, made one again."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return make_pose(U @ Vt, T[:3, 3])


def pair_rows(
    state: State,
    clouds: Mapping[str, Cloud],
    surfaces: Mapping[str, Array],
    layout: Layout,
    there: Matches,
    back: Matches,
    *,
    both_normals: bool,
) -> Rows:
    """Rows of two cameras a (source of ``there``) and b (source of ``back``).

    Args:
        state: Where they stand.
        clouds: Of all cameras, the state's depth errors taken out.
        surfaces: Camera -> depth (n,) of the surface at each sample, where levers are taken.
        layout: Of the unknowns.
        there: Samples of a that meet b.
        back: Samples of b that meet a.
        both_normals: Gaps along the mean of both surfaces' normals, rather than along the target's.
    """
    a, b = clouds[there.source], clouds[there.target]
    T_a, T_b = state.T_world_cam[a.camera], state.T_world_cam[b.camera]
    i, j = np.concatenate([there.i, back.j]), np.concatenate([there.j, back.i])
    p, q = transform_points(T_a, a.points[i]), transform_points(T_b, b.points[j])
    n_a, n_b = a.normals[i] @ T_a[:3, :3].T, b.normals[j] @ T_b[:3, :3].T
    first = np.arange(len(i)) < len(there.i)
    normal = np.where(first[:, None], n_b, n_a)
    doubt = np.where(first, b.normal_sigma[j], a.normal_sigma[i])
    if both_normals:
        normal = n_a + n_b
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        doubt = np.hypot(a.normal_sigma[i], b.normal_sigma[j]) / 2 + np.linalg.norm(n_a - n_b, axis=1) / 2
    off = p - q
    gap = (off * normal).sum(axis=1)
    beside = np.linalg.norm(off - gap[:, None] * normal, axis=1)
    places = layout.cameras.index(a.camera), layout.cameras.index(b.camera)
    # A twist turns the normal of its own camera's surface along: what it then acts on is the other one's sample.
    there_p = transform_points(T_a, a.rays[i] * surfaces[a.camera][i, None])
    there_q = transform_points(T_b, b.rays[j] * surfaces[b.camera][j, None])
    # Their mean turns half as far with each, about the middle of both.
    lever = (there_p + there_q) / 2 if both_normals else np.where(first[:, None], there_p, there_q)
    arm = np.hstack([np.cross(lever, normal), normal])
    # At the same place too, not where the sample lies that was met: moving a plane by a depth error and back by a turn
    # must leave nothing. A centimetre would seem to tell depth errors by a bare floor.
    error_a = _by_error(a, surfaces[a.camera], i, T_a, lever, normal)
    error_b = _by_error(b, surfaces[b.camera], j, T_b, lever, normal)
    tilt_a, tilt_b = _along(a, i, T_a, normal), _along(b, j, T_b, normal)
    values = np.column_stack([
        gap,
        arm,
        error_a,
        np.abs(tilt_a) * a.sigma_m[i],
        -error_b,
        np.abs(tilt_b) * b.sigma_m[j],
        (doubt * beside) ** 2 + SURFACE_M**2,
    ])  # fmt: skip
    key = _key(a.cell[i], b.cell[j], normal, a.is_floor[i] | b.is_floor[j])
    mean, count, sample = _averaged(values, key)
    arm, shared_a, shared_b = mean[:, 1:7], mean[:, 11], mean[:, 16]
    cell_a, cell_b = a.cell[i[sample]], b.cell[j[sample]]
    own = _unshared(shared_a, cell_a, count) + _unshared(shared_b, cell_b, count) + mean[:, 17]
    n = len(mean)
    return Rows(
        a=np.full(n, places[0]),
        b=np.full(n, places[1]),
        gap_m=mean[:, 0],
        by_a=np.hstack([arm, mean[:, 7:11]]),
        by_b=np.hstack([-arm, mean[:, 12:16]]),
        cell_a=cell_a,
        cell_b=cell_b,
        shared_a=shared_a,
        shared_b=shared_b,
        own=own,
        weight=np.ones(n),
        n_points=count,
    )


def floor_rows(
    state: State,
    clouds: Mapping[str, Cloud],
    surfaces: Mapping[str, Array],
    layout: Layout,
    camera: str,
    *,
    every: int = 1,
) -> Rows:
    """Rows of one camera's floor against the common one, from one of so many samples."""
    cloud, T = clouds[camera], state.T_world_cam[camera]
    i = np.flatnonzero(cloud.is_floor)[::every]
    plane = state.plane
    gap = plane.distances(transform_points(T, cloud.points[i]))
    p = transform_points(T, cloud.rays[i] * surfaces[camera][i, None])
    normal = np.broadcast_to(plane.normal, p.shape)
    tilt = _along(cloud, i, T, normal)
    upward = float(plane.normal @ state.up)
    values = np.column_stack([
        gap,
        np.cross(p, normal),
        normal,
        tilt[:, None] * cloud.slopes.T[i],
        np.abs(tilt) * cloud.sigma_m[i],
        -upward * (p @ plane_axes(state.up).T),
        np.full(len(i), -upward),
    ])  # fmt: skip
    mean, count, sample = _averaged(values, cloud.cell[i])
    n = len(mean)
    return Rows(
        a=np.full(n, layout.cameras.index(camera)),
        b=np.full(n, -1),
        gap_m=mean[:, 0],
        by_a=mean[:, 1:11],
        by_b=np.hstack([mean[:, 12:15], np.zeros((n, PER_CAMERA - FLOOR))]),
        cell_a=cloud.cell[i[sample]],
        cell_b=np.full(n, -1),
        shared_a=mean[:, 11],
        shared_b=np.zeros(n),
        own=UNSHARED * mean[:, 11] ** 2 + FLATNESS_M**2,
        weight=np.ones(n),
        n_points=count,
    )


def joined(rows: Sequence[Rows], clouds: Mapping[str, Cloud], layout: Layout) -> tuple[Rows, int]:
    """All rows, cells numbered over all cameras; and the number of cells."""
    cells = np.array([_count(clouds[name].cell) for name in layout.cameras])
    first = np.cumsum(cells) - cells
    parts = [
        replace(
            r,
            cell_a=r.cell_a + first[r.a],
            cell_b=np.where(r.b < 0, -1, r.cell_b + first[r.b]),
        )
        for r in rows
    ]
    return Rows.stacked(parts), int(cells.sum())


def weighted(rows: Rows, gap_m: Array, scale: float) -> Rows:
    """The rows with robust weights for gaps (m,), where noise is ``scale`` times what is promised."""
    u = np.abs(gap_m) / np.sqrt(rows.variance) / scale
    return replace(rows, weight=np.minimum(1.0, (KAPPA / np.maximum(u, 1e-9)) ** 2))


def residual_scale(rows: Rows, gap_m: Array) -> float:
    """How many times the promised noise there is: by the median of gaps (m,), which strangers do not lift.

    Below one only where gaps are clearly smaller than those of depth that is as noisy as promised.
    """
    if not len(gap_m):
        return 1.0
    ratio = float(np.median(np.abs(gap_m) / np.sqrt(rows.variance))) / 0.6745
    if ratio >= 1.0:
        return ratio
    at_most = ratio * (1.0 + 2.0 * MEDIAN_SIGMA / len(gap_m) ** 0.5) / USUAL_RATIO
    return min(1.0, max(LEAST_SCALE, at_most))


def _unshared(shared_m: Array, cell: Index, count: Index) -> Array:
    """(g,) variance of what is not the same all over cells (g,), for parts of them of so many samples [m^2]."""
    whole = np.bincount(cell, count)[cell]
    return UNSHARED * shared_m**2 * np.maximum(1.0, PART * whole / count)


def _by_error(cloud: Cloud, surface: Array, index: Index, T_world_cam: Pose, points: Array, normal: Array) -> Array:
    """(k, 4) how far a camera's depth error takes its surface along the normal at points of the world."""
    here = transform_points(invert_transform(T_world_cam), points)
    along = ((points - T_world_cam[:3, 3]) * normal).sum(axis=1) / here[:, 2]
    return along[:, None] * slopes_at(cloud, surface, index, here)


def _along(cloud: Cloud, i: Index, T_world_cam: Pose, normal: Array) -> Array:
    """(k,) how far a metre of depth takes a sample along the normal."""
    return np.asarray((cloud.rays[i] @ T_world_cam[:3, :3].T * normal).sum(axis=1))


def _key(cell_a: Index, cell_b: Index, normal: Array, is_floor: Mask) -> Index:
    """(k,) one number for samples of the same two cells on surfaces that face the same way."""
    axis = np.argmax(np.abs(normal), axis=1)
    facing = 2 * axis + (normal[np.arange(len(axis)), axis] > 0)
    side = np.where(is_floor, 6, facing)
    return (cell_a.astype(np.int64) * (int(cell_b.max(initial=0)) + 1) + cell_b) * 7 + side


def _averaged(values: Array, key: Index) -> tuple[Array, Index, Index]:
    """Means (g, c) of values (k, c) with the same key, how many these are (g,), and one of them (g,)."""
    _, sample, group, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(group, column, len(count)) for column in values.T], axis=1)
    return sums / np.maximum(count, 1)[:, None], count, sample


def _count(number: Index) -> int:
    return int(number.max()) + 1 if len(number) else 0
