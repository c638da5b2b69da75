"""A real recording, an inverted board carried before 4 webcams: distances beside another tool's, and its halves."""

from __future__ import annotations

import numpy as np

from aruco.model import Calibration
from benchmarks.child import ROOT
from benchmarks.halves import check_value, halves_metrics
from benchmarks.metric import Metric, Skipped
from rigcal.config import CalibrateConfig
from rigcal.pipeline import calibrate
from rigcal.sources import open_recordings
from rigcal.target import board_target

DATA = ROOT.parent / "shared" / "data" / "webcams4_a"
BOARD = "charuco:4x5:0.054:0.0405:DICT_4X4_1000"
# Distances of cameras [m] by another tool from the same images; intrinsics limit these to 3-12 mm.
REFERENCE_M = {
    ("cam0", "cam1"): 1.1489,
    ("cam0", "cam2"): 0.5332,
    ("cam0", "cam3"): 0.4170,
    ("cam1", "cam2"): 0.9530,
    ("cam1", "cam3"): 1.4380,
    ("cam2", "cam3"): 0.6163,
}
MAX_DIFFERENCE_MM = 12.0
# A pair's normalised square has mean one. Six degrees of freedom pass 3.7 once in a thousand, the worst of six pairs
# passes four about as rarely as that.
MAX_OVER_COVARIANCE = 4.0


def run(*, quick: bool) -> list[Metric]:
    if not DATA.is_dir():
        raise Skipped("the recording is not there")
    recording, target = open_recordings([DATA / "recording"]), board_target(BOARD)
    config = CalibrateConfig(moving_target=True)
    calibration = calibrate(recording, target, config)
    return [
        Metric(
            key="worst_mm",
            value=1e3 * _worst_difference_m(calibration),
            unit="mm",
            about="largest difference of a distance of two cameras from another tool's",
            limit=MAX_DIFFERENCE_MM,
            rel_tol=0.15,
        ),
        Metric(
            key="rms_px",
            value=max(camera.rms_px for camera in calibration.cameras),
            unit="px",
            about="largest reprojection error of a camera",
            rel_tol=0.15,
        ),
        Metric(
            key="placed",
            value=len(calibration.cameras) / len(recording.cameras),
            unit="",
            about="share of cameras with a pose",
            better="higher",
            limit=1.0,
            rel_tol=0.0,
        ),
        *halves_metrics(recording, target, config),
        Metric(
            key="halves_over_covariance",
            value=check_value(calibration, "split-half over covariance"),
            unit="",
            about="worst pair's squared difference of halves solved apart over what both covariances promise",
            limit=MAX_OVER_COVARIANCE,
            rel_tol=0.5,
        ),
        Metric(
            key="early_late_over_covariance",
            value=check_value(calibration, "early-late over covariance"),
            unit="",
            about="the same of the first and the second half; the board is elsewhere in the images, the lens too",
            rel_tol=0.5,
        ),
    ]


def _worst_difference_m(calibration: Calibration) -> float:
    """Not a number where a camera has no pose."""
    T = calibration.T_world_cam
    if not {name for pair in REFERENCE_M for name in pair} <= T.keys():
        return float("nan")
    measured = {(i, j): float(np.linalg.norm(T[i][:3, 3] - T[j][:3, 3])) for i, j in REFERENCE_M}
    return max(abs(measured[pair] - REFERENCE_M[pair]) for pair in REFERENCE_M)
