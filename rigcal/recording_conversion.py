"""Any recording to an RGB-D folder or an MCAP file: frame by frame, and what is finished is never lost.

Owns      what can be converted to where, making the result appear whole, what the user hears.
Leaves    reading to rigcal.sources, writing to rgbd_writer and mcap_writer there, which frames in which order to
          conversion_frames, knowing an interrupted conversion again to conversion_state.

Frames are kept in ``<out>.part``, a folder, until all are there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from loguru import logger

from aruco.errors import InputError, OutputError
from aruco.model import SILENT, BadFrame, KnowsUp, Progress, Recording
from rigcal.conversion_frames import GrowingFrames, by_time, missing_frames, packed_ahead, wanted_frames
from rigcal.conversion_state import Indices, abandon, held, state_of
from rigcal.recordings import plain_options
from rigcal.sources import STATE_FILE, UNFINISHED_SUFFIX, open_recordings
from rigcal.sources.mcap_growing import has_chunk
from rigcal.sources.mcap_writer import McapFrames
from rigcal.sources.options import SourceOptions
from rigcal.sources.rgbd_writer import RgbdFrames, refuse_unusable_name

MCAP_SUFFIX = ".mcap"
# Inside <out>.part; its name tells nobody that it is a recording.
GROWING_FILE = "frames"
# Every bad frame after these is counted only.
SPOKEN_BAD_FRAMES = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Converted:
    """What became of a recording's frames."""

    out: Path
    cameras: int
    written: int  # frames, those of earlier runs among them
    kept: int  # of these, those of earlier runs
    bad: int  # frames that could not be read
    depthless: int  # frames of this run whose depth could not be read, so that they have none

    @property
    def sentence(self) -> str:
        """What to tell the user."""
        kept = f", {self.kept} of them by an earlier run" if self.kept else ""
        of = " of the others" if self.kept else ""
        depthless = f"; {self.depthless}{of} are without depth, which could not be read" if self.depthless else ""
        bad = f"; {self.bad} could not be read and were left out" if self.bad else ""
        return f"Wrote {self.written} frames of {self.cameras} cameras to {self.out}{kept}{depthless}{bad}."


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
    for camera in recording.cameras:
        refuse_unusable_name(camera.name)
    depth = _wants_depth(recording, depth)
    wanted = wanted_frames(recording, every)
    goal = out.resolve()
    part = goal.with_name(goal.name + UNFINISHED_SUFFIX)
    state = state_of(recording, wanted, _options_that_matter(options, out, depth, every))
    _tell_what_is_left_behind(recording)
    try:
        with held(part, state), _nothing_left_of_nothing(part):
            _refuse_place(out, paths)  # again: another run may have ended meanwhile
            frames = _frames(recording, part, out, depth)
            converted = _convert(recording, wanted, frames, depth, progress, part)
            _appear(part, goal)
    except OSError as error:
        kept = f" (finished frames are in {part.name})" if _holds_frames(part) else ""
        raise OutputError(
            f"{out}: cannot be written ({error.strerror or error}); make room or choose another place{kept}."
        ) from error
    return replace(converted, out=out)


@contextmanager
def _nothing_left_of_nothing(part: Path) -> Iterator[None]:
    """Remove the folder of unfinished frames where it ends without any."""
    try:
        yield
    except BaseException:
        if not _holds_frames(part):
            abandon(part)
        raise


def _holds_frames(part: Path) -> bool:
    try:
        growing = part / GROWING_FILE
        return has_chunk(growing) if growing.is_file() else any(part.glob("*/image/*.png"))
    except (OSError, ValueError):  # what cannot be looked into is not thrown away
        return True


def _refuse_place(out: Path, paths: Sequence[Path]) -> None:
    from rigcal.cli import refuse_inputs

    refuse_inputs(out, paths, None)
    for path in paths:
        if path.is_dir() and path.resolve() in out.resolve().parents:
            raise OutputError(f"{out}: lies in {path}, an input; choose another place.")
    suffix = out.suffix.lower()
    # A folder may be called 2025.06.01 or box_1.5m.
    is_file_type = suffix[1:2].isalpha() and suffix != MCAP_SUFFIX
    if suffix == UNFINISHED_SUFFIX or (is_file_type and not out.is_dir()):
        raise OutputError(
            f"{out}: recordings are converted to an RGB-D folder or to an {MCAP_SUFFIX} file; choose such a name."
        )
    if out.exists() and (not out.is_dir() or out.suffix.lower() == MCAP_SUFFIX or any(out.iterdir())):
        raise OutputError(f"{out}: exists already; choose another place or remove it.")
    if not out.resolve().parent.is_dir():
        raise OutputError(f"{out}: the folder {out.parent} does not exist; create it or choose another place.")


def _wants_depth(recording: Recording, depth: bool | None) -> bool:
    there = any(len(recording.depth_indices(camera.name)) for camera in recording.cameras)
    if depth and not there:
        raise InputError("--depth: no camera of the recording has depth; leave the option out.")
    return there if depth is None else depth


def _tell_what_is_left_behind(recording: Recording) -> None:
    if isinstance(recording, KnowsUp) and any(
        recording.up_in_camera(camera.name) is not None for camera in recording.cameras
    ):
        logger.warning("which way is up, as the cameras measured it, is not converted: keep the recording itself")


def _options_that_matter(options: SourceOptions, out: Path, depth: bool, every: int) -> dict[str, Any]:
    return {
        "to": "mcap" if out.suffix.lower() == MCAP_SUFFIX else "rgbd",
        "every": every,
        "depth": {"mode": options.depth_mode, "stereo": options.stereo_depth} if depth else None,
        "topics": sorted(options.topics),  # two depth topics can be of the same images
    }


def _frames(recording: Recording, part: Path, out: Path, depth: bool) -> GrowingFrames:
    if out.suffix.lower() == MCAP_SUFFIX:
        names = [camera.name for camera in recording.cameras]
        with_depth = {name for name in names if depth and len(recording.depth_indices(name))}
        return McapFrames(part / GROWING_FILE, recording.cameras, with_depth)
    return RgbdFrames(part, recording.cameras)


def _convert(
    recording: Recording, wanted: Indices, frames: GrowingFrames, depth: bool, progress: Progress, part: Path
) -> Converted:
    """Write the frames that are not there yet, in the order of time."""
    missing = missing_frames(recording, wanted, frames)
    total = sum(map(len, wanted.values()))
    kept = total - sum(map(len, missing.values()))
    if kept:
        logger.info("{}: an earlier run finished {} of {} frames; going on from there", part, kept, total)
    bad: Counter[str] = Counter()
    depthless: Counter[str] = Counter()
    done = 0
    try:
        for packed in packed_ahead(by_time(recording, missing, depth, depthless), frames):
            if isinstance(packed, BadFrame):
                bad[packed.camera] += 1
                _tell_bad(packed, bad.total())
            else:
                frames.store(packed)
            done += 1
            progress.step("convert", kept + done, total)
        cameras = _with_frames({name: len(indices) - bad[name] for name, indices in wanted.items()})
        frames.finish()
    except BaseException:
        frames.close()
        if there := kept + done - bad.total():
            logger.info("{}: {} finished frames are kept; the same command goes on from there", part, there)
        raise
    return Converted(
        out=part,
        cameras=cameras,
        written=total - bad.total(),
        kept=kept,
        bad=bad.total(),
        depthless=depthless.total(),
    )


def _with_frames(counts: Mapping[str, int]) -> int:
    """How many cameras have a frame that was written; those without are named."""
    without = [name for name, count in counts.items() if not count]
    if len(without) == len(counts):
        raise InputError(
            "no frame of the recording can be read, so nothing is written; copy it again, or record it again."
        )
    if without:
        logger.warning("of {} no frame was written: {}", "a camera" if len(without) == 1 else "cameras", _some(without))
    return len(counts) - len(without)


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:10]) + (f" and {len(names) - 10} others" if len(names) > 10 else "")


def _tell_bad(frame: BadFrame, count: int) -> None:
    if count <= SPOKEN_BAD_FRAMES:
        logger.warning("camera {}: frame {} is left out: {}", frame.camera, frame.stamp_ns, frame.reason)
    if count == SPOKEN_BAD_FRAMES:
        logger.warning("further frames that cannot be read are counted, not named")


def _appear(part: Path, out: Path) -> None:
    """Make what is finished the result, in one step."""
    if out.suffix.lower() == MCAP_SUFFIX:
        (part / GROWING_FILE).replace(out)
        abandon(part)
        return
    if out.exists():
        out.rmdir()
    part.rename(out)
    (out / STATE_FILE).unlink(missing_ok=True)
