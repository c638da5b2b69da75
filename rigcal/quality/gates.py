"""The verdict: measured numbers against stated limits.

Owns      every limit and its reason, the verdict, the sentences that say what to do.
Leaves    measuring to rigcal.validation.

A number beyond its first limit keeps a calibration from being good, beyond its second makes it bad. Residuals of the
frames that were solved never make it good: at least one independent check must have looked at every camera. No check
of images alone sees a marker map that is wrong by one factor everywhere; see lengths.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from rigcal.quality.patterns import Pattern

Verdict = Literal["good", "usable", "bad"]


@dataclass(frozen=True, slots=True)
class Check:
    """One number beside its limit."""

    name: str
    value: float
    unit: str
    limit: float
    passed: bool

    def as_dict(self) -> dict[str, Any]:
        """The layout of ``_meta.quality.checks``; a number that is not finite becomes null."""
        value = self.value if math.isfinite(self.value) else None
        return {"name": self.name, "value": value, "unit": self.unit, "limit": self.limit, "passed": self.passed}


@dataclass(frozen=True, slots=True)
class Quality:
    """What is thought of a calibration, and why."""

    verdict: Verdict
    reasons: tuple[str, ...]
    checks: tuple[Check, ...]

    def as_dict(self) -> dict[str, Any]:
        """The layout of ``_meta.quality``."""
        return {
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "checks": [check.as_dict() for check in self.checks],
        }


@dataclass(frozen=True, slots=True)
class Gate:
    """Two limits of one number."""

    name: str
    unit: str
    good: float
    bad: float  # infinite: never bad by this alone
    at_least: bool = False  # more is better

    def exceeded(self, value: float, limit: float) -> bool:
        """Whether a value lies on the wrong side; NaN always does."""
        return not (value >= limit if self.at_least else value <= limit)


GATES: dict[str, Gate] = {
    gate.name: gate
    for gate in (
        # A depth camera at 2 m sees surfaces within 5 mm after averaging, and 0.15 degrees are 5 mm there; refinement
        # by depth can mend 12 mm and 0.6 degrees, not much more.
        Gate("camera position sigma", "mm", 5.0, 20.0),
        Gate("camera rotation sigma", "deg", 0.2, 1.0),
        # Good corners lie within 0.1 px, imperfect lenses and prints within one; beyond three something is wrong.
        Gate("reprojection", "px", 1.0, 3.0),
        # Fits of edges promise 0.02 to 0.1 px. Real lenses and prints make that five times worse, a wrong map or wrong
        # intrinsics ten and more times.
        Gate("residual scale", "times the corners' sigma", 6.0, 30.0),
        Gate("held-out reprojection", "px", 1.0, 4.0),
        # Printers and rulers are good for half a percent; five percent is a wrong marker size.
        Gate("length scale error", "percent", 0.5, 3.0),
        Gate("length error", "mm", 3.0, 15.0),
        # Stereo depth of one camera is off by a percent, the mean of several by less; beyond four it is the map.
        Gate("scale against depth", "percent", 2.0, 4.0),
        # Its poses may still be right: depth took no part in them.
        Gate("cameras whose depth contradicts the others", "", 0.0, math.inf),
        # Rays of one corner, from cameras that are right, meet as well as corners are found.
        Gate("ray miss", "px", 1.0, 4.0),
        # Half the frames know a pose 1.4 times worse, two halves differ 1.4 times more, and so do two cameras: with the
        # worst pair of several four times the sigma limits.
        Gate("split-half position", "mm", 20.0, 80.0),
        Gate("split-half rotation", "deg", 0.8, 4.0),
        # Mean of one for a pair. Of a dozen pairs one in a thousand passes four; real residuals repeat and have tails,
        # so twice that. At a hundred the sigmas are wrong by ten.
        Gate("split-half over covariance", "", 8.0, 100.0),
        Gate("early-late position", "mm", 20.0, 80.0),
        Gate("early-late rotation", "deg", 0.8, 4.0),
        # Lens errors differ with the place of the target, which wanders in time: more is allowed than between frames
        # that alternate.
        Gate("early-late over covariance", "", 25.0, 400.0),
        # Two exchanged frames of 25 are an accident; a third of a camera's views is its rule.
        Gate("rejected views", "percent", 15.0, 60.0),
        # The pose is that of one part of the recording, and nobody knows which part is true now.
        Gate("cameras moved while recorded", "", 0.0, 0.0),
        # They carry the world: one that has moved bends everything that is tied to it.
        Gate("kept cameras that no longer fit", "", 0.0, 0.0),
        # New cameras are off by as much. Two good calibrations of a rig differ by a few tenths of a millimetre, which
        # harms nobody; at 10 mm a depth camera's surfaces, known to 5 mm, fall apart into two.
        Gate("kept cameras displaced", "mm", 1.0, 10.0),
        # The adjustment resolves ambiguous views by others, as long as there are others.
        Gate("ambiguous views", "percent", 90.0, math.inf),
        # Corners of markers that lie five times as far off as others show a map that is wrong there.
        Gate("odd markers", "", 0.0, math.inf),
        # One view hides its own errors. Five of a moved target leave three times more residuals than unknowns.
        Gate("views of a camera", "", 5.0, 1.0, at_least=True),
        Gate("views of a camera, target at rest", "", 2.0, 1.0, at_least=True),
        # The same for places, which frames only repeat.
        Gate("places of the target", "", 5.0, 1.0, at_least=True),
        Gate("frames of the weakest link", "", 5.0, 1.0, at_least=True),
        Gate("cameras placed", "percent", 100.0, 50.0, at_least=True),
        Gate("cameras checked independently", "percent", 100.0, 0.0, at_least=True),
        # Patterns says what is worth a word: 10 mm at 2 m. Twice that is as far off as a bad sigma.
        Gate("residual pattern", "times what is tolerable", 1.0, 2.0),
        # What motion adds to a view. Half a pixel in all directions averages out over frames; 2.9 px in a real
        # recording put cameras 20 mm off.
        Gate("frames taken apart", "px", 0.5, 2.0),
        # Intrinsics of another resolution, lens or camera are off by two percent and more: that must not stay hidden.
        # Good ones, off by less than half a percent, do not show and need not.
        Gate("focal length error noticed", "percent", 2.0, math.inf),
        # A target held askew tilts the world by as much; nothing in the images tells.
        Gate("up from one frame only", "", 0.0, math.inf),
        # Accelerometers that nobody calibrated are within one degree, a target on a floor within half of one. At three
        # degrees the far end of a room of 5 m is off by 26 cm.
        Gate("up by accelerometers", "deg", 1.5, 3.0),
        # One of them may be the odd one; if it is the pose, other checks see it too.
        Gate("cameras whose accelerometer contradicts the others", "", 0.0, math.inf),
        # A target on a table has cameras below it; cameras in a mirrored world, or one upside down, stand deeper.
        Gate("camera below the target", "m", 0.5, 1.5),
    )
}


# What bends a calibration is told before what that looks like.
CAUSES = frozenset({"frames taken apart", "residual pattern", "kept cameras displaced"})


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """One measured number, what it was measured on, and what to do when it is too large."""

    gate: str
    value: float
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """All that was measured of a calibration."""

    readings: Sequence[Reading]
    cameras: Sequence[str]  # with a pose
    lost: Mapping[str, str]  # camera -> why it has no pose
    checked: frozenset[str]  # cameras that an independent check looked at
    to_get_checked: str  # what to record so that the others are
    pattern: Pattern | None = None
    remarks: Sequence[str] = field(default_factory=tuple)  # said with every verdict


def judge(measured: Measured) -> Quality:
    """The verdict over all numbers; a pure function of them."""
    readings = [*measured.readings, *_about_the_whole(measured)]
    checks, reasons = [], []
    worst: Verdict = "good"
    # A cause is told before its symptoms, then what makes it bad.
    for reading in sorted(readings, key=lambda r: (r.gate not in CAUSES, not _is_bad(r))):
        gate = GATES[reading.gate]
        failed = gate.exceeded(reading.value, gate.good)
        if failed:
            reasons.append(reading.sentence)
            worst = "bad" if worst == "bad" or _is_bad(reading) else "usable"
    for reading in readings:
        gate = GATES[reading.gate]
        passed = not gate.exceeded(reading.value, gate.good)
        checks.append(Check(gate.name, float(reading.value), gate.unit, gate.good, passed))
    return Quality(worst, (*dict.fromkeys(reasons), *measured.remarks), tuple(checks))


def _is_bad(reading: Reading) -> bool:
    gate = GATES[reading.gate]
    return math.isfinite(gate.bad) and gate.exceeded(reading.value, gate.bad)


def _about_the_whole(measured: Measured) -> Iterator[Reading]:
    n, lost = len(measured.cameras), measured.lost
    yield Reading(
        gate="cameras placed",
        value=100.0 * n / max(n + len(lost), 1),
        sentence="Without a pose: " + "; ".join(f"camera {name} ({why})" for name, why in lost.items()) + ".",
    )
    unchecked = [name for name in measured.cameras if name not in measured.checked]
    yield Reading(
        gate="cameras checked independently",
        value=100.0 * (n - len(unchecked)) / max(n, 1),
        sentence=f"Nothing independent checks {_named(unchecked)}: {measured.to_get_checked}.",
    )
    yield Reading(
        gate="residual pattern",
        value=0.0 if measured.pattern is None else measured.pattern.size,
        sentence="" if measured.pattern is None else measured.pattern.sentence,
    )


def _named(cameras: Sequence[str]) -> str:
    return f"camera{'s' * (len(cameras) > 1)} {', '.join(cameras)}"
