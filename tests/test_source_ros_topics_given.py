"""Intrinsics that the user gives for cameras of ROS recordings: for which they count, and what is said if for none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writers import SIZE, K, Message, Ros, pictures, write_mcap

from aruco.errors import InputError
from aruco.model import Camera, Frame
from rigcal.sources import open_recordings
from rigcal.sources.options import SourceOptions

IMAGES = pictures(2)
FILE = Path("rig.yaml")
GIVEN_K = np.array([[90.0, 0, 30], [0, 91, 22], [0, 0, 1]])


def bag(folder: Path, *names: str, info: bool = True, **fields: Any) -> Path:
    """Cameras with the CameraInfo that is described, or without."""
    ros, messages = Ros(2), list[Message]()
    for name in names:
        messages += [ros.image(f"/{name}/image_raw", 10**9 * (k + 1), i, "bgr8", name) for k, i in enumerate(IMAGES)]
        messages += [ros.info(f"/{name}/camera_info", **fields)] if info else []
    return write_mcap(folder / f"{'_'.join(names)}.mcap", messages)


def given(*names: str, size: tuple[int, int] = SIZE) -> SourceOptions:
    known = {name: Camera(name=name, width=size[0], height=size[1], K=GIVEN_K) for name in names}
    return SourceOptions(intrinsics=FILE, read_cameras=lambda path: known)


def focal_lengths(path: Path, options: SourceOptions) -> dict[str, float]:
    return {camera.name: float(camera.K[0, 0]) for camera in open_recordings([path], options).cameras}


def test_what_is_given_wins_over_camera_info_for_the_cameras_it_names(tmp_path: Path, told: list[str]):
    path = bag(tmp_path, "a", "b", "c", d=[0.1] * 5)
    recording = open_recordings([path], given("a", "c", "elsewhere"))
    assert [camera.K[0, 0] for camera in recording.cameras] == [90, K[0, 0], 90]
    assert [camera.has_distortion for camera in recording.cameras] == [False, True, False]
    assert told == ["rig.yaml: intrinsics of a, c are used instead of CameraInfo"]


def test_it_helps_a_driver_that_did_not_know_a_calibration(tmp_path: Path):
    path = bag(tmp_path, "cam", k=np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"CameraInfo is empty .* give its intrinsics with --intrinsics FILE"):
        open_recordings([path])
    assert focal_lengths(path, given("cam")) == {"cam": 90}


def test_and_the_depth_beside_its_images(tmp_path: Path):
    ros, zero = Ros(2), np.zeros((3, 3))
    depth = np.full((SIZE[1], SIZE[0]), 1000, dtype=np.uint16)
    messages = [ros.image("/cam/image_raw", 10**9, IMAGES[0], "bgr8"), ros.info("/cam/camera_info", k=zero)]
    messages += [ros.image("/cam/depth/image_raw", 10**9, depth, "16UC1"), ros.info("/cam/depth/camera_info", k=zero)]
    recording = open_recordings([write_mcap(tmp_path / "a.mcap", messages)], given("cam"))
    np.testing.assert_array_equal(recording.cameras[0].K_depth, GIVEN_K)
    (frame,) = recording.frames("cam", [0], depth=True)
    assert isinstance(frame, Frame)
    np.testing.assert_array_equal(frame.depth_m, depth * np.float32(0.001))


@pytest.mark.parametrize("info", [True, False])
def test_one_camera_here_and_there_is_the_same_whatever_it_is_called(info: bool, tmp_path: Path):
    assert focal_lengths(bag(tmp_path, "cam", info=info), given("webcam")) == {"cam": 90}


def test_but_not_where_other_recordings_are_read_beside_it(tmp_path: Path):
    paths = [bag(tmp_path, name) for name in "ab"]
    recording = open_recordings(paths, given("x"))
    assert [camera.K[0, 0] for camera in recording.cameras] == [K[0, 0]] * 2


def test_intrinsics_that_are_of_no_camera_are_told(tmp_path: Path, told: list[str]):
    assert focal_lengths(bag(tmp_path, "a", "b"), given("x")) == {"a": K[0, 0], "b": K[0, 0]}
    assert told == ["rig.yaml: has intrinsics of x, none of a, b, whose CameraInfo is used"]


def test_without_camera_info_the_file_must_name_the_cameras(tmp_path: Path, told: list[str]):
    path = bag(tmp_path, "a", "b", info=False)
    assert focal_lengths(path, given("a")) == {"a": 90}
    assert told == [
        f"{path}: /b/image_raw is left out, it has no CameraInfo, and rig.yaml has intrinsics of a, not of b"
    ]
    with pytest.raises(InputError) as caught:
        open_recordings([path], given("x", "y"))
    assert (
        "no CameraInfo beside /a/image_raw, /b/image_raw, and rig.yaml has intrinsics of x, y, not of a, b; call its "
        "cameras so, or name the images with --topics NAME=IMAGE"
    ) in str(caught.value)


@pytest.mark.parametrize("info", [True, False])
def test_intrinsics_of_another_size_are_refused_at_once(info: bool, tmp_path: Path):
    with pytest.raises(InputError) as caught:
        open_recordings([bag(tmp_path, "cam", info=info)], given("cam", size=(640, 480)))
    assert (
        "rig.yaml: the intrinsics are of images of 640 x 480, but /cam/image_raw has 64 x 48; give the intrinsics of "
        "this resolution"
    ) in str(caught.value)


def test_a_folder_for_the_videos_beside_a_bag_does_not_matter_to_it(tmp_path: Path):
    def nobody(path: Path) -> dict[str, Camera]:
        raise InputError(f"{path}: no intrinsics there.")

    options = SourceOptions(intrinsics=tmp_path, read_cameras=nobody)
    paths = [bag(tmp_path, name) for name in "ab"]
    assert len(open_recordings(paths, options).cameras) == 2
    with pytest.raises(InputError, match="no intrinsics there"):
        open_recordings(paths[:1], options)


def rectified(folder: Path) -> Path:
    ros, messages = Ros(2), list[Message]()
    for topic in ("image_raw", "image_rect_color"):
        messages += [ros.image(f"/cam/{topic}", 10**9 * (k + 1), i, "bgr8", "cam") for k, i in enumerate(IMAGES)]
    p = np.hstack([K, np.zeros((3, 1))])
    return write_mcap(folder / "cam.mcap", [*messages, ros.info("/cam/camera_info", d=[0.1] * 5, p=p)])


def of_raw_images() -> dict[str, Camera]:
    return {"cam": Camera(name="cam", width=SIZE[0], height=SIZE[1], K=GIVEN_K, distortion=np.full(5, 0.1))}


def test_intrinsics_of_raw_images_are_not_those_of_rectified_ones(tmp_path: Path):
    path = rectified(tmp_path)
    with pytest.raises(InputError) as caught:
        open_recordings([path], SourceOptions(intrinsics=FILE, read_cameras=lambda path: of_raw_images()))
    assert (
        f"{path}: rig.yaml: the intrinsics have distortion, but /cam/image_rect_color is rectified; name the raw "
        "images with --topics cam=IMAGE_TOPIC"
    ) in str(caught.value)
    assert "/cam/image_raw (sensor_msgs/Image, 2)" in str(caught.value)
    assert focal_lengths(path, given("cam")) == {"cam": 90}  # without distortion they may be


@pytest.mark.parametrize(("topic", "warnings"), [("image_raw", 0), ("image_rect_color", 1)])
def test_unless_the_user_names_the_images(topic: str, warnings: int, tmp_path: Path, said: list[str]):
    options = SourceOptions(intrinsics=FILE, read_cameras=lambda path: of_raw_images(), topics=(f"cam=/cam/{topic}",))
    (camera,) = open_recordings([rectified(tmp_path)], options).cameras
    assert camera.has_distortion
    assert len([line for line in said if "is rectified; they are used for it as named" in line]) == warnings
    assert len(said) == warnings
