"""Relative poses from a box that is carried through the room, 16 frames: adjusted jointly, and averaged beside it."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.metric import Metric
from benchmarks.rig_errors import MeasuredRig, measure_rigs, rig_metrics, rig_of
from rigcal.sim import simulate

LIMITS = {"pair_median_mm": 0.5, "pair_median_deg": 0.015, "pair_worst_mm": 1.0, "pair_worst_deg": 0.03}


def run(*, quick: bool) -> list[Metric]:
    seeds = range(1 if quick else 5)
    what = f"{len(seeds)} rigs"
    adjusted = measure_rigs(rig_of(simulate("box-moved", seed=seed)) for seed in seeds)
    averaged = measure_rigs(_averaged(rig_of(simulate("box-moved", seed=seed))) for seed in seeds)
    return [
        *rig_metrics(adjusted, what, limits=LIMITS),
        *rig_metrics(averaged, f"{what}, average of single views", prefix="average."),
    ]


def _averaged(rig: MeasuredRig) -> MeasuredRig:
    return replace(rig, config=replace(rig.config, joint=False))
