"""Frames in, views out: every chosen image is read, searched for markers and solved for the target's pose.

Owns      walking over a recording with several threads, counting what could not be read, hashing what was.
Leaves    the work on one image to aruco.detector and aruco.view_pose.

Only views are kept, never images, so memory does not grow with the length of a recording.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
from loguru import logger

from aruco.model import BadFrame, Camera, Detection, Frame, FrameCounts, Progress, Recording
from aruco.svo_sync import SyncResult
from aruco.view_pose import View, solve_view
from rigcal.counter import Counter
from rigcal.frames import Moments
from rigcal.target import Target

# Called with every image that was read; for previews.
OnFrame = Callable[[Frame, Camera, Detection, View | None], None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """What one camera's images gave."""

    views: tuple[View, ...]
    detections: Mapping[int, Detection]  # frame -> markers of the target
    digests: tuple[str, ...]  # of every image read, in time order
    stamps_ns: tuple[int, ...]
    counts: FrameCounts
    first_bad: str = ""  # why the first unreadable frame could not be read


@dataclass(frozen=True, slots=True)
class _Task:
    """A stretch of one camera's frames."""

    camera: Camera
    frames: tuple[int, ...]  # indices of synchronised frames
    indices: tuple[int, ...]  # into the camera's stamps


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Outcome:
    """What is kept of one image: never its pixels."""

    frame: int
    digest: str = ""
    stamp_ns: int = 0
    bad: str = ""  # why it could not be read
    detection: Detection | None = None
    view: View | None = None


def watch(
    recording: Recording,
    moments: Moments,
    target: Target,
    *,
    min_markers: int,
    jobs: int,
    progress: Progress,
    on_frame: OnFrame | None = None,
) -> dict[str, Seen]:
    """Search every chosen frame of every camera.

    Args:
        recording: The images.
        moments: The frames to look at.
        target: What to look for.
        min_markers: A view with fewer is left out.
        jobs: Threads; the result does not depend on it.
        progress: Is told of every image.
        on_frame: Is called with every image that was read, from several threads.

    Returns:
        Camera -> what was seen, for every camera of the recording.
    """
    by_name = {camera.name: camera for camera in recording.cameras}
    columns = moments.sync.cameras
    chosen = {
        name: [(f, int(k)) for f, k in enumerate(moments.groups[:, c]) if k >= 0] for c, name in enumerate(columns)
    }
    tasks = [task for name, pairs in chosen.items() for task in _tasks(by_name[name], pairs, jobs, len(chosen))]
    counter = Counter(progress, "looking for markers", sum(len(task.frames) for task in tasks))

    def run(task: _Task) -> list[_Outcome]:
        return list(_search(recording, task, target, min_markers, counter, on_frame))

    with _one_thread_each(jobs), ThreadPoolExecutor(max_workers=max(jobs, 1)) as pool:
        try:
            results = list(pool.map(run, tasks))
        except BaseException:  # an interrupt or a full disk: the other threads must not search to the end
            counter.stopped = True
            raise
    found: dict[str, list[_Outcome]] = {name: [] for name in by_name}
    for task, result in zip(tasks, results):
        found[task.camera.name] += result
    return {name: _summary(name, found[name], recording, moments.sync) for name in by_name}


class _one_thread_each:  # noqa: N801 (a context manager reads like a verb)
    """Keep OpenCV from using all cores in each of several threads."""

    def __init__(self, jobs: int) -> None:
        self._before = cv2.getNumThreads()
        self._now = 1 if jobs > 1 else self._before

    def __enter__(self) -> None:
        cv2.setNumThreads(self._now)

    def __exit__(self, *_: object) -> None:
        cv2.setNumThreads(self._before)


def _tasks(camera: Camera, pairs: Sequence[tuple[int, int]], jobs: int, n_cameras: int) -> Iterator[_Task]:
    """One task a camera, or as many stretches as keep all threads busy when there are fewer cameras than threads."""
    parts = max(1, -(-jobs // max(n_cameras, 1)))
    size = max(1, -(-len(pairs) // parts))
    for start in range(0, len(pairs), size):
        stretch = pairs[start : start + size]
        yield _Task(camera, tuple(f for f, _ in stretch), tuple(k for _, k in stretch))


def _search(
    recording: Recording,
    task: _Task,
    target: Target,
    min_markers: int,
    counter: Counter,
    on_frame: OnFrame | None,
) -> Iterator[_Outcome]:
    for index, frame in zip(task.frames, recording.frames(task.camera.name, task.indices), strict=True):
        if isinstance(frame, BadFrame):
            logger.debug("camera {}: frame left out: {}", task.camera.name, frame.reason)
            yield _Outcome(frame=index, bad=frame.reason)
        else:
            detection = target.detector.detect(frame.image, task.camera)
            enough = len(detection) >= max(min_markers, 1)
            view = solve_view(task.camera, index, detection, target.geometry) if enough else None
            if on_frame is not None:
                on_frame(frame, task.camera, detection, view)
            yield _Outcome(frame=index, digest=frame.digest, stamp_ns=frame.stamp_ns, detection=detection, view=view)
        counter.tick()
        if counter.stopped:
            return


def _summary(name: str, found: Sequence[_Outcome], recording: Recording, sync: SyncResult) -> Seen:
    bad = [outcome.bad for outcome in found if outcome.bad]
    detections = {o.frame: o.detection for o in found if o.detection is not None and len(o.detection)}
    counts = FrameCounts(
        recorded=len(recording.stamps_ns(name)),
        unpaired=sync.unpaired.get(name, 0),
        read=len(found) - len(bad),
        bad=len(bad),
        with_markers=len(detections),
    )
    return Seen(
        views=tuple(outcome.view for outcome in found if outcome.view is not None),
        detections=detections,
        digests=tuple(outcome.digest for outcome in found if not outcome.bad),
        stamps_ns=tuple(outcome.stamp_ns for outcome in found if not outcome.bad),
        counts=counts,
        first_bad=bad[0] if bad else "",
    )


def digest_of(seen: Seen, camera: Camera) -> str:
    """SHA-256 over a camera's intrinsics and the stamps and bytes of every image that was read."""
    sha = hashlib.sha256()
    sha.update(repr((camera.width, camera.height, camera.distortion_model)).encode())
    sha.update(camera.K.tobytes() + camera.distortion.tobytes())
    sha.update(repr((seen.stamps_ns, seen.digests)).encode())
    return sha.hexdigest()
