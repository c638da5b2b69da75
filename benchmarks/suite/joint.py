"""The joint adjustment on one core: time and memory by cameras, frames and markers, and how they grow with frames."""

from __future__ import annotations

import json
from dataclasses import dataclass

from benchmarks.child import ONE_THREAD, run_child
from benchmarks.metric import Metric


@dataclass(frozen=True, slots=True, kw_only=True)
class Size:
    """A rig to adjust, and what it may cost."""

    key: str
    cameras: int
    frames: int
    about: str
    limit_s: float | None = None
    limit_mb: float | None = None


SIZES = (
    Size(key="board_4x25", cameras=4, frames=25, about="4 cameras x 25 frames of a board of 48 points", limit_s=0.3),
    Size(key="box_4x200", cameras=4, frames=200, about="4 cameras x 200 frames x 8 markers", limit_s=1.0),
    Size(key="box_20x250", cameras=20, frames=250, about="20 cameras x 250 frames x 8 markers"),
    Size(key="box_20x500", cameras=20, frames=500, about="20 cameras x 500 frames x 8 markers"),
    Size(
        key="box_20x1000",
        cameras=20,
        frames=1000,
        about="20 cameras x 1000 frames x 8 markers",
        limit_s=4.0,
        limit_mb=600.0,
    ),
)
# Twice the frames, twice the time, and a half more for what caches and the number of steps make of it.
MAX_RATIO = 3.0


def run(*, quick: bool) -> list[Metric]:
    sizes = SIZES[:2] if quick else SIZES
    repeats = 1 if quick else 3
    times: dict[str, float] = {}
    metrics: list[Metric] = []
    for size in sizes:
        arguments = [str(size.cameras), str(size.frames), size.key.split("_")[0], str(repeats)]
        ran = run_child(["-m", "benchmarks.joint_sizes", *arguments], cores=1, env=ONE_THREAD)
        figures = json.loads(ran.output.splitlines()[-1])
        times[size.key] = figures["seconds"]
        metrics += _metrics(size, figures["seconds"], ran.peak_mb, figures["worst_mm"], repeats)
    return metrics if quick else [*metrics, *_growth(times)]


def _metrics(size: Size, seconds: float, peak_mb: float, worst_mm: float, repeats: int) -> list[Metric]:
    return [
        Metric(
            key=f"{size.key}.solve_s",
            value=seconds,
            unit="s",
            about=f"adjusting {size.about}, one core, best of {repeats}",
            limit=size.limit_s,
            rel_tol=1.0,
            machine=True,
        ),
        Metric(
            key=f"{size.key}.peak_mb",
            value=peak_mb,
            unit="MB",
            about=f"peak memory of a process that adjusts {size.about}",
            limit=size.limit_mb,
            rel_tol=0.25,
            machine=True,
        ),
        Metric(
            key=f"{size.key}.worst_mm",
            value=worst_mm,
            unit="mm",
            about=f"worst error of relative poses, {size.about}, corners of 0.1 px",
            rel_tol=0.3,
            abs_tol=0.02,
        ),
    ]


def _growth(times: dict[str, float]) -> list[Metric]:
    """Time at twice the frames over time, which is two for a cost that is linear in frames."""
    return [
        Metric(
            key=f"growth_{more}_over_{few}",
            value=times[f"box_20x{more}"] / times[f"box_20x{few}"],
            unit="times",
            about=f"time for {more} frames over that for {few}, 20 cameras x 8 markers",
            limit=MAX_RATIO,
            rel_tol=None,
            machine=True,
        )
        for few, more in ((250, 500), (500, 1000))
    ]
