"""Any recording to an RGB-D folder or an MCAP file: frame by frame, and what is finished is never lost.

Owns      which frames are converted, going on after an interruption, making the result appear whole.
Leaves    reading to rigcal.sources, writing to rgbd_writer and mcap_writer there.

Frames are kept in ``<out>.part``, a folder, until all are there; a state file in it says what is being converted.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.atomic import write_whole
from aruco.errors import InputError, OutputError
from aruco.model import SILENT, BadFrame, Camera, Frame, KnowsUp, Progress, Recording
from aruco.svo_sync import sample, synchronise
from rigcal.recordings import plain_options
from rigcal.sources import STATE_FILE, UNFINISHED_SUFFIX, open_recordings
from rigcal.sources.camera_info import dump_camera_info
from rigcal.sources.mcap_writer import McapFrames
from rigcal.sources.options import SourceOptions
from rigcal.sources.rgbd_writer import RgbdFrames, refuse_unusable_name

MCAP_SUFFIX = ".mcap"
# Inside <out>.part; its name tells nobody that it is a recording.
GROWING_FILE = "frames"
# Every bad frame after these is counted only.
SPOKEN_BAD_FRAMES = 5

Indices = Mapping[str, NDArray[np.int64]]  # camera -> ascending indices of frames


class _Frames(Protocol):
    """Frames that are being written."""

    def finished(self, camera: str) -> NDArray[np.int64]: ...

    def write(self, frame: Frame) -> None: ...

    def finish(self) -> None: ...

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Converted:
    """What became of a recording's frames."""

    out: Path
    cameras: int
    written: int  # frames, those of earlier runs among them
    kept: int  # of these, those of earlier runs
    bad: int  # frames that could not be read

    @property
    def sentence(self) -> str:
        """What to tell the user."""
        kept = f", {self.kept} of them by an earlier run" if self.kept else ""
        bad = f"; {self.bad} could not be read and were left out" if self.bad else ""
        return f"Wrote {self.written} frames of {self.cameras} cameras to {self.out}{kept}{bad}."


def convert_recording(
    paths: Sequence[Path],
    out: Path,
    *,
    options: SourceOptions | None = None,
    depth: bool | None = None,
    every: int = 1,
    progress: Progress = SILENT,
) -> Converted:
    """Convert recordings of any format into one RGB-D folder, or into one MCAP file where ``out`` ends in .mcap.

    A run that was interrupted leaves ``<out>.part``; the same call goes on from there.

    Args:
        paths: Recordings.
        out: What to make; it must not be there, or be an empty folder.
        options: What readers are told.
        depth: Whether to write depth and confidence; None: where the recording has it.
        every: Of the moments that cameras share, every how many-th; 1: all frames.
        progress: Is told how many frames are done.

    Raises:
        InputError: The recordings cannot be read.
        OutputError: The result cannot be written, or ``<out>.part`` is of something else.
        MissingExtraError: An optional package is not installed.
    """
    _refuse_place(out, paths)
    options = options or plain_options()
    recording = open_recordings(paths, options)
    depth = _wants_depth(recording, depth)
    wanted = _wanted(recording, every)
    part = out.with_name(out.name + UNFINISHED_SUFFIX)
    state = _state(recording, wanted, _options_that_matter(options, out, depth, every))
    _tell_what_is_left_behind(recording)
    try:
        with _held(part, state):
            frames = _frames(recording, part, out, depth)
            converted = _convert(recording, wanted, frames, depth, progress, part)
            _appear(part, out)
    except OSError as error:
        raise OutputError(
            f"{out}: cannot be written ({error.strerror or error}); make room or choose another place (finished frames "
            f"are in {part.name})."
        ) from error
    return replace(converted, out=out)


def _refuse_place(out: Path, paths: Sequence[Path]) -> None:
    from rigcal.cli import refuse_inputs

    refuse_inputs(out, paths, None)
    known = out.suffix.lower() in (MCAP_SUFFIX, "")
    if not known and out.suffix.lower() in (".bag", ".db3", ".svo", ".svo2", ".mp4", ".mkv", ".avi", UNFINISHED_SUFFIX):
        raise OutputError(
            f"{out}: recordings are converted to an RGB-D folder or to an {MCAP_SUFFIX} file; choose such a name."
        )
    if out.exists() and (not out.is_dir() or out.suffix.lower() == MCAP_SUFFIX or any(out.iterdir())):
        raise OutputError(f"{out}: exists already; choose another place or remove it.")


def _wants_depth(recording: Recording, depth: bool | None) -> bool:
    there = any(len(recording.depth_indices(camera.name)) for camera in recording.cameras)
    if depth and not there:
        raise InputError("--depth: no camera of the recording has depth; leave the option out.")
    return there if depth is None else depth


def _wanted(recording: Recording, every: int) -> Indices:
    """The frames to convert; thinned out by moments, so that frames of different cameras still belong together."""
    stamps = {camera.name: recording.stamps_ns(camera.name) for camera in recording.cameras}
    if every == 1:
        return {name: np.arange(len(s)) for name, s in stamps.items()}
    groups = synchronise(stamps)
    if not len(groups.groups):  # cameras that share no moment
        return {name: np.arange(0, len(s), every) for name, s in stamps.items()}
    kept = sample(groups.groups, every)
    return {name: column[column >= 0] for name, column in zip(groups.cameras, kept.T)}


def _tell_what_is_left_behind(recording: Recording) -> None:
    if isinstance(recording, KnowsUp) and any(
        recording.up_in_camera(camera.name) is not None for camera in recording.cameras
    ):
        logger.warning("which way is up, as the cameras measured it, is not converted: keep the recording itself")


# State


def _options_that_matter(options: SourceOptions, out: Path, depth: bool, every: int) -> dict[str, Any]:
    return {
        "to": "mcap" if out.suffix.lower() == MCAP_SUFFIX else "rgbd",
        "every": every,
        "depth": {"mode": options.depth_mode, "stereo": options.stereo_depth} if depth else None,
    }


def _state(recording: Recording, wanted: Indices, options: Mapping[str, Any]) -> dict[str, Any]:
    """What tells one conversion from another."""
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
def _held(part: Path, state: Mapping[str, Any]) -> Iterator[None]:
    """The folder of unfinished frames, for this run alone."""
    known = _known_state(part)
    if known is not None and known != state:
        raise OutputError(
            f"{part}: is left from converting something else ({_difference(known, state)}); give the same recordings "
            "and options to go on, remove it, or choose another name."
        )
    part.mkdir(parents=True, exist_ok=True)
    if known is None:
        write_whole(part / STATE_FILE, json.dumps(state, indent=1).encode())
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


# Frames


def _frames(recording: Recording, part: Path, out: Path, depth: bool) -> _Frames:
    for camera in recording.cameras:
        refuse_unusable_name(camera.name)
    if out.suffix.lower() == MCAP_SUFFIX:
        names = [camera.name for camera in recording.cameras]
        with_depth = {name for name in names if depth and len(recording.depth_indices(name))}
        return McapFrames(part / GROWING_FILE, recording.cameras, with_depth)
    return RgbdFrames(part, recording.cameras)


def _convert(
    recording: Recording, wanted: Indices, frames: _Frames, depth: bool, progress: Progress, part: Path
) -> Converted:
    """Write the frames that are not there yet, in the order of time."""
    missing = _missing(recording, wanted, frames)
    total = sum(map(len, wanted.values()))
    kept = total - sum(map(len, missing.values()))
    if kept:
        logger.info("{}: an earlier run finished {} of {} frames; going on from there", part, kept, total)
    bad = done = 0
    try:
        for frame in _by_time(recording, missing, depth):
            if isinstance(frame, BadFrame):
                bad += 1
                _tell_bad(frame, bad)
            else:
                frames.write(frame)
            done += 1
            progress.step("convert", kept + done, total)
        frames.finish()
    except BaseException:
        frames.close()
        logger.info("{}: {} finished frames are kept; the same command goes on from there", part, kept + done - bad)
        raise
    return Converted(out=part, cameras=len(recording.cameras), written=kept + done - bad, kept=kept, bad=bad)


def _missing(recording: Recording, wanted: Indices, frames: _Frames) -> Indices:
    return {
        name: indices[~np.isin(recording.stamps_ns(name)[indices], frames.finished(name))]
        for name, indices in wanted.items()
    }


def _by_time(recording: Recording, wanted: Indices, depth: bool) -> Iterator[Frame | BadFrame]:
    """Frames of all cameras in the order of their stamps, one at a time: as recorders write, and as players read."""
    streams = {name: recording.frames(name, indices.tolist(), depth=depth) for name, indices in wanted.items()}
    names = list(wanted)
    stamps = np.concatenate([recording.stamps_ns(name)[wanted[name]] for name in names])
    owners = np.repeat(np.arange(len(names)), [len(wanted[name]) for name in names])
    for k in np.argsort(stamps, kind="stable").tolist():
        yield next(streams[names[owners[k]]])


def _tell_bad(frame: BadFrame, count: int) -> None:
    if count <= SPOKEN_BAD_FRAMES:
        logger.warning("camera {}: frame {} is left out: {}", frame.camera, frame.stamp_ns, frame.reason)
    if count == SPOKEN_BAD_FRAMES:
        logger.warning("further frames that cannot be read are counted, not named")


def _appear(part: Path, out: Path) -> None:
    """Make what is finished the result, in one step."""
    if out.suffix.lower() == MCAP_SUFFIX:
        (part / GROWING_FILE).replace(out)
        shutil.rmtree(part, ignore_errors=True)
        return
    if out.exists():
        out.rmdir()
    part.rename(out)
    (out / STATE_FILE).unlink(missing_ok=True)
