"""The way to a registration: what takes part in it, and one linear estimate after another.

Owns      Setup, Fit, matching and solving anew about each result until it stays.
Leaves    rows to icp_equations, their sum to icp_normal, what the end of the way means to icp_solve.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aruco.floor_plane import FloorPlane, Mask
from aruco.icp_cloud import Cloud
from aruco.icp_equations import State, floor_parameters, floor_rows, joined, pair_rows, residual_scale, weighted
from aruco.icp_evidence import told_scales
from aruco.icp_match import Matches, match
from aruco.icp_normal import Normal, scaled_inverse, solved, summed
from aruco.icp_prior import Known, Prior, Scales
from aruco.icp_rows import BIAS, Layout, Rows
from aruco.icp_smooth import corrected, smoothed
from aruco.icp_starts import contradiction, other_starts
from aruco.icp_types import VOXELS, ICPConfig, Pair
from aruco.pose_math import Array, Pose, invert_transform, make_pose

# At each of the scales VOXELS, of how many samples one is looked up: neighbours share their errors anyway.
_EVERY = (4, 4, 2)
# Steps below this share of a standard deviation are none.
_SETTLED = 0.1
# Matches that change to and fro with the state move it for ever. After so many steps since the smallest that is what
# happens; up to half a standard deviation the place among them does not matter.
_STALE = 3
_TO_AND_FRO = 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Setup:
    """What does not change on the way. Its world has its origin amid the cameras: elsewhere small turns shift far."""

    layout: Layout
    reference: str
    unlinked: tuple[str, ...]  # cameras that no pairs link with the reference
    config: ICPConfig
    clouds: dict[str, Cloud]  # taken about their surfaces
    surfaces: dict[str, Array]  # camera -> (n,) depth of these
    pairs: tuple[Pair, ...]
    floors: tuple[str, ...]  # cameras that see the common floor
    known: Known
    start: State
    begin: State  # where the way begins: at the start, but for cameras that are thought to stand elsewhere
    T_own_world: Pose
    frozen: Mask  # (size,) unknowns that are not estimated


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """Where the way has led to."""

    state: State
    scales: Scales
    rows: Rows  # about the state, weighted
    n_cells: int
    noise: float  # factor on what is promised
    clouds: Normal  # sum of the rows
    matches: dict[Pair, Matches]
    rounds: int = 0
    settled: bool = False


def set_up(
    clouds: Mapping[str, Cloud],
    start: Mapping[str, Pose],
    priors: Mapping[str, Prior],
    pairs: Iterable[Pair],
    config: ICPConfig,
    *,
    floor: FloorPlane | None,
    reference: str,
    begin: Mapping[str, Pose] | None = None,
) -> Setup:
    """See icp_solve.register."""
    layout, pairs = Layout(tuple(sorted(clouds))), tuple(sorted(pairs))
    names = layout.cameras
    T_own_world = make_pose(np.eye(3), -np.mean([start[name][:3, 3] for name in names], axis=0))
    plane, up = None if floor is None else floor.moved(T_own_world), np.asarray(config.up, dtype=np.float64)
    floors = () if plane is None else tuple(name for name in names if clouds[name].is_floor.any())
    frozen = np.zeros(layout.size, dtype=bool)
    frozen[layout.floor] = not floors
    about = {name: smoothed(clouds[name]) for name in names}
    at_start = State(
        T_world_cam={name: T_own_world @ start[name] for name in names},
        bias={name: np.zeros(BIAS) for name in names},
        floor=np.zeros(3) if plane is None else floor_parameters(plane, up),
        up=up,
    )
    elsewhere = {name: T_own_world @ T for name, T in (begin or {}).items() if name in {*names} - {reference}}
    return Setup(
        layout=layout,
        reference=reference,
        unlinked=tuple(sorted({*names} - _reachable(reference, pairs))),
        config=config,
        clouds={name: cloud for name, (cloud, _) in about.items()},
        surfaces={name: depth for name, (_, depth) in about.items()},
        pairs=pairs,
        floors=floors,
        known=Known(
            layout=layout,
            poses={name: priors[name].moved(T_own_world) for name in names},
            clouds=clouds,
        ),
        start=at_start,
        begin=replace(at_start, T_world_cam={**at_start.T_world_cam, **elsewhere}),
        T_own_world=T_own_world,
        frozen=frozen,
    )


def fitted(setup: Setup) -> Fit:
    """The most probable state: a coarse way from each start, and on from the best of their ends to the finest scale."""
    ways = [_gone(setup, _met(setup, start, Scales(), scale=0), 0) for start in _starts(setup)]
    fit = min(ways, key=lambda way: contradiction(way.rows, way.matches))
    for scale in range(1, len(VOXELS)):
        fit = _gone(setup, fit, scale)
    return fit


def _starts(setup: Setup) -> Iterator[State]:
    begin = setup.begin
    yield begin
    free = tuple(name for name in setup.layout.cameras if name not in (setup.reference, *setup.unlinked))
    finest = _reach(setup.config, len(VOXELS) - 1)
    for T_world_cam in other_starts(setup.known, begin.T_world_cam, free, finest, seed=setup.config.seed):
        yield replace(begin, T_world_cam=T_world_cam)


def _gone(setup: Setup, fit: Fit, scale: int) -> Fit:
    """One estimate after another on one scale, until it stays; met at the end as on the next one."""
    steps: list[float] = []
    rounds, over = fit.rounds, False
    while not over:
        state, scales, step = _stepped(setup, fit)
        steps.append(step)
        over = _is_over(steps, setup.config.max_iterations[scale])
        fit = _met(setup, state, scales, scale=min(scale + 1, len(VOXELS) - 1) if over else scale)
    return replace(fit, rounds=rounds + len(steps), settled=steps[-1] < _TO_AND_FRO)


def _reach(config: ICPConfig, scale: int) -> float:
    """How far apart on a scale what meets may be [m]."""
    return VOXELS[scale] * config.voxel_size * config.max_correspondence_distance_factor


def _is_over(steps: Sequence[float], most: int) -> bool:
    """Whether a scale is done with after steps of these sizes in standard deviations."""
    stale = len(steps) - 1 - int(np.argmin(steps)) >= _STALE
    return steps[-1] < _SETTLED or stale or len(steps) >= most


def _met(setup: Setup, state: State, scales: Scales, *, scale: int) -> Fit:
    """What meets at a state, and the equations about it."""
    every = _EVERY[scale]
    reach = _reach(setup.config, scale)
    about = {name: corrected(setup.clouds[name], setup.surfaces[name], b) for name, b in state.bias.items()}
    seen, surfaces = {name: cloud for name, (cloud, _) in about.items()}, {n: depth for n, (_, depth) in about.items()}
    some = {name: _every(cloud, every) for name, cloud in seen.items()}
    matches: dict[Pair, Matches] = {}
    parts: list[Rows] = []
    for a, b in setup.pairs:
        T_b_a = invert_transform(state.T_world_cam[b]) @ state.T_world_cam[a]
        for source, target, T in ((a, b, T_b_a), (b, a, invert_transform(T_b_a))):
            found = match(some[source], seen[target], T, reach)
            matches[source, target] = replace(found, i=every * found.i)
        both = setup.config.method == "gicp"
        parts.append(pair_rows(state, seen, surfaces, setup.layout, matches[a, b], matches[b, a], both_normals=both))
    parts += [floor_rows(state, seen, surfaces, setup.layout, name, every=every) for name in setup.floors]
    rows, n_cells = joined(parts, setup.clouds, setup.layout)
    noise = residual_scale(rows, rows.gap_m)
    rows = weighted(rows, rows.gap_m, noise)
    clouds = summed(rows, setup.layout, n_cells, scale=noise)
    return Fit(state=state, scales=scales, rows=rows, n_cells=n_cells, noise=noise, clouds=clouds, matches=matches)


def _stepped(setup: Setup, fit: Fit) -> tuple[State, Scales, float]:
    """The best state of the linear equations, by what scales, and how far it is in standard deviations."""
    M = np.eye(setup.layout.size)[:, ~setup.frozen]  # all unknowns by the free ones
    scales = told_scales(setup.known, fit.state, fit.clouds, M, fit.scales)
    total = fit.clouds + setup.known.normal(fit.state, scales)
    x = solved(total, M)
    sigma = np.sqrt(np.diag(scaled_inverse(M.T @ total.H @ M)))
    step = float(np.max(np.abs(M.T @ x) / np.maximum(sigma, 1e-12), initial=0.0))
    return fit.state.moved(x, setup.layout), scales, step


def _every(cloud: Cloud, step: int) -> Cloud:
    """One of so many samples, to be looked up; not to be looked up in."""
    return replace(
        cloud,
        pixels=cloud.pixels[::step],
        rays=cloud.rays[::step],
        depth_m=cloud.depth_m[::step],
        sigma_m=cloud.sigma_m[::step],
        slopes=cloud.slopes[:, ::step],
        normals=cloud.normals[::step],
        normal_sigma=cloud.normal_sigma[::step],
        cell=cloud.cell[::step],
        is_floor=cloud.is_floor[::step],
    )


def _reachable(first: str, pairs: Iterable[Pair]) -> set[str]:
    """Cameras linked to one by pairs, itself among them."""
    pairs, found = list(pairs), {first}
    while new := {name for pair in pairs if found & {*pair} for name in pair} - found:
        found |= new
    return found
