"""What corners miss beyond their own noise, found while adjusting: shifted edges, and what is left after them.

Owns      the order: without shifts, with them, which of both is believed, the model noise that remains.
Leaves    shifts to edge_shift, the noise to model_noise, adjusting to judge.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from aruco.model import Detection
from aruco.pose_math import Array
from rigcal.solve.adjust import Gauge
from rigcal.solve.edge_shift import EdgeShift, cost_of_not_knowing, find_shift, outward_moves, outwards, shifted
from rigcal.solve.judge import Judged, adjust_judging
from rigcal.solve.model_noise import NOTICED, model_noise_px
from rigcal.solve.problem import Poses, Sightings

# Views that come back once the model noise is known may show more of it.
NOISE_ROUNDS = 6
SETTLED_NOISE = 1.05


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CornerErrors:
    """Errors that corners share, and what was made of them."""

    shift_px: Mapping[str, float] = field(default_factory=dict)  # camera -> shift of its edges that was taken out
    doubtful_shift_px: Mapping[str, float] = field(default_factory=dict)  # seen, but not beyond other errors
    noise_px: float = 0.0  # standard deviation beyond the corners' sigmas
    beyond_promise: float = 1.0  # how many times larger residuals are than the corners' sigmas alone promise

    def taken_out_of(self, detections: Mapping[str, Mapping[int, Detection]]) -> Mapping[str, Mapping[int, Detection]]:
        """Detections with edges where they are. Model noise is not in their sigmas: averages do not lower it."""
        return {
            name: {frame: self._mended(d, self.shift_px.get(name, 0.0)) for frame, d in by_frame.items()}
            for name, by_frame in detections.items()
        }

    def _mended(self, detection: Detection, shift_px: float) -> Detection:
        corners = detection.corners_px
        if shift_px and corners.shape[1] == 4:
            corners = corners - shift_px * outward_moves(corners)
        return replace(detection, corners_px=corners)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Explained:
    """An adjustment, its corners without their common errors, and these errors."""

    sightings: Sightings
    judged: Judged
    errors: CornerErrors
    shift_covariance: Array  # (6 c, 6 c) what shifts that are not known exactly add to that of the cameras


def adjust_explaining(sightings: Sightings, start: Poses, gauge: Gauge) -> Explained:
    """Adjust with judged views, and take out of the corners what they miss together.

    Raises:
        CalibrationError: Not one view has all its corners in front of its camera under the start.
    """
    plain = adjust_judging(sightings, start, gauge)
    direction = outwards(sightings)
    shift = None
    if direction.any() and plain.kept.any():
        shift = find_shift(sightings.only_views(plain.kept), plain.adjustment, plain.gauge)
    settled = None
    if shift is not None and shift.is_significant and shift.is_plausible:
        corrected = shifted(sightings, shift.shift_px, direction)
        settled = _with_noise(corrected, adjust_judging(corrected, start, gauge), start, gauge)
        # Lens and map may be wrong in ways that look like a shift, but hardly like a larger one than what they leave.
        settled = settled if shift.size_px > settled.noise_px else None
    applied = settled is not None
    settled = settled or _with_noise(sightings, plain, start, gauge)
    return Explained(
        sightings=settled.sightings,
        judged=settled.judged,
        errors=_errors(sightings, shift, applied, settled, plain.adjustment.scale),
        shift_covariance=_shift_covariance(settled, shift, applied),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Settled:
    """An adjustment with the model noise that it shows."""

    sightings: Sightings
    judged: Judged
    noise_px: float


def _with_noise(sightings: Sightings, judged: Judged, start: Poses, gauge: Gauge) -> _Settled:
    """Adjusted under the model noise that the views which belong show; it grows as more of them do."""
    found = _Settled(sightings, judged, 0.0)
    if not judged.kept.any() or judged.adjustment.scale < NOTICED:
        return found
    own_px = float(np.median(sightings.sigma_px))
    for _ in range(NOISE_ROUNDS):
        noise_px = model_noise_px(found.sightings, found.judged, own_px)
        if noise_px <= SETTLED_NOISE * found.noise_px:
            break
        noisy = sightings.with_noise(noise_px)
        found = _Settled(noisy, adjust_judging(noisy, start, gauge), noise_px)
    return found


def _errors(
    sightings: Sightings, shift: EdgeShift | None, applied: bool, settled: _Settled, scale: float
) -> CornerErrors:
    named: dict[str, float] = {}
    if shift is not None and shift.is_significant:
        named = {camera.name: float(px) for camera, px in zip(sightings.cameras, shift.shift_px)}
    left = settled.judged.adjustment.scale
    noisier = float(np.median(settled.sightings.sigma_px / sightings.sigma_px))
    return CornerErrors(
        shift_px=named if applied else {},
        doubtful_shift_px={} if applied else named,
        noise_px=settled.noise_px,
        beyond_promise=left * noisier if applied else max(scale, left),
    )


def _shift_covariance(settled: _Settled, shift: EdgeShift | None, applied: bool) -> Array:
    judged = settled.judged
    if shift is None or not judged.kept.any():
        return np.zeros_like(judged.adjustment.covariance)
    missed_px = np.zeros_like(shift.shift_px) if applied else shift.shift_px
    return cost_of_not_knowing(settled.sightings.only_views(judged.kept), judged.adjustment, judged.gauge, missed_px)
