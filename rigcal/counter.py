"""Counting what several threads have finished.

Owns      the number, telling it, the word that ends the work early.
Leaves    showing it to whoever listens.
"""

from __future__ import annotations

import threading

from aruco.model import Progress


class Counter:
    """Counts finished units of one step over threads, and tells them when to stop."""

    def __init__(self, progress: Progress, step: str, total: int) -> None:
        """Start at zero of ``total`` units."""
        self._progress, self._step, self._total, self._done = progress, step, total, 0
        self._lock = threading.Lock()
        self.stopped = False

    def tick(self) -> None:
        """One more is finished."""
        with self._lock:
            self._done += 1
            self._progress.step(self._step, self._done, self._total)
