"""The real command on 4 cameras x 100 frames of 1080p: time and memory on two cores."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from benchmarks.child import Ran, run_child
from benchmarks.metric import Metric

FRAMES, SHORT = 100, 25
CORES = 2


def run(*, quick: bool) -> list[Metric]:
    with tempfile.TemporaryDirectory() as folder:
        whole, short = Path(folder) / "whole", Path(folder) / "short"
        frames = SHORT * 2 if quick else FRAMES
        run_child(["-m", "rigcal", "simulate", "hd", str(whole), "--frames", str(frames), "--no-depth"])
        _shorten(whole, short)
        few = _calibrate(short)
        # Whatever else runs can only add time: the fastest of a few runs says most about the program.
        many = [_calibrate(whole) for _ in range(1 if quick else 3)]
    peak_mb = max(ran.peak_mb for ran in many)
    memory = [
        Metric(
            key="peak_mb",
            value=peak_mb,
            unit="MB",
            about=f"peak memory, 4 cameras x {FRAMES} frames of 1080p",
            limit=1000,
            rel_tol=0.25,
            machine=True,
        ),
        Metric(
            key="peak_growth_mb",
            value=peak_mb - few.peak_mb,
            unit="MB",
            about=f"peak memory, {FRAMES} frames more than {SHORT}",
            limit=40,  # what runs differ by; a single 1080p image is 6 MB, 75 x 4 of them are 1900
            rel_tol=None,
            machine=True,
        ),
    ]
    wall = Metric(
        key="wall_s",
        value=min(ran.wall_s for ran in many),
        unit="s",
        about=f"the command on 4 cameras x {FRAMES} frames of 1080p, two cores, best of 3",
        limit=25,
        rel_tol=1.0,
        machine=True,
    )
    return memory if quick else [wall, *memory]


def _calibrate(recording: Path) -> Ran:
    arguments = ["--input", str(recording), "--markers", str(recording / "markers.parquet"), "--auto-align"]
    output = ["--output", str(recording / "extrinsics.json"), "--jobs", str(CORES)]
    return run_child(["calibrate_extrinsics.py", *arguments, *output], cores=CORES)


def _shorten(whole: Path, short: Path) -> None:
    """The same recording with its first frames only, as links."""
    short.mkdir()
    os.link(whole / "markers.parquet", short / "markers.parquet")
    for info in whole.glob("*/camera_info.yaml"):
        images = short / info.parent.name / "image"
        images.mkdir(parents=True)
        os.link(info, images.parent / info.name)
        for image in sorted((info.parent / "image").iterdir())[:SHORT]:
            os.link(image, images / image.name)
