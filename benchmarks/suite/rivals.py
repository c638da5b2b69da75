"""The same corners of a board before 4 cameras solved by us, by averaging, and by OpenCV 5's calibrateMultiview.

Intrinsics are given and kept. Three times: corners as they are found, with 0.1 px of noise on top (what ordinary corner
methods leave), and with two frames of one camera exchanged, of every camera in turn. calibrateMultiview gets whole
boards only; what it makes of views that lack a point stands beside, under its own name.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from aruco.pose_math import Array, Pose
from benchmarks.board_rigs import EXCHANGED_LIMITS, exchangeable, look
from benchmarks.metric import Metric, Skipped
from benchmarks.rig_errors import rig_of
from benchmarks.rival_solvers import Corners, multiview, our_average, ours, plain_average
from rigcal.quality.truth import pair_errors
from rigcal.sim import simulate

Way = Callable[[Corners], dict[str, Pose]]

OURS = "ours"
WAYS: dict[str, tuple[Way, str]] = {
    OURS: (ours, "joint adjustment"),
    "average": (our_average, "our average of single views"),
    "plain": (plain_average, "PnP and plain average"),
    "multiview": (partial(multiview, whole_boards=True), "calibrateMultiview, whole boards only"),
}
PARTIAL: dict[str, tuple[Way, str]] = {
    "multiview_partial": (partial(multiview, whole_boards=False), "calibrateMultiview, partial views too"),
}
NOISE_PX = 0.1
DRAWS = 4  # of this noise for every rig
REPEATS = 3
# Two optimal ways differ by chance: the median of 30 pairs by some ten percent.
MIN_RATIO = 0.8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """Corners, and the truth about the cameras."""

    seed: int
    corners: Corners
    T_world_cam: Mapping[str, Pose]


def run(*, quick: bool) -> list[Metric]:
    if not hasattr(cv2, "calibrateMultiview"):
        raise Skipped(
            "calibrateMultiview came with OpenCV 5; to measure it without changing what is installed: "
            "uv run --with 'opencv-python-headless>=5,<6' python benchmarks/run.py rivals"
        )
    rigs = [_rig(seed) for seed in range(1 if quick else 5)]
    found = [(rig, rig.corners) for rig in rigs]
    noisy = [(rig, corners) for rig in rigs for corners in _shaken(rig)]
    exchanged = [(rig, corners) for rig in rigs for corners in _exchanges(rig)]
    what = f"{len(rigs)} rigs"
    return [
        *_compared(found, WAYS | PARTIAL, "", what),
        *_compared(noisy, WAYS, "noisy.", f"{what}, {DRAWS} times {NOISE_PX} px of noise on top"),
        *_compared(exchanged, WAYS, "exchanged.", f"{what}, two frames of each camera in turn exchanged"),
        *_survived(exchanged, f"{what}, two frames of each camera in turn exchanged"),
        *_times(rigs),
    ]


def _rig(seed: int) -> Rig:
    rig = rig_of(simulate("board-moved", seed=seed, depth=False))
    detections = {name: seen.detections for name, seen in look(rig).items()}
    corners = Corners(cameras=rig.recording.cameras, detections=detections, geometry=rig.target.geometry)
    return Rig(seed=seed, corners=corners, T_world_cam=rig.T_world_cam)


def _shaken(rig: Rig) -> Iterator[Corners]:
    rng = np.random.default_rng(rig.seed)
    for _ in range(DRAWS):
        yield rig.corners.shaken(NOISE_PX, rng)


def _exchanges(rig: Rig) -> Iterator[Corners]:
    rng = np.random.default_rng(rig.seed)
    for camera in sorted(rig.T_world_cam):
        yield rig.corners.exchanged(camera, exchangeable(rig.corners.frames_of, camera, rng))


def _compared(
    cases: list[tuple[Rig, Corners]], ways: Mapping[str, tuple[Way, str]], prefix: str, what: str
) -> list[Metric]:
    """Errors of every way over all pairs of all cases, and how many times ours they are."""
    errors_mm = {name: _errors_mm(way, cases) for name, (way, _) in ways.items()}
    metrics: list[Metric] = []
    for name, (_, about) in ways.items():
        told = f"{about}; {what}"
        metrics += [
            _error(f"{prefix}{name}.pair_median_mm", float(np.median(errors_mm[name])), f"median error, {told}", name),
            _error(f"{prefix}{name}.pair_worst_mm", float(np.max(errors_mm[name])), f"worst error, {told}", name),
        ]
        if name != OURS:
            ratio = float(np.median(errors_mm[name]) / np.median(errors_mm[OURS]))
            metrics.append(_ratio(f"{prefix}{name}.ratio", ratio, f"its median error over ours, {told}"))
    return metrics


def _survived(cases: list[tuple[Rig, Corners]], what: str) -> list[Metric]:
    """Of how many cases every way makes something useful."""
    limit_mm = EXCHANGED_LIMITS["pair_worst_mm"]
    return [
        Metric(
            key=f"exchanged.{name}.survived",
            value=float(np.mean([_errors_mm(way, [case]).max() <= limit_mm for case in cases])),
            unit="",
            about=f"share of recordings whose worst pair stays within {limit_mm} mm, {about}; {what}",
            better="higher",
            limit=1.0 if name == OURS else None,
            rel_tol=None,
        )
        for name, (way, about) in WAYS.items()
    ]


def _errors_mm(way: Way, cases: list[tuple[Rig, Corners]]) -> Array:
    """Distances [mm] of all pairs of all cases; cameras without a pose are a fault of the benchmark."""
    found: list[float] = []
    for rig, corners in cases:
        T_world_cam = way(corners)
        assert T_world_cam.keys() == rig.T_world_cam.keys()
        found += [1e3 * shift for _, shift in pair_errors(T_world_cam, rig.T_world_cam).values()]
    return np.array(found)


def _error(key: str, value: float, about: str, name: str) -> Metric:
    # What others do is shown and judged by nobody.
    return Metric(key=key, value=value, unit="mm", about=about, rel_tol=0.3 if name == OURS else None, abs_tol=0.02)


def _ratio(key: str, value: float, about: str) -> Metric:
    return Metric(key=key, value=value, unit="times", about=about, better="higher", limit=MIN_RATIO, rel_tol=None)


def _times(rigs: list[Rig]) -> list[Metric]:
    """From corners to poses: the median rig, each at its fastest of a few runs."""
    seconds = {
        name: float(np.median([min(_seconds(way, rig.corners) for _ in range(REPEATS)) for rig in rigs]))
        for name, (way, _) in WAYS.items()
    }
    times = [
        Metric(
            key=f"{name}.solve_s",
            value=seconds[name],
            unit="s",
            about=f"from corners of 4 cameras x 25 frames to poses, {about}",
            rel_tol=1.0 if name == OURS else None,
            machine=True,
        )
        for name, (_, about) in WAYS.items()
    ]
    ratios = [
        Metric(
            key=f"{name}.time_ratio",
            value=seconds[name] / seconds[OURS],
            unit="times",
            about=f"its time over ours, {about}",
            better="higher",
            rel_tol=None,
            machine=True,
        )
        for name, (_, about) in WAYS.items()
        if name != OURS
    ]
    return times + ratios


def _seconds(way: Way, corners: Corners) -> float:
    before = time.perf_counter()
    way(corners)
    return time.perf_counter() - before
