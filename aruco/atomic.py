"""Files that appear whole or not at all.

Owns      writing beside the goal and renaming over it, and finding out before the work whether that will succeed.
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import BinaryIO

from aruco.errors import OutputError


def write_whole(path: Path, data: bytes) -> None:
    """Write all of it or nothing: a crash never leaves half a file. A symbolic link keeps pointing to the file.

    A run that is killed while it writes leaves ``<path>.part``.

    Raises:
        OutputError: The file cannot be written.
    """
    write_all_whole({path: data})


def write_all_whole(contents: Mapping[Path, bytes]) -> None:
    """The same for several files: none appears before all are written beside their goals; then in their order.

    Raises:
        OutputError: One cannot be written.
    """
    parts: dict[Path, Path] = {}  # by the files that they become
    path = Path()
    try:
        for path, data in contents.items():
            with _new_part(path, _goal(path)) as stream:
                parts[path] = Path(stream.name)
                stream.write(data)
                stream.flush()
                os.fsync(stream.fileno())
        for path, part in parts.items():
            part.replace(_goal(path))
    except BaseException as error:
        for part in parts.values():
            _try_remove(part)
        if isinstance(error, OSError):
            raise _cannot(path, error) from error
        raise


def check_writable(path: Path, begins: bytes = b"") -> None:
    """Find out whether a file can be written, without touching what is there.

    Args:
        path: The file.
        begins: The first bytes of what will be written: an earlier result begins so too, and may be replaced; what
            begins otherwise is other work of somebody's, mostly a slip. Empty: anything may be replaced.

    Raises:
        OutputError: It cannot, and why.
    """
    goal = _goal(path)
    try:
        if begins and goal.exists() and not _is_alike(goal, begins):
            raise OutputError(
                f"{path}: exists, and is not what an earlier run would have written; remove it or choose another name."
            )
        if _is_there(part_of(goal)):
            raise _in_the_way(part_of(goal))
        # Not that name, which another run may want at this moment, but one as long.
        probe = goal.with_name(f"{goal.name}.{secrets.token_hex(2)}")
        probe.open("xb").close()
    except OSError as error:
        raise _cannot(path, error) from error
    _try_remove(probe)


def _is_alike(goal: Path, begins: bytes) -> bool:
    with goal.open("rb") as stream:
        head = stream.read(64).lstrip()
    return not head or head.startswith(begins)


def part_of(goal: Path) -> Path:
    """What becomes the file when all of it is written."""
    return goal.with_name(goal.name + ".part")


def _new_part(path: Path, goal: Path) -> BinaryIO:
    """The file beside the goal that becomes it; never one that is there, nor what a link of this name points to."""
    part = part_of(goal)
    try:
        return part.open("xb")
    except FileExistsError as error:
        raise _in_the_way(part) from error
    except OSError as error:
        raise _cannot(path, error) from error


def _is_there(path: Path) -> bool:
    """Whether anything has this name, even a link that points nowhere."""
    return path.exists() or path.is_symlink()


def _in_the_way(part: Path) -> OutputError:
    return OutputError(
        f"{part}: is in the way: an interrupted run leaves such a file, or another run is writing it; remove it or "
        "choose another name."
    )


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
