"""The same as board_moved through lenses with distortion."""

from __future__ import annotations

from benchmarks.board_rigs import board_metrics
from benchmarks.metric import Metric


def run(*, quick: bool) -> list[Metric]:
    return board_metrics(1 if quick else 3, distortion=True)
