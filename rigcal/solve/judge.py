"""Whole views on trial: adjust, look at every view under the result, leave out those that do not belong, repeat.

Owns      which views take part, and what carries the world when those that did no longer do.
Leaves    the adjustment itself to adjust.

A robust loss on single corners is not enough: when two frames of one camera are exchanged, or a target moves while a
frame is taken, all corners of the view are wrong together and agree with each other. So each view is judged by its
median corner, in units of the scale that the data themselves show.

The accused are heard first: when at least half of a frame's views do not fit, the target's pose is tried without each
camera in turn, and stays where most views fit it. So one camera's flipped solution at the start, or one wrong view,
does not cost the others theirs. A camera's pose can always be made to fit one view, so a camera of which few views
agree with others is left out, as is what no view ties to the gauge any longer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aruco.errors import CalibrationError
from aruco.merged_detection import RAYLEIGH_MEDIAN
from aruco.pose_math import Array
from rigcal.solve.adjust import Adjustment, Gauge, adjust
from rigcal.solve.problem import Poses, Sightings, residuals

# The median of a view's corners, in robust standard deviations of all corners. One for ordinary views; small or
# oblique markers and imperfect intrinsics reach three or four. A wrong view is tens or hundreds off.
MAX_VIEW_MEDIAN = 6.0
# A lens or a clock may make all views of one camera wrong by so much: a reason to trust them less, not to lose it.
HARMLESS_PX = 0.5
# The start is an average of single views: it is allowed more.
MAX_START_MEDIAN = 20.0
MAX_ROUNDS = 5
# Of a camera's views that others share a frame with, this share has to agree with them, and two at least.
MIN_SHARE = 0.25


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judged:
    """An adjustment over the views that belong; meaningless when none does."""

    adjustment: Adjustment
    gauge: Gauge  # what did not move; cameras without a kept view among it
    kept: NDArray[np.bool_]  # (v,)
    fits: NDArray[np.bool_]  # (v,) also those of cameras that others do not confirm, or that are tied to nothing
    view_median: Array  # (v,) of every view, kept or not, in robust standard deviations


def adjust_judging(sightings: Sightings, start: Poses, gauge: Gauge) -> Judged:
    """Adjust over all views that agree; views may come back when the poses get better.

    Raises:
        CalibrationError: Not one view has all its corners in front of its camera under the start.
    """
    median = view_medians(sightings, start)
    usual = median[np.isfinite(median)]
    if not len(usual):
        raise CalibrationError("No view fits the cameras' first poses: check the marker map and the intrinsics.")
    limit = MAX_START_MEDIAN * max(1.0, float(np.median(usual)))
    poses = heard(sightings, start, limit)
    kept, held = tied(sightings, fitting(sightings, poses, limit), gauge)
    adjustment, fits = adjust(sightings.only_views(kept), poses, held), kept
    for _ in range(MAX_ROUNDS):
        limit = MAX_VIEW_MEDIAN * adjustment.scale
        poses = heard(sightings, adjustment.poses, limit)
        fits = fitting(sightings, poses, limit)
        now, now_held = tied(sightings, confirmed(sightings, fits, gauge), gauge)
        settled = bool((now == kept).all())
        kept, held = now, now_held
        if settled or not kept.any():
            break
        adjustment = adjust(sightings.only_views(kept), poses, held)
    median = view_medians(sightings, poses) / adjustment.scale
    return Judged(adjustment=adjustment, gauge=held, kept=kept, fits=fits, view_median=median)


def heard(sightings: Sightings, poses: Poses, limit: float) -> Poses:
    """The poses after every frame in which at least half of the views are accused was tried again.

    Args:
        sightings: Corners.
        poses: Where cameras, which stay, and targets are thought to be.
        limit: Views with a larger median are accused.

    Returns:
        The same with the target's pose replaced in the frames in which, without one of the cameras, it comes to lie
        where more views fit.
    """
    fits = fitting(sightings, poses, limit)
    accused = _count(sightings, ~fits)
    contested = (accused > 0) & (accused >= _count(sightings, fits))
    numbers = np.flatnonzero(contested)
    if not len(numbers):
        return poses
    theirs = sightings.only_views(contested[sightings.view_frame])
    labels = tuple(sightings.frames[f] for f in numbers)
    theirs = replace(theirs, frames=labels, view_frame=np.searchsorted(numbers, theirs.view_frame))
    tried = Poses(poses.T_world_cam, poses.T_world_target[numbers])
    for camera in (-1, *range(len(sightings.cameras))):
        tried = _without(camera, theirs, tried, limit)
    T_world_target = poses.T_world_target.copy()
    T_world_target[numbers] = tried.T_world_target
    return Poses(poses.T_world_cam, T_world_target)


def _without(camera: int, sightings: Sightings, poses: Poses, limit: float) -> Poses:
    """Targets adjusted to all views but one camera's, where that makes more views fit."""
    used = np.isfinite(view_medians(sightings, poses)) & (sightings.view_camera != camera)
    if not used.any():
        return poses
    held = Gauge(np.ones(len(sightings.cameras), dtype=bool), np.zeros(len(sightings.frames), dtype=bool))
    said = adjust(sightings.only_views(used), poses, held).poses
    after, before = (_count(sightings, fitting(sightings, p, limit)) for p in (said, poses))
    more = after > before
    return Poses(poses.T_world_cam, np.where(more[:, None, None], said.T_world_target, poses.T_world_target))


def _count(sightings: Sightings, views: NDArray[np.bool_]) -> NDArray[np.int64]:
    """How many of some views every frame has, (f,)."""
    return np.bincount(sightings.view_frame[views], minlength=len(sightings.frames))


def confirmed(sightings: Sightings, fits: NDArray[np.bool_], gauge: Gauge) -> NDArray[np.bool_]:
    """Of the views (v,) that fit, those of cameras that are fixed or agree with others often enough."""
    if len(sightings.frames) == 1:  # the target rests: every camera has one view, which stands for itself
        return fits
    c, f = sightings.view_camera, sightings.view_frame
    everything = np.ones(len(c), dtype=bool)
    shared, agreeing = ((views & (_count(sightings, views) > 1)[f]) for views in (everything, fits))
    asked, agree = (np.bincount(c[views], minlength=len(sightings.cameras)) for views in (shared, agreeing))
    enough = agree >= np.minimum(asked, np.maximum(2, MIN_SHARE * asked))
    return fits & (enough | gauge.fixed_cameras)[c]


def tied(sightings: Sightings, fits: NDArray[np.bool_], gauge: Gauge) -> tuple[NDArray[np.bool_], Gauge]:
    """Of the views that fit, those that hang together with what carries the world.

    Args:
        sightings: Corners.
        fits: (v,) views that may take part.
        gauge: What carries the world. Fixed cameras do so wherever they are; when there are none, and the largest
            connected part of the rig lacks the fixed frame, the best seen frame of that part takes over.

    Returns:
        The views (v,), and the gauge, which also holds the cameras that no view is left of.
    """
    n_cam, n_frame = len(sightings.cameras), len(sightings.frames)
    part = _parts(sightings, fits)
    of_view = part[sightings.view_camera]
    fixed_frames = gauge.fixed_frames
    if not gauge.fixed_cameras.any():
        size = _sizes(sightings, fits, part)
        if size[part[n_cam:][fixed_frames]].max(initial=0.0) < size.max():
            seen = np.bincount(sightings.view_frame[fits & (of_view == np.argmax(size))], minlength=n_frame)
            fixed_frames = np.arange(n_frame) == np.argmax(seen)
    kept = fits & np.isin(of_view, part[np.concatenate([gauge.fixed_cameras, fixed_frames])])
    unseen = np.bincount(sightings.view_camera[kept], minlength=n_cam) == 0
    return kept, Gauge(gauge.fixed_cameras | unseen, fixed_frames)


def _parts(sightings: Sightings, fits: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Which connected part of the rig every camera, then every frame belongs to, (c + f,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(sightings.cameras) + len(sightings.frames)
    ends = (sightings.view_camera[fits], len(sightings.cameras) + sightings.view_frame[fits])
    return connected_components(coo_array((np.ones(len(ends[0])), ends), shape=(n, n)), directed=False)[1]


def _sizes(sightings: Sightings, fits: NDArray[np.bool_], part: NDArray[np.int32]) -> Array:
    """How large every part is: first by its cameras, then by its views."""
    c = sightings.view_camera[fits]
    cameras, views = (np.bincount(part[k], minlength=len(part)) for k in (np.unique(c), c))
    return cameras + views / (len(c) + 1)


def view_medians(sightings: Sightings, poses: Poses) -> Array:
    """The median distance (v,) of every view's corners, one for a view as good as its sigmas promise.

    Infinite with a corner behind the camera.
    """
    return _medians(sightings, _distances(sightings, poses))


def view_medians_px(sightings: Sightings, poses: Poses) -> Array:
    """The same in pixels: the standard deviation of a coordinate of which each median speaks (v,)."""
    return _medians(sightings, _distances(sightings, poses) * sightings.sigma_px)


def fitting(sightings: Sightings, poses: Poses, limit: float) -> NDArray[np.bool_]:
    """The views (v,) whose median distance is within a limit, or harmless."""
    distance = _distances(sightings, poses)
    median, median_px = _medians(sightings, distance), _medians(sightings, distance * sightings.sigma_px)
    return (median <= limit) | (median_px <= HARMLESS_PX)


def _distances(sightings: Sightings, poses: Poses) -> Array:
    """How far off each corner is (n,), one for one as good as its sigma promises; infinite behind the camera."""
    distance = np.linalg.norm(residuals(sightings, poses), axis=1) / RAYLEIGH_MEDIAN
    return np.nan_to_num(distance, nan=np.inf)


def _medians(sightings: Sightings, distance: Array) -> Array:
    """The median (v,) of every view's corners (n,); infinite with an infinite one."""
    sizes = sightings.corners_per_view
    median = np.empty(sightings.n_views)
    for size in np.unique(sizes):  # views of one size at once
        same = sizes == size
        ordered = np.sort(distance[sightings.start[:-1][same, None] + np.arange(size)], axis=1)
        median[same] = np.where(np.isinf(ordered[:, -1]), np.inf, ordered[:, size // 2])
    return median
