"""Several recordings as one.

Owns      which recording a camera is of, and what is wrong with recordings that cannot be one.
Leaves    frames to the recordings themselves, grouping frames by time to aruco.svo_sync.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.model import BadFrame, Camera, Frame, KnowsUp, Recording
from aruco.pose_math import Array

# Clocks that miss each other by less may still pair frames at their ends; see aruco.svo_sync.
NEAR_NS = 1_000_000_000
# Stamps before this are counted from the start of something, not from 1970.
FIRST_DATE_NS = 10**9 * 365 * 86400


@runtime_checkable
class HasFiles(Protocol):
    """A recording whose cameras each have a file, and a clock, of their own."""

    def file_of(self, camera: str) -> Path:
        """The file that a camera's frames are in."""
        ...


def joined(opened: Sequence[tuple[Path, Recording]]) -> Recording:
    """The cameras of all recordings, each given with where it lies.

    Raises:
        InputError: Two of them have a camera of one name.
    """
    recording = opened[0][1] if len(opened) == 1 else JoinedRecording(opened)
    for sentence in disagreeing_clocks(opened):
        logger.warning(sentence)
    return recording


class JoinedRecording:
    """Several recordings as one; implements aruco.model.Recording and KnowsUp."""

    def __init__(self, opened: Sequence[tuple[Path, Recording]]) -> None:
        owners: dict[str, tuple[Path, Recording]] = {}
        for path, recording in opened:
            for camera in recording.cameras:
                if camera.name in owners:
                    raise _same_name(camera.name, owners[camera.name], (path, recording))
                owners[camera.name] = (path, recording)
        self._owners = {name: recording for name, (_, recording) in owners.items()}
        cameras = [camera for _, recording in opened for camera in recording.cameras]
        self._cameras = tuple(sorted(cameras, key=lambda camera: camera.name))

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras of all recordings, sorted by name."""
        return self._cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The sorted time stamps of a camera's frames."""
        return self._owner(camera).stamps_ns(camera)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """Ascending indices of the camera's frames that have depth."""
        return self._owner(camera).depth_indices(camera)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """A camera's frames at ascending indices into its stamps, one at a time."""
        return self._owner(camera).frames(camera, indices, depth=depth)

    def up_in_camera(self, camera: str) -> Array | None:
        """(3,) unit vector against gravity in the camera's axes, where its recording measured it."""
        owner = self._owner(camera)
        return owner.up_in_camera(camera) if isinstance(owner, KnowsUp) else None

    def _owner(self, camera: str) -> Recording:
        if camera not in self._owners:
            raise InputError(f"no camera {camera} in the recordings; they have {', '.join(sorted(self._owners))}.")
        return self._owners[camera]


def _same_name(name: str, *two: tuple[Path, Recording]) -> InputError:
    one, other = (path for path, _ in two)
    if one.resolve() == other.resolve():
        return InputError(f"{one}: is given twice; leave one out.")
    ways = [way for path, recording in two if (way := _renaming(name, path, recording)) is not None]
    # Other names come from inside the file: a serial number is always of one camera, a topic need not be.
    way = ways[-1] if ways else "make one a folder with rigcal convert and rename the camera's folder there"
    return InputError(
        f"camera {name} is in {one} and in {other}; give one of them at a time or, if these are two cameras, {way}."
    )


def _renaming(name: str, path: Path, recording: Recording) -> str | None:
    """How a camera is renamed where it is called like a file or folder."""
    from rigcal.sources.rgbd_folder import RgbdFolder

    if isinstance(recording, RgbdFolder):
        return f"rename its folder in {path.parent if path.resolve().name == name else path}"
    return f"rename {recording.file_of(name)}" if isinstance(recording, HasFiles) else None


class _Span(NamedTuple):
    start_ns: int
    end_ns: int
    path: Path

    def __str__(self) -> str:
        return f"{self.path} lasts from {_moment(self.start_ns)} to {_moment(self.end_ns)}"


def disagreeing_clocks(opened: Sequence[tuple[Path, Recording]]) -> Iterator[str]:
    """A sentence for every recording that begins after all earlier ones have ended: they cannot have one clock.

    Of a recording that has a file for each camera, each file counts for itself.
    """
    spans = sorted(span for path, recording in opened for span in _spans(path, recording))
    if not spans:
        return
    latest = spans[0]
    for span in spans[1:]:
        if span.start_ns > latest.end_ns + NEAR_NS:
            yield (
                f"{latest}, but {span}: they share no moment, so no frames of them belong together; record them at "
                "one time and on one clock, or correct the stamps of one."
            )
        latest = max(latest, span, key=lambda one: one.end_ns)


def _spans(path: Path, recording: Recording) -> Iterator[_Span]:
    stamps = {camera.name: s for camera in recording.cameras if len(s := recording.stamps_ns(camera.name))}
    if isinstance(recording, HasFiles):
        yield from (_Span(int(s[0]), int(s[-1]), recording.file_of(name)) for name, s in stamps.items())
    elif stamps:
        yield _Span(min(int(s[0]) for s in stamps.values()), max(int(s[-1]) for s in stamps.values()), path)


def _moment(stamp_ns: int) -> str:
    if stamp_ns < FIRST_DATE_NS:
        return f"{stamp_ns / 1e9:.3f} s"
    try:
        return f"{datetime.fromtimestamp(stamp_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    except (OverflowError, ValueError):  # beyond the calendar
        return f"{stamp_ns / 1e9:.3f} s"
