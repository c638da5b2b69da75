"""A conversion that was interrupted: what is known about it, and whether another run may go on with it.

Owns      the state file in the folder of unfinished frames, keeping a second run out of it.
Leaves    the frames to recording_conversion.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.atomic import write_whole
from aruco.errors import OutputError
from aruco.model import BadFrame, Camera, Frame, Recording
from rigcal.sources import STATE_FILE
from rigcal.sources.camera_info import dump_camera_info

Indices = Mapping[str, NDArray[np.int64]]  # camera -> ascending indices of frames


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
    """
    known = _known_state(part)
    if known is not None and known != state:
        raise OutputError(
            f"{part}: is left from converting something else ({_difference(known, state)}); give the same recordings "
            "and options to go on, remove it, or choose another name."
        )
    part.mkdir(parents=True, exist_ok=True)
    if known is None:
        try:
            write_whole(part / STATE_FILE, json.dumps(state, indent=1).encode())
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)  # nothing but a state is in it
            raise
    with _locked(part):
        yield


def _known_state(part: Path) -> Mapping[str, Any] | None:
    """The state of an earlier run, None where there is none."""
    if not part.exists():
        return None
    try:
        left = {path.name for path in part.iterdir()}
        if left <= {STATE_FILE + ".part"}:  # killed before anything was begun
            return None
        found = json.loads((part / STATE_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(
            f"{part}: is there already and is no unfinished conversion; remove it, or choose another name."
        ) from error
    return found if isinstance(found, dict) else {}


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


@contextmanager
def _locked(part: Path) -> Iterator[None]:
    """Keep a second run out; the lock goes with the process, however that ends."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    with (part / STATE_FILE).open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise OutputError(f"{part}: another run is writing it; wait for that, or choose another name.") from error
        yield
