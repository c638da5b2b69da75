"""The options that say how recordings are to be read, shared by the commands that take some.

Owns      their names, defaults and help; light to import, so that --help answers at once.
Leaves    what they do to rigcal.recordings and the readers.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

_OPTIONS = (
    click.option("--depth-mode", default="NEURAL", show_default=True, metavar="MODE",
                 help="How the ZED SDK measures depth: NEURAL, NEURAL_PLUS, NEURAL_LIGHT, ULTRA, QUALITY or "
                      "PERFORMANCE. FILL invents depth and is refused."),
    click.option("--zed-conf", type=click.Path(path_type=Path), metavar="PATH",
                 help="Folder with the factory calibrations SN<serial>.conf of ZED cameras, or one of them: for SVO2 "
                      "files without the SDK. Its usual folders are looked at too."),
    click.option("--stereo-depth", is_flag=True,
                 help="Depth of SVO2 files by semi-global matching, without the SDK; less accurate than the SDK's."),
    click.option("--topics", multiple=True, metavar="CAMERA=IMAGE[,INFO[,DEPTH]]",
                 help="Of a ROS bag or MCAP file: a camera's image, camera info and depth topics; repeatable. Default: "
                      "paired by their names."),
    click.option("--same-clock", is_flag=True,
                 help="Videos without time stamps beside them began at the same moment: each counts from its first "
                      "picture."),
    click.option("--intrinsics", type=click.Path(path_type=Path), metavar="PATH",
                 help="Intrinsics of the cameras of videos, or of bags instead of camera info: camera_info, OpenCV or "
                      "Kalibr YAML, aniposelib TOML, a COLMAP text model; of videos also a folder with such files. "
                      "Default: looked for beside the videos."),
)  # fmt: skip


def source_options(command: Command) -> Command:
    """The command with these options, listed in this order."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
