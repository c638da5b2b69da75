"""Every camera's depth over the whole recording, pooled to one clean image.

Owns      which images are read, several cameras at a time, and cameras without usable depth.
Leaves    pooling to aruco.depth_pool.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from itertools import chain

import numpy as np
from loguru import logger

from aruco.camera_depth import check_camera, check_name
from aruco.depth_pool import DepthFrame, pool_depth, spread_indices
from aruco.depth_save import CameraDepth, camera_depth
from aruco.errors import InputError
from aruco.model import BadFrame, Camera, Progress, Recording
from rigcal.counter import Counter


def require_depth(recording: Recording) -> None:
    """Say early what could not be pooled or kept: before the long work, not after it.

    Raises:
        InputError: No camera has depth, or the first depth image of one is none, is in other units, or has intrinsics
            of another size.
    """
    cameras = [camera for camera in recording.cameras if len(recording.depth_indices(camera.name))]
    if not cameras:
        raise InputError(
            "The recording has no depth images, which --save-depth and --verify-depth read: they belong in "
            "<camera>/depth/<stamp_ns>.png or .npy; record them, or leave these options out."
        )
    unreadable: list[str] = []
    for camera in cameras:
        check_name(camera.name, "the recording")
        read = _Reading(recording, camera, recording.depth_indices(camera.name).tolist())
        first = next(iter(read), None)
        if first is not None:
            where = f"camera {camera.name}: depth"
            check_camera(camera_depth(pool_depth([first], where=where), K=camera.K_depth), where)
        else:
            unreadable.append(f"camera {camera.name}: {read.trouble}")
    if len(unreadable) == len(cameras):
        raise InputError(f"No depth image of the recording can be used. {'; '.join(unreadable)}.")


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
        InputError: A depth image is none, or in other units.
    """
    chosen = {camera.name: _spread(recording.depth_indices(camera.name).tolist()) for camera in recording.cameras}
    counter = Counter(progress, "pooling depth", sum(map(len, chosen.values())))

    def pooled(camera: Camera) -> CameraDepth | None:
        reading = _Reading(recording, camera, chosen[camera.name], counter)
        frames = iter(reading)
        first = next(frames, None)
        if first is None:
            logger.warning("camera {}: {}; so depth says nothing about it", camera.name, reading.trouble)
            return None
        found = pool_depth(chain([first], frames), where=f"camera {camera.name}: depth")
        if reading.trouble:
            logger.warning("camera {}: {}", camera.name, reading.trouble)
        if not found.count.any():
            logger.warning("camera {}: its depth images agree nowhere, as if it had been moved: left out", camera.name)
            return None
        if baseline_m is not None and camera.baseline_m not in (None, baseline_m):
            logger.warning(
                "camera {}: its recording says that its baseline is {:g} m, which counts for more than --baseline",
                camera.name,
                camera.baseline_m,
            )
        return camera_depth(found, K=camera.K_depth, baseline_m=camera.baseline_m or baseline_m)

    # Each camera holds its images until they are pooled: two at a time keep memory flat.
    with ThreadPoolExecutor(max_workers=max(1, min(jobs, 2))) as pool:
        try:
            results = zip(recording.cameras, pool.map(pooled, recording.cameras))
            return {camera.name: depth for camera, depth in results if depth is not None}
        except BaseException:  # the other threads must not read to the end
            counter.stopped = True
            raise


def depth_digest(depth: CameraDepth) -> str:
    """SHA-256 of pooled depth and of the intrinsics that it is read with."""
    return hashlib.sha256(depth.depth.tobytes() + depth.K.tobytes() + repr(depth.baseline_m).encode()).hexdigest()


def _spread(indices: Sequence[int]) -> list[int]:
    """A bounded number of these, from all over the recording."""
    return [indices[k] for k in spread_indices(len(indices))]


class _Reading:
    """The usable depth images of one camera, one at a time, and what became of the others."""

    def __init__(
        self,
        recording: Recording,
        camera: Camera,
        indices: Sequence[int],
        counter: Counter | None = None,
    ) -> None:
        self._recording, self._camera, self._indices, self._counter = recording, camera.name, indices, counter
        self._bad_depth: list[str] = []
        self._bad_image: list[str] = []
        self._empty = 0

    def __iter__(self) -> Iterator[DepthFrame]:
        for index, frame in zip(self._indices, self._recording.frames(self._camera, self._indices, depth=True)):
            if self._counter is not None:
                self._counter.tick()
                if self._counter.stopped:
                    raise CancelledError
            if isinstance(frame, BadFrame):
                self._note_bad(index, frame)
            elif frame.depth_m is None or not np.isfinite(frame.depth_m).any():
                self._empty += 1
            else:
                yield frame.stamp_ns, frame.depth_m, frame.confidence

    def _note_bad(self, index: int, frame: BadFrame) -> None:
        """Find out which of the two cannot be read."""
        (alone,) = self._recording.frames(self._camera, [index])
        if isinstance(alone, BadFrame):
            self._bad_image.append(alone.reason)
        else:
            self._bad_depth.append(frame.reason)

    @property
    def trouble(self) -> str:
        """What is wrong, in words; empty if nothing is."""
        n = len(self._indices)
        if not n:
            return "no depth images"
        depth, image = self._bad_depth, self._bad_image
        told = [f"{len(depth)} of {n} cannot be read ({depth[0]})"] if depth else []
        told += (
            [f"{len(image)} of {n} are left out as the images beside them cannot be read ({image[0]})"] if image else []
        )
        told += [f"{self._empty} of {n} hold no measurement"] if self._empty else []
        return "of its depth images " + ", and ".join(told) if told else ""
