"""Simulated rigs calibrated by the whole pipeline, and how far their poses are from the truth.

Owns      calibrating rigs of several seeds, pooling their errors, and metrics of these.
Leaves    rigs to rigcal.sim, the errors themselves to rigcal.quality.truth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from aruco.board import board_text
from aruco.errors import CalibrationError
from aruco.model import Calibration, Recording
from aruco.pose_math import Array, Pose
from benchmarks.metric import Metric
from rigcal.config import AlignConfig, CalibrateConfig, DetectConfig
from rigcal.pipeline import calibrate
from rigcal.quality.truth import pair_errors, tilt_error
from rigcal.sim import Simulation
from rigcal.target import Target, board_target, marker_target

UP = (0, 1, 0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeasuredRig:
    """A recording, and what has to be known and is true about it."""

    recording: Recording
    target: Target
    T_world_cam: Mapping[str, Pose]  # the truth
    config: CalibrateConfig


def rig_of(simulation: Simulation) -> MeasuredRig:
    """A simulated rig, to be calibrated upright; with a board in the board's frame, which has no upright side."""
    board = simulation.target.board
    if board is None:
        target = marker_target(simulation.faces, simulation.dictionary)
    else:
        target = board_target(board_text(board))
    config = CalibrateConfig(
        detect=DetectConfig(dictionary=simulation.dictionary),
        align=AlignConfig(enabled=board is None),
        moving_target=simulation.rig.moving,
    )
    return MeasuredRig(
        recording=simulation.recording,
        target=target,
        T_world_cam=simulation.T_world_cam,
        config=config,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outcome:
    """What became of one rig."""

    calibration: Calibration | None  # None: nothing could be placed
    T_world_cam: Mapping[str, Pose]  # the truth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigErrors:
    """Errors over the rigs of several seeds."""

    pairs: Array  # (n, 2) angle [rad] and distance [m] of every pair of cameras of every rig
    tilts: Array  # (k,) [rad] of every rig that has an upright world
    placed: int  # cameras with a pose
    asked: int  # cameras there are


def measure_rigs(rigs: Iterable[MeasuredRig]) -> RigErrors:
    """Calibrate each rig as the command does, and compare it with its truth."""
    return pooled(calibrated(rig) for rig in rigs)


def calibrated(rig: MeasuredRig) -> Outcome:
    """Calibrate a rig as the command does."""
    try:
        calibration = calibrate(rig.recording, rig.target, rig.config)
    except CalibrationError:
        calibration = None
    return Outcome(calibration=calibration, T_world_cam=rig.T_world_cam)


def pooled(outcomes: Iterable[Outcome]) -> RigErrors:
    """The errors of several rigs; cameras of rigs that could not be calibrated count as not placed."""
    pairs: list[tuple[float, float]] = []
    tilts: list[float] = []
    placed = asked = 0
    for outcome in outcomes:
        asked += len(outcome.T_world_cam)
        if outcome.calibration is None:
            continue
        T_world_cam = outcome.calibration.T_world_cam
        placed += len(T_world_cam)
        pairs += pair_errors(T_world_cam, outcome.T_world_cam).values()
        if outcome.calibration.up is not None:
            tilts.append(tilt_error(T_world_cam, outcome.T_world_cam, UP))
    return RigErrors(pairs=np.array(pairs).reshape(-1, 2), tilts=np.array(tilts), placed=placed, asked=asked)


def rig_metrics(
    errors: RigErrors, what: str, *, prefix: str = "", limits: dict[str, float] | None = None
) -> list[Metric]:
    """Median and worst errors over all pairs of all rigs, tilt of upright ones, and how many cameras have a pose."""
    limits = limits or {}
    turns_deg, shifts_mm = np.degrees(errors.pairs[:, 0]), 1e3 * errors.pairs[:, 1]
    tilts_deg = np.degrees(errors.tilts)
    statistics: dict[str, tuple[Callable[[Array], float], Array, str, str]] = {
        "pair_median_mm": (_median, shifts_mm, "mm", "median error of relative poses"),
        "pair_worst_mm": (_worst, shifts_mm, "mm", "worst error of relative poses"),
        "pair_median_deg": (_median, turns_deg, "deg", "median error of relative poses"),
        "pair_worst_deg": (_worst, turns_deg, "deg", "worst error of relative poses"),
        "tilt_worst_deg": (_worst, tilts_deg, "deg", "worst error of up"),
    }
    placed = Metric(
        key=f"{prefix}placed",
        value=errors.placed / errors.asked,
        unit="",
        about=f"share of cameras with a pose; {what}",
        better="higher",
        limit=1.0,
        rel_tol=0.0,
    )
    return [
        Metric(
            key=prefix + key,
            value=statistic(values),
            unit=unit,
            about=f"{about}; {what}",
            limit=limits.get(key),
            # The same seeds give the same images; other releases of the packages change the last digits only, but
            # the worst pair hangs on a single corner.
            rel_tol=0.15 if statistic is _median else 0.3,
            abs_tol=0.02 if unit == "mm" else 0.001,
        )
        for key, (statistic, values, unit, about) in statistics.items()
        if key != "tilt_worst_deg" or len(values)
    ] + [placed]


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _worst(values: Array) -> float:
    return float(np.max(values)) if len(values) else float("nan")
