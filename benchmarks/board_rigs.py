"""The simulated board before four cameras: as recorded, and with two frames of one camera exchanged.

Owns      which frames are exchanged, and metrics of both.
Leaves    calibrating and pooling to rig_errors.

Two exchanged frames agree with themselves: every corner of both views is wrong. Only other cameras that saw the board
at the same moment can tell. Where there is one other camera, two views contradict each other and nobody can say which
is wrong; so frames are exchanged that at least three cameras see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aruco.model import SILENT
from benchmarks.metric import Metric
from benchmarks.recordings import ExchangedRecording, HeldRecording
from benchmarks.rig_errors import MeasuredRig, Outcome, calibrated, pooled, rig_metrics, rig_of
from rigcal.config import FrameConfig, Resources
from rigcal.detecting import Seen, watch
from rigcal.frames import synchronised
from rigcal.sim import simulate

LIMITS = {"pair_median_mm": 0.9, "pair_worst_mm": 1.6, "pair_median_deg": 0.03, "pair_worst_deg": 0.06}
EXCHANGED_LIMITS = {"pair_median_mm": 1.3, "pair_worst_mm": 2.2}
WITNESSES = 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Exchange:
    """Two frames of one camera, and what became of the rig."""

    camera: str
    pair: tuple[int, int]
    outcome: Outcome

    @property
    def rejected(self) -> set[tuple[str, int]]:
        """Camera and frame of the views that the calibration names as not fitting the others."""
        if self.outcome.calibration is None:
            return set()
        named = self.outcome.calibration.notes["adjusted"]["rejected_views"]
        return {(camera, frame) for camera, frames in named.items() for frame in frames}

    @property
    def exchanged(self) -> set[tuple[str, int]]:
        """Camera and frame of the views that are wrong."""
        return {(self.camera, frame) for frame in self.pair}


def board_metrics(n_rigs: int, *, distortion: bool) -> list[Metric]:
    """Errors of the rigs of so many seeds, and of the same recordings with an exchange."""
    ordered: list[Outcome] = []
    exchanges: list[Exchange] = []
    for seed in range(n_rigs):
        rig = rig_of(simulate("board-moved", seed=seed, distortion=distortion, depth=False))
        rig = replace(rig, recording=HeldRecording(rig.recording))  # rendered once, looked at several times
        ordered.append(calibrated(rig))
        exchanges.append(_exchanged(rig, seed))
    what = f"{n_rigs} rigs" + (", lenses with distortion" if distortion else "")
    told = f"{what}, two frames of a camera exchanged"
    return [
        *rig_metrics(pooled(ordered), what, limits=LIMITS),
        *rig_metrics(pooled(e.outcome for e in exchanges), told, prefix="exchanged.", limits=EXCHANGED_LIMITS),
        *_naming_metrics(exchanges, told),
    ]


def look(rig: MeasuredRig) -> dict[str, Seen]:
    """Camera -> what it saw, as a calibration finds it."""
    moments = synchronised(rig.recording, FrameConfig())
    jobs = Resources().jobs
    return watch(rig.recording, moments, rig.target, min_markers=1, jobs=jobs, progress=SILENT)


def exchangeable(frames_of: Mapping[str, set[int]], camera: str, rng: np.random.Generator) -> tuple[int, int]:
    """Two frames of a camera in which enough others see the target.

    Args:
        frames_of: Camera -> frames in which it sees the target.
        camera: One of them.
        rng: Chooses.
    """
    seen_by = {f: sum(f in frames for frames in frames_of.values()) for f in frames_of[camera]}
    frames = sorted(f for f, n in seen_by.items() if n >= WITNESSES)
    one, other = sorted(rng.choice(frames, 2, replace=False).tolist())
    return one, other


def _exchanged(rig: MeasuredRig, seed: int) -> Exchange:
    frames_of = {name: set(seen.detections) for name, seen in look(rig).items()}
    camera = sorted(frames_of)[seed % len(frames_of)]
    pair = exchangeable(frames_of, camera, np.random.default_rng(seed))
    recording = ExchangedRecording(rig.recording, camera, pair)
    return Exchange(camera=camera, pair=pair, outcome=calibrated(replace(rig, recording=recording)))


def _naming_metrics(exchanges: Sequence[Exchange], what: str) -> list[Metric]:
    wrong = sum(len(e.exchanged) for e in exchanges)
    return [
        Metric(
            key="exchanged.named",
            value=sum(len(e.exchanged & e.rejected) for e in exchanges) / wrong,
            unit="",
            about=f"share of the exchanged views that are named; {what}",
            better="higher",
            limit=1.0,
            rel_tol=0.0,
        ),
        Metric(
            key="exchanged.accused",
            value=float(sum(len(e.rejected - e.exchanged) for e in exchanges)),
            unit="views",
            about=f"good views that are named beside the {wrong} exchanged ones; {what}",
            limit=0.0,
        ),
    ]
