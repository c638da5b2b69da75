"""Planes in one camera's depth: the floor it sees, and whatever else is flat and wide.

Owns      which samples lie on one plane, how well its normal is known.
Leaves    level planes and fits to floor_view, surfaces of small and curved things to icp_surface.

Samples of a plane share its normal. Normals of their own would differ by noise, and clouds that slide along a floor
would seem to be held by it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aruco.depth_noise import CORRELATION_PX
from aruco.floor_consensus import AGREE_DEG, AGREE_M, offset_of
from aruco.floor_plane import FloorPlane, Mask
from aruco.floor_view import (
    BAND_SIGMAS,
    MIN_INLIERS,
    FloorSamples,
    SeenPlane,
    fitted_plane,
    level_planes,
    plane_bands,
    plane_distances,
)
from aruco.icp_surface import Squares, Surfaces
from aruco.pose_math import Array, Pose

# Correlation cells that a large plane fills at least: its normal is then known several times as well as a window's. In
# a small image a share of it serves.
_LEAST_CELLS = 12
_LEAST_SHARE = 0.05
_MOST_PLANES = 24
# A sample's own normal is allowed this much and twice its noise, but no more than the second, which a right angle and
# most edges of things are far from.
_ALIKE_DEG = 12.0
_MOST_ALIKE_DEG = 30.0
# Samples whose surfaces are tried as planes, and samples that vote. A plane of 2 % is missed by all in 0.98^150 = 5 %.
_TRIED = 150
_VOTERS = 2000
# Of a surface known over a window only, at the votes: its slope runs away beyond that.
_LOOSE_M = 0.04
# A plane is fitted to what lies on it so often.
_ROUNDS = 3
# Directions of windows on a plane differ from its own by hardly more than their sigmas, on what bends by more. Walls
# may bend, and errors of depth may reach farther than a window: where they are small, noise is no measure.
_FLAT = 1.25
_FLAT_LARGE = 2.0
_HARDLY_RAD = math.radians(1.0)
# Half a window of the smallest size: so far from a plane's samples windows may have failed.
_BESIDE_PX = 16
# Noise has tails, beyond the band in which samples belong to a plane.
_STRAY = 2.0
# What stands on a small plane may be bent by as much as the window's fit does not notice.
_SMALL_SIGMA_RAD = math.radians(0.5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Planes:
    """The planes that a camera sees."""

    label: NDArray[np.intp]  # (n,) plane of each sample, or -1
    seen: tuple[SeenPlane, ...]  # their inliers do not index the samples
    normal_sigma: Array  # (k,) of their normals [rad]; 0 of large ones
    has_floor: bool  # the first plane is the floor
    stray: Mask  # (n,) samples that noise has put off a large plane: not on it, and no other surface

    @property
    def floor(self) -> SeenPlane | None:
        """The floor as the camera itself sees it, where it sees it."""
        return self.seen[0] if self.has_floor else None


def find_planes(
    samples: FloorSamples,
    squares: Squares,
    surfaces: Surfaces,
    *,
    T_world_cam: Pose,
    floor: FloorPlane | None,
    up: Array,
    rng: np.random.Generator,
) -> Planes:
    """The floor as the camera itself sees it, and whatever else is flat.

    Args:
        samples: All samples.
        squares: The same, as squares of the image.
        surfaces: Theirs.
        T_world_cam: Pose of the camera.
        floor: The rig's floor, world; None: no plane is the floor.
        up: (3,) unit, world.
        rng: Chance.
    """
    label = np.full(len(samples.inverse), -1, dtype=np.intp)
    least = _least(samples)
    level = level_planes(_only(samples, surfaces.sound), T_world_cam[:3, :3].T @ up, threshold_m=None, rng=rng)
    own = None if floor is None else _own_floor(level, floor, T_world_cam)
    if own is not None:
        label[_members(samples, surfaces, own)] = 0
    found = [] if own is None else [own]
    found += _other_planes(samples, squares, surfaces, label, rng, first=len(found))
    large = np.bincount(label[label >= 0], minlength=len(found)) >= least
    if own is not None:
        large[0] = True
    small = [math.hypot(_SMALL_SIGMA_RAD, normal_sigma(plane)) for plane in found]
    if found:
        _claim(samples, squares, found, label, surfaces.noise_scale)
    stray = np.zeros(len(label), dtype=bool)
    rest = np.flatnonzero((label < 0) & surfaces.sound)
    for plane in (plane for plane, is_large in zip(found, large) if is_large):
        stray[rest] |= _members(_only(samples, rest), surfaces.only(rest), plane, widen=_STRAY)
    return Planes(
        label=label,
        seen=tuple(found),
        normal_sigma=np.where(large, 0.0, small),
        has_floor=own is not None,
        stray=stray,
    )


def _claim(
    samples: FloorSamples,
    squares: Squares,
    found: Sequence[SeenPlane],
    label: NDArray[np.intp],
    noise_scale: float,
) -> None:
    """Give samples beside a plane's own that lie on it, and on no other, to it: windows fail at creases and edges."""
    rest = np.flatnonzero(label < 0)
    some = _only(samples, rest)
    claims = np.zeros((len(found), len(rest)), dtype=bool)
    for k, plane in enumerate(found):
        band = BAND_SIGMAS * noise_scale * some.sigma / some.inverse * plane.distance_m
        claims[k] = np.abs(plane_distances(some, plane.a)) <= band
        claims[k] &= squares.beside(label == k, _BESIDE_PX)[rest]
    alone = claims.sum(axis=0) == 1
    label[rest[alone]] = np.argmax(claims[:, alone], axis=0)


def normal_sigma(plane: SeenPlane) -> float:
    """Standard deviation [rad] of a plane's normal from noise, root mean square over the directions it may turn to."""
    across = np.eye(3) - np.outer(plane.normal, plane.normal)
    return plane.distance_m * math.sqrt(float(np.trace(across @ plane.noise @ across)) / 2.0)


def _only(samples: FloorSamples, keep: Mask | NDArray[np.intp]) -> FloorSamples:
    return replace(
        samples,
        pixels=samples.pixels[keep],
        rays=samples.rays[keep],
        inverse=samples.inverse[keep],
        sigma=samples.sigma[keep],
        bias_slope=samples.bias_slope[:, keep],
    )


def _least(samples: FloorSamples) -> float:
    """Samples that make a plane a large one."""
    cells = _LEAST_CELLS * (CORRELATION_PX / samples.stride) ** 2
    return max(float(MIN_INLIERS), min(cells, _LEAST_SHARE * len(samples.inverse)))


def _own_floor(level: Sequence[SeenPlane], floor: FloorPlane, T_world_cam: Pose) -> SeenPlane | None:
    """Of the level planes the one nearest to the floor, if it is near."""
    offsets = [offset_of(floor, plane, T_world_cam) for plane in level]
    misfits = [max(math.degrees(tilt) / AGREE_DEG, abs(rise) / AGREE_M) for tilt, rise in offsets]
    return level[int(np.argmin(misfits))] if misfits and min(misfits) <= 1.0 else None


def _members(samples: FloorSamples, surfaces: Surfaces, plane: SeenPlane, *, widen: float = 1.0) -> Mask:
    """Sound samples (n,) within noise of a plane that face as it does."""
    band = widen * plane_bands(samples, np.full(len(samples.inverse), plane.distance_m), None)
    near = surfaces.sound & (np.abs(plane_distances(samples, plane.a)) <= band)
    return near & _face_alike(surfaces, plane.normal)


def _face_alike(surfaces: Surfaces, normal: Array) -> Mask:
    allowed = np.minimum(math.radians(_ALIKE_DEG) + 2 * surfaces.normal_sigma, math.radians(_MOST_ALIKE_DEG))
    with np.errstate(invalid="ignore"):
        return surfaces.normals @ normal >= np.cos(allowed)


def _other_planes(
    samples: FloorSamples,
    squares: Squares,
    surfaces: Surfaces,
    label: NDArray[np.intp],
    rng: np.random.Generator,
    *,
    first: int,
) -> list[SeenPlane]:
    """Further planes, roughly the largest first; ``label`` is filled in.

    Large planes may lie in several parts of the image, as a wall behind furniture. A small one is one patch: what else
    happens to lie on its continuation is not part of it.
    """
    found: list[SeenPlane] = []
    least = _least(samples)
    index = np.flatnonzero((label < 0) & surfaces.sound)
    for _ in range(_MOST_PLANES):
        if len(index) < MIN_INLIERS:
            break
        rest, around = _only(samples, index), surfaces.only(index)
        start = _most_supported(rest, around, rng)
        votes = _near(rest, around, start[None])[:, 0]
        if int(votes.sum()) < MIN_INLIERS:
            break
        plane, members = _grown(rest, squares.only(index), around, votes, start, least)
        if plane is not None and int(members.sum()) >= MIN_INLIERS and _is_flat(around, plane, members, least):
            label[index[members]] = first + len(found)
            found.append(plane)
        index = index[~members]
    return found


def _most_supported(samples: FloorSamples, surfaces: Surfaces, rng: np.random.Generator) -> Array:
    """The surface ``a`` (3,) of the sample, of some that are tried, that most others lie on."""
    n = len(samples.inverse)
    tried, voters = rng.permutation(n)[:_TRIED], rng.permutation(n)[:_VOTERS]
    votes = _near(_only(samples, voters), surfaces.only(voters), surfaces.a[tried]).sum(axis=0)
    return surfaces.a[tried[int(np.argmax(votes))]]


def _near(samples: FloorSamples, surfaces: Surfaces, a: Array) -> Mask:
    """Which samples lie near planes a (k, 3) and face as they do, (n, k)."""
    length = np.linalg.norm(a, axis=1)
    off = np.abs(samples.inverse[:, None] - samples.rays @ a.T) / (samples.inverse[:, None] * length)
    return (off <= _LOOSE_M) & (surfaces.normals @ (-a / length[:, None]).T >= math.cos(math.radians(_ALIKE_DEG)))


def _grown(
    samples: FloorSamples, squares: Squares, surfaces: Surfaces, near: Mask, a: Array, least: float
) -> tuple[SeenPlane | None, Mask]:
    """The plane that a rough one becomes when it is fitted to what lies on it, and what does; or None and ``near``."""
    members, plane = near, None
    for _ in range(_ROUNDS):
        if int(members.sum()) < least:
            members = squares.largest_patch(members)
        fitted = _fitted(_only(samples, members), a)
        if fitted is None:
            return None, near
        plane, a = fitted, fitted.a
        members = _members(samples, surfaces, plane)
    if int(members.sum()) < least:
        members = squares.largest_patch(members)
    return plane, members


def _is_flat(surfaces: Surfaces, plane: SeenPlane, members: Mask, least: float) -> bool:
    """Whether noise explains how the members' own normals turn away from the plane's, or they hardly do."""
    cosine = np.clip(surfaces.normals[members] @ plane.normal, -1.0, 1.0)
    turn = np.arccos(cosine)
    limit = _FLAT_LARGE if int(members.sum()) >= least else _FLAT
    in_sigmas = math.sqrt(float(np.mean((turn / surfaces.normal_sigma[members]) ** 2)))
    return in_sigmas <= limit or float(np.median(turn)) <= _HARDLY_RAD


def _fitted(samples: FloorSamples, a: Array) -> SeenPlane | None:
    """The plane through most of these samples, of which ``a`` is a rough idea."""
    n = len(samples.inverse)
    band = plane_bands(samples, np.full(n, 1.0 / float(np.linalg.norm(a))), None)
    every = np.ones(n, dtype=bool)
    return fitted_plane(samples, band, every, every)
