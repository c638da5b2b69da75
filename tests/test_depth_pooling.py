"""Which depth images of a recording are pooled, and what is said of those that cannot be."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest
from loguru import logger
from numpy.typing import NDArray

from aruco.depth_pool import MAX_FRAMES
from aruco.errors import InputError
from aruco.model import SILENT, BadFrame, Camera, Frame
from rigcal.depth_pooling import depth_digest, pool_recording, require_depth

W, H = 32, 24
K = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
IMAGE = np.zeros((H, W), np.uint8)


def plain(index: int) -> NDArray[np.float32] | str | None:
    return np.full((H, W), 2.0, np.float32)


class Made:
    """A recording of one or more cameras whose depth a function makes; a text is why a frame is unreadable."""

    def __init__(self, n: int, depth: Callable[[int], NDArray[np.float32] | str | None], *cameras: Camera) -> None:
        self._cameras = cameras or (camera("a"),)
        self._n, self._depth = n, depth
        self.read: list[int] = []

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self._cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        return 1_000_000 * np.arange(self._n)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        return np.array([k for k in range(self._n) if self._depth(k) is not None], dtype=np.int64)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        for k in indices:
            self.read.append(k)
            made = self._depth(k)
            if isinstance(made, str) and (depth or "/image/" in made):
                yield BadFrame(camera, k, made)
            else:
                wanted = made if depth and not isinstance(made, str) else None
                yield Frame(camera=camera, stamp_ns=k, image=IMAGE, depth_m=wanted)


def camera(name: str, baseline_m: float | None = None) -> Camera:
    return Camera(name=name, width=W, height=H, K=K, baseline_m=baseline_m)


@pytest.fixture
def told() -> Iterator[list[str]]:
    lines: list[str] = []
    sink = logger.add(lambda line: lines.append(str(line)), level="WARNING", format="{message}")
    yield lines
    logger.remove(sink)


def pooled(recording: Made, baseline_m: float | None = None) -> dict[str, int]:
    require_depth(recording)
    found = pool_recording(recording, baseline_m, jobs=2, progress=SILENT)
    return {name: depth.n_frames for name, depth in found.items()}


@pytest.mark.parametrize("n", [7, 127, 253])
def test_depth_at_half_the_rate_of_images_is_found(n: int, told: list[str]) -> None:
    recording = Made(n, lambda k: plain(k) if k % 2 else None)
    assert pooled(recording) == {"a": min(n // 2, MAX_FRAMES)}
    assert all(k % 2 for k in recording.read)
    assert not told


def test_frames_that_cannot_be_read_are_told_with_their_reason(told: list[str]) -> None:
    recording = Made(6, lambda k: "a/depth/3.png is truncated" if k == 3 else plain(k))
    assert pooled(recording) == {"a": 5}
    assert told == ["camera a: of its depth images 1 of 6 cannot be read (a/depth/3.png is truncated)\n"]


def test_where_the_image_beside_depth_cannot_be_read_that_is_told(told: list[str]) -> None:
    recording = Made(6, lambda k: {2: "a/image/2.png is cut off", 3: "a/depth/3.png is torn"}.get(k) or plain(k))
    assert pooled(recording) == {"a": 4}
    assert told == [
        "camera a: of its depth images 1 of 6 cannot be read (a/depth/3.png is torn), and 1 of 6 are left out as the "
        "images beside them cannot be read (a/image/2.png is cut off)\n"
    ]


def test_an_interrupt_ends_the_reading_of_every_camera() -> None:
    class Interrupted:
        def step(self, name: str, done: int, total: int) -> None:
            if done == 1:
                raise KeyboardInterrupt
            time.sleep(0.01)  # long enough for the word to reach the other thread

    recording = Made(60, plain, camera("a"), camera("b"), camera("c"))
    with pytest.raises(KeyboardInterrupt):
        pool_recording(recording, None, jobs=1, progress=Interrupted())
    assert len(recording.read) < 30  # not the 60 of the next camera


def test_a_camera_without_a_measurement_is_left_out_and_named(told: list[str]) -> None:
    class Half(Made):
        def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
            for frame in super().frames(camera, indices, depth=depth):
                blind = camera == "b" and isinstance(frame, Frame)
                yield Frame(camera="b", stamp_ns=1, image=IMAGE, depth_m=np.full((H, W), np.nan)) if blind else frame

    assert pooled(Half(3, plain, camera("a"), camera("b"))) == {"a": 3}
    assert told == ["camera b: of its depth images 3 of 3 hold no measurement; so depth says nothing about it\n"]


def test_a_recording_of_which_no_depth_can_be_used_is_refused_with_the_reason() -> None:
    with pytest.raises(InputError, match=r"camera a: of its depth images 2 of 2 cannot be read .*8 bits"):
        require_depth(Made(2, lambda k: "depth has 8 bits"))


def test_a_recording_without_depth_is_refused() -> None:
    with pytest.raises(InputError, match="no depth images"):
        require_depth(Made(2, lambda k: None))


def test_intrinsics_of_another_size_are_refused_before_the_long_work() -> None:
    quarter = K / 4
    quarter[2, 2] = 1
    odd = Camera(name="a", width=W, height=H, K=K, depth_K=quarter)
    with pytest.raises(InputError, match="camera a: depth: intrinsics"):
        require_depth(Made(2, plain, odd))


def test_the_recordings_baseline_counts_for_more_than_the_option(told: list[str]) -> None:
    recording = Made(2, plain, camera("a", 0.12), camera("b"))
    found = pool_recording(recording, 0.06, jobs=1, progress=SILENT)
    assert {name: depth.baseline_m for name, depth in found.items()} == {"a": 0.12, "b": 0.06}
    assert len(told) == 1
    assert "camera a" in told[0]


def test_other_depth_has_another_digest() -> None:
    one, other = (
        pool_recording(Made(2, lambda k, z=z: np.full((H, W), z, np.float32)), None, jobs=1, progress=SILENT)["a"]
        for z in (2.0, 2.01)
    )
    assert depth_digest(one) != depth_digest(other)
    assert depth_digest(one) == depth_digest(one)
