"""Pooling the depth of 4 cameras x 50 frames of 720p of a recording, and keeping it: time, memory, disk, errors."""

from __future__ import annotations

import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from aruco.depth_pool import pool_depth
from benchmarks.child import run_child
from benchmarks.metric import Metric
from rigcal.sim.noise import DepthBias, DepthNoise, fixed_error, measure_depth

CAMERAS, FRAMES = 4, 50
# So many are rendered, which takes longer than what is measured; the others are these again, as links.
RENDERED = 10
_LATER_NS = 10_000_000_000
CORES = 2
_SIZE = (240, 320)
_WALL_M, _THING_M, _FOCAL_BASELINE = 3.0, 1.5, 84.0


def run(*, quick: bool) -> list[Metric]:
    return [*_work(RENDERED // 2 if quick else RENDERED), *_errors()]


def _work(rendered: int) -> list[Metric]:
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "recording"
        run_child(["-m", "rigcal", "simulate", "box-static", str(recording), "--frames", str(rendered)])
        _repeat(recording, FRAMES // rendered)
        ran = run_child(["-m", "benchmarks.suite.depth_pool", str(recording)], cores=CORES)
        figures = json.loads(ran.output)
        megabytes = (recording / "depth.h5").stat().st_size / 1e6
    about = f"{CAMERAS} cameras x {FRAMES} frames of 720p"
    return [
        Metric(
            key="wall_s",
            value=figures["pool_s"],
            unit="s",
            about=f"reading and pooling {about}, two cores",
            limit=30,
            rel_tol=1.0,
            machine=True,
        ),
        Metric(
            key="peak_mb",
            value=ran.peak_mb,
            unit="MB",
            about=f"peak memory of it, {about}",
            limit=2000,
            rel_tol=0.25,
            machine=True,
        ),
        Metric(
            key="store_s",
            value=figures["store_s"],
            unit="s",
            about="writing the store and reading it back",
            rel_tol=1.0,
            machine=True,
        ),
        Metric(key="store_mb", value=megabytes, unit="MB", about="size of the store, five kept frames a camera"),
    ]


def _repeat(recording: Path, times: int) -> None:
    """The same images that many times, one after the other."""
    for image in sorted([*recording.glob("*/image/*.png"), *recording.glob("*/depth/*.png")]):
        for k in range(1, times):
            os.link(image, image.with_name(f"{int(image.stem) + k * _LATER_NS}.png"))


def _errors() -> list[Metric]:
    """Error of disparity behind a thing that stands there for 40 percent of the time."""
    noise = DepthNoise()
    wall = np.full(_SIZE, _WALL_M, dtype=np.float32)
    fixed = fixed_error(_SIZE, noise, np.random.default_rng(0))
    images = np.stack(
        [
            measure_depth(wall, fixed, noise, DepthBias(), _FOCAL_BASELINE, np.random.default_rng(1 + k))
            for k in range(FRAMES)
        ]
    )
    there = (slice(60, 180), slice(80, 240))
    images[: 2 * FRAMES // 5, *there] -= np.float32(_WALL_M - _THING_M)
    # What averaging cannot take out is no error of the pooling.
    best = 1.0 / (1.0 / _WALL_M + fixed / _FOCAL_BASELINE)
    pooled = pool_depth((k, image, None) for k, image in enumerate(images)).depth
    metrics: list[Metric] = []
    for name, depth in (("pooled", pooled), ("median", np.nanmedian(images, axis=0))):
        error_px = (_FOCAL_BASELINE / depth - _FOCAL_BASELINE / best)[there]
        ours = name == "pooled"
        metrics.append(
            Metric(
                key=f"behind.{name}_px",
                value=float(np.sqrt(np.nanmean(error_px**2))),
                unit="px",
                about=f"{name} over 50 frames, behind a thing that stands there for 40 % of them: rms of disparity",
                # Thirty values of 0.12 px are worth 0.022 px.
                limit=0.03 if ours else None,
                rel_tol=0.1 if ours else None,
            )
        )
    return metrics


def _main(recording: Path) -> None:
    """In a process of its own: seconds of pooling and of the store, as JSON."""
    from aruco.depth_save import load_depth_data, save_depth_data
    from aruco.model import SILENT
    from rigcal.depth_pooling import pool_recording
    from rigcal.sources import open_recordings

    start = time.perf_counter()
    cameras = pool_recording(open_recordings([recording]), None, jobs=CORES, progress=SILENT)
    pooled = time.perf_counter()
    save_depth_data(recording / "depth.h5", cameras)
    load_depth_data(recording / "depth.h5")
    print(json.dumps({"pool_s": pooled - start, "store_s": time.perf_counter() - pooled}))


if __name__ == "__main__":
    import sys

    _main(Path(sys.argv[1]))
