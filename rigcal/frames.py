"""Which frames take part: those of one moment together, or every frame on its own for cameras without a common clock.

Owns      choosing moments from the stamps of a recording.
Leaves    grouping to aruco.svo_sync, looking at the images to detecting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.model import Recording
from aruco.svo_sync import SyncResult, sample, synchronise
from rigcal.config import FrameConfig


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Moments:
    """The frames to look at."""

    sync: SyncResult
    groups: NDArray[np.int64]  # (n, n_cameras) index into each camera's stamps, -1 for none

    def stamp_ns(self, recording: Recording, camera: str, frame: int) -> int:
        """When a camera's frame of a group was taken."""
        column = self.sync.cameras.index(camera)
        return int(recording.stamps_ns(camera)[self.groups[frame, column]])


def synchronised(recording: Recording, config: FrameConfig) -> Moments:
    """Frames of several cameras at one moment.

    Raises:
        InputError: Cameras have frames, but none of them at the same moment.
    """
    sync = _synchronise(recording, config)
    if not len(sync.groups):
        closest = "" if sync.closest_ns is None else f" (closest: {sync.closest_ns / 1e6:.1f} ms apart)"
        raise InputError(
            f"No two cameras have frames within {sync.tolerance_ns / 1e6:.1f} ms of each other{closest}: check that "
            "the recordings were made together and on one clock, raise --sync-tolerance-ms, or pass --still."
        )
    return Moments(sync=sync, groups=sample(sync.groups, config.sample_interval, config.max_samples))


def each_alone(recording: Recording, config: FrameConfig) -> Moments:
    """Every frame of every camera on its own, for a target whose rests are found afterwards."""
    sync = _synchronise(recording, config)
    rows: list[NDArray[np.int64]] = []
    for column, camera in enumerate(sync.cameras):
        frames = np.arange(0, len(recording.stamps_ns(camera)), config.sample_interval)
        alone = np.full((len(frames), len(sync.cameras)), -1, dtype=np.int64)
        alone[:, column] = frames
        rows.append(alone)
    return Moments(sync=sync, groups=np.concatenate(rows))


def _synchronise(recording: Recording, config: FrameConfig) -> SyncResult:
    stamps = {camera.name: recording.stamps_ns(camera.name) for camera in recording.cameras}
    tolerance = None if config.sync_tolerance_ms is None else round(1e6 * config.sync_tolerance_ms)
    return synchronise(stamps, tolerance_ns=tolerance)
