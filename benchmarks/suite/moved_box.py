"""Relative poses from a box that is carried through the room, 16 frames."""

from __future__ import annotations

from benchmarks.metric import Metric
from benchmarks.rig_errors import measure_rigs, rig_metrics, rig_of
from rigcal.sim import simulate


def run(*, quick: bool) -> list[Metric]:
    seeds = range(1 if quick else 5)
    rigs = (rig_of(simulate("box-moved", seed=seed)) for seed in seeds)
    return rig_metrics(measure_rigs(rigs), f"{len(seeds)} rigs")
