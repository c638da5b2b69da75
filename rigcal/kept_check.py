"""Whether kept cameras still stand where their file puts them: where do the views put them, if they may say so?

Owns      placing the rig with a single kept camera held, comparing the others with the file, naming who disagrees.
Leaves    what a disagreement costs to rigcal.quality.gates, what is done about it to pipeline.

Kept cameras that contradict each other bend everything between them, and what is left looks like noise. So before they
are held, all but one are set free, and the file and the views are compared camera by camera. Where more than half agree
with each other, the others are displaced; of two that disagree nobody knows which it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
from loguru import logger

from aruco.errors import CalibrationError
from aruco.pose_math import Array, Pose, invert_transform, log_se3, pose_distance, transform_points
from aruco.uncertainty import carried
from rigcal.evidence import Evidence
from rigcal.kept import KeptRig
from rigcal.placing import adjust_placed, place_with_target
from rigcal.quality.gates import GATES
from rigcal.solve.joint import JointRig

# Squared distance over what the covariances promise, over six: one on average. Cameras that nobody moved stay below 3
# in simulated rigs whose frames err by up to 0.3 px, and below 6 in halves of real recordings, whose errors differ with
# the place of the target. With corners good to 0.05 px, a camera that stands 3 mm elsewhere is at 36 and more.
MAX_OVER_COVARIANCE = 12.0
# A file that does not say how good it is may be worse than the views: its sigmas count as so many times theirs.
UNKNOWN_SIGMA = 2.0
# Two calibrations that are both right differ by less, for reasons that no covariance knows.
HARMLESS_M = 1e-3 * GATES["kept cameras displaced"].good
# One or two views of a camera cannot be told from wrong ones.
MIN_VIEWS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Contradiction:
    """Kept cameras that do not stand to each other as their file says."""

    file: str
    cameras: tuple[str, ...]  # displaced if it is one; of several nobody knows which
    shift_m: float  # of several: of the pair that differs most
    turn_rad: float
    size_m: float  # how far the camera, or what it sees of the target, is displaced: the larger of both

    @property
    def is_known(self) -> bool:
        """Whether it is known which camera is displaced."""
        return len(self.cameras) == 1

    @property
    def summary(self) -> str:
        """Who, and how far."""
        far = f"{1e3 * self.shift_m:.1f} mm and {math.degrees(self.turn_rad):.2f} degrees"
        if self.is_known:
            return f"the other cameras of {self.file} put it {far} from where that file has it"
        names = f"{', '.join(self.cameras[:-1])} and {self.cameras[-1]}"
        return f"cameras {names} of {self.file} contradict each other by {far}"

    @property
    def sentence(self) -> str:
        """The same, and what to do."""
        if self.is_known:
            return (
                f"Camera {self.cameras[0]} is displaced: {self.summary}. It was moved since, or its intrinsics or its "
                "clock are not those of then, and nothing was tied to it; take it out of that file and run again, "
                "which places it anew."
            )
        return (
            f"{self.summary[0].upper()}{self.summary[1:]}: one of them was moved since; find out which, take it out of "
            "that file and run again, which places it anew."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptCheck:
    """What a recording says about the cameras that are to stay."""

    compared: tuple[str, ...] = ()  # with at least one other
    contradictions: tuple[Contradiction, ...] = ()

    @property
    def displaced(self) -> dict[str, str]:
        """Cameras that are known to stand elsewhere, and where."""
        return {c.cameras[0]: c.summary for c in self.contradictions if c.is_known}

    @property
    def doubtful(self) -> dict[str, str]:
        """Cameras of which one at least stands elsewhere, and who contradicts whom."""
        return {name: c.summary for c in self.contradictions if not c.is_known for name in c.cameras}

    def as_dict(self) -> dict[str, Any]:
        """For the file."""
        return {
            "compared": list(self.compared),
            "contradictions": [
                {"cameras": list(c.cameras), "mm": 1e3 * c.shift_m, "deg": math.degrees(c.turn_rad)}
                for c in self.contradictions
            ],
        }


NOTHING_COMPARED = KeptCheck()


def compare_kept(evidence: Evidence, kept: KeptRig) -> KeptCheck:
    """Kept cameras compared with where the views put them, group by group as far as views tie them to each other."""
    waiting = {name: len(s.views) for name, s in sorted(evidence.seen.items()) if name in kept.T_world_cam and s.views}
    compared: list[str] = []
    contradictions: list[Contradiction] = []
    while len(waiting) > 1:
        anchor = max(waiting, key=lambda name: waiting[name])
        rig = _with_one_held(evidence, kept.only({anchor}))
        least = MIN_VIEWS if evidence.config.target_moves else 1
        placed = {} if rig is None else rig.rig.cameras
        group = [name for name in waiting if name in placed and len(placed[name].frames) >= least]
        waiting = {name: n for name, n in waiting.items() if name not in {*group, anchor}}
        if rig is not None and len(group) > 1:
            compared += group
            contradictions += _contradictions(group, _differences(rig, kept, group), kept.file)
    return KeptCheck(compared=tuple(compared), contradictions=tuple(contradictions))


def _with_one_held(evidence: Evidence, anchor: KeptRig) -> JointRig | None:
    """The rig adjusted with a single kept camera held; None where that fails."""
    try:
        evidence, (average, *_), _ = place_with_target(evidence, anchor)
        return adjust_placed(average, evidence, anchor)
    except CalibrationError as error:
        logger.debug("kept cameras cannot be compared: {}", error)
        return None


@dataclass(frozen=True, slots=True)
class _Difference:
    """Where the file puts a camera and where the views do, if another camera stands where the file puts it."""

    shift_m: float
    turn_rad: float
    size_m: float
    over_covariance: float

    @property
    def is_real(self) -> bool:
        return self.over_covariance > MAX_OVER_COVARIANCE and self.size_m > HARMLESS_M


def _differences(rig: JointRig, kept: KeptRig, names: Sequence[str]) -> dict[tuple[str, str], _Difference]:
    """(camera, reference) -> how they differ."""
    return {pair: _differ(rig, kept, *pair) for pair in permutations(names, 2)}


def _differ(rig: JointRig, kept: KeptRig, name: str, reference: str) -> _Difference:
    to_file = kept.T_world_cam[reference] @ invert_transform(rig.rig.cameras[reference].T_world_cam)
    T_seen: Pose = to_file @ rig.rig.cameras[name].T_world_cam
    T_file = kept.T_world_cam[name]
    D = T_file @ invert_transform(T_seen)
    xi, covariance = log_se3(D), _covariance(rig, kept, name, reference, to_file)
    middle = np.mean([(to_file @ T)[:3, 3] for T in rig.rig.T_world_target.values()], axis=0)
    turn, shift = pose_distance(T_seen, T_file)
    return _Difference(
        shift_m=shift,
        turn_rad=turn,
        size_m=max(shift, float(np.linalg.norm(transform_points(D, middle) - middle))),
        over_covariance=float(xi @ np.linalg.pinv(covariance, rcond=1e-14, hermitian=True) @ xi) / 6,
    )


def _covariance(rig: JointRig, kept: KeptRig, name: str, reference: str, to_file: Pose) -> Array:
    """(6, 6) of a difference, in the file's world: that of the views and that of the file."""
    both = (name, reference)
    apart = sum(rig.covariance[n] for n in both) - rig.common[name, reference] - rig.common[reference, name]
    seen = carried(apart, to_file)
    # What both cameras of the file have in common, it does not say: their sum is too large rather than too small.
    known = all(n in kept.covariance for n in both)
    return seen + (sum(kept.covariance[n] for n in both) if known else UNKNOWN_SIGMA**2 * seen)


def _contradictions(
    group: Sequence[str], differences: Mapping[tuple[str, str], _Difference], file: str
) -> Iterator[Contradiction]:
    """Who disagrees: the minority, if more than half agree with each other and no other half does, or all that do."""
    apart = {(i, j) for i, j in permutations(group, 2) if differences[i, j].is_real or differences[j, i].is_real}
    if not apart:
        return
    agreeing = {r: tuple(i for i in group if (i, r) not in apart) for r in group}
    united = {names for names in agreeing.values() if apart.isdisjoint(permutations(names, 2))}
    majorities = [names for names in united if 2 * len(names) > len(group)]
    if len(majorities) == 1:
        reference = next(r for r in group if agreeing[r] == majorities[0])
        for name in (n for n in group if n not in majorities[0]):
            yield _told(file, (name,), differences[name, reference])
    else:
        worst = max((differences[pair] for pair in sorted(apart)), key=lambda d: d.size_m)
        yield _told(file, tuple(name for name in group if any(name in pair for pair in apart)), worst)


def _told(file: str, cameras: tuple[str, ...], d: _Difference) -> Contradiction:
    return Contradiction(file=file, cameras=cameras, shift_m=d.shift_m, turn_rad=d.turn_rad, size_m=d.size_m)
