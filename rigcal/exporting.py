"""The story of ``rigcal convert CALIBRATION --to FORMAT``: read, add intrinsics, check, write.

Owns      its order, which intrinsics belong to which camera, refusing to write over what is read.
Leaves    formats to rigcal.formats, recordings to rigcal.sources.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from loguru import logger

from aruco.errors import InputError, OutputError
from aruco.model import Camera
from rigcal import cli
from rigcal.formats import registry
from rigcal.formats.rig import ExportOptions, Format, Rig, listed
from rigcal.recordings import read_cameras
from rigcal.sources import open_recordings
from rigcal.sources.options import SourceOptions


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
        OutputError: The output cannot be written, or is an input.
    """
    intrinsics = source_options.intrinsics if source_options else None
    _refuse_inputs(out, [calibration, *(path for path in (options.into, intrinsics) if path)])
    cli.refuse_inputs(out, recordings, None)
    rig = _read(calibration)
    if intrinsics:
        rig = _with_cameras(rig, read_cameras(intrinsics), str(intrinsics))
    if recordings:
        cameras = {camera.name: camera for camera in open_recordings(recordings, source_options).cameras}
        rig = _with_cameras(rig, cameras, listed(str(path) for path in recordings))
    to.write(rig, out, options)
    count = len(rig.T_world_cam)
    return f"Wrote {count} camera{'s' if count > 1 else ''} to {out}.\n{to.name}: {to.explain}"


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
    try:
        known = registry.detect(path)
    except InputError:
        return
    raise InputError(
        f"{path}: is a calibration ({known.name}), and no format was given to convert it to; add --to FORMAT -o OUT."
    )


def _with_cameras(rig: Rig, cameras: Mapping[str, Camera], where: str) -> Rig:
    """The rig with intrinsics from elsewhere, which know better than the calibration file."""
    ours = {name: camera for name, camera in cameras.items() if name in rig.T_world_cam}
    if not ours:
        raise InputError(
            f"{where}: has camera {listed(cameras)}, and the calibration {listed(rig.T_world_cam)}; give the recording "
            "that the calibration was made from."
        )
    if missing := rig.T_world_cam.keys() - ours.keys() - rig.cameras.keys():
        logger.warning("{}: has no camera {}, whose intrinsics stay unknown", where, listed(missing))
    return replace(rig, cameras={**rig.cameras, **ours})


def _refuse_inputs(out: Path, inputs: Sequence[Path]) -> None:
    goal = out.resolve()
    for path in inputs:
        source = path.resolve()
        same = os.path.exists(out) and os.path.exists(path) and os.path.samefile(out, path)
        # Of a folder that is read no file is replaced, and no folder that what is read lies in.
        if same or goal == source or source.is_relative_to(goal) or (goal.exists() and goal.is_relative_to(source)):
            raise OutputError(f"{out}: is an input; choose another name for the output.")
