"""A folder of text files that appears whole or not at all.

Owns      writing beside the goal and renaming, replacing an earlier folder of the same files and nothing else.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from aruco.errors import OutputError


def write_folder(out: Path, files: Mapping[str, str]) -> None:
    """Write a folder of text files (name -> content).

    Raises:
        OutputError: It holds anything besides files of these names, or cannot be written.
    """
    goal = out.resolve()
    part, old = goal.with_name(goal.name + ".part"), goal.with_name(goal.name + ".old")
    try:
        _refuse_strangers(goal, out, files)
        if part.exists() or old.exists():
            raise OutputError(
                f"{part if part.exists() else old}: is left from an interrupted run, or another one is writing it; "
                "remove it."
            )
        if not goal.parent.is_dir():
            raise OutputError(f"{out}: the folder {goal.parent} does not exist; create it or choose another place.")
        part.mkdir()
        try:
            for name, text in files.items():
                (part / name).write_text(text, encoding="utf-8", newline="\n")
            if goal.exists():
                goal.rename(old)
            part.rename(goal)
        except BaseException:
            if old.exists() and not goal.exists():
                old.rename(goal)
            raise
        finally:
            shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror or error}); choose another place.") from error


def _refuse_strangers(goal: Path, out: Path, files: Mapping[str, str]) -> None:
    if goal.exists() and not goal.is_dir():
        raise OutputError(f"{out}: is a file, and this format is a folder; choose another name.")
    strangers = sorted(path.name for path in goal.iterdir() if path.name not in files) if goal.exists() else []
    if strangers:
        raise OutputError(f"{out}: holds {strangers[0]}, which is not of this format; choose an empty folder.")
