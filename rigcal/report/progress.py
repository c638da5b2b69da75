"""How far a long step has come: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from aruco.model import Progress

# A line now and then tells a log file that the run is alive, without filling it.
SECONDS_BETWEEN_LINES = 5.0


class _Lines:
    """Plain lines with rate and time left."""

    def __init__(self) -> None:
        self._name = ""
        self._start = self._last = 0.0

    def step(self, name: str, done: int, total: int) -> None:
        now = time.monotonic()
        if name != self._name:
            self._name, self._start, self._last = name, now, now
        if done < total and now - self._last < SECONDS_BETWEEN_LINES:
            return
        self._last = now
        rate = done / max(now - self._start, 1e-9)
        left = f", {(total - done) / rate:.0f} s left" if done < total else ""
        sys.stderr.write(f"{name}: {done} of {total} ({rate:.1f} a second{left})\n")
        sys.stderr.flush()


@contextmanager
def showing_progress() -> Iterator[Progress]:
    """A Progress that draws a bar with rate and time left on a terminal, and writes plain lines elsewhere."""
    if not sys.stderr.isatty():
        yield _Lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Bar(*columns, console=Console(stderr=True)) as bar:
        yield _OnBar(bar)


class _OnBar:
    def __init__(self, bar: object) -> None:
        self._bar = bar
        self._tasks: dict[str, object] = {}
        self._start: dict[str, float] = {}

    def step(self, name: str, done: int, total: int) -> None:
        from rich.progress import Progress as Bar

        bar = self._bar
        assert isinstance(bar, Bar)
        if name not in self._tasks:
            self._tasks[name] = bar.add_task(name, total=total, rate="")
            self._start[name] = time.monotonic()
        rate = done / max(time.monotonic() - self._start[name], 1e-9)
        bar.update(self._tasks[name], completed=done, total=total, rate=f"{rate:.1f} a second")  # pyright: ignore
