"""How long ``calibrate-extrinsics --help`` takes to answer."""

from __future__ import annotations

import statistics

from benchmarks.child import run_child
from benchmarks.metric import Metric


def run(*, quick: bool) -> list[Metric]:
    times = [run_child(["calibrate_extrinsics.py", "--help"]).wall_s for _ in range(3 if quick else 5)]
    return [
        Metric(
            key="wall_s",
            value=statistics.median(times),
            unit="s",
            about="`calibrate-extrinsics --help`, median of 5",
            limit=0.5,
            rel_tol=1.0,
            machine=True,
        )
    ]
