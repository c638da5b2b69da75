"""Relative poses from a closed box that rests, one 0.45 m marker a face: 4 cameras at 2-3 m, 720p, three frames."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.metric import Metric
from benchmarks.rig_errors import MeasuredRig, measure_rigs, rig_metrics, rig_of
from benchmarks.tone_curve import BentRecording
from rigcal.sim import Simulation, simulate
from rigcal.sim.noise import ImageNoise

LIMITS = {"pair_median_mm": 2.5, "pair_median_deg": 0.06, "pair_worst_mm": 5.0, "pair_worst_deg": 0.15}
ROUGH = ImageNoise(blur_px=1.0, read_noise=4.0, shot_noise=0.0)


def run(*, quick: bool) -> list[Metric]:
    seeds = range(2 if quick else 8)
    normal = measure_rigs(rig_of(simulate("box-static", seed=seed)) for seed in seeds)
    bent = measure_rigs(rig_of(simulate("box-static", seed=seed, distortion=True)) for seed in seeds)
    rough = measure_rigs(rig_of(simulate("box-static", seed=seed, image_noise=ROUGH)) for seed in seeds)
    tone = measure_rigs(_as_most_cameras_see_it(simulate("box-static", seed=seed)) for seed in seeds)
    return [
        *rig_metrics(normal, f"{len(seeds)} rigs", limits=LIMITS),
        *rig_metrics(bent, f"{len(seeds)} rigs, lenses with distortion", prefix="bent.", limits=LIMITS),
        *rig_metrics(rough, f"{len(seeds)} rigs, blur 1.0 px, noise 4 grey levels", prefix="rough.", limits=LIMITS),
        *rig_metrics(tone, f"{len(seeds)} rigs, images on the sRGB curve", prefix="tone."),
    ]


def _as_most_cameras_see_it(simulation: Simulation) -> MeasuredRig:
    return replace(rig_of(simulation), recording=BentRecording(simulation.recording))
