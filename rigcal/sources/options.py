"""What a reader of recordings may be told besides the path."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from aruco.errors import InputError
from aruco.model import Camera

DEPTH_MODES = ("NEURAL", "NEURAL_PLUS", "NEURAL_LIGHT", "ULTRA", "QUALITY", "PERFORMANCE")


def _no_reader(path: Path) -> Mapping[str, Camera]:
    raise InputError(f"{path}: nobody here reads intrinsics; give a recording that has its own.")


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceOptions:
    """For all readers; each looks at what concerns it."""

    depth_mode: str = "NEURAL"  # of the ZED SDK, one of DEPTH_MODES
    zed_conf: Path | None = None  # folder with SN<serial>.conf, or such a file
    stereo_depth: bool = False  # depth of SVO2 files by semi-global matching
    topics: tuple[str, ...] = ()  # "<camera>=<image topic>[,<camera info topic>[,<depth topic>]]"
    same_clock: bool = False  # the first pictures of video files without a table of stamps are of one moment
    intrinsics: Path | None = None  # of cameras; None: those in recordings, or beside videos
    is_only: bool = True  # no other recording is read beside this one
    # Reads such a file: camera -> intrinsics; raises InputError where it holds none.
    read_cameras: Callable[[Path], Mapping[str, Camera]] = _no_reader
