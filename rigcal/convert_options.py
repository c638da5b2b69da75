"""The options of ``rigcal convert``, and which of its uses they ask for.

Owns      their names and help, telling a calibration's conversion from a recording's; light to import, so that --help
          answers at once.
Leaves    converting to rigcal.exporting and rigcal.recording_conversion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import click
from click.core import ParameterSource

from aruco.errors import OutputError
from rigcal.formats.registry import NAMES, format_of
from rigcal.source_options import source_options

Command = TypeVar("Command", bound=Callable[..., Any])
Use = Literal["explain", "formats", "calibration", "recording"]

HELP = """Convert a calibration to another format, or a recording to a folder of images or an MCAP file.

\b
rigcal convert CALIBRATION --to FORMAT -o OUT    any format that is known, to any other
rigcal convert RECORDING... OUT                  to the folder OUT, or to OUT.mcap
rigcal convert --explain FORMAT                  what its numbers mean
rigcal convert --formats                         all formats

What the input is, is seen from its content. Inputs are never written to, outputs appear whole or not at all.
"""

_OPTIONS = (
    click.argument("paths", nargs=-1, metavar="[INPUT]... [OUT]", type=click.Path(path_type=Path)),
    click.option("--to", type=click.Choice(NAMES), metavar="FORMAT",
                 help="Convert a calibration to this format; see --formats."),
    click.option("-o", "--output", type=click.Path(path_type=Path), metavar="OUT", help="Where the result goes."),
    click.option("--explain", type=click.Choice(NAMES), metavar="FORMAT",
                 help="Say what the numbers of a format mean."),
    click.option("--formats", is_flag=True, help="List the formats of calibrations, each with what its numbers mean."),
    click.option("--recording", "recordings", type=click.Path(path_type=Path), multiple=True, metavar="REC",
                 help="The recording that the calibration was made from: camera intrinsics come from it. Repeatable."),
    click.option("--parent-frame", metavar="NAME",
                 help="ros2-launch, urdf: the frame that the poses are given in. Default: world."),
    click.option("--frame-name", metavar="PATTERN",
                 help="ros2-launch, urdf: a camera's frame, with {camera} for its name. Default: "
                      "{camera}_left_camera_optical_frame, as ZED's wrapper before 5.1 has it."),
    click.option("--image-name", metavar="PATTERN",
                 help="colmap, nerfstudio: a camera's image, with {camera} for its name. Default: {camera}.png, "
                      "{camera}/image.png for colmap."),
    click.option("--into", type=click.Path(path_type=Path), metavar="FILE",
                 help="zed-fusion: take everything but the poses from this configuration."),
    click.option("--every", type=click.IntRange(min=1), metavar="N",
                 help="Of a recording: every Nth moment that the cameras share."),
    click.option("--depth/--no-depth", default=None,
                 help="Of a recording: with depth, or images only. Default: what it has."),
)  # fmt: skip

# What only one of the uses takes: parameter -> option.
OF_CALIBRATIONS = {
    "recordings": "--recording",
    "parent_frame": "--parent-frame",
    "frame_name": "--frame-name",
    "image_name": "--image-name",
    "into": "--into",
}
OF_RECORDINGS = {"every": "--every", "depth": "--depth or --no-depth"}
OF_SOURCES = {
    "depth_mode": "--depth-mode",
    "zed_conf": "--zed-conf",
    "stereo_depth": "--stereo-depth",
    "topics": "--topics",
    "same_clock": "--same-clock",
}
OF_FORMATS = ("parent_frame", "frame_name", "image_name", "into")


def convert_options(command: Command) -> Command:
    """The command with these options, listed in this order."""
    command = source_options(command)
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def use_of(given: Mapping[str, Any]) -> Use:
    """Which use of the command the options ask for.

    Raises:
        click.UsageError: None, or options of two; what to give instead.
    """
    if given["explain"] or given["formats"]:
        if len(_stated() - {"debug"}) > 1:
            raise click.UsageError("--explain and --formats convert nothing; leave out the rest.")
        return "explain" if given["explain"] else "formats"
    if given["to"]:
        if not given["recordings"] and (odd := [OF_SOURCES[key] for key in OF_SOURCES if key in _stated()]):
            raise click.UsageError(f"{odd[0]} says how a recording is read; give the recording as --recording with it.")
        _refuse(given, OF_RECORDINGS, "is for recordings, and --to for calibrations; leave one out.")
        if len(given["paths"]) + bool(given["output"]) != 2:
            raise click.UsageError(
                f"give one calibration and -o: rigcal convert CALIBRATION --to {given['to']} -o OUT."
            )
        return "calibration"
    _refuse(given, OF_CALIBRATIONS, "is for calibrations; give --to FORMAT with it.")
    if len(given["paths"]) + bool(given["output"]) < 2:
        raise click.UsageError(
            "give what to convert and where to: rigcal convert CALIBRATION --to FORMAT -o OUT, or rigcal convert "
            "RECORDING OUT."
        )
    return "recording"


def _stated() -> set[str]:
    """The parameters that stand on the command line."""
    context = click.get_current_context()
    return {key for key in context.params if context.get_parameter_source(key) is ParameterSource.COMMANDLINE}


def _refuse(given: Mapping[str, Any], options: Mapping[str, str], why: str) -> None:
    for key, option in options.items():
        if given[key] not in (None, ()):
            raise click.UsageError(f"{option} {why}")


def export_choices(given: Mapping[str, Any], takes: frozenset[str]) -> dict[str, Any]:
    """The fields of ExportOptions that were given.

    Raises:
        click.UsageError: One of them means nothing to the format.
    """
    chosen = {key: given[key] for key in OF_FORMATS if given[key] is not None}
    for key in chosen.keys() - takes:
        raise click.UsageError(f"{OF_CALIBRATIONS[key]} means nothing to {given['to']}; leave it out.")
    return chosen


def inputs_and_output(given: Mapping[str, Any]) -> tuple[list[Path], Path]:
    """What is converted, and where to: -o, or the last argument.

    Raises:
        OutputError: The last argument is a calibration that would be replaced: ``*.json`` may stand for two inputs.
    """
    paths = list(given["paths"])
    if given["output"]:
        return paths, given["output"]
    if given["to"] and format_of(paths[-1]) == given["to"]:
        raise OutputError(
            f"{paths[-1]}: is a calibration already ({given['to']}), and may be meant as another input; to replace it, "
            f"give it as the output: -o {paths[-1]}."
        )
    return paths[:-1], paths[-1]
