"""What rigcal writes into MCAP files it reads back, whatever the cameras are called."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pytest
from bag_writers import Ros, write_mcap
from mcap.reader import make_reader

from aruco.model import Camera, Frame, Recording
from rigcal.sources import open_recordings
from rigcal.sources.mcap_writer import McapFrames
from rigcal.sources.options import SourceOptions

W, H = 32, 24
N = 2
T0 = 1_700_000_000_000_000_000
DISTORTION = np.array([-0.3, 0.1, 0.001, 0.002, 0.05])


def camera(name: str, number: int = 0) -> Camera:
    """Each of another focal length and baseline, and distorted."""
    K = np.array([[30.0 + number, 0, 15.5], [0, 31.0 + number, 11.5], [0, 0, 1]])
    return Camera(name=name, width=W, height=H, K=K, distortion=DISTORTION, baseline_m=0.1 + number / 100)


def frame(name: str, number: int, index: int, *, depth: bool = True, confidence: bool = True) -> Frame:
    """Every number in it tells the camera; the image is grey where a camera's number is odd."""
    image = np.full((H, W) if number % 2 else (H, W, 3), 10 * number + index, dtype=np.uint8)
    return Frame(
        camera=name,
        stamp_ns=T0 + index * 10**8,
        image=image,
        depth_m=np.full((H, W), 1.0 + number, dtype=np.float32) if depth else None,
        confidence=np.full((H, W), 20 + number, dtype=np.uint8) if confidence else None,
    )


def written(path: Path, names: Sequence[str], with_depth: Collection[str] | None = None) -> Path:
    """Frames of all cameras; of those without depth there is confidence all the same."""
    with_depth = names if with_depth is None else with_depth
    frames = McapFrames(path, [camera(name, k) for k, name in enumerate(names)], with_depth)
    for index in range(N):
        for k, name in enumerate(names):
            frames.store(frames.packed(frame(name, k, index, depth=name in with_depth)))
    frames.finish()
    return path


def assert_same(recording: Recording, names: Sequence[str]) -> None:
    assert [found.name for found in recording.cameras] == sorted(names)
    for found in recording.cameras:
        number = names.index(found.name)
        wanted = camera(found.name, number)
        np.testing.assert_array_equal(found.K, wanted.K)
        np.testing.assert_array_equal(found.distortion, wanted.distortion)
        assert found.baseline_m == wanted.baseline_m
        frames = list(recording.frames(found.name, range(N), depth=True))
        assert len(frames) == N
        for index, read in enumerate(frames):
            assert isinstance(read, Frame), read
            stored = frame(found.name, number, index)
            np.testing.assert_array_equal(read.image, stored.image)
            np.testing.assert_array_equal(read.depth_m, stored.depth_m)
            np.testing.assert_array_equal(read.confidence, stored.confidence)


NAMES = [
    ("left", "right"),
    ("left", "right", "color"),
    ("rgb", "ir", "depth"),
    ("ir_left", "ir_right"),
    ("left_raw", "left_rect"),
    ("mono", "gray", "cam0"),
    ("cam_rect", "image_rect", "compressed", "image_raw"),
    ("confidence", "aligned_depth_to_color", "zed_node", "34563472"),
    ("a b", "a_b", "a.b"),
]


@pytest.mark.parametrize("names", NAMES, ids=" ".join)
def test_cameras_come_back_whatever_they_are_called(names: Sequence[str], tmp_path: Path, told: list[str]):
    assert_same(open_recordings([written(tmp_path / "rig.mcap", names)]), names)
    assert told == []


def test_a_camera_that_the_user_names_keeps_its_distortion_depth_and_baseline(tmp_path: Path):
    """Although left_rect says that it is rectified."""
    path = written(tmp_path / "rig.mcap", ("left_raw", "left_rect"))
    recording = open_recordings([path], SourceOptions(topics=("mine=/left_rect/image/compressed",)))
    (found,) = recording.cameras
    wanted = camera("mine", 1)
    np.testing.assert_array_equal(found.K, wanted.K)
    np.testing.assert_array_equal(found.distortion, DISTORTION)
    assert found.baseline_m == wanted.baseline_m
    (read,) = recording.frames("mine", [0], depth=True)
    assert isinstance(read, Frame)
    np.testing.assert_array_equal(read.depth_m, frame("left_rect", 1, 0).depth_m)


def test_confidence_without_depth_leaves_a_file_that_others_read(tmp_path: Path, said: list[str]):
    path = written(tmp_path / "rig.mcap", ("a", "b"), with_depth={"a"})
    with path.open("rb") as stream:
        topics = [channel.topic for _, channel, _ in make_reader(stream).iter_messages()]
    assert len(topics) == N * (5 + 2)
    recording = open_recordings([path])
    assert [len(recording.stamps_ns(name)) for name in "ab"] == [N, N]
    (read,) = recording.frames("b", [0], depth=True)
    assert isinstance(read, Frame)
    assert read.depth_m is None
    assert said == []


def test_the_same_topics_of_another_program_are_read_by_their_names(tmp_path: Path):
    """As of a file that ros2 bag recorded while rigcal's was played: no metadata, so frames must tell cameras apart."""
    ros, messages = Ros(2), []
    for name in ("left", "right", "color"):
        messages += [ros.info(f"/{name}/camera_info", size=(W, H), frame_id=name)]
        messages += [ros.image(f"/{name}/image", T0, np.zeros((H, W, 3), np.uint8), "bgr8", name)]
    recording = open_recordings([write_mcap(tmp_path / "again.mcap", messages)])
    assert [found.name for found in recording.cameras] == ["color", "left", "right"]
