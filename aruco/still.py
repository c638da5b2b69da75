"""Cameras that are not synchronised: the stretches of time in which the target rests, seen in the detections.

Owns      when anything moved, the stretches between, one merged detection a camera and stretch.
Leaves    the merging of corners to merged_detection.

While a target rests it does not matter when exactly each camera looked. A camera sees motion between two of its frames
when the markers of both have moved; the target rests in the times in which no camera sees motion.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aruco.merged_detection import merge_detections
from aruco.model import Detection

# Corners of a resting marker move by less between frames; a hand that lets go moves it by more.
MOTION_PX = 0.5
# Frames need not be on one clock to better than this.
CLOCK_SLACK_NS = 50_000_000
# A pause shorter than this is a turning point of the hand.
MIN_STRETCH_NS = 300_000_000
# Two frames farther apart say nothing about the time between.
MAX_GAP_NS = 1_000_000_000
MIN_FRAMES = 3


@dataclass(frozen=True, slots=True)
class Stretch:
    """A time in which nothing moves, both ends included."""

    first_ns: int
    last_ns: int


def still_stretches(tracks: Mapping[str, Sequence[tuple[int, Detection]]]) -> list[Stretch]:
    """The times in which the target rests for every camera that sees it.

    Args:
        tracks: Camera -> (stamp [ns], markers) of its frames with markers, in time order.

    Returns:
        Stretches of at least MIN_STRETCH_NS, in time order.
    """
    moving: list[tuple[int, int]] = []
    resting: list[tuple[int, int]] = []
    for track in tracks.values():
        for (t0, before), (t1, after) in itertools.pairwise(track):
            if t1 - t0 <= MAX_GAP_NS:
                (resting if _is_still(before, after) else moving).append((t0, t1))
    slack = [(t0 - CLOCK_SLACK_NS, t1 + CLOCK_SLACK_NS) for t0, t1 in moving]
    free = _without(_united(resting), _united(slack))
    return [Stretch(t0, t1) for t0, t1 in free if t1 - t0 >= MIN_STRETCH_NS]


def _is_still(before: Detection, after: Detection) -> bool:
    """Whether the markers that both frames show are in their place; without a common one, nobody knows."""
    _, i, j = np.intersect1d(before.ids, after.ids, return_indices=True)
    if not len(i):
        return False
    return bool(np.median(np.linalg.norm(before.corners_px[i] - after.corners_px[j], axis=2)) < MOTION_PX)


def _united(intervals: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    united: list[tuple[int, int]] = []
    for t0, t1 in sorted(intervals):
        if united and t0 <= united[-1][1]:
            united[-1] = (united[-1][0], max(united[-1][1], t1))
        else:
            united.append((t0, t1))
    return united


def _without(keep: Sequence[tuple[int, int]], taken: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """What is left of disjoint sorted intervals when others are cut out."""
    left: list[tuple[int, int]] = []
    for start, end in keep:
        for t0, t1 in taken:
            if t1 > start and t0 < end:
                if t0 > start:
                    left.append((start, t0))
                start = max(start, t1)
        if start < end:
            left.append((start, end))
    return left


def merge_stretches(
    tracks: Mapping[str, Sequence[tuple[int, Detection]]], stretches: Sequence[Stretch]
) -> dict[str, dict[int, Detection]]:
    """Camera -> number of the stretch -> its markers, averaged over the stretch; short glimpses are left out."""
    merged: dict[str, dict[int, Detection]] = {}
    for camera, track in tracks.items():
        merged[camera] = {}
        for number, stretch in enumerate(stretches):
            inside = [detection for t, detection in track if stretch.first_ns <= t <= stretch.last_ns]
            if len(inside) >= MIN_FRAMES:
                detection = merge_detections(inside)
                if len(detection):
                    merged[camera][number] = detection
    return merged
