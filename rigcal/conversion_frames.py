"""The frames of a conversion on their way: which, in which order, and several at work at once.

Owns      thinning out by moments, the order of time, images whose depth cannot be read, packing while others are read.
Leaves    reading to recordings, what a packed frame is to those who write it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.model import BadFrame, Frame, Recording
from aruco.svo_sync import sample, synchronise
from rigcal.config import Resources
from rigcal.conversion_state import Indices

# Frames that are packed at once: more take memory, and reading is slower by then.
MAX_AHEAD = 8


class GrowingFrames(Protocol):
    """Frames that are being written."""

    def finished(self, camera: str) -> NDArray[np.int64]:
        """The stamps of a camera's frames that are there and whole."""
        ...

    def packed(self, frame: Frame) -> Any:
        """A frame as it will be stored; may be called from several threads."""
        ...

    def store(self, packed: Any) -> None:
        """Add a frame."""
        ...

    def finish(self) -> None:
        """Make them a recording."""
        ...

    def close(self) -> None:
        """Leave them as they are, to be gone on with."""
        ...


def wanted_frames(recording: Recording, every: int) -> Indices:
    """The frames to convert; thinned out by moments, so that frames of different cameras still belong together."""
    stamps = {camera.name: recording.stamps_ns(camera.name) for camera in recording.cameras}
    if every == 1:
        return {name: np.arange(len(s)) for name, s in stamps.items()}
    groups = synchronise(stamps)
    if not len(groups.groups):  # cameras that share no moment
        return {name: np.arange(0, len(s), every) for name, s in stamps.items()}
    kept = sample(groups.groups, every)
    return {name: column[column >= 0] for name, column in zip(groups.cameras, kept.T)}


def missing_frames(recording: Recording, wanted: Indices, frames: GrowingFrames) -> Indices:
    """Those that are not written yet."""
    return {
        name: indices[~np.isin(recording.stamps_ns(name)[indices], frames.finished(name))]
        for name, indices in wanted.items()
    }


def by_time(recording: Recording, wanted: Indices, depth: bool, depthless: Counter[str]) -> Iterator[Frame | BadFrame]:
    """Frames of all cameras in the order of their stamps, one at a time: as recorders write, and as players read."""
    streams = {name: _frames_of(recording, name, wanted[name].tolist(), depth, depthless) for name in wanted}
    names = list(wanted)
    stamps = np.concatenate([recording.stamps_ns(name)[wanted[name]] for name in names])
    owners = np.repeat(np.arange(len(names)), [len(wanted[name]) for name in names])
    for k in np.argsort(stamps, kind="stable").tolist():
        yield next(streams[names[owners[k]]])


def _frames_of(
    recording: Recording, camera: str, indices: Sequence[int], depth: bool, depthless: Counter[str]
) -> Iterator[Frame | BadFrame]:
    """A camera's frames; where depth is what cannot be read the image comes alone, and is counted."""
    for index, frame in zip(indices, recording.frames(camera, indices, depth=depth)):
        if isinstance(frame, BadFrame) and frame.depth_may_be_why:
            (alone,) = recording.frames(camera, [index])
            if isinstance(alone, Frame):
                if not depthless[camera]:
                    logger.warning(
                        "camera {}: frame {} is written without depth, as are all like it: {}",
                        *(camera, frame.stamp_ns, frame.reason),
                    )
                depthless[camera] += 1
            yield alone
        else:
            yield frame


def packed_ahead(frames: Iterator[Frame | BadFrame], to: GrowingFrames) -> Iterator[Any]:
    """Frames as they will be stored, or BadFrame, in the same order; some are packed while others are read."""
    jobs = min(Resources().jobs, MAX_AHEAD)
    with ThreadPoolExecutor(jobs) as pool:
        waiting: deque[BadFrame | Future[Any]] = deque()
        try:
            for frame in frames:
                waiting.append(frame if isinstance(frame, BadFrame) else pool.submit(to.packed, frame))
                if len(waiting) > jobs:
                    yield _done(waiting.popleft())
            while waiting:
                yield _done(waiting.popleft())
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _done(waiting: BadFrame | Future[Any]) -> Any:
    return waiting if isinstance(waiting, BadFrame) else waiting.result()
