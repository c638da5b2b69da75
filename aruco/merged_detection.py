"""Many detections of a scene at rest -> one, with the noise averaged out and what does not average out kept.

Owns      the frames in which a scene rests, the robust mean of corners over frames, and its standard deviation.

Noise falls with the square root of the number of frames; the error that every frame repeats (ink, shading, where a
corner falls on the pixel grid) does not, so it stays in the sigma however long the recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from aruco.corner_fit import SIGMA_FLOOR_PX
from aruco.model import Detection
from aruco.pose_math import Array

# A corner this many robust deviations from the median was disturbed: somebody walked through.
OUTLIER_SIGMAS = 5.0
# Corners of a resting marker scatter by a pixel at worst; a target that was touched moves by more.
REST_PX = 2.0
REST_SHARE = 0.02
# The median distance of a two-dimensional unit normal.
RAYLEIGH_MEDIAN = 1.17741


def frames_at_rest(detections: Mapping[int, Detection]) -> list[int]:
    """The frames in which the markers are where they mostly are.

    Args:
        detections: Frame -> markers of one camera.

    Returns:
        Frames in which at least half of the markers lie within REST_PX or REST_SHARE of their side of their median
        place over all frames; ascending.
    """
    places: dict[int, list[Array]] = {}
    for detection in detections.values():
        for marker, corners in zip(detection.ids, detection.corners_px):
            places.setdefault(int(marker), []).append(corners)
    median = {marker: np.median(np.array(corners), axis=0) for marker, corners in places.items()}
    return sorted(frame for frame, detection in detections.items() if _rests(detection, median))


def _rests(detection: Detection, median: Mapping[int, Array]) -> bool:
    if not len(detection):
        return False
    usual = np.array([median[int(marker)] for marker in detection.ids])
    size = np.ptp(usual, axis=1).max(axis=1)
    away = np.linalg.norm(detection.corners_px - usual, axis=2).mean(axis=1)
    return bool(np.mean(away <= np.maximum(REST_PX, REST_SHARE * size)) >= 0.5)


def merge_detections(detections: Sequence[Detection]) -> Detection:
    """One detection of a scene that rests.

    Args:
        detections: Of one camera. A marker counts when it is in at least half as many frames as the most seen one.

    Returns:
        Ids ascending, mean corners, and sigmas that hold the scatter over frames and the part that repeats.
    """
    seen: dict[int, list[tuple[Array, Array]]] = {}
    for detection in detections:
        for marker, corners, sigma in zip(detection.ids, detection.corners_px, detection.sigma_px):
            seen.setdefault(int(marker), []).append((corners, sigma))
    most = max(map(len, seen.values()), default=0)
    kept = {marker: _mean(seen[marker]) for marker in sorted(seen) if len(seen[marker]) >= most / 2}
    if not kept:
        return Detection(ids=np.empty(0, np.int64), corners_px=np.empty((0, 4, 2)), sigma_px=np.empty((0, 4)))
    return Detection(
        ids=np.array(list(kept), dtype=np.int64),
        corners_px=np.array([corners for corners, _ in kept.values()]),
        sigma_px=np.array([sigma for _, sigma in kept.values()]),
    )


def _mean(seen: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Mean corners (k, 2) of one marker and their sigmas (k,)."""
    corners = np.array([c for c, _ in seen])
    sigma = np.array([s for _, s in seen])
    distance = np.linalg.norm(corners - np.median(corners, axis=0), axis=2)
    promised = sigma.mean(axis=1)
    limit = OUTLIER_SIGMAS * np.maximum(np.median(distance) / RAYLEIGH_MEDIAN, promised)
    good = distance.max(axis=1) <= limit
    agreed = bool(good.any())  # or half of the frames say one thing and half another
    good |= not agreed
    corners, sigma = corners[good], sigma[good]
    n = len(corners)
    noise2 = np.maximum(sigma**2 - SIGMA_FLOOR_PX**2, 0.0).mean(axis=0)
    if n > 2 or not agreed:  # two frames that agree say too little about their scatter
        noise2 = np.maximum(noise2, corners.var(axis=0, ddof=1).mean())
    return corners.mean(axis=0), np.sqrt(noise2 / n + SIGMA_FLOOR_PX**2)
