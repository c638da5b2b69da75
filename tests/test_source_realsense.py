"""RealSense's own recordings, in files made to librealsense's description of them.

What the files have of their own: topics by device, sensor and stream; times of recording since the device was started;
a float32 behind each image, marked by the frame_id "1", that no message definition mentions; depth named mono16.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writers import SIZE, K, Message, Ros, pictures, write_bag1, write_bag2

from aruco.errors import InputError
from aruco.model import Frame
from rigcal.sources import open_recordings
from rigcal.sources.options import SourceOptions

N = 4
T0 = 1_700_000_000_123_000_000  # global time
IMAGES = pictures(N)
GREY = [image[..., 0].copy() for image in pictures(N, seed=5)]
DEPTHS = [np.random.default_rng(k).integers(0, 9000, (SIZE[1], SIZE[0])).astype(np.uint16) for k in range(N)]
K_IR = np.array([[90.0, 0, 32], [0, 90, 24], [0, 0, 1]])
HERE = (0.0, 0.0, 0.0)
COLOUR = (0.0149, 0.0001, 0.0003)  # where the colour sensor of a D435 stands, metres
UNIT = 0.0001  # of an L515 or of short-range settings
STREAMS = {"Depth_0": "sensor_0", "Infrared_1": "sensor_0", "Infrared_2": "sensor_0", "Color_0": "sensor_1"}


def static(
    ros: Ros, streams: tuple[str, ...], serial: str, colour_at: tuple[float, ...], options: bool
) -> Iterator[Message]:
    """What a file begins with."""
    vector, turn = ros.store.types["geometry_msgs/msg/Vector3"], ros.store.types["geometry_msgs/msg/Quaternion"]
    yield ros.message("/file_version", "std_msgs/msg/UInt32", 1, data=4)
    for key, value in (("Name", "Intel RealSense D435"), ("Serial Number", serial), ("Firmware Version", "5.16")):
        if value:
            yield ros.message("/device_0/info", "diagnostic_msgs/msg/KeyValue", 1, key=key, value=value)
    if options:
        for name, value in (("Depth_Units", UNIT), ("Stereo_Baseline", 49.94)):
            yield ros.message(f"/device_0/sensor_0/option/{name}/value", "std_msgs/msg/Float32", 1, data=value)
    for stream in streams:
        prefix = f"/device_0/{STREAMS[stream]}/{stream}"
        yield Message(f"{prefix}/info", "realsense_msgs/msg/StreamInfo", 1, bytes(13))
        matrix, model = (K, "Inverse Brown Conrady") if stream == "Color_0" else (K_IR, "Brown Conrady")
        # P is left empty.
        yield ros.info(
            f"{prefix}/info/camera_info", 0, k=matrix, d=[0.0] * 5, model=model, p=np.zeros((3, 4)), log_ns=1
        )
        place = colour_at if stream == "Color_0" else (-0.04994, 0.0, 0.0) if stream == "Infrared_2" else HERE
        yield ros.message(
            f"{prefix}/tf/0",
            "geometry_msgs/msg/Transform",
            1,
            translation=vector(*place),
            rotation=turn(0.0, 0.0, 0.0, 1.0),
        )


def recorded(
    ros: Ros,
    streams: tuple[str, ...] = tuple(STREAMS),
    *,
    serial: str = "934222071234",
    colour_at: tuple[float, ...] = COLOUR,
    options: bool = True,
    unit: float | None = UNIT,
) -> Iterator[Message]:
    yield from static(ros, streams, serial, colour_at, options)
    pixels: dict[str, tuple[list[Any], str]] = {
        "Depth_0": (DEPTHS, "mono16"),
        "Infrared_1": (GREY, "8UC1"),
        "Infrared_2": (GREY[::-1], "8UC1"),
        "Color_0": (IMAGES, "rgb8"),
    }
    for k in range(N):
        for stream in streams:
            images, encoding = pixels[stream]
            topic, stamp = f"/device_0/{STREAMS[stream]}/{stream}/image/data", T0 + k * 33_000_000
            marked = unit is not None and ros.version == 1
            message = ros.image(
                topic, stamp, images[k], encoding, "1" if marked else "", log_ns=2_000_000_000 + k * 33_000_000
            )
            extra = struct.pack("<f", unit if stream == "Depth_0" else 0.0) if marked and unit is not None else b""
            yield message._replace(data=message.data + extra)
            yield ros.message(
                f"{topic.removesuffix('data')}metadata", "diagnostic_msgs/msg/KeyValue", 1, key="Exposure", value="33"
            )


def test_the_colour_camera_is_taken_by_serial_number_and_depth_of_another_place_left_out(
    tmp_path: Path, said: list[str]
):
    recording = open_recordings([write_bag1(tmp_path / "a.bag", recorded(Ros(1)))])
    (camera,) = recording.cameras
    assert camera.name == "934222071234"
    np.testing.assert_array_equal(camera.K, K)
    assert not camera.has_distortion
    assert recording.stamps_ns(camera.name).tolist() == [T0 + k * 33_000_000 for k in range(N)]
    assert len(recording.depth_indices(camera.name)) == 0
    found = [frame.image for frame in recording.frames(camera.name, range(N), depth=True) if isinstance(frame, Frame)]
    np.testing.assert_array_equal(found, [image[..., ::-1] for image in IMAGES])
    assert said == [
        "camera 934222071234: depth is not in the frame of /device_0/sensor_1/Color_0 and is left out; --topics "
        "934222071234=/device_0/sensor_0/Infrared_1/image/data,/device_0/sensor_0/Infrared_1/info/camera_info,"
        "/device_0/sensor_0/Depth_0/image/data takes the images that share it"
    ]


def check_depth(recording: Any, name: str, unit: float) -> None:
    assert recording.depth_indices(name).tolist() == list(range(N))
    for k, frame in enumerate(recording.frames(name, range(N), depth=True)):
        assert isinstance(frame, Frame), frame
        assert frame.depth_m is not None
        np.testing.assert_allclose(np.nan_to_num(frame.depth_m), DEPTHS[k] * unit, rtol=1e-6)  # float32


def test_the_left_infrared_camera_has_the_depth(tmp_path: Path, said: list[str]):
    streams = ("Depth_0", "Infrared_1", "Infrared_2")
    recording = open_recordings([write_bag1(tmp_path / "a.bag", recorded(Ros(1), streams))])
    (camera,) = recording.cameras
    np.testing.assert_array_equal(camera.K, K_IR)
    assert camera.baseline_m == pytest.approx(0.04994, rel=1e-6)  # float32
    found = [frame.image for frame in recording.frames(camera.name, range(N)) if isinstance(frame, Frame)]
    np.testing.assert_array_equal(found, GREY)
    check_depth(recording, camera.name, UNIT)
    assert said == []


def test_depth_in_the_colour_cameras_place_belongs_to_it(tmp_path: Path):
    """As of an SDK recording of aligned streams, or of a sensor with one lens."""
    bag = write_bag1(tmp_path / "a.bag", recorded(Ros(1), colour_at=HERE))
    recording = open_recordings([bag])
    np.testing.assert_array_equal(recording.cameras[0].K, K)
    np.testing.assert_array_equal(recording.cameras[0].K_depth, K_IR)
    check_depth(recording, "934222071234", UNIT)


@pytest.mark.parametrize(("unit", "options", "scale"), [(UNIT, False, UNIT), (None, True, UNIT), (None, False, 0.001)])
def test_the_depth_unit_is_in_the_images_else_in_the_options_else_a_millimetre(
    unit: float | None, options: bool, scale: float, tmp_path: Path
):
    messages = recorded(Ros(1), ("Depth_0", "Infrared_1"), unit=unit, options=options)
    recording = open_recordings([write_bag1(tmp_path / "a.bag", messages)])
    check_depth(recording, recording.cameras[0].name, scale)


def test_what_is_said_about_depth_works(tmp_path: Path, said: list[str]):
    bag = write_bag1(tmp_path / "a.bag", recorded(Ros(1)))
    open_recordings([bag])
    topics = said[0].split("--topics ")[1].split(" takes")[0]
    recording = open_recordings([bag], SourceOptions(topics=(topics,)))
    np.testing.assert_array_equal(recording.cameras[0].K, K_IR)
    check_depth(recording, "934222071234", UNIT)
    assert len(said) == 1


def test_depth_of_another_place_is_taken_as_named_and_told(tmp_path: Path, said: list[str]):
    bag = write_bag1(tmp_path / "a.bag", recorded(Ros(1)))
    colour, depth = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"
    topics = f"top={colour}/image/data,{colour}/info/camera_info,{depth}/image/data"
    recording = open_recordings([bag], SourceOptions(topics=(topics,)))
    check_depth(recording, "top", UNIT)
    assert "is not in the frame of" in said[0]


def test_a_folder_of_recordings_is_a_rig_whatever_the_files_are_called(tmp_path: Path):
    """One file a camera; rig_0.bag and rig_1.bag are no split bag, although their topics have the same names."""
    for k, serial in enumerate(("111", "222")):
        write_bag1(tmp_path / f"rig_{k}.bag", recorded(Ros(1), ("Color_0",), serial=serial))
    recording = open_recordings([tmp_path])
    assert [camera.name for camera in recording.cameras] == ["111", "222"]


def test_newer_recordings_in_db3_files_are_read_alike(tmp_path: Path):
    folder = write_bag2(tmp_path / "a", [m for m in recorded(Ros(2)) if "StreamInfo" not in m.type])
    recording = open_recordings([folder / "a.db3"])
    found = [frame.image for frame in recording.frames("934222071234", range(N)) if isinstance(frame, Frame)]
    np.testing.assert_array_equal(found, [image[..., ::-1] for image in IMAGES])


def test_a_recording_of_depth_alone_holds_no_camera(tmp_path: Path):
    bag = write_bag1(tmp_path / "a.bag", recorded(Ros(1), ("Depth_0",)))
    with pytest.raises(InputError, match="holds no images that are read; its topics: /device_0/sensor_0/Depth_0"):
        open_recordings([bag])


@pytest.mark.parametrize("serial", ["../x", "a/b", ".."])
def test_a_serial_number_that_leads_elsewhere_is_refused(serial: str, tmp_path: Path):
    bag = write_bag1(tmp_path / "a.bag", recorded(Ros(1), serial=serial))
    with pytest.raises(InputError, match="a folder cannot have this name"):
        open_recordings([bag])


def test_without_a_serial_number_the_device_is_the_name(tmp_path: Path):
    bag = write_bag1(tmp_path / "a.bag", recorded(Ros(1), serial=""))
    assert [camera.name for camera in open_recordings([bag]).cameras] == ["device_0"]
