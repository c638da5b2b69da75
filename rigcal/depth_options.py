"""The options of calibrate-extrinsics that concern the rig's own depth, and what they may not be combined with.

Owns      their names, defaults and help; light to import, so that --help answers at once.
Leaves    what they do to pipeline.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

_OPTIONS = (
    click.option("--save-depth", type=click.Path(path_type=Path), metavar="FILE.h5",
                 help="Pool every camera's depth over time and write it, for refine-ground-plane."),
    click.option("--verify-depth", is_flag=True,
                 help="Compare measured depth with where the target is: how far it is off, and how that grows with "
                      "range and over the image."),
    click.option("--refine-depth", is_flag=True,
                 help="Let depth correct the poses, and estimate each camera's depth bias, which later steps take "
                      "out. Each is used only if it proves better on depth and markers that were held out. Needs "
                      "--verify-depth."),
    click.option("--depth-model", type=click.Choice(["stereo", "offset"]), default="stereo", show_default=True,
                 help="How depth is biased: stereo cameras by a scale and an error of disparity, others by a scale "
                      "and an offset."),
    click.option("--baseline", type=float, metavar="METRES",
                 help="Distance of the two eyes of stereo cameras whose recording does not say it: 0.12 for a ZED 2."),
    click.option("--report-csv", type=click.Path(path_type=Path), metavar="FILE.csv",
                 help="Every compared corner and face as a line of a table. Needs --verify-depth."),
)  # fmt: skip


def depth_options(command: Command) -> Command:
    """The command with these options, listed in this order."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def check_depth_options(given: Mapping[str, Any]) -> None:
    """Refuse combinations that mean nothing.

    Raises:
        click.UsageError: What to give instead.
    """
    if given["refine_depth"] and not given["verify_depth"]:
        raise click.UsageError("--refine-depth corrects what --verify-depth has looked at: give both")
    if given["refine_depth"] and not given["joint"]:
        raise click.UsageError("--refine-depth weighs depth against the joint adjustment: leave out --no-joint")
    if given["report_csv"] and not given["verify_depth"]:
        raise click.UsageError("--report-csv lists what --verify-depth compares: give both")
