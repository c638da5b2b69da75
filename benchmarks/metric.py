"""One measured number, and what counts as worse.

Owns      Metric, Skipped, and the judgement of a metric against its limit and its baseline.
Leaves    measuring to the suite, keeping figures to baseline.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Better = Literal["lower", "higher"]


class Skipped(Exception):  # noqa: N818 (not an error: the benchmark cannot run here, and says why)
    """A benchmark that cannot run here, for instance because a recording is not there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Metric:
    """One benchmarked number.

    A limit is a promise and holds on any machine. The baseline is what was measured last: a metric that is worse by
    more than its tolerance has regressed. A metric without ``rel_tol`` is shown beside others and never regresses.
    """

    key: str  # within its benchmark until the runner puts the benchmark's name in front: "corners.clean.median_px"
    value: float
    unit: str
    about: str  # one line for the table
    better: Better = "lower"
    limit: float | None = None
    rel_tol: float | None = 0.10  # share of the baseline
    abs_tol: float = 0.0  # in the metric's unit, for numbers near zero; the larger of both counts
    machine: bool = False  # depends on the machine and on what else it does

    def breaks_limit(self) -> bool:
        """Whether the number is beyond its limit, or is no number."""
        return not math.isfinite(self.value) or (self.limit is not None and self._is_worse(self.limit, 0.0))

    def worse_than(self, baseline: Metric) -> bool:
        """Whether the number has become worse than a baseline's by more than the tolerance, or is no number."""
        if not math.isfinite(self.value):
            return True
        if self.rel_tol is None:
            return False
        return self._is_worse(baseline.value, max(abs(baseline.value) * self.rel_tol, self.abs_tol))

    def _is_worse(self, than: float, slack: float) -> bool:
        change = self.value - than
        return (change if self.better == "lower" else -change) > slack


def faults(measured: list[Metric], baseline: dict[str, Metric] | None) -> dict[str, str]:
    """What is wrong, by key: limits broken, regressions, and figures that are no longer measured.

    Args:
        measured: What some benchmarks gave.
        baseline: The committed figures of the same benchmarks by key; None: judge limits only.

    Returns:
        Key -> sentence; empty when all is well. A figure without a baseline is judged by its limit only.
    """
    found: dict[str, str] = {}
    for metric in measured:
        before = (baseline or {}).get(metric.key)
        if metric.breaks_limit():
            limit = "not a finite number" if metric.limit is None else f"limit {metric.limit:g}"
            found[metric.key] = f"{metric.value:.4g} {metric.unit}, {limit}"
        elif before is not None and metric.worse_than(before):
            found[metric.key] = f"{metric.value:.4g} {metric.unit}, was {before.value:.4g}"
    gone = set(baseline or {}) - {metric.key for metric in measured}
    return found | dict.fromkeys(sorted(gone), "in the baseline, but no longer measured")
