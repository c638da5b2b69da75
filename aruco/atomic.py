"""Files that appear whole or not at all.

Owns      writing beside the goal and renaming over it, and finding out before the work whether that will succeed.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

from aruco.errors import OutputError


def write_whole(path: Path, data: bytes) -> None:
    """Write all of it or nothing: a crash never leaves half a file. A symbolic link keeps pointing to the file.

    A run that is killed while it writes leaves ``<path>.part``.

    Raises:
        OutputError: The file cannot be written.
    """
    goal = _goal(path)
    stream = _new_part(path, goal)
    part = Path(stream.name)
    try:
        with stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(goal)
    except BaseException as error:
        _try_remove(part)
        if isinstance(error, OSError):
            raise _cannot(path, error) from error
        raise


def check_writable(path: Path) -> None:
    """Find out whether a file can be written, without touching what is there.

    Raises:
        OutputError: It cannot, and why.
    """
    probe = _new_part(path, _goal(path))
    probe.close()
    _try_remove(Path(probe.name))


def _new_part(path: Path, goal: Path) -> BinaryIO:
    """The file beside the goal that becomes it; never one that is there, nor what a link of this name points to."""
    part = goal.with_name(goal.name + ".part")
    try:
        return part.open("xb")
    except FileExistsError as error:
        raise OutputError(
            f"{part}: is in the way: an interrupted run leaves such a file, or another run is writing it; remove it or "
            "choose another name."
        ) from error
    except OSError as error:
        raise _cannot(path, error) from error


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
