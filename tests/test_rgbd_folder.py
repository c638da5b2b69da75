"""The RGB-D folder: what is written is what is read, and whatever is wrong with a folder is said."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from aruco.errors import InputError, OutputError
from aruco.model import SILENT, BadFrame, Camera, DistortionModel, Frame, Recording
from aruco.pose_math import Array
from rigcal.sources import open_recordings
from rigcal.sources.camera_info import MAX_FILE_BYTES, dump_camera_info, load_camera_info
from rigcal.sources.rgbd_folder import RgbdFolder, write_recording

DATA = Path(__file__).parents[2] / "shared/data"
MS = 1_000_000
W, H = 32, 24
K = np.array([[30.0, 0.0, 15.5], [0.0, 30.0, 11.5], [0.0, 0.0, 1.0]])


def picture(seed: int, *, grey: bool = False, width: int = W) -> NDArray[np.uint8]:
    shape = (H, width) if grey else (H, width, 3)
    noise = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0), dtype=np.uint8)


def encoded(image: NDArray[np.uint8] | NDArray[np.uint16], suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def camera_named(name: str, *, depth_K: Array | None = None) -> Camera:
    return Camera(name=name, width=W, height=H, K=K, depth_K=depth_K)


def make_camera(folder: Path, images: dict[str, bytes], camera: Camera | None = None) -> Path:
    (folder / "image").mkdir(parents=True)
    (folder / "camera_info.yaml").write_text(dump_camera_info(camera or camera_named(folder.name)))
    for name, data in images.items():
        (folder / "image" / name).write_bytes(data)
    return folder


def put(folder: Path, name: str, data: bytes) -> None:
    folder.mkdir(exist_ok=True)
    (folder / name).write_bytes(data)


def npy(array: NDArray[np.generic]) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def read_all(recording: Recording, camera: str, *, depth: bool = False) -> list[Frame | BadFrame]:
    return list(recording.frames(camera, range(len(recording.stamps_ns(camera))), depth=depth))


def only_frame(recording: Recording, *, depth: bool = False) -> Frame | BadFrame:
    (frame,) = read_all(recording, recording.cameras[0].name, depth=depth)
    return frame


def good(frame: Frame | BadFrame) -> Frame:
    assert isinstance(frame, Frame), frame
    return frame


class InMemory:
    """A recording of two cameras without files; the second has depth of another size and a bad frame."""

    cameras = (camera_named("left"), camera_named("right", depth_K=K / [[2], [2], [1]]))

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        return np.array([5, 33 * MS, 66 * MS], dtype=np.int64)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        return np.array([] if camera == "left" else [0, 2], dtype=np.int64)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        for i in indices:
            stamp_ns = int(self.stamps_ns(camera)[i])
            if camera == "left":
                yield Frame(camera=camera, stamp_ns=stamp_ns, image=picture(i, grey=True))
            elif i == 1:
                yield BadFrame(camera, stamp_ns, "dropped")
            else:
                depth_m = np.full((H // 2, W // 2), 1.2344 + i, dtype=np.float32)
                depth_m[0, :4] = np.nan, np.inf, -1.0, 70.0
                confidence = np.full((H // 2, W // 2), 7 + i, dtype=np.uint8)
                more = {"depth_m": depth_m, "confidence": confidence} if depth else {}
                yield Frame(camera=camera, stamp_ns=stamp_ns, image=picture(i), **more)


# camera_info.yaml

positive = st.floats(1e-6, 1e6)
numbers = st.floats(-1e6, 1e6)
models: st.SearchStrategy[tuple[DistortionModel, int]] = st.sampled_from(
    [("plumb_bob", 0), ("plumb_bob", 4), ("plumb_bob", 5), ("rational_polynomial", 8), ("equidistant", 4)]
)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    model, n = draw(models)
    K = np.array([[draw(positive), draw(numbers), draw(numbers)], [0, draw(positive), draw(numbers)], [0, 0, 1]])
    return Camera(
        name=draw(st.sampled_from(["38580376", "left", "yes", "1e5", "Kamera süd", "a: b", "null"])),
        width=draw(st.integers(1, 9999)),
        height=draw(st.integers(1, 9999)),
        K=K,
        distortion_model=model,
        distortion=np.array([draw(numbers) for _ in range(n)]),
        depth_K=draw(st.none() | st.just(K * [[draw(positive)], [1.0], [1.0]])),
        depth_scale=draw(positive),
        baseline_m=draw(st.none() | positive),
    )


@settings(max_examples=60, deadline=None)
@given(camera=cameras())
def test_camera_info_round_trips_exactly(tmp_path_factory: pytest.TempPathFactory, camera: Camera) -> None:
    path = tmp_path_factory.mktemp("info") / "camera_info.yaml"
    path.write_text(dump_camera_info(camera), encoding="utf-8")
    again = load_camera_info(path, camera.name)
    for field in ("name", "width", "height", "distortion_model", "depth_scale", "baseline_m"):
        assert getattr(again, field) == getattr(camera, field)
    for field in ("K", "distortion", "depth_K"):
        np.testing.assert_array_equal(getattr(again, field), getattr(camera, field))


def info(**changes: str | None) -> str:
    lines = {
        "image_width": "32",
        "image_height": "24",
        "camera_matrix": "{rows: 3, cols: 3, data: [30, 0, 15.5, 0, 30, 11.5, 0, 0, 1]}",
        "distortion_model": "plumb_bob",
        "distortion_coefficients": "{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}",
    }
    return "".join(f"{key}: {value}\n" for key, value in {**lines, **changes}.items() if value is not None)


def test_camera_info_reads_numbers_as_ros_writes_them(tmp_path: Path) -> None:
    path = tmp_path / "camera_info.yaml"
    # YAML 1.1 takes 1e-05 for a word, and a byte order mark is what some editors leave.
    path.write_text("\ufeff" + info(distortion_coefficients="{rows: 1, cols: 4, data: [1e-05, -2E-3, .5, 010]}"))
    camera = load_camera_info(path, "left")
    np.testing.assert_array_equal(camera.distortion, [1e-5, -2e-3, 0.5, 10, 0])
    assert (camera.name, camera.depth_scale, camera.baseline_m) == ("left", 0.001, None)


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefghij", "bcdefghijk")
)
MATRIX = "{{rows: {}, cols: {}, data: [{}]}}"
BAD_INFO = {
    "lacks image_width, camera_matrix": info(image_width=None, camera_matrix=None),
    "image_width must be a whole number from 1 to 32768, got '32.5'": info(image_width="32.5"),
    "image_height must be a whole number from 1 to 32768, got '-24'": info(image_height="-24"),
    "image_width must be a whole number from 1 to 32768, got '0'": info(image_width="0"),
    "image_width must be a whole number from 1 to 32768, got '1000000000'": info(image_width="1000000000"),
    "rows must be a whole number from 0 to 65535, got '-3'": info(camera_matrix=MATRIX.format(-3, 3, "30")),
    "NaN": info(camera_matrix=MATRIX.format(3, 3, "nan, 0, 15.5, 0, 30, 11.5, 0, 0, 1")),
    "ordinary numbers": info(camera_matrix=MATRIX.format(3, 3, ".nan, 0, 15.5, 0, 30, 11.5, 0, 0, 1")),
    "focal lengths must be positive": info(camera_matrix=MATRIX.format(3, 3, "0, 0, 15.5, 0, 30, 11.5, 0, 0, 1")),
    "3 rows and 3 cols": info(camera_matrix=MATRIX.format(3, 3, "30, 0, 15.5, 0, 30, 11.5")),
    "got 9 rows": info(camera_matrix=MATRIX.format(9, 1, "30, 0, 15.5, 0, 30, 11.5, 0, 0, 1")),
    "rows, cols and data": info(camera_matrix="[30, 0, 15.5]"),
    "single value, not a list": info(camera_matrix=MATRIX.format(3, 3, "30, 0, 15.5, 0, 30, 11.5, 0, 0, [1]")),
    "unknown distortion_model 'fancy'": info(distortion_model="fancy"),
    "wants 8 distortion_coefficients": info(distortion_model="rational_polynomial"),
    "depth_scale": info(depth_scale="0"),
    "baseline": info(baseline="-0.12"),
    "depth_camera_matrix": info(depth_camera_matrix="{rows: 3, cols: 3, data: []}"),
    "holds no keys": "just a sentence",
    "holds no keys ": "",
    "not a readable YAML": "image_width: [32",
    "not a readable YAML ": "image_width: \x07",
    "not a readable YAML  ": 20_000 * "[",
    "KiB": info() + MAX_FILE_BYTES * "#",
    "distortion_model must be a single value": BOMB + info(distortion_model="*k"),
    "not a readable YAML   ": info(image_width="*nobody"),
}


@pytest.mark.parametrize(("words", "text"), BAD_INFO.items())
def test_unusable_camera_info_is_refused_by_name(tmp_path: Path, words: str, text: str) -> None:
    path = make_camera(tmp_path / "left", {"1.png": encoded(picture(0))}) / "camera_info.yaml"
    make_camera(tmp_path / "right", {"1.png": encoded(picture(0))})  # a good camera beside it changes nothing
    path.write_text(text)
    with pytest.raises(InputError) as error:
        RgbdFolder(tmp_path)
    assert words.strip() in str(error.value)
    assert str(error.value).startswith(f"{path}: ")
    assert len(str(error.value)) < len(str(path)) + 300


def test_camera_info_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "camera_info.yaml"
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(InputError, match="not a readable YAML"):
        load_camera_info(path, "left")


def test_a_camera_without_camera_info_is_an_error(tmp_path: Path) -> None:
    make_camera(tmp_path / "left", {"1.png": encoded(picture(0))})
    (make_camera(tmp_path / "right", {"1.png": encoded(picture(0))}) / "camera_info.yaml").unlink()
    with pytest.raises(InputError, match=r"right.camera_info.yaml: cannot be read"):
        RgbdFolder(tmp_path)


# Reading


def test_frames_come_in_time_order_with_digest_and_as_stored(tmp_path: Path) -> None:
    grey, colour = encoded(picture(1, grey=True)), encoded(picture(2))
    jpeg = encoded(picture(3), ".jpg")
    make_camera(tmp_path / "left", {"100.png": grey, "20.png": colour, "-3.jpg": jpeg, "7.JPEG": jpeg})
    recording = RgbdFolder(tmp_path)
    assert recording.stamps_ns("left").tolist() == [-3, 7, 20, 100]
    frames = [good(frame) for frame in read_all(recording, "left")]
    assert [frame.stamp_ns for frame in frames] == [-3, 7, 20, 100]
    assert [frame.digest for frame in frames] == [hashlib.sha256(d).hexdigest() for d in (jpeg, jpeg, colour, grey)]
    np.testing.assert_array_equal(frames[2].image, picture(2))
    np.testing.assert_array_equal(frames[3].image, picture(1, grey=True))
    assert frames[0].image.shape == (H, W, 3)
    assert [good(f).stamp_ns for f in recording.frames("left", [1, 3])] == [7, 100]


def test_cameras_are_sorted_and_named_after_their_folders(tmp_path: Path) -> None:
    for name in ("b", "a", "10"):
        make_camera(tmp_path / name, {"1.png": encoded(picture(0))}, camera_named("something else"))
    (tmp_path / "notes").mkdir()
    (tmp_path / "readme.txt").write_text("not a camera")
    assert [camera.name for camera in RgbdFolder(tmp_path).cameras] == ["10", "a", "b"]


def test_a_single_cameras_folder_is_a_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = make_camera(tmp_path / "left", {"1.png": encoded(picture(0))})
    monkeypatch.chdir(folder)
    for path in (folder, Path(".")):
        assert [camera.name for camera in RgbdFolder(path).cameras] == ["left"]


def test_frames_are_read_one_at_a_time(tmp_path: Path) -> None:
    folder = make_camera(tmp_path / "left", {f"{i}.png": encoded(picture(i)) for i in range(3)})
    frames = RgbdFolder(tmp_path).frames("left", range(3))
    good(next(frames))
    (folder / "image" / "1.png").unlink()  # had it been read ahead, nobody would notice
    bad = next(frames)
    assert isinstance(bad, BadFrame)
    assert "cannot be read" in bad.reason
    good(next(frames))


def test_other_files_are_ignored_and_png_wins(tmp_path: Path) -> None:
    names = [
        "notes.txt",
        "._1.png",
        "1.2.png",
        "x1.png",
        "99999999999999999999.png",
        "9000000000000000000.png",
        "\u0661.png",
    ]
    images = dict.fromkeys([*names, "1.png", "1.jpg", "2.jpg", "2.jpeg", "01.png"], encoded(picture(0)))
    folder = make_camera(tmp_path / "left", {**images, "1.jpg": b"junk"})
    (folder / "image" / "5.png").mkdir()
    (folder / "image" / "6.png").symlink_to(tmp_path / "nowhere")
    recording = RgbdFolder(tmp_path)
    # What is named like a frame and is none counts as a bad frame: nothing disappears without a word.
    assert recording.stamps_ns("left").tolist() == [1, 2, 5, 6]
    assert [isinstance(frame, Frame) for frame in read_all(recording, "left")] == [True, True, False, False]


def test_stamps_cannot_be_changed(tmp_path: Path) -> None:
    make_camera(tmp_path / "left", {"1.png": encoded(picture(0))})
    with pytest.raises(ValueError, match="read-only"):
        RgbdFolder(tmp_path).stamps_ns("left")[0] = 2


def test_an_unknown_camera_is_named_at_once(tmp_path: Path) -> None:
    make_camera(tmp_path / "left", {"1.png": encoded(picture(0))})
    with pytest.raises(InputError, match="no camera right in the recording; it has left"):
        RgbdFolder(tmp_path).frames("right", [0])


# Bad frames

WHOLE_PNG, WHOLE_JPEG = encoded(picture(4)), encoded(picture(4), ".jpg")
DEEP = encoded(np.full((H, W), 300, dtype=np.uint16))


def bit_flipped(data: bytes) -> bytes:
    return data[:200] + bytes([data[200] ^ 4]) + data[201:]


def promising(side: int) -> bytes:
    """A small PNG whose header promises a large square: believing it would cost the memory of one."""
    header = b"IHDR" + side.to_bytes(4, "big") * 2 + b"\x08\0\0\0\0"
    return WHOLE_PNG[:12] + header + zlib.crc32(header).to_bytes(4, "big") + WHOLE_PNG[33:]


BAD_IMAGES = {
    "is empty (0 bytes)": b"",
    "is neither PNG nor JPEG": b"GIF89a and so on",
    "is 16 x 24, but camera_info.yaml says 32 x 24": encoded(picture(0, width=16)),
    "is 16 x 24, but camera_info.yaml says 32 x 24 ": encoded(picture(0, width=16), ".jpg"),
    "is cut off": WHOLE_PNG[: len(WHOLE_PNG) // 2],
    "is cut off (the end of the PNG is missing)": WHOLE_PNG[:-12],
    "is cut off ": WHOLE_JPEG[: 3 * len(WHOLE_JPEG) // 4],
    "is cut off (the end of the JPEG is missing)": WHOLE_JPEG[:-2],
    "is damaged": bit_flipped(WHOLE_PNG),
    "has 16 bits a channel": DEEP,
    "is 131072 x 131072, but": promising(131072),
}


@pytest.mark.parametrize(("words", "data"), BAD_IMAGES.items())
def test_a_bad_image_is_a_bad_frame_among_good_ones(tmp_path: Path, words: str, data: bytes) -> None:
    make_camera(tmp_path / "left", {"1.png": WHOLE_PNG, "2.png": data, "3.png": WHOLE_JPEG})
    first, second, third = read_all(RgbdFolder(tmp_path), "left")
    assert (good(first).stamp_ns, good(third).stamp_ns) == (1, 3)
    assert isinstance(second, BadFrame)
    assert (second.camera, second.stamp_ns) == ("left", 2)
    assert second.reason.startswith(f"left/image/2.png {words.strip()}")


@pytest.mark.parametrize("whole", [WHOLE_PNG, WHOLE_JPEG])
def test_every_truncation_is_noticed(tmp_path: Path, whole: bytes) -> None:
    lengths = range(0, len(whole), 7)
    make_camera(tmp_path / "left", {f"{n}.png": whole[:n] for n in lengths})
    frames = read_all(RgbdFolder(tmp_path), "left")
    assert len(frames) == len(lengths)
    assert not any(isinstance(frame, Frame) for frame in frames)


def test_bytes_after_the_end_of_an_image_do_no_harm(tmp_path: Path) -> None:
    make_camera(tmp_path / "left", {"1.png": WHOLE_PNG + 64 * b"\0", "2.jpg": WHOLE_JPEG + 64 * b"\0"})
    for frame in read_all(RgbdFolder(tmp_path), "left"):
        assert good(frame).image.shape == (H, W, 3)


def test_an_orientation_tag_does_not_turn_the_image(tmp_path: Path) -> None:
    # Intrinsics belong to the pixels as stored; tag 0x112 = 3 asks viewers for a half turn.
    tiff = b"MM\0*\0\0\0\x08\0\1\x01\x12\0\3\0\0\0\1\0\3\0\0\0\0\0\0"
    exif = b"Exif\0\0" + tiff
    tagged = WHOLE_JPEG[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + WHOLE_JPEG[2:]
    make_camera(tmp_path / "left", {"1.jpg": WHOLE_JPEG, "2.jpg": tagged})
    plain, turned = (good(frame).image for frame in read_all(RgbdFolder(tmp_path), "left"))
    np.testing.assert_array_equal(plain, turned)
    as_viewers_see_it = cv2.imdecode(np.frombuffer(tagged, np.uint8), cv2.IMREAD_COLOR)
    assert as_viewers_see_it is not None
    assert not np.array_equal(as_viewers_see_it, plain)  # the tag is well-formed


def test_transparency_is_dropped(tmp_path: Path) -> None:
    image = np.dstack([picture(1), np.full((H, W), 128, np.uint8)])
    make_camera(tmp_path / "left", {"1.png": encoded(image)})
    np.testing.assert_array_equal(good(only_frame(RgbdFolder(tmp_path))).image, picture(1))


# Cameras and recordings without images


def test_a_camera_without_images_is_kept_with_zero_stamps(tmp_path: Path) -> None:
    make_camera(tmp_path / "left", {"1.png": encoded(picture(0))})
    make_camera(tmp_path / "right", {"notes.txt": b""})
    (make_camera(tmp_path / "third", {}) / "image").rmdir()
    recording = RgbdFolder(tmp_path)
    assert [camera.name for camera in recording.cameras] == ["left", "right", "third"]
    assert [len(recording.stamps_ns(camera.name)) for camera in recording.cameras] == [1, 0, 0]
    assert read_all(recording, "right", depth=True) == []


def test_no_image_at_all_is_an_error(tmp_path: Path) -> None:
    make_camera(tmp_path / "left", {"notes.txt": b""})
    with pytest.raises(InputError, match="no camera has an image"):
        RgbdFolder(tmp_path)


def test_empty_and_missing_folders_are_errors(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="no recording there"):
        RgbdFolder(tmp_path)
    for name in ("missing", "file"):
        with pytest.raises(InputError, match=f"{name}: cannot be read"):
            RgbdFolder(tmp_path / name)


# Depth and confidence


def test_depth_is_metres_with_nan_where_nothing_was_measured(tmp_path: Path) -> None:
    raw = np.arange(H * W, dtype=np.uint16).reshape(H, W) * 50
    metres = np.where(raw > 0, raw / 1000.0, np.nan).astype(np.float32)
    odd = metres.copy()
    odd[1, :3] = np.inf, -np.inf, -1.0
    folder = make_camera(tmp_path / "left", dict.fromkeys(["0.png", "33000000.png"], encoded(picture(0))))
    put(folder / "depth", "0.png", encoded(raw))
    put(folder / "depth", "33000000.npy", npy(odd))
    put(folder / "confidence", "33000000.png", encoded(np.full((H, W), 55, np.uint8)))
    recording = RgbdFolder(tmp_path)
    first, second = (good(frame) for frame in read_all(recording, "left", depth=True))
    assert first.depth_m is not None
    assert first.depth_m.dtype == np.float32
    np.testing.assert_allclose(first.depth_m, metres, rtol=1e-7)  # one float32 rounding
    odd[1, :3] = np.nan
    np.testing.assert_array_equal(second.depth_m, odd)
    assert first.confidence is None
    assert second.confidence is not None
    assert (second.confidence == 55).all()
    assert all(good(frame).depth_m is None for frame in read_all(recording, "left"))  # only when asked for


@pytest.mark.parametrize(
    ("images_ms", "depths_ms", "expected"),
    [
        ([0, 33, 66], [0, 33, 66], [0, 33, 66]),
        ([0, 33, 66], [4, 37], [4, 37, None]),
        ([0, 33, 66], [16, 49, 83], [16, 49, None]),  # half a period is 16.5 ms
        ([0, 33, 66], [17, 83], [None, 17, None]),  # belongs to the later, 16 ms away
        ([0, 33, 66], [-2, 1, 5], [1, None, None]),  # of several the nearest
        ([0, 33, 66], [-1, 1], [-1, None, None]),  # of equals the earlier
        ([0], [49], [49]),  # nobody knows the period
        ([0], [51], [None]),
        ([0, 4000, 8000], [90, 5000], [90, None, None]),  # stills: not one second off
    ],
)
def test_depth_belongs_to_the_nearest_image(
    tmp_path: Path, images_ms: list[int], depths_ms: list[int], expected: list[int | None]
) -> None:
    folder = make_camera(tmp_path / "left", {f"{t * MS}.png": encoded(picture(0)) for t in images_ms})
    for t in depths_ms:
        put(folder / "depth", f"{t * MS}.png", encoded(np.full((H, W), 10_000 + t, np.uint16)))
    frames = [good(frame) for frame in read_all(RgbdFolder(tmp_path), "left", depth=True)]
    found = [None if f.depth_m is None else round(1000 * float(f.depth_m[0, 0])) - 10_000 for f in frames]
    assert found == expected


SMALL = np.ones((H // 2, W // 2), np.float32)
BAD_DEPTHS = {
    "1.png is empty": (".png", b""),
    "1.png must be 16-bit grey": (".png", encoded(picture(0, grey=True))),
    "1.png must be 16-bit grey ": (".png", encoded(np.zeros((H, W, 3), np.uint16))),
    "1.png is cut off": (".png", DEEP[:-1]),
    "1.png is 16 x 12, but": (".png", encoded(np.ones((H // 2, W // 2), np.uint16))),
    "1.npy is 16 x 12, but must be 32 x 24": (".npy", npy(SMALL)),
    "1.npy is not a whole .npy file": (".npy", b""),
    "1.npy is not a whole .npy file ": (".npy", npy(SMALL)[:-1]),
    "1.npy is not a whole .npy file  ": (".npy", b"\x93NUMPY\x01\x00"),
    "1.npy is not a whole .npy file   ": (".npy", npy(np.array([None]))),  # would be unpickled
    "1.npy is not a whole .npy file     ": (".npy", npy(SMALL).replace(b"(12, 16)", b"((2, 16)")),
    # Promises 4 TB; trusting the header would ask for them.
    "1.npy is not a whole .npy file    ": (".npy", npy(SMALL).replace(b"(12, 16)", b"(999999, 999999)")),
    "1.npy must be one float32 array": (".npy", npy(np.ones((H, W)))),
    "1.npy must be one float32 array ": (".npy", npy(np.ones((H, W, 1), np.float32))),
}


@pytest.mark.parametrize(("words", "file"), BAD_DEPTHS.items())
def test_a_bad_depth_makes_a_bad_frame_only_where_depth_is_wanted(
    tmp_path: Path, words: str, file: tuple[str, bytes]
) -> None:
    folder = make_camera(tmp_path / "left", {"1.png": encoded(picture(0))})
    put(folder / "depth", f"1{file[0]}", file[1])
    recording = RgbdFolder(tmp_path)
    good(only_frame(recording))
    bad = only_frame(recording, depth=True)
    assert isinstance(bad, BadFrame)
    assert bad.reason.startswith(f"left/depth/{words.strip()}")


def test_depth_with_its_own_matrix_may_have_its_own_size(tmp_path: Path) -> None:
    folder = make_camera(tmp_path / "left", {"1.png": encoded(picture(0))}, camera_named("left", depth_K=K))
    put(folder / "depth", "1.npy", npy(np.asfortranarray(SMALL)))
    put(folder / "confidence", "1.png", encoded(np.ones((H // 2, W // 2), np.uint8)))
    frame = good(only_frame(RgbdFolder(tmp_path), depth=True))
    assert frame.depth_m is not None
    assert frame.depth_m.shape == (H // 2, W // 2)
    put(folder / "confidence", "1.png", encoded(np.ones((H, W), np.uint8)))
    bad = only_frame(RgbdFolder(tmp_path), depth=True)
    assert isinstance(bad, BadFrame)
    assert "it must be grey and have the depth's size" in bad.reason


# Writing


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    source = InMemory()
    write_recording(source, tmp_path / "new" / "out", depth=True)
    recording = RgbdFolder(tmp_path / "new" / "out")
    assert [camera.name for camera in recording.cameras] == ["left", "right"]
    assert recording.cameras[1].depth_K is not None
    for camera in ("left", "right"):
        before = [f for f in source.frames(camera, range(3), depth=True) if isinstance(f, Frame)]
        after = [good(frame) for frame in read_all(recording, camera, depth=True)]
        assert [frame.stamp_ns for frame in after] == [frame.stamp_ns for frame in before]
        for a, b in zip(after, before):
            np.testing.assert_array_equal(a.image, b.image)
            assert (a.depth_m is None) == (b.depth_m is None)
            if a.depth_m is not None and b.depth_m is not None:
                assert np.isnan(a.depth_m[0, :4]).all()  # NaN, infinity, negative, beyond 16 bits
                # Half a unit of depth_scale, and a float32 rounding.
                np.testing.assert_allclose(a.depth_m[1:], b.depth_m[1:], atol=0.000501)
                np.testing.assert_array_equal(a.confidence, b.confidence)
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["out"]


def test_a_second_copy_is_the_same_to_the_byte(tmp_path: Path) -> None:
    write_recording(InMemory(), tmp_path / "one", depth=True)
    write_recording(RgbdFolder(tmp_path / "one"), tmp_path / "two", depth=True)
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.*"))
    assert len(files) == 11  # 2 camera_info, 5 images, 2 depths, 2 confidences
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()


def test_without_depth_only_images_are_written(tmp_path: Path) -> None:
    write_recording(InMemory(), tmp_path / "out", depth=False)
    assert sorted(path.name for path in (tmp_path / "out" / "right").iterdir()) == ["camera_info.yaml", "image"]


def test_a_camera_called_image_is_one(tmp_path: Path) -> None:
    for names in (["image"], ["image", "left"]):
        out = tmp_path / str(len(names))
        for name in names:
            make_camera(out / name, {"5.png": encoded(picture(1))})
        for path in (out, out / "image"):
            recording = open_recordings([path])
            assert [camera.name for camera in recording.cameras] == (names if path == out else ["image"])
            assert recording.stamps_ns("image").tolist() == [5]


class Watcher:
    """Looks at the half-written folder after each frame, and may stop the writing."""

    def __init__(self, look: Callable[[int], None]) -> None:
        self.look = look
        self.steps: list[tuple[str, int, int]] = []

    def step(self, name: str, done: int, total: int) -> None:
        self.steps.append((name, done, total))
        self.look(done)


def test_an_interrupted_write_leaves_nothing(tmp_path: Path) -> None:
    def stop(done: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_recording(InMemory(), tmp_path / "out", depth=True, progress=Watcher(stop))
    assert list(tmp_path.iterdir()) == []


def test_a_half_written_folder_never_reads_as_a_recording(tmp_path: Path) -> None:
    # A killed process cannot tidy up: what lies there at any moment must be no recording.
    def look(done: int) -> None:
        assert not (tmp_path / "out").exists()
        with pytest.raises(InputError):
            RgbdFolder(tmp_path / "out.part")
        with pytest.raises(InputError):
            open_recordings([tmp_path])

    watcher = Watcher(look)
    write_recording(InMemory(), tmp_path / "out", depth=True, progress=watcher)
    assert watcher.steps == [("write", done, 6) for done in range(1, 7)]
    assert len(open_recordings([tmp_path]).cameras) == 2


@pytest.mark.parametrize("place", ["full", "file", "file/out", "left-over"])
def test_places_that_cannot_be_written_are_refused_and_untouched(tmp_path: Path, place: str) -> None:
    put(tmp_path / "full", "letter.txt", b"dear")
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "left-over.part").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(OutputError, match=place):
        write_recording(InMemory(), tmp_path / place, depth=True)
    assert sorted(tmp_path.rglob("*")) == before


def test_an_empty_folder_may_be_filled(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write_recording(InMemory(), tmp_path / "out", depth=False, progress=SILENT)
    assert len(RgbdFolder(tmp_path / "out").cameras) == 2


@pytest.mark.parametrize("name", ["../escape", "a/b", ".."])
def test_a_camera_name_that_leads_elsewhere_is_refused(tmp_path: Path, name: str) -> None:
    source = InMemory()
    source.cameras = (camera_named(name), camera_named("right"))
    with pytest.raises(OutputError, match="rename the camera"):
        write_recording(source, tmp_path / "out", depth=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "why"),
    [
        (b"a\nb", "its name holds a sign that cannot be printed"),
        (b"a\xff", "its name is not valid UTF-8"),
        (b"_meta", "names that start with _ are no cameras in extrinsics files"),
    ],
)
def test_a_folder_whose_name_no_camera_can_have_is_refused_with_the_reason(
    tmp_path: Path, name: bytes, why: str
) -> None:
    shown = os.fsdecode(name)
    sound = make_camera(tmp_path / "rec" / "sound", {"1.png": encoded(picture(0))})
    shutil.copytree(sound, tmp_path / "rec" / shown)
    for place in (tmp_path / "rec", tmp_path / "rec" / shown):
        with pytest.raises(InputError) as error:
            RgbdFolder(place)
        assert str(error.value) == f"{tmp_path / 'rec'}: camera {shown!r}: {why}; rename its folder."


# Opening


def test_several_recordings_become_one(tmp_path: Path) -> None:
    make_camera(tmp_path / "one" / "right", {"5.png": encoded(picture(1))})
    make_camera(tmp_path / "two" / "left", {"6.png": encoded(picture(2))})
    for paths in ([tmp_path / "one", tmp_path / "two"], [tmp_path / "two" / "left", tmp_path / "one"], [tmp_path]):
        recording = open_recordings(paths)
        assert [camera.name for camera in recording.cameras] == ["left", "right"]
        assert recording.stamps_ns("right").tolist() == [5]
        (frame,) = recording.frames("left", [0])
        np.testing.assert_array_equal(good(frame).image, picture(2))
    with pytest.raises(InputError, match="no camera top in the recordings; they have left, right"):
        open_recordings([tmp_path]).stamps_ns("top")


def test_two_cameras_of_one_name_are_refused_with_both_paths(tmp_path: Path) -> None:
    for name in ("one", "two"):
        make_camera(tmp_path / name / "left", {"5.png": encoded(picture(1))})
    for paths in ([tmp_path / "one", tmp_path / "two"], [tmp_path]):
        with pytest.raises(
            InputError, match=f"camera left is in {tmp_path / 'one'} and in {tmp_path / 'two'}"
        ) as error:
            open_recordings(paths)
        assert f"at a time or, if these are two cameras, rename its folder in {tmp_path / 'two'}." in str(error.value)
    with pytest.raises(InputError, match=f"rename its folder in {tmp_path / 'two'}\\."):
        open_recordings([tmp_path / "one", tmp_path / "two" / "left"])


def test_other_paths_are_refused_with_what_is_known(tmp_path: Path) -> None:
    put(tmp_path / "take", "movie.mp4", b"")
    for paths, words in (
        ([tmp_path / "take" / "movie.mp4"], "is empty .*Known recordings: RGB-D folders"),
        ([tmp_path / "take"], "movie.mp4: is empty"),
        ([tmp_path], "no recording there; an RGB-D folder has"),
        ([tmp_path / "missing"], "no such file or folder"),
        ([tmp_path / (300 * "x")], "no such file or folder"),
        ([], "no recording given"),
    ):
        with pytest.raises(InputError, match=words):
            open_recordings(paths)


def test_looking_for_a_reader_does_not_load_opencv() -> None:
    code = "import sys, rigcal.sources; print(sorted({'cv2', 'numpy', 'yaml'} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.skipif(os.name == "nt" or not hasattr(os, "geteuid") or os.geteuid() == 0, reason="needs permissions")
def test_a_folder_without_permission_is_an_error(tmp_path: Path) -> None:
    folder = make_camera(tmp_path / "left", {"1.png": encoded(picture(0))})
    (folder / "image").chmod(0)
    try:
        with pytest.raises(InputError, match="cannot be read"):
            RgbdFolder(tmp_path)
    finally:
        (folder / "image").chmod(0o700)


@pytest.mark.parametrize(("name", "n_frames", "has_depth"), [("cube3_b", 36, True), ("webcams4_a", 57, False)])
def test_real_recordings_are_read(name: str, n_frames: int, has_depth: bool) -> None:
    folder = DATA / name / "recording"
    if not folder.exists():
        pytest.skip("no real data here")
    recording = open_recordings([folder])
    for camera in recording.cameras:
        assert len(recording.stamps_ns(camera.name)) == n_frames
        for frame in recording.frames(camera.name, [0, n_frames - 1], depth=True):
            assert good(frame).image.shape[:2] == (camera.height, camera.width)
            assert (good(frame).depth_m is not None) == has_depth


# Beside other recordings


def videos(folder: Path, *names: str) -> None:
    for name in names:
        put(folder, name, b"\0\0\0\x18ftypmp42" + bytes(range(256)))


@pytest.mark.parametrize("infos", [("left/camera_info.yaml", "right/camera_info.yaml"), ("camera_info.yaml",)])
def test_descriptions_of_cameras_beside_videos_are_the_videos(
    infos: Sequence[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[str] = []
    recording = RgbdFolder(make_camera(tmp_path / "rec" / "a", {"1.png": encoded(picture(0))}))
    monkeypatch.setattr(
        "rigcal.sources.video.opened_together",
        lambda paths, options: given.extend(path.name for path in paths) or recording,
    )
    films = tmp_path / "films"
    videos(films, "left.mp4", "right.mp4")
    for info in infos:
        (films / info).parent.mkdir(exist_ok=True)
        (films / info).write_text(dump_camera_info(camera_named("left")))
    open_recordings([films])
    assert given == ["left.mp4", "right.mp4"]


def test_a_folder_of_descriptions_alone_is_told_that_images_are_missing(tmp_path: Path) -> None:
    (tmp_path / "left").mkdir()
    (tmp_path / "left/camera_info.yaml").write_text(dump_camera_info(camera_named("left")))
    with pytest.raises(InputError, match="no camera has an image"):
        open_recordings([tmp_path])


def test_videos_beside_cameras_of_an_rgbd_folder_are_not_dropped(tmp_path: Path) -> None:
    make_camera(tmp_path / "a", {"1.png": encoded(picture(0))})
    videos(tmp_path, "b.mp4")
    for path in (tmp_path, tmp_path / "a"):
        videos(path, "b.mp4")
        with pytest.raises(InputError, match=r"several kinds, .* \(RGB-D folder\), b\.mp4 \(video\)"):
            open_recordings([path])
