"""Cameras whose pose the floor contradicts: what a user is told, and what becomes of the verdict.

Owns      the sentences, how far the verdict of the marker calibration falls.
Leaves    which cameras are contradicted to aruco.floor_doubts, where the sentences go to levelled_rig.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from aruco.floor_doubts import FloorDoubts
from aruco.ground_plane import FloorCorrection, GroundPlaneMetrics
from rigcal.quality.gates import GATES, Verdict

# From the worst to the best.
_VERDICTS: tuple[Verdict, ...] = ("bad", "usable", "good")
OF_MARKERS = "Verdict and checks are those of the marker calibration, before levelling moved single cameras."
_ITS = {True: "its covariance promises", False: "poses are usually off"}
_THEIR = {True: "the covariances of their poses promise", False: "poses are usually off"}


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundDoubts:
    """Why a levelled rig is not to be believed; empty if it is."""

    cameras: Mapping[str, str] = field(default_factory=dict)  # camera -> what its warnings say
    rig: str = ""  # cameras that disagree without any one being the wrong one
    shared: Collection[str] = ()  # those cameras
    limit: Verdict = "good"  # the best verdict that can stay

    @property
    def reasons(self) -> list[str]:
        """Sentences for the verdict."""
        of_one = [f"Camera {name}: {why}." for name, why in self.cameras.items() if name not in self.shared]
        return [*([self.rig] if self.rig else []), *of_one]


def ground_doubts(metrics: GroundPlaneMetrics, given: Collection[str]) -> GroundDoubts:
    """What the floor contradicts.

    Args:
        metrics: Of the levelling.
        given: Cameras whose covariance the file has.
    """
    doubts, corrections = metrics.doubts, metrics.corrections
    cameras = {
        name: _of_camera(corrections[name], scale, name in given, odd=name in doubts.odd)
        for name, scale in doubts.factors.items()
    }
    cameras |= {name: c.reason for name, c in corrections.items() if not c.accepted}
    return GroundDoubts(
        cameras=dict(sorted(cameras.items())),
        rig=_of_rig(corrections, doubts, given) if doubts.shared else "",
        shared=sorted(doubts.shared),
        limit=_limit([corrections[name] for name in cameras]),
    )


def judged(quality: Any, doubts: GroundDoubts) -> Any:
    """``_meta.quality`` of the marker calibration, no better than the floor leaves it."""
    if not isinstance(quality, dict):
        return quality
    before, told = quality.get("verdict"), quality.get("reasons", [])
    new = {**quality}
    if before in _VERDICTS and _VERDICTS.index(doubts.limit) < _VERDICTS.index(before):
        new |= {"verdict": doubts.limit, "verdict_before_levelling": before}
    if isinstance(told, list):
        said = [*doubts.reasons, *told, OF_MARKERS]
        new["reasons"] = [s for k, s in enumerate(said) if s not in said[:k]]
    return new


def _limit(corrections: Collection[FloorCorrection]) -> Verdict:
    """By how far floors are off, with the limits that a verdict has for poses."""
    if not corrections:
        return "good"
    tilt_deg = max(c.tilt_before_deg for c in corrections)
    rise_mm = max(1e3 * abs(c.height_before_m) for c in corrections)
    far = tilt_deg > GATES["camera rotation sigma"].bad or rise_mm > GATES["camera position sigma"].bad
    return "bad" if far else "usable"


def _of_camera(correction: FloorCorrection, scale: float, given: bool, *, odd: bool) -> str:
    which = "it was moved" if odd else "this or other cameras were moved"
    return (
        f"its floor is {_off([correction])} off where its pose puts it, {_times(scale)} what {_ITS[given]}: {which} "
        "since the calibration, or that or the depth is wrong; levelling mends pitch, roll and height only, so "
        "calibrate again"
    )


def _of_rig(corrections: Mapping[str, FloorCorrection], doubts: FloorDoubts, given: Collection[str]) -> str:
    names = sorted(doubts.shared)
    off = _off([corrections[name] for name in names])
    promised = _THEIR[any(name in given for name in names)]
    times = _times(max(doubts.shared.values()))
    whose = f"floors of cameras {', '.join(names)} are up to" if len(names) > 1 else f"floor of camera {names[0]} is"
    return (
        f"The {whose} {off} off the common one, {times} what {promised}, "
        "and more than bias of depth explains: cameras were moved since the calibration, or that or the depth is "
        "wrong; calibrate again, with --refine-depth if depth is in doubt."
    )


def _off(corrections: Collection[FloorCorrection]) -> str:
    tilt_deg = max(c.tilt_before_deg for c in corrections)
    return f"{tilt_deg:.1f} degrees and {max(1e3 * abs(c.height_before_m) for c in corrections):.0f} mm"


def _times(scale: float) -> str:
    return f"{scale:.0f} times"
