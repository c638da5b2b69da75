"""Every camera's depth over the whole recording, pooled to one clean image.

Owns      which images are read, several cameras at a time, and cameras without depth.
Leaves    pooling to aruco.depth_pool.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

from loguru import logger

from aruco.depth_pool import DepthFrame, pool_depth, spread_indices
from aruco.depth_save import CameraDepth, camera_depth
from aruco.errors import InputError
from aruco.model import BadFrame, Camera, Progress, Recording

# Images can be recorded more often than depth, but not many times more: a camera without in so many has none.
LOOKED_AT = 8


def require_depth(recording: Recording) -> None:
    """Say early that there is nothing to pool.

    Raises:
        InputError: No camera has depth among the images looked at.
    """
    if not any(_has_depth(recording, camera) for camera in recording.cameras):
        raise InputError(
            "The recording has no depth images, which --save-depth and --verify-depth read: they belong in "
            "<camera>/depth/<stamp_ns>.png or .npy; record them, or leave these options out."
        )


def pool_recording(
    recording: Recording, baseline_m: float | None, *, jobs: int, progress: Progress
) -> dict[str, CameraDepth]:
    """Camera -> pooled depth, of every camera that has any.

    Args:
        recording: With depth.
        baseline_m: Distance of the eyes of stereo cameras whose intrinsics do not say it [m].
        jobs: Threads; the result does not depend on it.
        progress: Is told of every image.

    Raises:
        InputError: No camera has depth, or a depth image is none, or in other units.
    """
    cameras = [camera for camera in recording.cameras if _has_depth(recording, camera)]
    for camera in sorted({c.name for c in recording.cameras} - {c.name for c in cameras}):
        logger.warning("camera {}: no depth images, so depth says nothing about it", camera)
    chosen = {camera.name: spread_indices(len(recording.stamps_ns(camera.name))) for camera in cameras}
    count = _Counter(progress, sum(map(len, chosen.values())))

    def pooled(camera: Camera) -> CameraDepth | None:
        frames = _depth_frames(recording, camera, chosen[camera.name], count)
        found = pool_depth(frames, where=f"camera {camera.name}: depth")
        if not found.count.any():
            logger.warning(
                "camera {}: its depth images agree nowhere, as if it had been moved; they are left out", camera.name
            )
            return None
        K = camera.K if camera.depth_K is None else camera.depth_K
        return camera_depth(found, K=K, baseline_m=camera.baseline_m or baseline_m)

    # Each camera holds its images until they are pooled: two at a time keep memory flat.
    with ThreadPoolExecutor(max_workers=max(1, min(jobs, 2))) as pool:
        results = zip(cameras, pool.map(pooled, cameras))
        return {camera.name: depth for camera, depth in results if depth is not None}


def _has_depth(recording: Recording, camera: Camera) -> bool:
    """Whether any of the first images has depth; unreadable ones do not count."""
    indices = range(len(recording.stamps_ns(camera.name)))
    frames = recording.frames(camera.name, indices, depth=True)
    read = islice((f for f in frames if not isinstance(f, BadFrame)), LOOKED_AT)
    return any(frame.depth_m is not None for frame in read)


def _depth_frames(recording: Recording, camera: Camera, indices: list[int], count: _Counter) -> Iterator[DepthFrame]:
    for frame in recording.frames(camera.name, indices, depth=True):
        count.tick()
        if isinstance(frame, BadFrame):
            logger.debug("camera {}: depth left out: {}", camera.name, frame.reason)
        elif frame.depth_m is not None:
            yield frame.stamp_ns, frame.depth_m, frame.confidence


class _Counter:
    """Counts images over threads."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0
        self._lock = threading.Lock()

    def tick(self) -> None:
        with self._lock:
            self._done += 1
            self._progress.step("pooling depth", self._done, self._total)
