"""A command in a process of its own: how long it ran and how much memory it held.

Owns      starting, timing and weighing a child.
Leaves    which command, and what its output means, to the suite.

The measuring process is this very file, run as a script that imports the standard library only: Linux counts the
memory of the process that started a child to the child's peak, so a large parent would hide a small child.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Numpy's and OpenMP's threads, which have to be told before they are loaded.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Ran:
    """What a child did."""

    wall_s: float
    peak_mb: float  # most memory it held at once, 1e6 bytes
    output: str


def run_child(command: Sequence[str], *, cores: int = 0, env: Mapping[str, str] | None = None) -> Ran:
    """Run Python with some arguments, from the project's root.

    Args:
        command: Arguments of Python, for instance ``["-m", "rigcal", "demo"]``.
        cores: How many cores it may use, where the system can limit that; 0: all.
        env: Variables on top of this process's own.

    Raises:
        RuntimeError: It failed; the message holds what it wrote.
    """
    measuring = [sys.executable, "-I", "-S", __file__, str(cores), sys.executable, *command]
    done = subprocess.run(measuring, cwd=ROOT, env={**os.environ, **(env or {})}, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    output, _, figures = done.stdout.rstrip("\n").rpartition("\n")
    return Ran(output=output.rstrip("\n"), **json.loads(figures))


def _measure(cores: int, command: Sequence[str]) -> int:
    """Run a command, and add a line of figures to its output; its exit code."""
    import resource  # not on Windows, where these benchmarks do not run

    if cores and sys.platform == "linux":
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    start = time.perf_counter()
    code = subprocess.run(command).returncode
    wall_s = time.perf_counter() - start
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, in bytes
    peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * unit / 1e6
    sys.stdout.write("\n" + json.dumps({"wall_s": wall_s, "peak_mb": peak_mb}) + "\n")
    return code


if __name__ == "__main__":
    raise SystemExit(_measure(int(sys.argv[1]), sys.argv[2:]))
