#!/usr/bin/env python
"""Repeat the project's figures: measure, compare with the limits and the committed baseline, exit 1 if worse.

Owns      the command line, finding the benchmarks, the report of a run.
Leaves    measuring to the modules of suite: a new file there is a new benchmark.
"""

from __future__ import annotations

import pkgutil
import time
from dataclasses import replace
from importlib import import_module

import click
from loguru import logger

from benchmarks import baseline, suite
from benchmarks.metric import Metric, Skipped, faults

NAMES = sorted(module.name for module in pkgutil.iter_modules(suite.__path__))


@click.command(context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]})
@click.argument("names", metavar="[NAME]...", nargs=-1, type=click.Choice(NAMES))
@click.option("--quick", is_flag=True, help="Fewer rigs, images and repeats; only limits are judged.")
@click.option(
    "--update-baseline", is_flag=True, help="Make what was measured the baseline, but no benchmark that breaks a limit."
)
@click.option("--compare/--no-compare", default=True, show_default=True, help="Judge against the baseline too.")
def main(names: tuple[str, ...], quick: bool, update_baseline: bool, compare: bool) -> None:
    """Measure the benchmarks NAME (default: all) and fail when a figure is worse than it was or may be."""
    if quick and update_baseline:
        raise click.UsageError("--quick measures less than the baseline holds; leave out one of the two")
    logger.remove()  # the figures are what a run has to say
    committed = baseline.load()
    measured: list[Metric] = []
    judged: dict[str, Metric] | None = {} if compare and not (quick or update_baseline) else None
    for name in names or NAMES:
        try:
            found = _measure(name, quick)
        except Skipped as reason:
            click.echo(f"{name}: skipped: {reason}\n")
            continue
        before = {key: metric for key, metric in committed.items() if baseline.benchmark_of(key) == name}
        _show(found, before)
        measured += found
        if judged is not None:
            judged |= before
    wrong = faults(measured, judged)
    for key, sentence in wrong.items():
        click.echo(f"WORSE {key}: {sentence}", err=True)
    if update_baseline:
        broken = {baseline.benchmark_of(key) for key in wrong}
        good = [metric for metric in measured if baseline.benchmark_of(metric.key) not in broken]
        baseline.save(baseline.updated(committed, good))
        click.echo(
            f"Wrote {len(good)} figures to the baseline and its table; left as they were: {sorted(broken) or 'none'}."
        )
    raise SystemExit(1 if wrong else 0)


def _measure(name: str, quick: bool) -> list[Metric]:
    module = import_module(f"benchmarks.suite.{name}")
    click.echo(f"{name}: {(module.__doc__ or '').strip().splitlines()[0]}")
    start = time.perf_counter()
    found = [replace(metric, key=f"{name}.{metric.key}") for metric in module.run(quick=quick)]
    click.echo(f"  measured in {time.perf_counter() - start:.0f} s")
    return found


def _show(measured: list[Metric], before: dict[str, Metric]) -> None:
    click.echo(f"  {'figure':44} {'now':>9} {'baseline':>9} {'limit':>7}  unit")
    for metric in measured:
        was = f"{before[metric.key].value:.4g}" if metric.key in before else "new"
        limit = "" if metric.limit is None else f"{metric.limit:g}"
        note = "  (depends on the machine)" if metric.machine else ""
        click.echo(f"  {metric.key:44} {metric.value:9.4g} {was:>9} {limit:>7}  {metric.unit}{note}")
    click.echo()


if __name__ == "__main__":
    main()
