"""Relative poses from an open corner of three printed sides that rests, four 0.24 m markers a side."""

from __future__ import annotations

from benchmarks.metric import Metric
from benchmarks.rig_errors import measure_rigs, rig_metrics, rig_of
from rigcal.sim import simulate


def run(*, quick: bool) -> list[Metric]:
    seeds = range(2 if quick else 5)
    rigs = (rig_of(simulate("corner-static", seed=seed)) for seed in seeds)
    return rig_metrics(measure_rigs(rigs), f"{len(seeds)} rigs")
