"""Validation on what was not used: frames held out of the solve, known lengths, and halves solved apart.

Owns      which solves and measurements validate a calibration, and their numbers.
Leaves    solving parts to validation_case, the choice of frames, lengths, patterns and limits to rigcal.quality, the
          sentences to rigcal.verdict.

A moved target couples all cameras, so a frame held out is predicted into each camera from the corners of the others
alone. A target that rests is the world: every camera stands on its own corners, held-out frames repeat the same
errors, and what is independent is only where cameras meet in a corner that both see. Its halves show repeatability.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from loguru import logger

from aruco.model import Camera, Detection
from aruco.pose_math import Array, adjoint, invert_transform, log_se3, pose_distance
from aruco.rig_estimate import RigEstimate
from rigcal.quality import holdout
from rigcal.quality.lengths import Lengths, measure_lengths
from rigcal.quality.patterns import Corners, Tested, search_patterns
from rigcal.quality.timing import Timing
from rigcal.solve.adjust import Adjustment, adjust
from rigcal.solve.joint import Detections, JointRig
from rigcal.solve.problem import Poses, Sightings, gather, residuals, view_sums
from rigcal.validation_case import Case, Frames, case_of, merged_views, solve_part, view_mask
from rigcal.validation_timing import timing_of

# Predicting from all other cameras costs a small solve a camera: as many frames as a median needs.
MAX_PREDICTED_VIEWS = 100
# Where the other cameras know the target's pose no better than this, a prediction tests their view, not the rig.
MAX_PREDICTION_SIGMA_PX = 0.5
# Halves and patterns of a long recording: so many views know a rig far better than any limit asks.
MAX_SPLIT_VIEWS = 3000
MAX_PATTERN_VIEWS = 1500


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldOut:
    """Corners of frames that were not solved, where the rig puts them and where they were seen."""

    frames: tuple[int, ...]
    median_px: Mapping[str, float]  # camera -> distance
    rms_px: Mapping[str, float]
    n_views: Mapping[str, int]
    all_median_px: float
    all_rms_px: float
    from_others: bool  # predicted from the other cameras' corners alone


@dataclass(frozen=True, slots=True, kw_only=True)
class Split:
    """Two parts of the recording solved apart: the difference of one pair's relative pose."""

    i: str
    j: str
    turn_rad: float
    shift_m: float
    normalised: float  # squared, over what both covariances promise, over 6: one on average


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Validation:
    """What a calibration says about what it has not used."""

    moving: bool
    rig: RigEstimate
    adjusted: JointRig
    held_out: HeldOut | None
    lengths: Lengths | None
    lengths_held_out: bool  # whether cameras were solved without the corners of these lengths, or each on its own
    odd_even: tuple[Split, ...]  # empty where a half cannot be solved
    early_late: tuple[Split, ...]
    patterns: Tested
    weakest: holdout.Link | None  # of a moved target
    reprojection_px: Mapping[str, float]  # RMS of the solved corners
    left_out: Mapping[str, tuple[int, ...]]  # camera -> frames whose markers took no part
    timing: Timing | None = None  # of a moved target, where its motion tells


def validate(
    rig_average: RigEstimate,
    adjusted: JointRig,
    cameras: Sequence[Camera],
    detections: Detections,
    geometry: Mapping[int, Array],
    *,
    moving: bool,
    share: float = 0.2,
    times_s: Mapping[int, float] | None = None,
) -> Validation:
    """Measure a calibration on what it has not used.

    The solves start from the adjusted poses: a start gives away which of several optima is meant, not where it lies.

    Args:
        rig_average: From which the adjustment started.
        adjusted: The calibration, in the same world.
        cameras: All cameras of the recording.
        detections: What they saw.
        geometry: Marker id -> (k, 3) points [m], target frame.
        moving: Whether the target has a pose of its own in every frame.
        share: Of the frames, to be held out; fewer where a camera or a link would not be left enough.
        times_s: When each frame was taken; without it, frames are thought to follow each other evenly.
    """
    detections = adjusted.corners.taken_out_of(detections)
    case = case_of(rig_average, adjusted, cameras, detections, geometry, moving)
    held = _held_frames(case, share)
    rest = {name: tuple(f for f in frames if f not in set(held[name])) for name, frames in case.used.items()}
    some = any(held.values())
    solved = solve_part(case, rest) if some else None
    if moving and len(case.cameras) == 1:
        held_out = _within_camera(case)
    else:
        held_out = None if solved is None else _predicted(case, solved.poses, held)
    names = [camera.name for camera in case.cameras]
    T_world_cam = dict(zip(names, (case.poses if solved is None or not moving else solved.poses).T_world_cam))
    return Validation(
        moving=moving,
        rig=rig_average,
        adjusted=adjusted,
        held_out=held_out,
        lengths=measure_lengths(case.cameras, T_world_cam, _to_measure(case, held if some else case.used), geometry),
        lengths_held_out=not moving or solved is not None,
        odd_even=_split(case, [slice(0, None, 2), slice(1, None, 2)]),
        early_late=_split(case, None),
        patterns=_patterns(case),
        weakest=holdout.weakest_link(case.used, adjusted.fixed) if moving else None,
        reprojection_px=_reprojection(case),
        left_out={name: _left_out(detections[name], frames, geometry) for name, frames in case.used.items()},
        timing=timing_of(case, cameras, times_s),
    )


def _held_frames(case: Case, share: float) -> dict[str, tuple[int, ...]]:
    if not case.moving:
        return {name: holdout.every_nth(frames, share) for name, frames in case.used.items()}
    held = set(holdout.frames_to_hold_out(case.used, share, tied=case.joint.fixed))
    if not held:
        logger.debug("no frame of the moved target can be spared: nothing is held out")
    return {name: tuple(f for f in frames if f in held) for name, frames in case.used.items()}


# --- held-out frames ------------------------------------------------------------------------------------------------


def _predicted(case: Case, poses: Poses, held: Frames) -> HeldOut | None:
    """Held-out corners predicted from the other cameras, or from the world of a target that rests."""
    measure = _from_others if case.moving else _from_the_world
    distances = measure(case, poses, held)
    frames = tuple(sorted({f for frames in held.values() for f in frames}))
    return _summed(distances, frames, from_others=case.moving)


def _summed(distances: Mapping[str, list[Array]], frames: tuple[int, ...], *, from_others: bool) -> HeldOut | None:
    found = {name: d for name, d in distances.items() if len(d)}
    if not found:
        return None
    together = np.concatenate([np.concatenate(d) for d in found.values()])
    return HeldOut(
        frames=frames,
        median_px={name: float(np.median(np.concatenate(d))) for name, d in found.items()},
        rms_px={name: _rms(np.concatenate(d)) for name, d in found.items()},
        n_views={name: len(d) for name, d in found.items()},
        all_median_px=float(np.median(together)),
        all_rms_px=_rms(together),
        from_others=from_others,
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _distances_px(sightings: Sightings, poses: Poses) -> list[Array]:
    """How far off each corner is [px], view by view."""
    distance = np.linalg.norm(residuals(sightings, poses), axis=1) * sightings.sigma_px
    return [distance[a:b] for a, b in zip(sightings.start[:-1], sightings.start[1:])]


def _from_the_world(case: Case, poses: Poses, held: Frames) -> dict[str, list[Array]]:
    target = np.broadcast_to(poses.T_world_target[:1], (1, 4, 4))
    found: dict[str, list[Array]] = {}
    for c, camera in enumerate(case.cameras):
        by_frame = {camera.name: {f: case.detections[camera.name][f] for f in held[camera.name]}}
        sightings = gather([camera], by_frame, case.geometry, case.noise_px)
        targets = np.repeat(target, len(sightings.frames), axis=0)
        found[camera.name] = _distances_px(sightings, Poses(poses.T_world_cam[c : c + 1], targets))
    return found


def _from_others(case: Case, poses: Poses, held: Frames) -> dict[str, list[Array]]:
    """Each camera's held-out views, the target placed by all other cameras."""
    frames = sorted({f for mine in held.values() for f in mine})
    step = max(1, len(frames) * len(case.cameras) // MAX_PREDICTED_VIEWS)
    some = {name: [f for f in mine if f in set(frames[::step])] for name, mine in held.items()}
    sightings = case.sightings.only_views(view_mask(case, some))
    found: dict[str, list[Array]] = {}
    for c, camera in enumerate(case.cameras):
        others = sightings.only_views(sightings.view_camera != c)
        found[camera.name] = _carried_over(case, poses, others, sightings.only_views(sightings.view_camera == c))
    return found


def _carried_over(case: Case, poses: Poses, others: Sightings, mine: Sightings) -> list[Array]:
    """Distances [px] of views from where the target is when it is placed by other views of the same frames."""
    mine = mine.only_views(np.isin(mine.view_frame, others.view_frame))
    if not mine.n_views:
        return []
    placed = adjust(others, Poses(poses.T_world_cam, case.poses.T_world_target), case.gauge(cameras=True))
    sure = _prediction_sigma_px(mine, others, placed) <= MAX_PREDICTION_SIGMA_PX
    return _distances_px(mine.only_views(sure), placed.poses)


def _within_camera(case: Case) -> HeldOut | None:
    """Of a single camera every second marker, the target placed by the markers between."""
    (camera,) = case.cameras
    several = {f: d for f in case.used[camera.name] if len(d := case.detections[camera.name][f]) > 1}
    turns = {f: np.arange(len(d)) % 2 == 1 for f, d in several.items()}
    mine, others = (
        gather([camera], {camera.name: {f: d.only(half[f]) for f, d in several.items()}}, case.geometry, case.noise_px)
        for half in (turns, {f: ~mask for f, mask in turns.items()})
    )
    if not several or mine.frames != others.frames or not mine.n_views:
        return None
    number = {f: k for k, f in enumerate(case.sightings.frames)}
    targets = case.poses.T_world_target[[number[f] for f in mine.frames]]
    part = replace(case, sightings=others, poses=Poses(case.poses.T_world_cam, targets))
    return _summed({camera.name: _carried_over(part, part.poses, others, mine)}, mine.frames, from_others=False)


def _prediction_sigma_px(mine: Sightings, others: Sightings, placed: Adjustment) -> Array:
    """How well the other cameras know where a view's corners are: root mean square sigma of a coordinate, (v,)."""
    H = np.zeros((len(mine.frames), 6, 6))
    np.add.at(H, others.view_frame, view_sums(others, placed.poses, np.inf).W)
    inverse = np.linalg.pinv(H[mine.view_frame], rcond=1e-12, hermitian=True)
    W = view_sums(mine, placed.poses, np.inf).W
    variance = np.einsum("vij,vji->v", W, inverse) / (2 * mine.corners_per_view)
    sigma_px = np.array([_rms(mine.sigma_px[a:b]) for a, b in zip(mine.start[:-1], mine.start[1:])])
    return placed.scale * np.sqrt(variance) * sigma_px


def _to_measure(case: Case, held: Frames) -> dict[str, dict[int, Detection]]:
    if not case.moving:
        return merged_views(case.detections, case.used)
    return {name: {f: case.detections[name][f] for f in frames} for name, frames in held.items()}


# --- halves ---------------------------------------------------------------------------------------------------------


def _split(case: Case, parts: Sequence[slice] | None) -> tuple[Split, ...]:
    """Two parts of the frames solved apart: given as slices, or None for the first half and the second."""
    if case.moving:
        frames = holdout.shared_frames(case.used)
        frames = frames[:: max(1, case.sightings.n_views // MAX_SPLIT_VIEWS)]
        slices = parts or [slice(0, len(frames) // 2), slice(len(frames) // 2, None)]
        sets = [set(frames[s]) for s in slices]
        if len(case.cameras) < 2 or not holdout.halves_hang_together(case.used, sets, case.joint.fixed):
            return ()
        halves = [{name: tuple(f for f in mine if f in s) for name, mine in case.used.items()} for s in sets]
    else:
        halves = [
            {
                name: mine[(parts or [slice(0, len(mine) // 2), slice(len(mine) // 2, None)])[k]]
                for name, mine in case.used.items()
            }
            for k in (0, 1)
        ]
    solved = [solve_part(case, half) for half in halves]
    if solved[0] is None or solved[1] is None:
        return ()
    a, b = solved[0], solved[1]
    return tuple(_difference(case, a, b, i, j) for i, j in combinations(range(len(case.cameras)), 2))


def _difference(case: Case, a: Adjustment, b: Adjustment, i: int, j: int) -> Split:
    T_a, T_b = (invert_transform(k.poses.T_world_cam[i]) @ k.poses.T_world_cam[j] for k in (a, b))
    d = log_se3(T_a @ invert_transform(T_b))
    covariance = _of_pair(a, i, j) + _of_pair(b, i, j)
    turn, shift = pose_distance(T_a, T_b)
    return Split(
        i=case.cameras[i].name,
        j=case.cameras[j].name,
        turn_rad=turn,
        shift_m=shift,
        normalised=float(d @ np.linalg.pinv(covariance, rcond=1e-14, hermitian=True) @ d) / 6,
    )


def _of_pair(a: Adjustment, i: int, j: int) -> Array:
    """(6, 6) covariance of T_i_j, left: ``Exp(-x_i)`` and ``Exp(x_j)`` meet in world axes between the two poses."""
    blocks = a.covariance.reshape(len(a.poses.T_world_cam), 6, -1, 6)
    C = blocks[i, :, i] + blocks[j, :, j] - blocks[i, :, j] - blocks[j, :, i]
    A = adjoint(invert_transform(a.poses.T_world_cam[i]))
    return A @ C @ A.T


# --- residuals of what was solved -----------------------------------------------------------------------------------


def _patterns(case: Case) -> Tested:
    s = case.sightings
    step = max(1, s.n_views // MAX_PATTERN_VIEWS)
    s = s.only_views(s.view_frame % step == 0)
    return search_patterns(
        Corners(
            cameras=case.cameras,
            T_world_cam=case.poses.T_world_cam,
            T_world_target=case.poses.T_world_target,
            moving=case.moving,
            camera=s.view_camera[s.corner_view],
            frame=s.view_frame[s.corner_view],
            marker=s.marker,
            points=s.points,
            pixels=s.pixels,
            sigma_px=s.sigma_px,
            scale=case.joint.scale,
        )
    )


def _reprojection(case: Case) -> dict[str, float]:
    distances = _distances_px(case.sightings, case.poses)
    return {
        camera.name: _rms(np.concatenate([np.empty(0), *(distances[v] for v in views)]))
        for c, camera in enumerate(case.cameras)
        if len(views := np.flatnonzero(case.sightings.view_camera == c))
    }


def _left_out(
    detections: Mapping[int, Detection], used: Sequence[int], geometry: Mapping[int, Array]
) -> tuple[int, ...]:
    known = (f for f, d in sorted(detections.items()) if any(int(i) in geometry for i in d.ids))
    return tuple(f for f in known if f not in set(used))
