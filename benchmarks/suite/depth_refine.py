"""Depth beside markers on simulated rigs, with biased depth (0.3 %, 0.15 px) and without: poses, biases, time."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from aruco.model import SILENT
from aruco.pose_math import Array, Pose
from benchmarks.metric import Metric
from rigcal.config import CalibrateConfig, DetectConfig
from rigcal.depth_pooling import pool_recording
from rigcal.depth_refining import DepthRefinement, refine_with_depth
from rigcal.depth_samples import face_depths
from rigcal.evidence import Evidence, look
from rigcal.kept import NOTHING_KEPT
from rigcal.placing import adjust_placed, place_cameras
from rigcal.quality.truth import pair_errors
from rigcal.sim import Simulation, simulate
from rigcal.target import marker_target

# No rig may become worse by more than the larger of both.
ALLOWED_SHARE = 0.05
ALLOWED_M = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Outcome:
    before_m: float  # median error of the relative poses
    after_m: float
    bias_errors: Array  # (k, 2) scale, disparity [px]
    accepted: bool
    seconds: float


def run(*, quick: bool) -> list[Metric]:
    seeds = range(2 if quick else 20)
    outcomes = [_measured(seed) for seed in seeds]
    return [
        *_metrics([biased for biased, _ in outcomes], "biased", f"{len(seeds)} rigs"),
        *_metrics([true for _, true in outcomes], "unbiased", f"{len(seeds)} rigs, depth without bias"),
    ]


def _measured(seed: int) -> tuple[_Outcome, _Outcome]:
    """One static rig, its depth with bias and without; images are the same."""
    simulation = simulate("box-static", seed=seed)
    target = marker_target(simulation.faces, simulation.dictionary)
    config = CalibrateConfig(detect=DetectConfig(dictionary=simulation.dictionary))
    evidence = look(simulation.recording, target, config, jobs=2, progress=SILENT)
    unbiased = simulate("box-static", seed=seed, depth_bias=False)
    return _refined(simulation, evidence), _refined(unbiased, replace(evidence, recording=unbiased.recording))


def _refined(simulation: Simulation, evidence: Evidence) -> _Outcome:
    average = place_cameras(evidence, NOTHING_KEPT)[0]
    joint = adjust_placed(average, evidence, NOTHING_KEPT)
    pooled = pool_recording(simulation.recording, None, jobs=2, progress=SILENT)
    faces = face_depths(evidence, joint.rig, pooled)
    start = time.perf_counter()
    found = refine_with_depth(average, joint, evidence, faces, pooled)
    seconds = time.perf_counter() - start
    before = {name: placement.T_world_cam for name, placement in joint.rig.cameras.items()}
    return _Outcome(
        before_m=_median_error_m(before, simulation),
        after_m=_median_error_m(found.T_world_cam, simulation),
        bias_errors=_bias_errors(found, simulation),
        accepted=found.accepted,
        seconds=seconds,
    )


def _median_error_m(T_world_cam: Mapping[str, Pose], simulation: Simulation) -> float:
    return float(np.median([shift for _, shift in pair_errors(T_world_cam, simulation.T_world_cam).values()]))


def _bias_errors(found: DepthRefinement, simulation: Simulation) -> Array:
    errors: list[tuple[float, float]] = []
    for name, bias in found.biases.items():
        truth = simulation.depth_bias[name]
        errors.append((bias.scale - truth.scale, (bias.disparity_px or 0.0) - truth.disparity_px))
    return np.abs(np.array(errors).reshape(-1, 2))


def _metrics(outcomes: Iterable[_Outcome], prefix: str, what: str) -> list[Metric]:
    rigs = list(outcomes)
    before, after = (np.array([getattr(rig, name) for rig in rigs]) for name in ("before_m", "after_m"))
    harm = (after - before) / np.maximum(ALLOWED_SHARE * before, ALLOWED_M)
    errors = np.concatenate([rig.bias_errors for rig in rigs])
    worst = errors.max(axis=0) if len(errors) else np.full(2, np.nan)

    def metric(key: str, value: float, unit: str, about: str, limit: float | None, abs_tol: float) -> Metric:
        full = f"{about}; {what}"
        return Metric(
            key=f"{prefix}.{key}", value=value, unit=unit, about=full, limit=limit, rel_tol=0.3, abs_tol=abs_tol
        )

    return [
        replace(
            metric("ratio_mean", float((after / before).mean()), "", "pair error with depth over without", 1.0, 0.01),
            rel_tol=0.0,
        ),
        metric("harm_worst", float(harm.max()), "", "worst growth of pair error over 5 % or 1 mm", 1.0, 0.05),
        metric("scale_worst_percent", 100 * float(worst[0]), "%", "worst error of a depth scale", 0.3, 0.02),
        metric("disparity_worst_px", float(worst[1]), "px", "worst error of a disparity bias", 0.1, 0.01),
        Metric(
            key=f"{prefix}.accepted",
            value=sum(rig.accepted for rig in rigs) / len(rigs),
            unit="",
            about=f"share of rigs whose depth was believed; {what}",
            better="higher",
            rel_tol=0.0,
            abs_tol=0.1,
        ),
        Metric(
            key=f"{prefix}.seconds",
            value=float(np.median([rig.seconds for rig in rigs])),
            unit="s",
            about=f"refining 4 cameras of 720p, depth already pooled; {what}",
            rel_tol=1.0,
            machine=True,
        ),
    ]
