"""Recordings made of others: kept in memory, with two frames exchanged, or every second capture only.

Owns      these views of a recording.
Leaves    reading and rendering to the recordings they are made of.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aruco.model import BadFrame, Camera, Frame, Recording
from aruco.svo_sync import synchronise


class HeldRecording:
    """A Recording that reads, or renders, every image once: for those that are looked at several times."""

    def __init__(self, source: Recording) -> None:
        self._source = source
        self._held: dict[tuple[str, int], Frame | BadFrame] = {}

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """As those of the source."""
        return self._source.cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """As those of the source."""
        return self._source.stamps_ns(camera)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """As those of the source."""
        return self._source.depth_indices(camera)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """The source's; what is asked for with depth is not kept."""
        if depth:
            yield from self._source.frames(camera, indices, depth=True)
            return
        for index in indices:
            if (camera, index) not in self._held:
                (self._held[camera, index],) = self._source.frames(camera, [index])
            yield self._held[camera, index]


class ExchangedRecording:
    """A Recording in which two images of one camera carry each other's stamp.

    Args:
        source: The same in order.
        camera: Whose images are exchanged.
        pair: Their indices.
    """

    def __init__(self, source: Recording, camera: str, pair: tuple[int, int]) -> None:
        self._source = source
        self._camera = camera
        self._instead = {pair[0]: pair[1], pair[1]: pair[0]}

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """As those of the source."""
        return self._source.cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """As those of the source."""
        return self._source.stamps_ns(camera)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """As those of the source."""
        return self._source.depth_indices(camera)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """The source's, two of them exchanged."""
        if camera != self._camera:
            yield from self._source.frames(camera, indices, depth=depth)
            return
        stamps = self.stamps_ns(camera)
        for index in indices:
            for frame in self._source.frames(camera, [self._instead.get(index, index)], depth=depth):
                yield replace(frame, stamp_ns=int(stamps[index]))


class PartRecording:
    """A Recording with some of the frames of another.

    Args:
        source: All of them.
        indices: Camera -> ascending indices of the frames that are left.
    """

    def __init__(self, source: Recording, indices: Mapping[str, NDArray[np.int64]]) -> None:
        self._source = source
        self._indices = indices

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """As those of the source."""
        return self._source.cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """Those of the frames that are left."""
        return self._source.stamps_ns(camera)[self._indices[camera]]

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """Those of the frames that are left."""
        return np.flatnonzero(np.isin(self._indices[camera], self._source.depth_indices(camera)))

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        """The source's."""
        return self._source.frames(camera, [int(self._indices[camera][k]) for k in indices], depth=depth)


def halves(recording: Recording) -> tuple[PartRecording, PartRecording]:
    """The captures of even and of odd numbers; frames that belong to no capture are in neither."""
    stamps = {camera.name: recording.stamps_ns(camera.name) for camera in recording.cameras}
    sync = synchronise(stamps)
    even, odd = (
        {name: column[column >= 0] for name, column in zip(sync.cameras, sync.groups[first::2].T)} for first in (0, 1)
    )
    return PartRecording(recording, even), PartRecording(recording, odd)
