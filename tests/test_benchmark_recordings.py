"""What benchmarks make of recordings: kept images, an exchange, halves; other ways to solve the same corners."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from aruco import lens
from aruco.model import Camera, Detection, Frame
from aruco.pose_math import Array, Pose, exp_se3, invert_transform, transform_points
from benchmarks.board_rigs import exchangeable
from benchmarks.recordings import ExchangedRecording, HeldRecording, halves
from benchmarks.rival_solvers import Corners, ours, plain_average
from rigcal.quality.truth import pair_errors
from rigcal.sim.placement import look_at

PERIOD_NS = 1_000_000_000


class Numbered:
    """Two cameras whose images hold their own number; camera b misses its second frame, and counts what it reads."""

    def __init__(self) -> None:
        self.cameras = tuple(Camera(name=name, width=4, height=4, K=np.diag([9.0, 9.0, 1.0])) for name in "ab")
        self.reads = 0

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        every = PERIOD_NS * np.arange(6, dtype=np.int64)
        return every if camera == "a" else np.delete(every, 1)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        return np.arange(len(self.stamps_ns(camera)))

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame]:
        for index in indices:
            self.reads += 1
            stamp = int(self.stamps_ns(camera)[index])
            image = np.full((4, 4), stamp // PERIOD_NS, dtype=np.uint8)
            yield Frame(
                camera=camera, stamp_ns=stamp, image=image, depth_m=np.ones((4, 4), np.float32) if depth else None
            )


def numbers(recording: Numbered | HeldRecording | ExchangedRecording, camera: str) -> list[tuple[int, int]]:
    """Second and number on the image of all frames of a camera."""
    frames = recording.frames(camera, range(len(recording.stamps_ns(camera))))
    return [(frame.stamp_ns // PERIOD_NS, int(frame.image[0, 0])) for frame in frames if isinstance(frame, Frame)]


def test_a_held_recording_reads_every_image_once() -> None:
    source = Numbered()
    held = HeldRecording(source)
    assert numbers(held, "a") == numbers(held, "a") == numbers(Numbered(), "a")
    assert source.reads == 6
    assert next(held.frames("a", [0], depth=True)).depth_m is not None  # pyright: ignore[reportAttributeAccessIssue]


def test_an_exchange_swaps_images_and_leaves_stamps() -> None:
    exchanged = ExchangedRecording(Numbered(), "a", (1, 4))
    assert numbers(exchanged, "a") == [(0, 0), (1, 4), (2, 2), (3, 3), (4, 1), (5, 5)]
    assert numbers(exchanged, "b") == numbers(Numbered(), "b")


def test_halves_keep_the_frames_of_a_capture_together() -> None:
    even, odd = halves(Numbered())
    # The capture at second 1 has one camera only and belongs to nobody: 0, 2, 3, 4, 5 are captures 0 to 4.
    for half, seconds in ((even, [0, 3, 5]), (odd, [2, 4])):
        for camera in "ab":
            assert (half.stamps_ns(camera) // PERIOD_NS).tolist() == seconds
            assert [int(f.image[0, 0]) for f in half.frames(camera, [0, 1]) if isinstance(f, Frame)] == seconds[:2]


def test_frames_are_exchanged_that_enough_cameras_see() -> None:
    seen = {"a": {0, 1, 2, 3}, "b": {0, 1, 2}, "c": {1, 2, 3}}
    assert exchangeable(seen, "a", np.random.default_rng(0)) == (1, 2)


# --- other ways -----------------------------------------------------------------------------------------------------


def corners_of_a_rig() -> tuple[Corners, dict[str, Pose]]:
    """Exact corners of a board of 5 x 4 points in 8 frames, and the truth."""
    rng = np.random.default_rng(0)
    K = np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]])
    cameras = tuple(Camera(name=name, width=1280, height=720, K=K) for name in "abc")
    places = ((-1.0, 1.0, -2.0), (0.0, 1.0, -2.2), (1.0, 1.2, -2.0))
    T_world_cam = {camera.name: look_at(np.array(at), np.zeros(3)) for camera, at in zip(cameras, places)}
    grid = np.array([[x, y, 0.0] for y in range(4) for x in range(5)]) * 0.1 - [0.2, 0.15, 0.0]
    T_world_board = [exp_se3(rng.normal(0, 0.2, 6)) for _ in range(8)]

    def seen(camera: Camera, T: Pose) -> Detection:
        pixels = lens.project(camera, transform_points(invert_transform(T_world_cam[camera.name]) @ T, grid))
        return Detection(ids=np.arange(20), corners_px=pixels[:, None], sigma_px=np.full((20, 1), 0.02))

    detections = {c.name: {f: seen(c, T) for f, T in enumerate(T_world_board)} for c in cameras}
    geometry: dict[int, Array] = {k: grid[k : k + 1] for k in range(20)}
    return Corners(cameras=cameras, detections=detections, geometry=geometry), T_world_cam


def worst_mm(found: dict[str, Pose], truth: dict[str, Pose]) -> float:
    assert found.keys() == truth.keys()
    return 1e3 * max(shift for _, shift in pair_errors(found, truth).values())


def test_exact_corners_give_the_truth_whichever_way() -> None:
    corners, truth = corners_of_a_rig()
    # What iterations leave; every way is a thousand times better than its figures in the benchmark.
    assert worst_mm(plain_average(corners), truth) < 1e-3
    assert worst_mm(ours(corners), truth) < 1e-5


def test_an_exchange_is_seen_by_the_plain_average_and_not_by_ours() -> None:
    corners, truth = corners_of_a_rig()
    exchanged = corners.exchanged("b", (2, 6))
    assert exchanged.detections["b"][2] is corners.detections["b"][6]
    assert worst_mm(plain_average(exchanged), truth) > 1.0  # two of eight views are decimetres off
    assert worst_mm(ours(exchanged), truth) < 1e-5


def test_shaking_moves_corners_by_what_it_says_and_their_sigmas_not_at_all() -> None:
    corners, _ = corners_of_a_rig()
    shaken = corners.shaken(0.1, np.random.default_rng(1))
    before, after = (
        np.concatenate([d.corners_px.ravel() for seen in c.detections.values() for d in seen.values()])
        for c in (corners, shaken)
    )
    # 960 numbers know a standard deviation to 2 percent.
    assert np.std(after - before) == pytest.approx(0.1, rel=0.1)
    assert (shaken.detections["a"][0].sigma_px == corners.detections["a"][0].sigma_px).all()
