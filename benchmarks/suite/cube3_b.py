"""A real recording, a small cube moved between 36 captures of 3 cameras: beside its reference, and its halves."""

from __future__ import annotations

import json

import numpy as np

from benchmarks.child import ROOT
from benchmarks.halves import halves_metrics
from benchmarks.metric import Metric, Skipped
from rigcal.config import CalibrateConfig, DetectConfig
from rigcal.pipeline import calibrate
from rigcal.quality.truth import pair_errors
from rigcal.sources import open_recordings
from rigcal.target import marker_target_from_file

DATA = ROOT.parent / "shared" / "data" / "cube3_b"
DICTIONARY = "DICT_4X4_50"
# The reference itself is known to about one percent, 10 mm; the recording agrees with itself much better.
LIMITS = {"worst_mm": 10.0, "worst_deg": 1.0}
HALVES_LIMITS = {"halves_worst_mm": 1.5, "halves_worst_deg": 0.3}


def run(*, quick: bool) -> list[Metric]:
    if not DATA.is_dir():
        raise Skipped("the recording is not there")
    reference = json.loads((DATA / "reference.json").read_text(encoding="utf-8"))
    T_cam0_cam = {name: np.array(T) for name, T in reference.items()}
    recording = open_recordings([DATA / "recording"])
    target = marker_target_from_file(DATA / "markers.parquet", DICTIONARY)
    config = CalibrateConfig(detect=DetectConfig(dictionary=DICTIONARY), moving_target=True)
    calibration = calibrate(recording, target, config)
    worst_rad, worst_m = np.max(list(pair_errors(calibration.T_world_cam, T_cam0_cam).values()), axis=0)
    return [
        Metric(
            key="worst_mm",
            value=float(1e3 * worst_m),
            unit="mm",
            about="largest difference of relative poses from the reference",
            limit=LIMITS["worst_mm"],
            rel_tol=0.15,
        ),
        Metric(
            key="worst_deg",
            value=float(np.degrees(worst_rad)),
            unit="deg",
            about="largest difference of relative poses from the reference",
            limit=LIMITS["worst_deg"],
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
            value=len(calibration.cameras) / len(T_cam0_cam),
            unit="",
            about="share of cameras with a pose",
            better="higher",
            limit=1.0,
            rel_tol=0.0,
        ),
        *halves_metrics(recording, target, config, limits=HALVES_LIMITS),
    ]
