from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType
from svo2_writer import (
    FOOTER,
    PERIOD_NS,
    SIZE,
    START_NS,
    Clip,
    R_rect_left,
    T_right_left,
    conf_text,
    eyes,
    frame_messages,
    write_svo2,
)

from aruco.detector import MarkerDetector
from aruco.errors import InputError, MissingExtraError
from aruco.lens import project, undistort
from aruco.model import BadFrame, Camera, Frame, KnowsUp
from aruco.pose_math import exp_so3, make_pose, transform_points
from rigcal.sources import stereo_depth, svo2_pictures, svo2_sensors, zed_conf
from rigcal.sources.mcap_index import McapIndex, Part
from rigcal.sources.options import SourceOptions
from rigcal.sources.svo2 import Svo2, opened, recognises
from rigcal.sources.svo2_payload import coding_of, eye_size, payload_of

SERIAL = "10020030"
MARKER_M, MARKERS_A_ROW = 0.15, 4
DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
PX_PER_M = 1600
RESTING = [(0.2, -9.77, 0.8)] * 20


@pytest.fixture(autouse=True)
def _no_sdk_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zed_conf, "USUAL_FOLDERS", ())


def _pairs(n: int) -> list[np.ndarray]:
    """Soft pictures that all differ, the left half from the right too."""
    x, y = np.meshgrid(np.linspace(0, 1, SIZE[0]), np.linspace(0, 1, SIZE[1]))

    def eye(k: int, turn: float) -> np.ndarray:
        wave = 128 + 90 * np.sin(6 * x + 4 * y * turn + 0.7 * k)
        return np.stack([wave, 0.5 * wave + 60, 200 - 0.5 * wave], axis=2)

    return [np.rint(np.hstack([eye(k, 1.0), eye(k, -1.0)])).astype(np.uint8) for k in range(n)]


def _recording(folder: Path, clips: dict[str, Clip] | Clip, conf: bool = True, **options: Any) -> Path:
    path = folder / "clip.svo2"
    by_serial = clips if isinstance(clips, dict) else {SERIAL: clips}
    write_svo2(path, by_serial, **options)
    for serial in by_serial if conf else ():
        (folder / f"SN{serial}.conf").write_text(conf_text(), encoding="utf-8")
    return path


def _read(path: Path, indices: Sequence[int], camera: str = SERIAL, **options: Any) -> list[Frame | BadFrame]:
    depth = options.pop("depth", False)
    return list(opened(path, SourceOptions(**options)).frames(camera, indices, depth=depth))


def _rectified(folder: Path, half: np.ndarray) -> np.ndarray:
    return zed_conf.factory_calibration(folder / f"SN{SERIAL}.conf", *SIZE).rectification().left(half)


def _off(image: np.ndarray, expected: np.ndarray) -> float:
    return float(np.abs(image.astype(float) - expected.astype(float)).mean())


@pytest.mark.parametrize("codec", ["h264", "hevc", "jpeg"])
def test_stamps_and_images_are_those_written(tmp_path: Path, codec: str) -> None:
    pairs = _pairs(7)
    stamps = [START_NS + PERIOD_NS * k + (k % 2) * 1_000_003 for k in range(7)]
    path = _recording(tmp_path, Clip(pairs=pairs, stamps_ns=stamps, codec=codec, key_every=3))
    recording = opened(path, SourceOptions())
    (camera,) = recording.cameras
    assert (camera.name, camera.width, camera.height) == (SERIAL, *SIZE)
    assert camera.baseline_m == pytest.approx(0.12, abs=1e-5)  # the offsets lengthen 120 mm by a thousandth of one
    assert not camera.has_distortion
    np.testing.assert_array_equal(recording.stamps_ns(SERIAL), stamps)
    frames = list(recording.frames(SERIAL, range(7)))
    assert [frame.stamp_ns for frame in frames] == stamps
    for k, frame in enumerate(frames):
        assert isinstance(frame, Frame)
        expected = _rectified(tmp_path, pairs[k][:, : SIZE[0]])
        # Two roundings and colours at half the resolution: a grey level or two; the next frame is off by 30.
        assert _off(frame.image, expected) < 2.5
        assert _off(frame.image, _rectified(tmp_path, pairs[(k + 1) % 7][:, : SIZE[0]])) > 15
        assert _off(frame.image, _rectified(tmp_path, pairs[k][:, SIZE[0] :])) > 15  # the other eye
        assert len(frame.digest) == 64
        assert frame.depth_m is None
    assert len({frame.digest for frame in frames if isinstance(frame, Frame)}) == 7


def _board_picture() -> np.ndarray:
    side = int(MARKER_M * PX_PER_M)
    step = int(side * 1.25)
    sheet = np.full((3 * step, MARKERS_A_ROW * step), 255, np.uint8)
    for k in range(3 * MARKERS_A_ROW):
        row, column = divmod(k, MARKERS_A_ROW)
        at = (row * step + (step - side) // 2, column * step + (step - side) // 2)
        sheet[at[0] : at[0] + side, at[1] : at[1] + side] = cv2.aruco.generateImageMarker(DICTIONARY, k, side)
    return sheet


def _board_corners() -> dict[int, np.ndarray]:
    """Corners (4, 3) of each marker on the board [m]; x along its rows, y along its columns."""
    side, step = int(MARKER_M * PX_PER_M), int(int(MARKER_M * PX_PER_M) * 1.25)
    found = {}
    for k in range(3 * MARKERS_A_ROW):
        row, column = divmod(k, MARKERS_A_ROW)
        x, y = column * step + (step - side) // 2, row * step + (step - side) // 2
        corners = np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]], dtype=float)
        found[k] = np.column_stack([corners / PX_PER_M, np.zeros(4)])
    return found


def _drawn(eye: Camera, T_eye_board: np.ndarray, sheet: np.ndarray) -> np.ndarray:
    """A flat picture seen through a lens, (h, w, 3): every pixel the mean of 4 x 4 rays."""
    fine = 4
    x, y = np.meshgrid(np.arange(eye.width, dtype=float), np.arange(eye.height, dtype=float))
    directions = undistort(eye, np.column_stack([x.ravel(), y.ravel()])).reshape(eye.height, eye.width, 2)
    # Between neighbouring pixels the lens is straight to 1e-6 px.
    directions = cv2.resize(directions, None, fx=fine, fy=fine, interpolation=cv2.INTER_LINEAR)
    rays = np.dstack([directions, np.ones(directions.shape[:2])]).reshape(-1, 3)
    # A ray r meets the plane z = 0 of the board where R^T (s r - t) has no third component.
    R, t = T_eye_board[:3, :3], T_eye_board[:3, 3]
    s = (R[:, 2] @ t) / (rays @ R[:, 2])
    at = ((s[:, None] * rays - t) @ R)[:, :2] * PX_PER_M - 0.5
    maps = [at[:, k].reshape(directions.shape[:2]).astype(np.float32) for k in range(2)]
    seen = cv2.remap(sheet, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(170,))
    small = cv2.resize(seen, (eye.width, eye.height), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)


@pytest.fixture(scope="module")
def board() -> tuple[np.ndarray, np.ndarray]:
    """(T_left_board, both eyes' picture of a board of markers that nearly fills the left image)."""
    T_left_board = make_pose(exp_so3(np.array([0.15, -0.2, 0.05])), np.array([-0.46, -0.27, 0.62]))
    left, right = eyes()
    sheet = _board_picture()
    pair = np.hstack([_drawn(left, T_left_board, sheet), _drawn(right, T_right_left() @ T_left_board, sheet)])
    return T_left_board, pair


def _found_corners(image: np.ndarray) -> dict[int, np.ndarray]:
    found = MarkerDetector("DICT_4X4_50").detect(image)
    return dict(zip(found.ids.tolist(), found.corners_px))


def test_a_board_lies_where_the_rectified_pinhole_projects_it(
    tmp_path: Path, board: tuple[np.ndarray, np.ndarray]
) -> None:
    """Left is left, and the lens is gone: corners through the whole chain, from the formula of the recorded lens."""
    T_left_board, pair = board
    path = _recording(tmp_path, Clip(pairs=[pair, pair]))
    recording = opened(path, SourceOptions())
    (camera,) = recording.cameras
    frame = next(recording.frames(SERIAL, [1]))
    assert isinstance(frame, Frame)
    found = _found_corners(frame.image)
    assert len(found) >= 6
    raw = _found_corners(pair[:, : SIZE[0]])
    off, off_right, off_raw = [], [], []
    for k, corners in _board_corners().items():
        if k not in found or k not in raw:
            continue
        # The sheet's pixel edges, not centres, are the corners of its markers; see _drawn's half pixel.
        p_left = transform_points(T_left_board, corners) @ R_rect_left().T
        expected = project(camera, p_left)
        off.append(np.linalg.norm(found[k] - expected, axis=1))
        off_right.append(np.linalg.norm(found[k] - project(camera, p_left - [camera.baseline_m, 0, 0]), axis=1))
        off_raw.append(np.linalg.norm(raw[k] - expected, axis=1))
    # Corners of 50 pixel markers after coding and two interpolations: 0.05 px typical.
    assert np.concatenate(off).max() < 0.3
    assert np.concatenate(off_right).min() > 20  # the other eye: f B / Z = 50 px
    assert np.concatenate(off_raw).max() > 5  # without rectification


def test_stereo_depth_is_that_of_the_scene(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    sheet = cv2.GaussianBlur(rng.integers(0, 255, (2600, 4200)).astype(np.uint8), (0, 0), 6)
    sheet = cv2.normalize(sheet, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)  # type: ignore[call-overload]
    T_left_wall = make_pose(np.eye(3), np.array([-1.3, -0.8, 1.1]))
    left, right = eyes()
    pair = np.hstack([_drawn(left, T_left_wall, sheet), _drawn(right, T_right_left() @ T_left_wall, sheet)])
    path = _recording(tmp_path, Clip(pairs=[pair]))
    recording = opened(path, SourceOptions(stereo_depth=True))
    np.testing.assert_array_equal(recording.depth_indices(SERIAL), [0])
    frame = next(recording.frames(SERIAL, [0], depth=True))
    assert isinstance(frame, Frame)
    assert frame.depth_m is not None
    known = frame.depth_m[np.isfinite(frame.depth_m)]
    assert len(known) > 0.5 * frame.depth_m.size
    # 0.1 px of disparity at f B / Z = 37 px is 3 mm; the rectified axis is turned by some tenths of a degree.
    assert abs(np.median(known) - 1.1) < 0.015
    assert next(recording.frames(SERIAL, [0])).depth_m is None  # type: ignore[union-attr]
    assert len(opened(path, SourceOptions()).depth_indices(SERIAL)) == 0
    assert _read(path, [0], depth=True)[0].depth_m is None  # type: ignore[union-attr]


def test_only_what_is_needed_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[svo2_pictures.PacketDecoder] = []

    class Counted(svo2_pictures.PacketDecoder):
        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            made.append(self)

    monkeypatch.setattr(svo2_pictures, "PacketDecoder", Counted)
    pairs = _pairs(20)
    path = _recording(tmp_path, Clip(pairs=pairs, key_every=5))
    recording = opened(path, SourceOptions())
    assert not made
    frames = list(recording.frames(SERIAL, [7, 9, 16]))
    # From the key frames 5 and 15 on: 5 6 7 8 9 and 15 16.
    assert sum(decoder.n_decoded for decoder in made) == 7
    for k, frame in zip([7, 9, 16], frames, strict=True):
        assert isinstance(frame, Frame)
        assert _off(frame.image, _rectified(tmp_path, pairs[k][:, : SIZE[0]])) < 2.5


def test_two_readers_of_one_camera_do_not_disturb_each_other(tmp_path: Path) -> None:
    recording = opened(_recording(tmp_path, Clip(pairs=_pairs(6))), SourceOptions())
    alone = {frame.stamp_ns: frame for frame in recording.frames(SERIAL, range(6))}
    for one, other in zip(recording.frames(SERIAL, [1, 2, 3]), recording.frames(SERIAL, [3, 4, 5])):
        for frame in (one, other):
            assert isinstance(frame, Frame)
            np.testing.assert_array_equal(frame.image, alone[frame.stamp_ns].image)  # type: ignore[union-attr]


def test_several_cameras_in_one_file(tmp_path: Path) -> None:
    pairs = _pairs(8)
    clips = {"222": Clip(pairs=pairs[:4]), "111": Clip(pairs=pairs[4:], codec="hevc", key_every=2)}
    path = _recording(tmp_path, clips)
    recording = opened(path, SourceOptions())
    assert [camera.name for camera in recording.cameras] == ["111", "222"]
    (tmp_path / f"SN{SERIAL}.conf").write_text(conf_text(), encoding="utf-8")
    for serial, first in (("222", 0), ("111", 4)):
        for k, frame in enumerate(recording.frames(serial, range(4))):
            assert isinstance(frame, Frame)
            assert _off(frame.image, _rectified(tmp_path, pairs[first + k][:, : SIZE[0]])) < 2.5
    with pytest.raises(InputError, match="no camera 333"):
        recording.frames("333", [0])


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.ZSTD])
def test_compressed_chunks_are_read_too(tmp_path: Path, compression: CompressionType) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(4)), compression=compression)
    assert all(isinstance(frame, Frame) for frame in _read(path, range(4)))


def test_up_is_against_gravity(tmp_path: Path) -> None:
    """A camera that looks down by 30 degrees: up is -y in its image, and away from where it looks."""
    up = np.array([0.0, -np.cos(np.pi / 6), -np.sin(np.pi / 6)])
    noise = np.random.default_rng(1).normal(0, 0.05, (200, 3))
    path = _recording(tmp_path, Clip(pairs=_pairs(2), accelerations=(9.81 * up + noise).tolist()))
    recording = opened(path, SourceOptions())
    assert isinstance(recording, KnowsUp)
    found = recording.up_in_camera(SERIAL)
    assert found is not None
    assert np.linalg.norm(found) == pytest.approx(1, abs=1e-12)
    # 0.05 m/s2 of noise over 200 samples, a median: 0.005 m/s2 of 9.81.
    np.testing.assert_allclose(found, up, atol=2e-3)


@pytest.mark.parametrize(
    ("accelerations", "told"),
    [
        ([], False),  # no sensors
        ([(0.0, -9.8, 0.0)] * 3, False),  # too few
        ([(0.0, -12.0, 0.0)] * 50, True),  # no gravity
        ([(0.0, -0.998, 0.0)] * 50, True),  # in g
        ([(float("nan"), -9.8, 0.0)] * 50, False),
        ([(6.0 * (-1) ** k, -9.8 + 0.1 * k % 3, 1.0) for k in range(50)], True),  # carried about
    ],
)
def test_implausible_acceleration_tells_nothing(
    tmp_path: Path, said: list[str], accelerations: list[tuple[float, ...]], told: bool
) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(2), accelerations=accelerations))
    assert opened(path, SourceOptions()).up_in_camera(SERIAL) is None
    assert any("accelerometer" in line for line in said) == told


def test_sensors_are_read_and_doubted_once(tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    original = svo2_sensors.up_in_camera
    monkeypatch.setattr(svo2_sensors, "up_in_camera", lambda *given: read.append(given[2]) or original(*given))
    lying = [(0.0, -12.0, 0.0)] * 50
    clips = {
        "111": Clip(pairs=_pairs(2), accelerations=RESTING),
        "222": Clip(pairs=_pairs(2), accelerations=lying),
    }
    recording = opened(_recording(tmp_path, clips), SourceOptions())
    for _ in range(3):
        assert recording.up_in_camera("111") is not None
        assert recording.up_in_camera("222") is None
    assert read == ["111", "222"]
    assert sum("accelerometer" in line for line in said) == 1


def test_of_many_sensor_messages_only_some_are_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A day has 35 million. Every fourth of these says another thing than the others."""
    monkeypatch.setattr(svo2_sensors, "_MAX_SAMPLES", 100)
    seen: list[int] = []
    original = McapIndex.parts

    def noted(self: McapIndex, *given: Any, **options: Any) -> Iterator[Part]:
        for part in original(self, *given, **options):
            seen.append(part.index)
            yield part

    lying = [(0.0, -9.8, 0.0) if k % 4 == 0 else (9.8, 0.0, 0.0) for k in range(400)]
    recording = opened(_recording(tmp_path, Clip(pairs=_pairs(2), accelerations=lying)), SourceOptions())
    monkeypatch.setattr(McapIndex, "parts", noted)
    up = recording.up_in_camera(SERIAL)
    assert up is not None
    np.testing.assert_allclose(up, [0, -1, 0], atol=1e-6)  # they are written as float32
    assert seen == list(range(0, 400, 4))


def test_readers_with_depth_do_not_share_a_matcher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[stereo_depth.StereoMatcher] = []

    class Noted(stereo_depth.StereoMatcher):
        def __init__(self, **given: Any) -> None:
            super().__init__(**given)
            made.append(self)

    monkeypatch.setattr(stereo_depth, "StereoMatcher", Noted)
    recording = opened(_recording(tmp_path, Clip(pairs=_pairs(3))), SourceOptions(stereo_depth=True))
    for _ in zip(recording.frames(SERIAL, [0, 1], depth=True), recording.frames(SERIAL, [1, 2], depth=True)):
        pass
    assert len(made) == 2  # not one for all, nor one for each frame
    list(recording.frames(SERIAL, [0]))
    assert len(made) == 2


def test_a_truncated_file_gives_what_is_whole(tmp_path: Path, said: list[str]) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(20), accelerations=RESTING), chunk_size=20_000)
    whole = path.read_bytes()
    everything = _read(path, range(20))
    path.write_bytes(whole[: len(whole) * 3 // 5])
    recording = opened(path, SourceOptions())
    n = len(recording.stamps_ns(SERIAL))
    assert 4 < n < 18
    assert any("cut off" in line and f"of {len(whole) * 3 // 5}" in line for line in said)
    for before, after in zip(everything, recording.frames(SERIAL, range(n))):
        assert isinstance(before, Frame)
        assert isinstance(after, Frame)
        np.testing.assert_array_equal(before.image, after.image)


@pytest.mark.parametrize("size", [0, 5, 60, 400])
def test_stumps_get_a_sentence(tmp_path: Path, size: int) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(2)))
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(InputError, match=r"clip\.svo2"):
        opened(path, SourceOptions())


def _damaged_footer(number: int, message: bytes) -> bytes:
    return message[: -FOOTER.size + 32] + b"\xff" * 12 + message[-FOOTER.size + 44 :]


def test_a_damaged_footer_spoils_its_group_and_nothing_else(tmp_path: Path) -> None:
    def change(number: int, message: bytes) -> bytes:
        return _damaged_footer(number, message) if number == 7 else message

    pairs = _pairs(15)
    path = _recording(tmp_path, Clip(pairs=pairs, key_every=5, change=change))
    frames = _read(path, range(15))
    assert [frame.stamp_ns for frame in frames] == [START_NS + PERIOD_NS * k for k in range(15)]
    bad = {k: frame.reason for k, frame in enumerate(frames) if isinstance(frame, BadFrame)}
    assert sorted(bad) == [7, 8, 9]
    assert bad[7] == f"{SERIAL}: frame 7 has a damaged footer (its size does not fit)"
    assert "needs frame 7" in bad[9]
    for k in (6, 10, 14):
        frame = frames[k]
        assert isinstance(frame, Frame)
        assert _off(frame.image, _rectified(tmp_path, pairs[k][:, : SIZE[0]])) < 2.5


def test_frames_after_a_gap_are_bad_until_the_next_key_frame(tmp_path: Path) -> None:
    gone = {12: None}
    change = lambda number, message: gone.get(number, message)  # noqa: E731
    clip = Clip(pairs=_pairs(20), stamps_ns=[START_NS + k for k in range(20)], change=change)
    path = _recording(tmp_path, clip)
    frames = _read(path, range(19))
    assert [k for k, frame in enumerate(frames) if isinstance(frame, BadFrame)] == [12, 13]  # 13 and 14 as recorded
    assert "missing before it" in frames[12].reason  # type: ignore[union-attr]


def test_a_missing_key_frame_is_noticed_without_numbers(tmp_path: Path) -> None:
    """Should the frames' numbers mean something else, the number of the last key frame still tells."""

    def change(number: int, message: bytes) -> bytes | None:
        return None if number == 5 else message[:-12] + bytes(4) + message[-8:]

    path = _recording(tmp_path, Clip(pairs=_pairs(15), key_every=5, change=change))
    frames = _read(path, range(14))
    assert [k for k, frame in enumerate(frames) if isinstance(frame, BadFrame)] == [5, 6, 7, 8]


def test_a_stream_that_begins_between_key_frames(tmp_path: Path) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(10), change=lambda k, message: message if k > 1 else None))
    frames = _read(path, range(8))
    assert [isinstance(frame, Frame) for frame in frames] == [False] * 3 + [True] * 5
    assert "before the first key frame" in frames[0].reason  # type: ignore[union-attr]


def test_damaged_payloads_do_not_stop_the_reading(tmp_path: Path) -> None:
    def change(number: int, message: bytes) -> bytes:
        if number == 1:
            return message[:40] + bytes(len(message) - 40 - FOOTER.size) + message[-FOOTER.size :]
        return message

    path = _recording(tmp_path, Clip(pairs=_pairs(10), change=change))
    frames = _read(path, range(10))
    bad = [k for k, frame in enumerate(frames) if isinstance(frame, BadFrame)]
    assert {1} <= set(bad) <= {1, 2, 3, 4}
    assert "frame 1 holds a picture that" in frames[1].reason  # type: ignore[union-attr]


def test_a_damaged_chunk_spoils_its_frames_only(tmp_path: Path, said: list[str]) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(20)), chunk_size=20_000)
    data = bytearray(path.read_bytes())
    at = data.find(b"\x00\x00\x00\x01", len(data) // 2)
    data[at + 60] ^= 0xFF
    path.write_bytes(bytes(data))
    frames = _read(path, range(20))
    bad = [frame.reason for frame in frames if isinstance(frame, BadFrame)]
    assert 0 < len(bad) < 10
    assert any("damaged chunk" in reason for reason in bad)
    assert any("does not fit its checksum" in line for line in said)


def test_a_damaged_chunk_of_key_frames_does_not_cost_the_others(tmp_path: Path) -> None:
    """The first six of them, none of which can tell how the frames are coded."""
    clip = Clip(pairs=_pairs(12), key_every=1)
    path = _recording(tmp_path, clip, chunk_size=sum(len(message) for message in frame_messages(clip)[:6]))
    data = bytearray(path.read_bytes())
    data[data.find(b"\x00\x00\x00\x01") + 60] ^= 0xFF
    path.write_bytes(bytes(data))
    frames = _read(path, range(12))
    n_bad = next(k for k, frame in enumerate(frames) if isinstance(frame, Frame))
    assert n_bad >= 6  # five were once asked
    assert all(isinstance(frame, Frame) for frame in frames[n_bad:])


def test_stamps_out_of_order_are_sorted_and_doubles_dropped(tmp_path: Path) -> None:
    """The stamps of footers may step back where the clock was set; each picture keeps its own."""
    stamps = [START_NS + PERIOD_NS * k for k in range(6)]
    footers = [stamps[k] for k in (0, 1, 4, 3, 2, 2)]

    def change(number: int, message: bytes) -> bytes:
        at = len(message) - FOOTER.size + 24
        return message[:at] + struct.pack("<Q", footers[number]) + message[at + 8 :]

    pairs = _pairs(6)
    path = _recording(tmp_path, Clip(pairs=pairs, change=change, key_every=6))
    recording = opened(path, SourceOptions())
    np.testing.assert_array_equal(recording.stamps_ns(SERIAL), stamps[:5])
    for k, frame in zip((0, 1, 4, 3, 2), recording.frames(SERIAL, range(5)), strict=True):
        assert isinstance(frame, Frame)
        assert _off(frame.image, _rectified(tmp_path, pairs[k][:, : SIZE[0]])) < 2.5


def test_no_conf_names_the_option_and_where_to_get_it(tmp_path: Path) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(1)), conf=False)
    with pytest.raises(InputError, match=rf"SN{SERIAL}\.conf.*--zed-conf.*stereolabs\.com"):
        opened(path, SourceOptions())
    elsewhere = tmp_path / "confs"
    elsewhere.mkdir()
    (elsewhere / f"SN{SERIAL}.conf").write_text(conf_text(), encoding="utf-8")
    assert opened(path, SourceOptions(zed_conf=elsewhere)).cameras[0].name == SERIAL
    (elsewhere / "SN77.conf").write_text(conf_text(), encoding="utf-8")
    (elsewhere / f"SN{SERIAL}.conf").unlink()
    with pytest.raises(InputError, match=f"of camera 77, not of {SERIAL}"):
        opened(path, SourceOptions(zed_conf=elsewhere / "SN77.conf"))


@pytest.mark.parametrize(
    ("header", "said"),
    [
        ({"encryption": "AES-256"}, "is encrypted"),
        ({"Encrypted": True}, "is encrypted"),
        ({"version": "3.0.0"}, "version '3.0.0'"),
    ],
)
def test_encrypted_and_newer_files_are_named(tmp_path: Path, header: dict[str, Any], said: str) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(1)), header=header)
    with pytest.raises(InputError, match=f"{said}.*ZED SDK"):
        opened(path, SourceOptions())


def test_a_header_that_says_it_is_not_encrypted_is_believed(tmp_path: Path) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(1)), header={"encrypted": False, "encryption": "none"})
    assert opened(path, SourceOptions()).cameras


def test_frames_that_nobody_knows_are_called_so(tmp_path: Path) -> None:
    noise = np.random.default_rng(2).integers(0, 256, 100_000).astype(np.uint8).tobytes()

    def scrambled(number: int, message: bytes) -> bytes:
        return message[:8] + noise[: len(message) - 8 - FOOTER.size] + message[-FOOTER.size :]

    path = _recording(tmp_path, Clip(pairs=_pairs(3), change=scrambled))
    with pytest.raises(InputError, match=r"neither H\.264, H\.265 nor JPEG.*encrypted"):
        opened(path, SourceOptions())
    path = _recording(tmp_path, Clip(pairs=_pairs(3), change=lambda number, message: noise[: len(message)]))
    with pytest.raises(InputError, match="encrypted"):
        opened(path, SourceOptions())


@pytest.mark.parametrize("topic", ["../x", "Camera_SN../../x", "Camera_SN", "Camera_SNabc", "/etc/Camera_SN1"])
def test_names_that_lead_elsewhere_are_refused(tmp_path: Path, topic: str) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(1)), topic=topic)
    with pytest.raises(InputError, match="Camera_SN<serial>"):
        opened(path, SourceOptions())


def test_absurd_sizes_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    def huge(number: int, message: bytes) -> bytes:
        at = len(message) - FOOTER.size
        return message[:at] + struct.pack("<II", 2**31, 2**31) + message[at + 8 :]

    path = _recording(tmp_path, Clip(pairs=_pairs(3), change=lambda k, m: huge(k, m) if k == 1 else m))
    frames = _read(path, range(3))
    assert [isinstance(frame, BadFrame) for frame in frames] == [False, True, True]
    assert "not a camera's image" in frames[1].reason  # type: ignore[union-attr]


def test_a_picture_of_another_size_than_said_is_bad(tmp_path: Path) -> None:
    small = [cv2.resize(pair, (640, 180)) for pair in _pairs(1)]
    other = frame_messages(Clip(pairs=small))[0]

    def change(number: int, message: bytes) -> bytes:
        # The frame says what the others say, and holds another picture.
        said = message[-FOOTER.size : -FOOTER.size + 32] + other[-FOOTER.size + 32 : -FOOTER.size + 36]
        return other[: -FOOTER.size] + said + message[-FOOTER.size + 36 :] if number == 5 else message

    path = _recording(tmp_path, Clip(pairs=_pairs(6), change=change))
    frames = _read(path, range(6))
    assert isinstance(frames[4], Frame)
    assert isinstance(frames[5], BadFrame)
    assert "640 x 180" in frames[5].reason


def test_damaged_jpeg_strips_are_bad_frames(tmp_path: Path) -> None:
    def change(number: int, message: bytes) -> bytes:
        if number == 0:
            return message
        if number == 1:  # the third strip is cut short inside
            at = message.find(b"\xff\xd9", len(message) // 2)
            return message[:at] + b"\0\0" + message[at + 2 :]
        return message[:8] + b"\xff" + message[9:]  # a strip's size

    path = _recording(tmp_path, Clip(pairs=_pairs(4), codec="jpeg", change=change))
    frames = _read(path, range(4))
    assert [isinstance(frame, Frame) for frame in frames] == [True, False, False, False]
    assert "JPEG strip" in frames[1].reason  # type: ignore[union-attr]
    assert "JPEG strips" in frames[2].reason  # type: ignore[union-attr]


def test_content_comes_before_the_suffix(tmp_path: Path) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(1)))
    head = path.read_bytes()[: 64 * 1024]
    assert recognises(Path("clip.mcap"), head)
    assert recognises(Path("clip.svo2"), head)
    assert not recognises(Path("clip.mcap"), b"\x89MCAP0\r\n" + b"ros2" * 20)
    assert not recognises(Path("clip.mp4"), b"\0\0\0\x20ftypisom")
    assert not recognises(Path("clip.svo2"), b"")
    # Encrypted as a whole, or damaged: better said here than by those who know nothing of it.
    scrambled = tmp_path / "other.svo2"
    scrambled.write_bytes(b"SVOE" * 50)
    assert recognises(scrambled, scrambled.read_bytes())
    with pytest.raises(InputError, match="encrypted"):
        opened(scrambled, SourceOptions())


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(1)))
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(MissingExtraError, match="av"):
        opened(path, SourceOptions())
    monkeypatch.setitem(__import__("sys").modules, "mcap", None)
    with pytest.raises(MissingExtraError, match=r"rigcal\[all\]"):
        opened(path, SourceOptions())


def test_widths_of_one_eye_and_of_both_are_told_apart() -> None:
    for size in ((2208, 1242), (1920, 1080), (1920, 1200), (1280, 720), (960, 600), (672, 376)):
        assert eye_size(*size) == size
        assert eye_size(2 * size[0], size[1]) == size


@pytest.mark.parametrize("codec", ["h264", "hevc", "jpeg"])
def test_the_coding_is_seen_in_the_first_key_frame(codec: str) -> None:
    message = frame_messages(Clip(pairs=_pairs(1), codec=codec))[0]
    assert coding_of(payload_of(message)) == codec
    assert coding_of(payload_of(message)[:3]) is None


def test_the_protocol_is_kept(tmp_path: Path) -> None:
    recording: Svo2 = opened(_recording(tmp_path, Clip(pairs=_pairs(3))), SourceOptions())
    assert list(recording.frames(SERIAL, [])) == []
    stamps = recording.stamps_ns(SERIAL)
    assert stamps.dtype == np.int64
    with pytest.raises(ValueError, match="read-only"):
        stamps[0] = 0


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_the_left_image_is_the_same_where_the_right_one_is_not_decoded_to_colours(tmp_path: Path, codec: str) -> None:
    path = _recording(tmp_path, Clip(pairs=_pairs(4), codec=codec))
    recording = opened(path, SourceOptions(stereo_depth=True))
    for alone, both in zip(recording.frames(SERIAL, range(4)), recording.frames(SERIAL, range(4), depth=True)):
        assert isinstance(alone, Frame)
        assert isinstance(both, Frame)
        assert both.depth_m is not None
        # Colours of the last columns are filled up from their neighbours, which were cut off.
        np.testing.assert_array_equal(alone.image[:, :-8], both.image[:, :-8])
        assert alone.digest == both.digest
