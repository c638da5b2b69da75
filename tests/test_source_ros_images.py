"""Pixels of ROS images: every encoding gives the picture that went in, and what is not read is named."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
import pytest
from bag_writers import Ros, jpeg, pictures, png

from rigcal.sources.decompression import DamagedError
from rigcal.sources.ros_images import confidence_percent, depth_metres, image_pixels, is_depth
from rigcal.sources.ros_messages import (
    RawImage,
    read_camera_info,
    read_compressed,
    read_header,
    read_image,
)

BGR = pictures(1)[0]
GREY = BGR[..., 1].copy()
ALPHA = np.dstack([BGR, np.full_like(GREY, 7)])
DEPTH = np.random.default_rng(3).integers(0, 5000, GREY.shape).astype(np.uint16)


def raw(pixels: Any, encoding: str, version: int = 2, **more: Any) -> RawImage:
    message = Ros(version).image("/i", 123_456_789_012, pixels, encoding, "frame", **more)
    return read_image(message.data, "ros1" if version == 1 else "cdr")


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("padding", [0, 13])
@pytest.mark.parametrize(
    ("pixels", "encoding", "expected"),
    [
        (GREY, "mono8", GREY),
        (GREY, "8UC1", GREY),
        (BGR, "bgr8", BGR),
        (BGR, "8UC3", BGR),
        (BGR[..., ::-1], "rgb8", BGR),
        (ALPHA, "bgra8", BGR),
        (ALPHA[..., [2, 1, 0, 3]], "rgba8", BGR),
    ],
)
def test_plain_encodings_are_exact(pixels: Any, encoding: str, expected: Any, padding: int, version: int):
    message = raw(pixels, encoding, version, padding=padding)
    assert (message.header.stamp_ns, message.header.frame_id) == (123_456_789_012, "frame")
    found = image_pixels(message)
    np.testing.assert_array_equal(found, expected)
    assert found.flags.c_contiguous


@pytest.mark.parametrize(("encoding", "at"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("YUYV", 0)])
def test_yuv_has_its_bytes_where_the_name_says(encoding: str, at: int):
    """A colour bar of wide stripes: luma at even or odd bytes, and blue is not red."""
    bar = np.zeros((8, 64, 3), dtype=np.uint8)
    bar[:, 16:32], bar[:, 32:48], bar[:, 48:] = (255, 0, 0), (0, 0, 255), (0, 255, 0)
    yuv = cv2.cvtColor(bar, cv2.COLOR_BGR2YUV).astype(int)
    # ITU-R BT.601 of limited range, which cameras send; OpenCV's is full.
    luma = np.rint(16 + yuv[..., 0] * 219 / 255)
    b, g, r = (bar[..., k].astype(float) for k in range(3))
    u, v = 128 - 0.148 * r - 0.291 * g + 0.439 * b, 128 + 0.439 * r - 0.368 * g - 0.071 * b
    packed = np.empty((8, 128), dtype=np.uint8)
    packed[:, at::2] = luma
    packed[:, 1 - at :: 4], packed[:, 3 - at :: 4] = u[:, ::2], v[:, ::2]
    found = image_pixels(raw(packed, encoding, width=64))
    # Eight bits, there and back.
    assert np.abs(found.astype(int) - bar).max() <= 4


@pytest.mark.parametrize("name", ["rggb", "bggr", "gbrg", "grbg"])
def test_mosaics_are_named_by_their_first_two_rows(name: str):
    colour = {"r": 200, "g": 120, "b": 30}
    mosaic = np.array([[colour[name[0]], colour[name[1]]], [colour[name[2]], colour[name[3]]]], dtype=np.uint8)
    found = image_pixels(raw(np.tile(mosaic, (12, 16)), f"bayer_{name}8"))
    assert found.shape == (24, 32, 3)
    assert np.unique(found[4:-4, 4:-4].reshape(-1, 3), axis=0).tolist() == [[30, 120, 200]]


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "mono16", "bayer_rggb16", "rgb16", "h264"])
def test_encodings_that_are_no_pictures_are_named(encoding: str):
    with pytest.raises(DamagedError, match=f"has the encoding '{encoding}', which is not read; record one of mono8"):
        image_pixels(raw(DEPTH, encoding))


@pytest.mark.parametrize("big", [0, 1])
@pytest.mark.parametrize("encoding", ["16UC1", "mono16"])
def test_sixteen_bits_are_millimetres(encoding: str, big: int):
    values = DEPTH.astype(">u2" if big else "<u2")
    found = depth_metres(raw(values, encoding, padding=6, is_bigendian=big), 0.001)
    np.testing.assert_array_equal(np.nan_to_num(found), (DEPTH * 0.001).astype(np.float32))
    assert np.isnan(found[DEPTH == 0]).all()


@pytest.mark.parametrize("big", [0, 1])
def test_floats_are_metres_and_what_is_no_measurement_is_nan(big: int):
    values = (DEPTH * 0.001).astype(">f4" if big else "<f4")
    values[0, :4] = [np.nan, np.inf, -np.inf, -1]
    found = depth_metres(raw(values, "32FC1", is_bigendian=big), 123.0)
    expected = values.astype(np.float32)
    expected[0, :4] = 0
    np.testing.assert_array_equal(np.nan_to_num(found), expected)
    assert np.isnan(found[expected == 0]).all()


def test_confidence_is_a_percentage():
    values = np.array([[0.0, 1.0, 99.6, 100.0], [np.nan, -1.0, 250.0, 50.0]], dtype=np.float32)
    expected = [[0, 1, 99, 100], [100, 0, 100, 50]]
    np.testing.assert_array_equal(confidence_percent(raw(values, "32FC1")), expected)
    np.testing.assert_array_equal(confidence_percent(raw(GREY, "mono8")), GREY)


@pytest.mark.parametrize(
    ("height", "width", "step"), [(48, 64, 100), (2**31, 2**31, 192), (0, 64, 192), (48, 2**28, 0), (49, 64, 192)]
)
def test_sizes_that_the_data_do_not_have_are_refused(height: int, width: int, step: int):
    good = raw(BGR, "bgr8")
    bad = RawImage(
        header=good.header, width=width, height=height, encoding="bgr8", is_bigendian=False, step=step, data=good.data
    )
    with pytest.raises(DamagedError, match=r"too few for|not a camera's image"):
        image_pixels(bad)


def packed(data: bytes, form: str, version: int = 2) -> Any:
    return read_compressed(Ros(version).compressed("/i", 1, data, form).data, "ros1" if version == 1 else "cdr")


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    "form", ["png", "bgr8; png compressed bgr8", "rgb8; png compressed bgr8", "rgb8; png compressed "]
)
def test_compressed_images_are_decoded(form: str, version: int):
    np.testing.assert_array_equal(image_pixels(packed(png(BGR), form, version)), BGR)
    np.testing.assert_array_equal(image_pixels(packed(png(GREY), "mono8; png compressed mono8", version)), GREY)


def test_compressed_images_in_the_other_order_say_so():
    np.testing.assert_array_equal(image_pixels(packed(png(BGR), "rgb8; png compressed rgb8")), BGR[..., ::-1])


def test_jpeg_is_what_opencv_makes_of_it():
    data = jpeg(cv2.GaussianBlur(BGR, (0, 0), 3))
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image_pixels(packed(data, "jpeg")), expected)
    with pytest.raises(DamagedError, match=r"\(jpeg\) is cut off"):
        image_pixels(packed(data[:-30], "jpeg"))


HEADER = struct.pack("<iff", 0, 100.0, 50.0)


def test_compressed_depth_of_sixteen_bits_has_a_header_before_its_png():
    for data, form in ((HEADER + png(DEPTH), "16UC1; compressedDepth png"), (png(DEPTH), "16UC1; png compressed ")):
        assert is_depth(form)
        np.testing.assert_array_equal(
            np.nan_to_num(depth_metres(packed(data, form), 0.001)), (DEPTH * 0.001).astype(np.float32)
        )


def test_compressed_depth_of_metres_is_quantised_inverse_depth():
    """As compressed_depth_image_transport quantises with its defaults: depth_max 10 m, depth_quantization 100."""
    quantisation, farthest = 100.0, 10.0
    a = quantisation * (quantisation + 1)
    b = 1 - a / farthest
    metres = np.random.default_rng(1).uniform(0.5, 9.9, GREY.shape).astype(np.float32)
    metres[0, 0] = np.nan
    values = np.where(np.isnan(metres), 0, a / np.nan_to_num(metres, nan=1) + b).astype(np.uint16)
    data = struct.pack("<iff", 0, a, b) + png(values)
    found = depth_metres(packed(data, "32FC1; compressedDepth"), 0.001)
    assert np.isnan(found[0, 0])
    valid = ~np.isnan(metres)
    # A step of the quantisation is z^2 / a: 1 cm at 10 m.
    assert (np.abs(found - metres)[valid] <= metres[valid] ** 2 / a * 1.01 + 1e-5).all()


@pytest.mark.parametrize(
    ("data", "form", "message"),
    [
        (HEADER + bytes(8), "16UC1; compressedDepth rvl", "compressed as RVL, which is not read"),
        (HEADER[:5], "16UC1; compressedDepth png", "ends after 5 bytes"),
        (HEADER + png(GREY), "16UC1; compressedDepth png", "is not 16-bit grey"),
        (png(DEPTH), "32FC1; png compressed", "does not say how metres became 16 bits"),
        (HEADER + png(DEPTH)[:-20], "16UC1; compressedDepth png", "cut off"),
    ],
)
def test_compressed_depth_that_is_not_read_is_named(data: bytes, form: str, message: str):
    with pytest.raises(DamagedError, match=message):
        depth_metres(packed(data, form), 0.001)


@pytest.mark.parametrize("version", [1, 2])
def test_messages_cut_anywhere_are_refused(version: int):
    ros, encoding = Ros(version), "ros1" if version == 1 else "cdr"
    info = ros.info("/c", d=[0.1, 0.2, 0.3, 0.4, 0.5]).data
    assert read_camera_info(info, encoding).D.tolist() == [0.1, 0.2, 0.3, 0.4, 0.5]
    # ROS 2's last fields, of the region, are not read.
    for size in range(len(info) - 16):
        with pytest.raises(DamagedError):
            read_camera_info(info[:size], encoding)
    image = ros.image("/i", 10**18, GREY, "mono8", "a_frame").data
    for size in range(0, 60, 3):
        with pytest.raises(DamagedError):
            read_image(image[:size], encoding)
    assert read_header(image[:60], encoding).frame_id == "a_frame"


def test_big_endian_cdr_is_read():
    ros = Ros(2)
    kind = "sensor_msgs/msg/Image"
    fields = {
        "header": ros.header(123_456_789_012, "frame"),
        "height": GREY.shape[0],
        "width": GREY.shape[1],
        "encoding": "mono8",
        "is_bigendian": 0,
        "step": GREY.shape[1],
        "data": GREY.ravel(),
    }
    data = bytes(ros.store.serialize_cdr(ros.store.types[kind](**fields), kind, little_endian=False))
    message = read_image(data, "cdr")
    assert message.header.stamp_ns == 123_456_789_012
    np.testing.assert_array_equal(image_pixels(message), GREY)


def test_other_representations_than_plain_cdr_are_refused():
    data = bytearray(Ros(2).image("/i", 1, GREY, "mono8").data)
    data[1] = 3  # a parameter list
    with pytest.raises(DamagedError, match="is not plain CDR"):
        read_image(bytes(data), "cdr")
