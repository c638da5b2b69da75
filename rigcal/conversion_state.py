"""A conversion that was interrupted: what is known about it, and whether another run may go on with it.

Owns      the state file in the folder of unfinished frames, keeping a second run out of it.
Leaves    the frames to recording_conversion.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import OutputError
from aruco.model import BadFrame, Camera, Frame, Recording
from rigcal.sources import STATE_FILE
from rigcal.sources.camera_info import dump_camera_info

Indices = Mapping[str, NDArray[np.int64]]  # camera -> ascending indices of frames

# What a system answers where somebody else has the lock; some file systems have none at all.
_HELD = frozenset([errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES])


def state_of(recording: Recording, wanted: Indices, options: Mapping[str, Any]) -> dict[str, Any]:
    """What tells one conversion from another, as JSON can hold it.

    Args:
        recording: What is converted.
        wanted: Which frames of it.
        options: What else makes a difference; keys are named like the command's options.
    """
    cameras = {camera.name: _fingerprint(recording, camera, wanted[camera.name]) for camera in recording.cameras}
    return {"format": "rigcal.conversion", "version": 1, "options": dict(options), "cameras": cameras}


def _fingerprint(recording: Recording, camera: Camera, indices: NDArray[np.int64]) -> dict[str, Any]:
    stamps = recording.stamps_ns(camera.name)
    return {
        "camera_info": hashlib.sha256(dump_camera_info(camera).encode()).hexdigest(),
        "frames": len(indices),
        "stamps": hashlib.sha256(stamps[indices].astype("<i8").tobytes()).hexdigest(),
        "first": _digest(next(iter(recording.frames(camera.name, indices[:1].tolist())), None)),
    }


def _digest(frame: Frame | BadFrame | None) -> str:
    if not isinstance(frame, Frame):
        return ""
    return frame.digest or hashlib.sha256(frame.image.tobytes()).hexdigest()


@contextmanager
def held(part: Path, state: Mapping[str, Any]) -> Iterator[None]:
    """The folder of unfinished frames, for this run alone; it is made where it is not there.

    Raises:
        OutputError: It is of something else, or another run is writing it.
        OSError: It cannot be written.
    """
    with _locked(part) as file:
        known = _known_state(part, file)
        if known is None:
            _begin(part, file, state)
        elif known != state:
            raise OutputError(
                f"{part}: is left from converting something else ({_difference(known, state)}); give the same "
                "recordings and options to go on, remove it, or choose another name."
            )
        if os.name == "nt":  # where a folder with an open file in it is neither renamed nor removed
            file.close()
        yield


def abandon(part: Path) -> None:
    """Remove the folder as far as that goes; its state last, because without one it is a stranger's to the next run."""
    with suppress(OSError):
        for path in part.iterdir():
            if path.is_dir():
                shutil.rmtree(path)
            elif path.name != STATE_FILE:
                path.unlink()
        (part / STATE_FILE).unlink()
        part.rmdir()


@contextmanager
def _locked(part: Path) -> Iterator[IO[bytes]]:
    """The state file of a folder, each made where it is not there, for this process alone until that ends.

    The file itself is locked, so it is never replaced by another: whoever has it open has the same.
    """
    while True:
        _refuse_stranger(part)
        part.mkdir(exist_ok=True)
        try:
            opened = (part / STATE_FILE).open("a+b")
        except FileNotFoundError:  # who held it has just removed the folder
            continue
        with opened as file:
            _lock(part, file)
            if _is_at(part / STATE_FILE, file):
                yield file
                return


def _lock(part: Path, file: IO[bytes]) -> None:
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _HELD:
            raise OutputError(
                f"{part}: another conversion is writing it; wait for that, or choose another name."
            ) from error
        logger.warning(
            "{}: cannot be locked there ({}); see that no other conversion writes it", part, error.strerror or error
        )


def _is_at(path: Path, file: IO[bytes]) -> bool:
    """Whether an open file is still the one at a path: who held it before may have removed or renamed it."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _refuse_stranger(part: Path) -> None:
    """Complain about what is no folder of unfinished frames, before anything is made in it."""
    try:
        left = {path.name for path in part.iterdir()}
    except FileNotFoundError:
        return
    except OSError as error:
        raise _stranger(part) from error
    if left and STATE_FILE not in left:
        raise _stranger(part)


def _stranger(part: Path) -> OutputError:
    return OutputError(f"{part}: is there already and is no unfinished conversion; remove it, or choose another name.")


def _known_state(part: Path, file: IO[bytes]) -> Mapping[str, Any] | None:
    """The state of an earlier run, None where there is none."""
    try:
        file.seek(0)
        found = json.loads(file.read())
    except ValueError as error:
        if {path.name for path in part.iterdir()} == {STATE_FILE}:  # new, or killed before anything was begun
            return None
        raise _stranger(part) from error
    return found if isinstance(found, dict) else {}


def _begin(part: Path, file: IO[bytes], state: Mapping[str, Any]) -> None:
    try:
        file.truncate(0)
        file.write(json.dumps(state, indent=1).encode())
        file.flush()
        os.fsync(file.fileno())  # before any frame, so that frames never lie beside half a state
    except BaseException:
        abandon(part)
        raise


def _difference(known: Mapping[str, Any], state: Mapping[str, Any]) -> str:
    """The first thing in words that two states differ in."""
    for key, value in state["options"].items():
        if (known.get("options") or {}).get(key) != value:
            return f"--{key}" if key != "to" else "another kind of result"
    before, now = known.get("cameras") or {}, state["cameras"]
    if before.keys() != now.keys():
        return f"its cameras are {', '.join(sorted(before)) or 'none'}, not {', '.join(sorted(now))}"
    words = {"camera_info": "other intrinsics", "frames": "another number of frames", "stamps": "other time stamps"}
    for name, about in now.items():
        for key, value in about.items():
            if before[name].get(key) != value:
                return f"camera {name} has {words.get(key, 'other images')}"
    return "by another version of this program"
