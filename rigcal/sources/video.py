"""Video files as cameras: a file a camera, its name the camera's.

Owns      what is taken for a video, several of them as one recording, the frames that are asked for.
Leaves    packets to video_index and video_reader, pictures to decoding, clocks to video_stamps, intrinsics to
          video_cameras.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError, OutputError
from aruco.model import BadFrame, Camera, Frame
from rigcal.sources.decoding import MISSING, Picture, Undecoded
from rigcal.sources.options import SourceOptions
from rigcal.sources.rgbd_writer import refuse_unusable_name
from rigcal.sources.video_cameras import camera_of_video
from rigcal.sources.video_ends import EBML, is_avi, is_iso, ts_period
from rigcal.sources.video_index import Run, VideoIndex
from rigcal.sources.video_reader import VideoReader
from rigcal.sources.video_stamps import NO_STAMP, find_stamps, read_stamps

# Brands of ISO files that hold single images.
_STILL_BRANDS = (b"heic", b"heix", b"mif1", b"avif", b"crx ")
_MPEG_PROGRAM = b"\x00\x00\x01\xba"
# Headers of first units of bare streams: parameter sets and delimiters of H.264, then of H.265.
_BARE_UNITS = (b"\x67", b"\x27", b"\x47", b"\x09", b"\x40\x01", b"\x42\x01", b"\x46\x01")


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file may be a video, by its first bytes."""
    if is_iso(head):
        return head[8:12] not in _STILL_BRANDS
    if head.startswith((EBML, _MPEG_PROGRAM)) or is_avi(head) or ts_period(head) is not None:
        return True
    start = head.find(b"\x00\x00\x01", 0, 4)
    return 0 <= start <= 1 and head[start + 3 : start + 5].startswith(_BARE_UNITS)


def opened(path: Path, options: SourceOptions) -> VideoFiles:
    """Open one video file as a recording of one camera; raises as opened_together does."""
    return opened_together([path], options)


def opened_together(paths: Sequence[Path], options: SourceOptions) -> VideoFiles:
    """Open video files as a recording with a camera each; nothing is decoded but the first pictures.

    Args:
        paths: The files.
        options: Of these ``same_clock``, ``intrinsics`` and ``read_cameras`` matter.

    Raises:
        InputError: A file cannot be read, lacks intrinsics, or nothing says how the clocks of several go together.
        MissingExtraError: PyAV is not installed.
    """
    _refuse_names(paths)
    tables = {path: find_stamps(path) for path in paths}
    _refuse_clocks(tables, options.same_clock)
    return VideoFiles([_Video.read(path, tables[path], options, alone=len(paths) == 1) for path in paths])


class VideoFiles:
    """Cameras of which each has a video file; implements aruco.model.Recording."""

    def __init__(self, videos: Sequence[_Video]) -> None:
        self._videos = {video.camera.name: video for video in videos}

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, sorted by name."""
        return tuple(self._videos[name].camera for name in sorted(self._videos))

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The ascending time stamps of a camera's frames; raises InputError for an unknown camera."""
        return self._video(camera).stamps_ns

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """None: videos have no depth."""
        self._video(camera)
        return np.empty(0, dtype=np.int64)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """A camera's frames at ascending indices into its stamps, decoded one after the other."""
        return self._video(camera).read_frames(indices)

    def file_of(self, camera: str) -> Path:
        """The file that a camera's frames are in; raises InputError for an unknown camera."""
        return self._video(camera).index.path

    def _video(self, camera: str) -> _Video:
        if camera not in self._videos:
            raise InputError(f"no camera {camera} among the videos; they are {', '.join(sorted(self._videos))}.")
        return self._videos[camera]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Video:
    index: VideoIndex
    camera: Camera
    stamps_ns: NDArray[np.int64]  # (n,), strictly ascending
    packets: NDArray[np.int64]  # (n,) of these frames

    @staticmethod
    def read(path: Path, table: Path | None, options: SourceOptions, *, alone: bool) -> _Video:
        index = VideoIndex.read(path)
        camera = camera_of_video(path, index.size, options, alone=alone)
        if table is None:
            stamps = index.stamps_ns()
            if options.same_clock:
                # Files of one camera begin at zero in one container and 80 ms later in another.
                stamps = stamps - stamps[0]
        else:
            stamps = read_stamps(table, path.stem, len(index.frames), alone=alone, may_be_cut=bool(index.loss))
        kept = np.flatnonzero(index.decodable & (stamps != NO_STAMP))
        stamps, first = np.unique(stamps[kept], return_index=True)
        if len(first) < len(kept):
            logger.debug("{}: {} frames have the time of another, and are left out", path, len(kept) - len(first))
        if not len(stamps):
            raise InputError(f"{path}: no frame of it can be used; record it again.")
        stamps.setflags(write=False)
        return _Video(index=index, camera=camera, stamps_ns=stamps, packets=index.frames[kept[first]])

    def read_frames(self, indices: Sequence[int]) -> Iterator[Frame | BadFrame]:
        stamps = {int(self.packets[index]): int(self.stamps_ns[index]) for index in indices}
        if not stamps:
            return
        digests: dict[int, str] = {}
        with VideoReader(self.index) as reader:
            for run in self.index.runs(list(stamps)):
                for packet, picture in reader.pictures(run, digests):
                    if isinstance(picture, Undecoded) and picture.reason == MISSING:
                        picture = self._from_earlier(packet)
                    yield self._frame(stamps[packet], picture, digests.pop(packet, ""))

    def _from_earlier(self, packet: int) -> Picture | Undecoded:
        """A picture that did not come out: where images are refreshed bit by bit it wants an earlier start."""
        start = self.index.start_of(packet, earlier=1)
        if start == self.index.start_of(packet):
            return Undecoded(MISSING)
        with VideoReader(self.index) as reader:
            return next(picture for _, picture in reader.pictures(Run(start=start, packets=(packet,)), {}))

    def _frame(self, stamp_ns: int, picture: Picture | Undecoded, digest: str) -> Frame | BadFrame:
        if not isinstance(picture, Undecoded):
            return Frame(camera=self.camera.name, stamp_ns=stamp_ns, image=picture, digest=digest)
        reason = f"{self.index.path.name} at {stamp_ns * 1e-9:.3f} s: the picture {picture.reason}"
        logger.debug("skipped: {}", reason)
        return BadFrame(self.camera.name, stamp_ns, reason)


def _refuse_names(paths: Sequence[Path]) -> None:
    places: dict[str, Path] = {}
    for path in paths:
        try:
            refuse_unusable_name(path.stem)
        except OutputError as error:
            raise InputError(f"{path}: {error}") from error
        if path.stem in places:
            raise InputError(
                f"camera {path.stem} is {places[path.stem]} and {path}; rename one of the files, or leave one out."
            )
        places[path.stem] = path


def _refuse_clocks(tables: dict[Path, Path | None], same_clock: bool) -> None:
    """Complain about several videos of which nobody knows how their clocks go together."""
    without = [path.name for path, table in tables.items() if table is None]
    if len(tables) < 2 or not without or (same_clock and len(without) == len(tables)):
        return
    if len(without) < len(tables):
        raise InputError(
            f"{', '.join(without)}: no table of time stamps, while others have one, so their clocks differ; put "
            f"{Path(without[0]).stem}.csv with the columns frame and timestamp_ns beside each."
        )
    raise InputError(
        f"{', '.join(without)}: each video counts its time from its own start; give --same-clock if all started at one "
        f"moment, or put a table of time stamps beside each ({Path(without[0]).stem}.csv with the columns frame and "
        "timestamp_ns)."
    )
