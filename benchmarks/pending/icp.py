"""Registration of clouds from rough and good poses, with biased depth and unbiased, beside the plain recipe.

Four cameras; a rough start is 0.6 degrees and 12 mm a camera, a good one 0.03 degrees and 2 mm (standard deviations
about and along each axis); biased depth is wrong by 0.3 percent and 0.15 px (standard deviations).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.icp_outcomes import PLAIN, Outcome, direct_outcomes, outcomes, plain_outcomes, spread
from benchmarks.metric import Metric

# Limits and priors of the registration were chosen on other rigs.
FRESH = range(60, 70)
# Of these, by other ways than the command's, of which nothing is promised.
EVERY = 3
# Median over rigs of the median error of relative poses [mm].
LIMITS = {("rough", False): 6.0, ("rough", True): 10.0, ("good", False): 4.5, ("good", True): 6.0}
# A rig is harmed when its median pair error grows by more than either.
HARM_SHARE, HARM_MM = 0.05, 1.0
WAYS = {
    "known": "levelled, then registered, with covariances",
    "unknown": "levelled, then registered, without covariances",
    "direct": "registered without levelling, with covariances",
    "plain": "the plain recipe, point to plane",
    "plain_gicp": "the plain recipe, GICP",
}
# What the command does.
OURS = ("known", "unknown")


def run(*, quick: bool) -> list[Metric]:
    seeds = FRESH[:2] if quick else FRESH
    ours, direct, plain = (
        [outcome for found in spread(measure, seeds[::every]) for outcome in found]
        for measure, every in ((outcomes, 1), (direct_outcomes, EVERY), (plain_outcomes, EVERY))
    )
    metrics: list[Metric] = []
    for (start, biased), limit in LIMITS.items():
        mine, raw, theirs = (
            [o for o in found if (o.start, o.biased) == (start, biased)] for found in (ours, direct, plain)
        )
        case = _Case(
            key=f"{start}.{'biased' if biased else 'unbiased'}",
            about=f"{start} start, {'biased' if biased else 'unbiased'} depth",
        )
        metrics += [
            case.shown("start", [o.before_mm for o in mine], "as given"),
            case.shown("promised", [o.promised_mm for o in mine], "as given poses and information of pairs promise"),
            *(case.limited(way, [o.after_mm[way] for o in mine], limit) for way in OURS),
            case.shown("direct", [o.after_mm["direct"] for o in raw], WAYS["direct"]),
            *(case.shown(way, [o.after_mm[way] for o in theirs], WAYS[way]) for way in PLAIN),
        ]
    return [*metrics, *(metric for way in OURS for metric in _harm(ours, way)), _seconds(ours)]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Case:
    """Rigs of one start and one kind of depth."""

    key: str
    about: str

    def shown(self, way: str, errors_mm: list[float], about: str) -> Metric:
        """A figure that is shown beside others."""
        about = f"median pair error, {about}; {len(errors_mm)} rigs, {self.about}"
        return Metric(
            key=f"{self.key}.{way}_mm", value=float(np.median(errors_mm)), unit="mm", about=about, rel_tol=None
        )

    def limited(self, way: str, errors_mm: list[float], limit: float) -> Metric:
        """A figure that is promised."""
        return replace(self.shown(way, errors_mm, WAYS[way]), limit=limit, rel_tol=0.2)


def _harm(ours: list[Outcome], way: str) -> Iterator[Metric]:
    about = f"{WAYS[way]}; {len(ours)} rigs and starts"
    yield Metric(
        key=f"all.{way}.ratio",
        value=float(np.mean([o.after_mm[way] / o.before_mm for o in ours])),
        unit="",
        about=f"mean ratio of pair error after and before, {about}",
        limit=1.0,
        rel_tol=0.1,
    )
    yield Metric(
        key=f"all.{way}.icp_ratio",
        value=float(np.mean([o.after_mm[way] / o.levelled_mm[way] for o in ours])),
        unit="",
        about=f"the same against what levelling has left, {about}",
        limit=1.0,
        rel_tol=0.1,
    )
    given, levelled = [o.before_mm for o in ours], [o.levelled_mm[way] for o in ours]
    for name, what, before_mm in (("harm", "", given), ("icp_harm", "by registration alone, ", levelled)):
        growth = [(o.after_mm[way] - b) / max(HARM_SHARE * b, HARM_MM) for o, b in zip(ours, before_mm)]
        yield Metric(
            key=f"all.{way}.{name}_worst",
            value=max(growth),
            unit="",
            about=f"worst growth of pair error over 5 % or 1 mm, {what}{about}",
            limit=1.0,
            rel_tol=None,
        )
    yield Metric(
        key=f"all.{way}.moved",
        value=float(np.mean([o.moved[way] for o in ours])),
        unit="cameras",
        about=f"moved by registration, of four, mean; {about}",
        rel_tol=None,
    )


def _seconds(ours: list[Outcome]) -> Metric:
    return Metric(
        key="all.seconds",
        value=float(np.median([o.seconds["known"] for o in ours])),
        unit="s",
        about="levelling and registering four cameras of 1280 x 720, one core, another rig on the other; median",
        rel_tol=None,
        machine=True,
    )
