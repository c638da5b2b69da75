"""Two halves of a recording calibrated apart: how far relative poses differ, without any reference.

Owns      calibrating every second capture, and metrics of the difference.
Leaves    parting a recording to recordings.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from aruco.errors import CalibrationError
from aruco.model import Calibration, Recording
from aruco.pose_math import Array
from benchmarks.metric import Metric
from benchmarks.recordings import halves
from rigcal.config import CalibrateConfig
from rigcal.pipeline import calibrate
from rigcal.quality.truth import pair_errors
from rigcal.target import Target


def halves_metrics(
    recording: Recording, target: Target, config: CalibrateConfig, *, limits: Mapping[str, float] | None = None
) -> list[Metric]:
    """The largest difference of relative poses between both halves; not a number where a half lacks a camera."""
    limits = limits or {}
    worst_rad, worst_m = _worst_difference(recording, target, config)
    return [
        Metric(
            key=key,
            value=value,
            unit=unit,
            about="largest difference of relative poses between even and odd captures, calibrated apart",
            limit=limits.get(key),
            rel_tol=0.3,  # the worst of a few pairs, each of which hangs on half the captures
        )
        for key, value, unit in (
            ("halves_worst_mm", 1e3 * worst_m, "mm"),
            ("halves_worst_deg", float(np.degrees(worst_rad)), "deg"),
        )
    ]


def check_value(calibration: Calibration, name: str) -> float:
    """The value of one of a calibration's own checks; not a number where it has none of this name."""
    checks = calibration.notes.get("quality", {}).get("checks", ())
    return next((float(check["value"]) for check in checks if check["name"] == name), float("nan"))


def _worst_difference(recording: Recording, target: Target, config: CalibrateConfig) -> Array:
    """Angle [rad] and distance [m]."""
    everyone = {camera.name for camera in recording.cameras}
    try:
        even, odd = (calibrate(half, target, config).T_world_cam for half in halves(recording))
    except CalibrationError:
        return np.full(2, np.nan)
    if not (even.keys() == odd.keys() == everyone):
        return np.full(2, np.nan)
    return np.max(list(pair_errors(even, odd).values()), axis=0)
