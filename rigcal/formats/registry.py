"""Which formats of calibrations there are, and which of them a file is in.

Owns      the names of the formats, importing them when asked for, recognising a file by its content.
Leaves    each layout to its own file. Light to import, so that --help answers at once.
"""

from __future__ import annotations

import codecs
import os
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from aruco.errors import InputError

if TYPE_CHECKING:
    from aruco.model import Camera
    from rigcal.formats.rig import Format, Rig

# Name -> module; each has a constant FORMAT. Files are offered to them in this order.
MODULES: Mapping[str, str] = {
    "native": "native_rig",
    "zed-fusion": "zed_fusion",
    "ros2-launch": "ros2_launch",
    "urdf": "urdf",
    "kalibr": "kalibr",
    "colmap": "colmap",
    "nerfstudio": "nerfstudio",
    "opencv": "opencv",
    "tum": "tum",
    "aniposelib": "aniposelib",
    "open3d": "open3d",
    "usd": "usd",
}
NAMES = tuple(MODULES)
HEAD_BYTES = 64 * 2**10


class UnknownFormatError(InputError):
    """A file that is no calibration in a format that is known here."""


def format_named(name: str) -> Format:
    """The format of a name.

    Raises:
        InputError: There is none.
    """
    if name not in MODULES:
        raise InputError(f"unknown format {name!r}; known: {', '.join(NAMES)}.")
    return import_module(f"rigcal.formats.{MODULES[name]}").FORMAT


def detect(path: Path) -> Format:
    """The format that a file or folder is in, by its content.

    Raises:
        InputError: It cannot be read, or nobody knows it.
    """
    head = _head(path)
    if not head.strip(b"\0 \t\r\n") and not os.path.isdir(path):
        raise InputError(f"{path}: {_nothing_in(head)}, so it is no calibration; copy or make it again.")
    for name in NAMES:
        known = format_named(name)
        if known.recognises(path, head):
            return known
    raise UnknownFormatError(f"{path}: not a calibration in a format that is known here; known: {', '.join(NAMES)}.")


def format_of(path: Path) -> str | None:
    """The name of the format that a file or folder is in; None: it is no calibration that is known here."""
    try:
        return detect(path).name
    except InputError:
        return None


def read_rig(path: Path) -> Rig:
    """The cameras of a calibration in any format.

    Raises:
        InputError: It cannot be read; the message names the file.
    """
    rig = detect(path).read(path)
    _check_names(rig.T_world_cam, path)
    return rig


def cameras_of(path: Path) -> Mapping[str, Camera]:
    """The intrinsics in a file of any format that has them: camera -> intrinsics.

    Raises:
        InputError: It cannot be read or has none.
    """
    known = detect(path)
    cameras = known.read_cameras(path) if known.read_cameras else known.read(path).cameras
    if not cameras:
        raise InputError(f"{path}: holds no intrinsics ({known.name}); give a file that has them.")
    _check_names(cameras, path)
    return cameras


def _check_names(names: Iterable[str], path: Path) -> None:
    from rigcal.formats.rig import check_name

    for name in names:
        check_name(name, path)


def _nothing_in(head: bytes) -> str:
    """What a file is that begins with nothing that could be read."""
    return "is empty" if not head else "holds nothing but zeros and blanks" if b"\0" in head else "holds only blanks"


def _head(path: Path) -> bytes:
    try:
        if os.path.isdir(path):
            return b""
        if os.path.exists(path) and not os.path.isfile(path):
            raise InputError(f"{path}: is not a file; give a calibration.")  # opening a pipe would wait for ever
        with path.open("rb") as stream:
            return stream.read(HEAD_BYTES).removeprefix(codecs.BOM_UTF8)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path.") from error
