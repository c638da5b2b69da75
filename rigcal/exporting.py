"""The story of ``rigcal convert CALIBRATION --to FORMAT``: read, add intrinsics, check, write.

Owns      its order, which intrinsics belong to which camera, refusing to write over what is read or another's.
Leaves    formats to rigcal.formats, recordings to rigcal.sources.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from loguru import logger

from aruco.errors import InputError, OutputError
from aruco.model import Camera
from rigcal import cli
from rigcal.formats import registry
from rigcal.formats.rig import ExportOptions, Format, Rig, listed
from rigcal.recordings import plain_options, read_cameras
from rigcal.sources import open_recordings
from rigcal.sources.options import SourceOptions

# What helps where intrinsics are of none of the calibration's cameras.
_GIVE_ITS_RECORDING = "give the recording that the calibration was made from"
_RENAME = "rename the camera there; where it is called like its file, rename the file"


def export(
    calibration: Path,
    out: Path,
    *,
    to: Format,
    options: ExportOptions,
    recordings: Sequence[Path] = (),
    source_options: SourceOptions | None = None,
) -> str:
    """Convert a calibration file.

    Args:
        calibration: In any format that is known.
        out: The file or folder to write, whole or not at all.
        to: The format to write.
        options: What its writer is told.
        recordings: Whose cameras' intrinsics are used; they go before those of the calibration itself.
        source_options: What readers of recordings are told; with intrinsics, these are taken from that file.

    Returns:
        What was written, in a sentence.

    Raises:
        InputError: Something cannot be read, or the format cannot hold it.
        OutputError: The output cannot be written, is an input, is there in a recording already, or in another format.
    """
    given = source_options or plain_options()
    _refuse_to_replace(
        out, to, [calibration, *filter(None, (options.into, given.intrinsics, given.zed_conf))], recordings
    )
    cli.refuse_inputs(out, recordings, None)
    rig = _read(calibration)
    if given.intrinsics:
        rig = _with_cameras(rig, read_cameras(given.intrinsics), str(given.intrinsics), _RENAME)
    if recordings:
        cameras = _recorded_cameras(out, recordings, given)
        rig = _with_cameras(rig, cameras, listed(str(path) for path in recordings), _GIVE_ITS_RECORDING)
    to.write(rig, out, options)
    return f"{_written(rig, out, options)}\n{to.name}: {to.explain}"


def _written(rig: Rig, out: Path, options: ExportOptions) -> str:
    if options.into is not None:
        return f"Wrote {out}: {options.into} with new poses for its cameras that the calibration has."
    count = len(rig.T_world_cam)
    return f"Wrote {count} camera{'s' if count > 1 else ''} to {out}."


def _read(calibration: Path) -> Rig:
    try:
        return registry.read_rig(calibration)
    except registry.UnknownFormatError as error:
        raise InputError(f"{error} A recording is converted without --to: rigcal convert RECORDING OUT.") from error


def refuse_calibration(path: Path) -> None:
    """See that what is to be converted as a recording is none of our calibrations.

    Raises:
        InputError: It is one, and a format to convert it to was not given.
    """
    if not path.is_file():
        return
    if (known := registry.format_of(path)) is not None:
        raise InputError(
            f"{path}: is a calibration ({known}), and no format was given to convert it to; add --to FORMAT -o OUT."
        )


def _recorded_cameras(out: Path, recordings: Sequence[Path], options: SourceOptions) -> Mapping[str, Camera]:
    """The cameras of recordings.

    Raises:
        OutputError: A reader looked for intrinsics in what the output would replace.
    """
    asked: list[Path] = []

    def noted(path: Path) -> Mapping[str, Camera]:
        asked.append(path)
        return options.read_cameras(path)

    found = open_recordings(recordings, replace(options, read_cameras=noted)).cameras
    if _is_input(out, asked):
        raise OutputError(f"{out}: is an input, where the recording's intrinsics are; choose another name.")
    return {camera.name: camera for camera in found}


def _with_cameras(rig: Rig, cameras: Mapping[str, Camera], where: str, cure: str) -> Rig:
    """The rig with intrinsics from elsewhere, which know better than the calibration file."""
    ours = {name: camera for name, camera in cameras.items() if name in rig.T_world_cam}
    if not ours:
        raise InputError(
            f"{where}: has camera {listed(cameras)}, and the calibration {listed(rig.T_world_cam)}; {cure}."
        )
    if missing := rig.T_world_cam.keys() - ours.keys() - rig.cameras.keys():
        logger.warning("{}: has no camera {}, whose intrinsics stay unknown", where, listed(missing))
    return replace(rig, cameras={**rig.cameras, **ours})


def _refuse_to_replace(out: Path, to: Format, inputs: Sequence[Path], recordings: Sequence[Path]) -> None:
    """See that writing replaces no input, nothing in or beside a recording, and no calibration in another format.

    Raises:
        OutputError: It would, or nobody can tell.
    """
    try:
        if _is_input(out, inputs):
            raise OutputError(f"{out}: is an input; choose another name for the output.")
        # Whoever wrote it: a recording's own ground truth and lenses look like an earlier output.
        if _is_recorded(out, recordings):
            raise OutputError(
                f"{out}: lies in a recording that is given, or beside it, where no file is ever replaced; choose "
                "another name for the output, or remove it if it is an earlier one."
            )
        there = registry.format_of(out)
        if there not in (None, to.name):
            raise OutputError(
                f"{out}: is a calibration in another format ({there}), which {to.name} does not replace; remove it "
                "or choose another name for the output."
            )
    except OSError as error:
        raise OutputError(f"{out}: cannot be looked at ({error.strerror or error}); choose another place.") from error


def _is_input(path: Path, inputs: Sequence[Path]) -> bool:
    """Whether a path is an input or a link to it, lies in one that is a folder, or is a folder that one lies in."""
    goal, sources = path.resolve(), [source.resolve() for source in inputs]
    around = any(source.is_relative_to(goal) for source in sources)
    inside = goal.exists() and any(goal.is_relative_to(source) for source in sources)
    return around or inside or _one_of(goal, sources)


def _is_recorded(path: Path, recordings: Sequence[Path]) -> bool:
    """Whether what exists at a path lies in a recording, or beside one that is a file: lenses and time stamps do."""
    if not path.exists():
        return False
    place = path.parent.resolve() / path.name  # a link in a recording is a part of it
    for recording in recordings:
        root = recording.resolve()
        if root.is_relative_to(place) or place.is_relative_to(root):
            return True
        folders = [root] if root.is_dir() else [root.parent, recording.parent.resolve()]
        for folder in filter(Path.is_dir, folders):
            if (place.parent == folder and place.is_file()) or _one_of(place, folder.iterdir()):
                return True
    return False


def _one_of(path: Path, others: Iterable[Path]) -> bool:
    """Whether a path is one of these files by another name."""
    return path.is_file() and any(other.is_file() and os.path.samefile(path, other) for other in others)
