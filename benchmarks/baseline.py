"""The committed figures, and the table of them in the README.

Owns      baseline.json and the part of README.md between its markers.
Leaves    judging to metric.

Neither file holds a date, a host or a path: they change only when a figure does.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, replace
from pathlib import Path

from benchmarks.metric import Metric

HERE = Path(__file__).parent
BASELINE, README = HERE / "baseline.json", HERE / "README.md"
BEGIN, END = "<!-- figures -->", "<!-- end -->"
_HEADER = {"format": "rigcal.benchmarks", "version": 1}
_DIGITS = 4  # more would only record noise


def benchmark_of(key: str) -> str:
    """The benchmark that measures a figure."""
    return key.split(".", 1)[0]


def load(path: Path = BASELINE) -> dict[str, Metric]:
    """The committed figures by key; none when there is no file yet."""
    if not path.exists():
        return {}
    document = json.loads(path.read_text(encoding="utf-8"))
    metrics = [Metric(**entry) for entry in document["metrics"]]
    return {metric.key: metric for metric in metrics}


def updated(before: dict[str, Metric], measured: Iterable[Metric]) -> dict[str, Metric]:
    """The figures with those of some benchmarks replaced; all others stay."""
    rounded = [replace(metric, value=float(f"{metric.value:.{_DIGITS}g}")) for metric in measured]
    again = {benchmark_of(metric.key) for metric in rounded}
    kept = {key: metric for key, metric in before.items() if benchmark_of(key) not in again}
    merged = kept | {metric.key: metric for metric in rounded}
    names = sorted({benchmark_of(key) for key in merged})
    # Benchmarks in order of their names, figures in the order in which they were measured.
    return {key: merged[key] for name in names for key in merged if benchmark_of(key) == name}


def save(figures: dict[str, Metric], path: Path = BASELINE, readme: Path = README) -> None:
    """Write the figures, and the README's table of them."""
    document = {**_HEADER, "metrics": [asdict(metric) for metric in figures.values()]}
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    readme.write_text(with_table(readme.read_text(encoding="utf-8"), figures), encoding="utf-8")


def with_table(text: str, figures: dict[str, Metric]) -> str:
    """A page in which the part between the markers is the table of the figures."""
    head, rest = text.split(BEGIN, 1)
    tail = rest.split(END, 1)[1]
    return f"{head}{BEGIN}\n{table(figures)}\n{END}{tail}"


def table(figures: dict[str, Metric]) -> str:
    """A Markdown table, one row a figure."""
    rows = ["| figure | what | measured | limit |", "|---|---|---|---|"]
    for metric in figures.values():
        measured = f"{metric.value:.3g} {metric.unit}".strip() + (" \\*" if metric.machine else "")
        bound = {"lower": "≤", "higher": "≥"}[metric.better]
        limit = "" if metric.limit is None else f"{bound} {metric.limit:g}"
        rows.append(f"| `{metric.key}` | {metric.about} | {measured} | {limit} |")
    return "\n".join(rows)
