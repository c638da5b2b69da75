"""Files that appear whole or not at all.

Owns      writing beside the goal and renaming over it, and finding out before the work whether that will succeed.
"""

from __future__ import annotations

import os
from pathlib import Path

from aruco.errors import OutputError


def write_whole(path: Path, data: bytes) -> None:
    """Write all of it or nothing: a crash never leaves half a file. A symbolic link keeps pointing to the file.

    Raises:
        OutputError: The file cannot be written.
    """
    goal = _goal(path)
    part = goal.with_name(goal.name + ".part")
    try:
        with part.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(goal)
    except OSError as error:
        _try_remove(part)
        raise _cannot(path, error) from error


def check_writable(path: Path) -> None:
    """Find out whether a file can be written, without touching what is there.

    Raises:
        OutputError: It cannot, and why.
    """
    goal = _goal(path)
    probe = goal.with_name(goal.name + ".part")
    try:
        probe.open("ab").close()
    except OSError as error:
        raise _cannot(path, error) from error
    _try_remove(probe)


def _goal(path: Path) -> Path:
    """The file behind links; only a regular file may be replaced."""
    try:
        goal = Path(os.path.realpath(path))
        if goal.is_dir():
            raise OutputError(f"{path}: is a folder; give the name of a file.")
        if goal.exists() and not goal.is_file():
            raise OutputError(f"{path}: is a device or a pipe; give the name of a file.")
        if not goal.parent.is_dir():
            raise OutputError(f"{path}: the folder {path.parent} does not exist; create it or choose another place.")
    except OSError as error:
        raise _cannot(path, error) from error
    return goal


def _cannot(path: Path, error: OSError) -> OutputError:
    return OutputError(f"{str(path)[:200]}: cannot be written ({error.strerror or error}); choose another place.")


def _try_remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return
