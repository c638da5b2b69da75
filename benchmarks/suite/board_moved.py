"""Relative poses from a ChArUco board carried before 4 cameras, 25 frames at 2 m; two frames exchanged beside it."""

from __future__ import annotations

from benchmarks.board_rigs import board_metrics
from benchmarks.metric import Metric


def run(*, quick: bool) -> list[Metric]:
    return board_metrics(1 if quick else 5, distortion=False)
