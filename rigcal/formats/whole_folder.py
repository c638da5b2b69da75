"""A folder of text files that appears whole or not at all.

Owns      writing beside the goal and renaming, replacing a folder that was written here before and nothing else.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from aruco.errors import OutputError


def write_folder(out: Path, files: Mapping[str, str], *, mark: str) -> None:
    """Write a folder of text files (name -> content).

    Args:
        out: The folder. One that is there is replaced if it holds no other files, and ``mark`` is unchanged in it.
        files: What to write.
        mark: The file whose content nobody else writes.

    Raises:
        OutputError: The folder is another's, or cannot be written.
    """
    goal = out.resolve()
    part, old = goal.with_name(goal.name + ".part"), goal.with_name(goal.name + ".old")
    try:
        _refuse_another(goal, out, files, mark)
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


def _refuse_another(goal: Path, out: Path, files: Mapping[str, str], mark: str) -> None:
    if goal.exists() and not goal.is_dir():
        raise OutputError(f"{out}: is a file, and this format is a folder; choose another name.")
    there = sorted(path.name for path in goal.iterdir()) if goal.exists() else []
    if strangers := [name for name in there if name not in files]:
        raise OutputError(f"{out}: holds {strangers[0]}, which is not of this format; choose an empty folder.")
    if there and not _holds(goal / mark, files[mark]):
        raise OutputError(f"{out}: holds {there[0]}, which was not written here; choose an empty folder.")


def _holds(path: Path, text: str) -> bool:
    wanted = text.encode()
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(wanted) + 1) == wanted
