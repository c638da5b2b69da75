"""A real recording, a small cube moved between 36 captures of 3 cameras, beside its reference poses."""

from __future__ import annotations

import json

import numpy as np

from benchmarks.child import ROOT
from benchmarks.metric import Metric, Skipped
from rigcal.config import CalibrateConfig, DetectConfig
from rigcal.pipeline import calibrate_files
from rigcal.quality.truth import pair_errors

DATA = ROOT.parent / "shared" / "data" / "cube3_b"


def run(*, quick: bool) -> list[Metric]:
    if not DATA.is_dir():
        raise Skipped("the recording is not there")
    reference = json.loads((DATA / "reference.json").read_text(encoding="utf-8"))
    T_cam0_cam = {name: np.array(T) for name, T in reference.items()}
    config = CalibrateConfig(detect=DetectConfig(dictionary="DICT_4X4_50"), moving_target=True)
    calibration = calibrate_files([DATA / "recording"], DATA / "markers.parquet", config)
    errors = pair_errors(calibration.T_world_cam, T_cam0_cam)
    # The reference itself is known to about 10 mm.
    return [
        Metric(
            key="worst_mm",
            value=max(1e3 * shift for _, shift in errors.values()),
            unit="mm",
            about="largest difference of relative poses from the reference",
            limit=15.0,
            rel_tol=0.15,
        ),
        Metric(
            key="worst_deg",
            value=max(float(np.degrees(turn)) for turn, _ in errors.values()),
            unit="deg",
            about="largest difference of relative poses from the reference",
            limit=2.0,
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
    ]
