"""How long markers take to be found in a 1080p image on one core, beside plain ArUco on the same images."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import cv2
import numpy as np

from aruco.detector import MarkerDetector
from benchmarks.child import ONE_THREAD, run_child
from benchmarks.metric import Metric
from benchmarks.plain_detectors import plain_detector
from benchmarks.tag_wall import tag_walls
from rigcal.sim import simulate_rig
from rigcal.sim.noise import ImageNoise
from rigcal.sim.rigs import named_rig

DICTIONARY = "DICT_APRILTAG_36h11"
SCENES = {
    "box": "a closed box in a room, 1 to 3 markers",
    "corner": "an open corner in a room, 4 to 12 markers",
    "bent": "the open corner, lens with distortion",
    "wall": "40 markers of 40-80 px",
}


def run(*, quick: bool) -> list[Metric]:
    ran = run_child(["-m", "benchmarks.suite.detect_time", "3" if quick else "9"], cores=1, env=ONE_THREAD)
    metrics: list[Metric] = []
    for scene, (ours_s, plain_s) in json.loads(ran.output).items():
        about = SCENES[scene]
        metrics += [
            Metric(
                key=f"{scene}.ms",
                value=1e3 * ours_s,
                unit="ms",
                about=f"finding markers in a 1080p image on one core; {about}",
                # The promise is about an image of one target; the wall shows what each further marker costs.
                limit=None if scene == "wall" else 100,
                rel_tol=1.0,
                machine=True,
            ),
            Metric(
                key=f"{scene}.of_plain",
                value=ours_s / plain_s,
                unit="times",
                about=f"the same over plain ArUco's time; {about}",
                rel_tol=0.5,
                machine=True,
            ),
        ]
    return metrics


def _images(scene: str) -> Iterator[tuple]:
    """Images and their cameras."""
    if scene == "wall":
        for wall in tag_walls(2, (40.0, 80.0), seed=3, dictionary=DICTIONARY):
            yield wall.photograph(ImageNoise(), 0), wall.camera
        return
    hd = replace(named_rig("hd"), n_frames=1, depth=False)
    rig = hd if scene == "box" else replace(hd, target="corner", resting_face="b", distortion=scene == "bent")
    recording = simulate_rig(rig, seed=0).recording
    for camera in recording.cameras:
        yield next(recording.frames(camera.name, [0])).image, camera


def _fastest_s(repeats: int, *tasks: Callable[[], object]) -> list[float]:
    """The shortest time of each task; they take turns, so that what else runs hits all of them alike."""
    times = np.full((repeats, len(tasks)), np.inf)
    for k in range(repeats):
        for j, task in enumerate(tasks):
            start = time.perf_counter()
            task()
            times[k, j] = time.perf_counter() - start
    return times.min(axis=0).tolist()


def _main(repeats: int) -> None:
    """In a process of its own with one thread: scene -> mean seconds of ours and of plain ArUco, as JSON."""
    cv2.setNumThreads(1)
    ours, plain = MarkerDetector(DICTIONARY), plain_detector(DICTIONARY)
    seconds: dict[str, list[float]] = {}
    for scene in SCENES:
        times = [
            _fastest_s(repeats, lambda i=image, c=camera: ours.detect(i, c), lambda i=image: plain(i))
            for image, camera in _images(scene)
        ]
        seconds[scene] = np.mean(times, axis=0).tolist()
    print(json.dumps(seconds))


if __name__ == "__main__":
    import sys

    _main(int(sys.argv[1]))
