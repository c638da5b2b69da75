"""SVO files through the ZED SDK's documented behaviour, played by a stand-in."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_pyzed import DEPTH_MODE, ERROR_CODE, UNIT, FakeSdk, FakeSvo, confidence, depth_m, image_bgr
from loguru import logger

from aruco.errors import InputError
from aruco.model import BadFrame, Frame, KnowsUp
from aruco.pose_math import Array
from rigcal.sources import zed_sdk
from rigcal.sources.mcap_records import MAGIC
from rigcal.sources.options import SourceOptions
from rigcal.sources.zed_player import RefusedError

FIRST_NS, PERIOD_NS = 1_700_000_000_000_000_000, 33_333_333
NAME = "34563472"

Opening = Callable[..., tuple[zed_sdk.ZedRecording, FakeSdk]]


def svo_of(n: int = 12, **given: Any) -> FakeSvo:
    return FakeSvo(stamps_ns=[FIRST_NS + PERIOD_NS * k for k in range(n)], **given)


@pytest.fixture
def opening(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Opening:
    def with_sdk(
        svo: FakeSvo, options: SourceOptions | None = None, name: str = "a.svo"
    ) -> tuple[zed_sdk.ZedRecording, FakeSdk]:
        path = tmp_path / name
        path.write_bytes(b"SVO")
        sdk = FakeSdk({str(path): svo})
        for module, stand_in in sdk.modules().items():
            monkeypatch.setitem(sys.modules, module, stand_in)
        return zed_sdk.opened(path, options or SourceOptions()), sdk

    return with_sdk


@pytest.fixture
def without_sdk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyzed", None)
    monkeypatch.delitem(sys.modules, "pyzed.sl", raising=False)


def rotation(axis: Array, angle_rad: float) -> Array:
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * cross @ cross


def test_the_camera_is_the_rectified_left_eye_in_metres(opening: Opening) -> None:
    recording, sdk = opening(svo_of())
    (camera,) = recording.cameras
    assert (camera.name, camera.width, camera.height) == (NAME, 32, 20)
    assert np.array_equal(camera.K, [[25.0, 0, 15.7], [0, 25.5, 9.6], [0, 0, 1]])  # not self-calibrated anew
    assert not camera.has_distortion
    assert camera.baseline_m == pytest.approx(0.12)  # the stand-in gives millimetres unless told otherwise
    assert sdk.open_now == 0


def test_the_camera_is_opened_for_calibration(opening: Opening, tmp_path: Path) -> None:
    recording, sdk = opening(svo_of(), SourceOptions(depth_mode="NEURAL_PLUS", zed_conf=tmp_path))
    list(recording.frames(NAME, [0], depth=True))
    for parameters in sdk.parameters:
        assert parameters.svo_real_time_mode is False
        assert parameters.camera_disable_self_calib is True
        assert parameters.coordinate_units is UNIT.METER
        assert parameters.depth_stabilization == 0
        assert parameters.optional_settings_path == str(tmp_path)
    assert [p.depth_mode for p in sdk.parameters] == [DEPTH_MODE.NONE, DEPTH_MODE.NONE, DEPTH_MODE.NEURAL_PLUS]


def test_stamps_cost_one_pass_without_depth_and_are_kept(opening: Opening) -> None:
    svo = svo_of(12)
    recording, sdk = opening(svo)
    assert sdk.grabs == 0
    assert recording.stamps_ns(NAME).tolist() == svo.stamps_ns
    assert recording.stamps_ns(NAME).dtype == np.int64
    assert recording.depth_indices(NAME).tolist() == list(range(12))
    assert (sdk.grabs, sdk.depths, sdk.open_now) == (12, 0, 0)


def test_frames_are_the_pictures_of_their_stamps(opening: Opening) -> None:
    svo = svo_of(12)
    recording, sdk = opening(svo)
    frames = list(recording.frames(NAME, range(12)))
    assert sdk.depths == 0
    for k, frame in enumerate(frames):  # compared after the last was read: none may lie in the SDK's memory
        assert isinstance(frame, Frame)
        assert frame.stamp_ns == svo.stamps_ns[k]
        assert np.array_equal(frame.image, image_bgr(svo, k))
        assert frame.depth_m is None
        assert frame.confidence is None
    assert len({frame.digest for frame in frames if isinstance(frame, Frame)}) == 12


def test_depth_is_in_metres_and_unknown_where_the_sdk_measured_nothing(opening: Opening) -> None:
    svo = svo_of()
    recording, sdk = opening(svo)
    three, seven = recording.frames(NAME, [3, 7], depth=True)
    assert isinstance(three, Frame)
    assert isinstance(seven, Frame)
    assert three.depth_m is not None
    assert seven.depth_m is not None
    assert three.depth_m.dtype == np.float32
    assert np.isnan(three.depth_m[0, :5]).all()  # unknown, too far, too near, zero, negative
    assert np.array_equal(three.depth_m[1:], depth_m(svo, 3)[1:])
    assert np.array_equal(seven.depth_m[1:], depth_m(svo, 7)[1:])
    assert sdk.depths == 2  # not on the way from 3 to 7


def test_confidence_keeps_the_sdks_meaning(opening: Opening) -> None:
    svo = svo_of()
    recording, _ = opening(svo)
    (frame,) = recording.frames(NAME, [0], depth=True)
    assert isinstance(frame, Frame)
    assert frame.confidence is not None
    assert frame.confidence.dtype == np.uint8
    assert frame.confidence[0, :2].tolist() == [100, 100]  # no number: not to be trusted
    assert np.array_equal(frame.confidence[1:], np.rint(confidence(svo, 0)[1:]))
    assert frame.confidence.max() == 100


def test_sampling_jumps_and_does_not_decode_what_lies_between(opening: Opening) -> None:
    svo = svo_of(1000)
    recording, sdk = opening(svo)
    recording.stamps_ns(NAME)
    sdk.grabs = 0
    frames = list(recording.frames(NAME, range(0, 1000, 100)))
    assert [frame.stamp_ns for frame in frames] == svo.stamps_ns[::100]
    assert sdk.grabs == 10
    assert sdk.seeks == list(range(100, 1000, 100))


def test_frames_that_are_near_are_reached_without_a_jump(opening: Opening) -> None:
    recording, sdk = opening(svo_of(40))
    recording.stamps_ns(NAME)
    sdk.grabs = 0
    assert all(isinstance(frame, Frame) for frame in recording.frames(NAME, range(0, 40, 10)))
    assert sdk.seeks == []
    assert sdk.grabs == 31


@pytest.mark.parametrize("missed", [-3, -1, 1, 2])
def test_a_jump_that_misses_gives_the_right_frame_all_the_same(opening: Opening, missed: int) -> None:
    svo = svo_of(300, seek_error=missed)
    recording, sdk = opening(svo)
    wanted = [0, 100, 104, 250]
    frames = list(recording.frames(NAME, wanted, depth=True))
    for k, frame in zip(wanted, frames):
        assert isinstance(frame, Frame)
        assert np.array_equal(frame.image, image_bgr(svo, k))
        assert frame.depth_m is not None
        assert np.array_equal(frame.depth_m[1:], depth_m(svo, k)[1:])
    # Believing the position, as the documentation has it, would have given another picture: the check can fail.
    trusting = image_bgr(svo, 100 + missed)
    assert isinstance(frames[1], Frame)
    assert not np.array_equal(frames[1].image, trusting)
    # Once seen, the error is known: the last jump lands on its frame.
    assert sdk.seeks[-1] == 250 - missed
    assert sdk.depths <= 4 + 12
    assert sdk.open_now == 0


@pytest.mark.parametrize("missed", [0, 3, 20])
def test_on_the_way_to_a_frame_hardly_any_depth_is_computed(opening: Opening, missed: int) -> None:
    """Whether jumps land or miss by a few or by many frames; from 64 before it, all would be 65."""
    svo = svo_of(300, seek_error=missed)
    recording, sdk = opening(svo)
    (frame,) = recording.frames(NAME, [150], depth=True)
    assert isinstance(frame, Frame)
    assert frame.depth_m is not None
    assert np.array_equal(frame.depth_m[1:], depth_m(svo, 150)[1:])
    # Of three searches at most: 3 frames beyond the place at the first, 4 before and 3 beyond at the two others.
    assert sdk.depths <= 4 + 8 + 8
    sdk.depths = 0
    (frame,) = recording.frames(NAME, [250], depth=True)
    assert isinstance(frame, Frame)
    assert sdk.depths == 1


def test_a_frame_that_never_comes_again_is_bad(opening: Opening) -> None:
    svo = svo_of(300)
    recording, _ = opening(svo)
    recording.stamps_ns(NAME)
    svo.stamps_ns[200] += 1  # another file than at the first pass
    bad, good = recording.frames(NAME, [200, 201])
    assert isinstance(bad, BadFrame)
    assert bad.reason == "a.svo: frame 200 was not found again by its time stamp"
    assert isinstance(good, Frame)


def test_corrupted_frames_are_bad_and_the_others_good(opening: Opening) -> None:
    svo = svo_of(12, corrupted=frozenset({4}))
    recording, _ = opening(svo)
    frames = list(recording.frames(NAME, range(12)))
    assert [k for k, frame in enumerate(frames) if isinstance(frame, BadFrame)] == [4]
    assert isinstance(frames[4], BadFrame)
    assert frames[4].reason == "a.svo: frame 4 is corrupted (CORRUPTED_FRAME of the ZED SDK)"
    assert frames[4].stamp_ns == svo.stamps_ns[4]


def test_frames_that_cannot_be_decoded_leave_a_gap(opening: Opening) -> None:
    svo = svo_of(12, failing=frozenset({4, 5}))
    recording, _ = opening(svo)
    said: list[str] = []
    sink = logger.add(said.append, level="WARNING", format="{message}")
    stamps = recording.stamps_ns(NAME)
    logger.remove(sink)
    assert stamps.tolist() == svo.stamps_ns[:4] + svo.stamps_ns[6:]
    assert "2 of 12 frames cannot be decoded" in said[0]
    (frame,) = recording.frames(NAME, [4])
    assert isinstance(frame, Frame)
    assert np.array_equal(frame.image, image_bgr(svo, 6))


def test_a_file_that_ends_early_gives_what_is_whole(opening: Opening) -> None:
    svo = svo_of(12, ends_after=9)
    recording, _ = opening(svo)
    said: list[str] = []
    sink = logger.add(said.append, level="WARNING", format="{message}")
    frames = list(recording.frames(NAME, range(9)))
    logger.remove(sink)
    assert len(recording.stamps_ns(NAME)) == 9
    assert all(isinstance(frame, Frame) for frame in frames)
    assert said[0].strip().endswith("a.svo: ends after 9 of 12 frames")


def test_a_file_that_is_cut_after_the_first_pass_gives_bad_frames_not_an_endless_search(opening: Opening) -> None:
    svo = svo_of(200)
    recording, _ = opening(svo)
    recording.stamps_ns(NAME)
    svo.ends_after = 100
    frames = list(recording.frames(NAME, [50, 150, 60 + 30]))
    assert [isinstance(frame, Frame) for frame in frames] == [True, False, True]


def test_stamps_that_repeat_or_run_back_are_put_in_order(opening: Opening) -> None:
    svo = svo_of(6)
    svo.stamps_ns[2] = svo.stamps_ns[1]
    svo.stamps_ns[4], svo.stamps_ns[5] = svo.stamps_ns[5], svo.stamps_ns[4]
    recording, _ = opening(svo)
    stamps = recording.stamps_ns(NAME)
    assert (np.diff(stamps) > 0).all()
    frames = list(recording.frames(NAME, range(5)))
    for frame, original in zip(frames, [0, 1, 3, 5, 4]):
        assert isinstance(frame, Frame)
        assert np.array_equal(frame.image, image_bgr(svo, original))


def test_two_readers_share_one_open_camera(opening: Opening) -> None:
    svo = svo_of(100)
    recording, sdk = opening(svo)
    with_depth = recording.frames(NAME, range(0, 100, 25), depth=True)
    without = recording.frames(NAME, range(10, 100, 25))
    for k, (near, far) in enumerate(zip(without, with_depth, strict=True)):
        assert isinstance(near, Frame)
        assert isinstance(far, Frame)
        assert np.array_equal(near.image, image_bgr(svo, 25 * k + 10))
        assert np.array_equal(far.image, image_bgr(svo, 25 * k))
        assert far.depth_m is not None
    assert (sdk.most_open, sdk.open_now) == (1, 0)


def test_threads_share_one_open_camera(opening: Opening) -> None:
    svo = svo_of(120)
    recording, sdk = opening(svo)
    recording.stamps_ns(NAME)
    stretches = [range(0, 40), range(40, 80), range(80, 120)]
    with ThreadPoolExecutor(3) as pool:
        parts = list(pool.map(lambda stretch: list(recording.frames(NAME, stretch)), stretches))
    for k, frame in enumerate(frame for part in parts for frame in part):
        assert isinstance(frame, Frame)
        assert np.array_equal(frame.image, image_bgr(svo, k))
    assert (sdk.most_open, sdk.open_now) == (1, 0)


def test_the_camera_is_closed_when_a_reader_stops_early_or_fails(opening: Opening) -> None:
    recording, sdk = opening(svo_of())
    frames = recording.frames(NAME, range(12))
    next(frames)
    assert sdk.open_now == 1
    frames.close()  # type: ignore[attr-defined]
    assert sdk.open_now == 0
    with pytest.raises(InputError, match="has frames 0 to 11, not 12"):
        list(recording.frames(NAME, [0, 12]))
    assert sdk.open_now == 0


def test_up_is_what_the_accelerometer_measures_turned_into_the_camera(opening: Opening) -> None:
    R_cam_imu = rotation(np.array([1.0, -2.0, 0.5]), 0.4)
    up = rotation(np.array([1.0, 0.0, 0.3]), 0.6) @ np.array([0.0, -1.0, 0.0])  # a level camera: its own y is down
    rng = np.random.default_rng(1)
    measured = 9.81 * (R_cam_imu.T @ up) + rng.normal(0, 0.05, (41, 3))
    measured[7] = [40.0, 0.0, 0.0]  # somebody knocks at the table
    svo = svo_of(41, accelerations=[tuple(row) for row in measured.tolist()], R_cam_imu=R_cam_imu)
    recording, _ = opening(svo)
    assert isinstance(recording, KnowsUp)
    found = recording.up_in_camera(NAME)
    assert found is not None
    # 0.05 m/s^2 of noise over 41 medians: 0.05 * 1.25 / sqrt(41) / 9.81 = 1e-3 rad an axis; three times that and two
    # axes.
    assert np.linalg.norm(found - up) < 4e-3
    # Without the IMU's rotation, with its inverse or with the other sign it would miss.
    for wrong in (R_cam_imu.T @ up, R_cam_imu.T @ R_cam_imu.T @ up, -up):
        assert np.linalg.norm(found - wrong) > 0.1


@pytest.mark.parametrize(
    "accelerations",
    [
        None,
        [(0.0, 0.0, 0.0)] * 12,
        [(0.0, -5.0, 0.0)] * 12,
        [(float("nan"), 0.0, 0.0)] * 12,
        [(6.0 * (-1) ** k, -9.8, 1.0) for k in range(12)],
        [(0.0, -9.8, 0.0)] * 4 + [(float("nan"), 0.0, 0.0)] * 8,
    ],
    ids=["no sensor", "not recorded", "not gravity", "not a number", "carried about", "too few"],
)
def test_up_is_unknown_where_gravity_was_not_measured(opening: Opening, accelerations: Any) -> None:
    recording, _ = opening(svo_of(12, accelerations=accelerations))
    assert recording.up_in_camera(NAME) is None


def test_up_is_unknown_where_the_sdk_does_not_know_how_the_imu_sits(opening: Opening) -> None:
    recording, _ = opening(svo_of(12, accelerations=[(0.0, -9.8, 0.0)] * 12, R_cam_imu=np.zeros((3, 3))))
    assert recording.up_in_camera(NAME) is None


def test_fill_is_refused_because_it_invents_distances(opening: Opening) -> None:
    with pytest.raises(InputError, match=r"--depth-mode fill: FILL invents distances .* choose one of PERFORMANCE"):
        opening(svo_of(), SourceOptions(depth_mode="fill"))


@pytest.mark.parametrize("name", ["TERRA", "NONE", "LAST", ""])
def test_an_unknown_depth_mode_is_answered_with_what_the_sdk_offers(opening: Opening, name: str) -> None:
    offered = "PERFORMANCE, QUALITY, ULTRA, NEURAL_LIGHT, NEURAL, NEURAL_PLUS"
    with pytest.raises(InputError, match=f"has no such mode; choose {offered}"):
        opening(svo_of(), SourceOptions(depth_mode=name))


@pytest.mark.parametrize(
    ("code", "cure"),
    [
        (ERROR_CODE.INVALID_SVO_FILE, "damaged"),
        (ERROR_CODE.NO_GPU_DETECTED, "NVIDIA GPU"),
        (ERROR_CODE.CALIBRATION_FILE_NOT_AVAILABLE, "--zed-conf"),
        (ERROR_CODE.CUDA_ERROR, "ZED Explorer"),
    ],
)
def test_a_file_that_the_sdk_refuses_gets_its_reason_and_a_cure(opening: Opening, code: ERROR_CODE, cure: str) -> None:
    with pytest.raises(RefusedError, match=rf"a\.svo: the ZED SDK cannot open it \({code.name}\); .*{cure}"):
        opening(svo_of(refused=code))


def test_depth_that_does_not_fit_the_gpu_is_said_when_it_is_asked_for(opening: Opening) -> None:
    recording, sdk = opening(svo_of(refused_with_depth=ERROR_CODE.NOT_ENOUGH_GPU_MEMORY))
    assert len(list(recording.frames(NAME, [0]))) == 1
    with pytest.raises(InputError, match=r"NOT_ENOUGH_GPU_MEMORY.*--depth-mode"):
        list(recording.frames(NAME, [0], depth=True))
    assert sdk.open_now == 0


def test_a_warning_at_opening_does_not_stop_the_reading(opening: Opening) -> None:
    recording, _ = opening(svo_of(refused=ERROR_CODE.CAMERA_REBOOTING))
    assert len(recording.stamps_ns(NAME)) == 12


def test_files_without_stamps_or_without_a_frame_are_refused(opening: Opening) -> None:
    with pytest.raises(InputError, match="no time stamps"):
        opening(FakeSvo(stamps_ns=[0] * 5))[0].stamps_ns(NAME)
    with pytest.raises(InputError, match="cannot decode a single frame"):
        opening(svo_of(5, failing=frozenset(range(5))))[0].stamps_ns(NAME)
    with pytest.raises(InputError, match="cannot decode a single frame"):
        opening(svo_of(0))[0].stamps_ns(NAME)


def test_a_file_without_end_of_failures_is_given_up(opening: Opening) -> None:
    recording, sdk = opening(svo_of(5000, failing=frozenset(range(10, 5000))))
    assert len(recording.stamps_ns(NAME)) == 10
    assert sdk.grabs < 200


def test_absurd_sizes_and_intrinsics_are_refused(opening: Opening) -> None:
    with pytest.raises(InputError, match="40000 x 40000, which is not a camera's"):
        opening(svo_of(width=40000, height=40000))
    with pytest.raises(InputError, match=r"a\.svo: camera 34563472: .*focal lengths must be positive"):
        opening(svo_of(fx=-3.0))


def test_a_camera_without_a_serial_number_is_named_by_its_file(opening: Opening) -> None:
    recording, _ = opening(svo_of(serial=0), name="front.svo")
    assert recording.cameras[0].name == "front"


def test_other_cameras_are_unknown(opening: Opening) -> None:
    recording, _ = opening(svo_of())
    with pytest.raises(InputError, match="no camera 1 in the recording; it has 34563472"):
        recording.stamps_ns("1")
    with pytest.raises(InputError, match="no camera 1"):
        recording.frames("1", [0])


def test_an_svo_is_recognised_by_its_suffix(tmp_path: Path, opening: Opening) -> None:
    opening(svo_of())
    for name, known in [("x.svo", True), ("x.SVO", True), ("x.svo2", True), ("x.mp4", False)]:
        (tmp_path / name).write_bytes(b"data")
        assert zed_sdk.recognises(tmp_path / name, b"data") is known
    assert not zed_sdk.recognises(tmp_path / "x.svo", b"")  # empty
    assert not zed_sdk.recognises(tmp_path / "x.svo", bytes(100))  # never copied to its end
    (tmp_path / "folder.svo").mkdir()
    assert not zed_sdk.recognises(tmp_path / "folder.svo", b"")
    assert not zed_sdk.recognises(tmp_path / "missing.svo", b"")


@pytest.mark.usefixtures("without_sdk")
def test_without_the_sdk_an_svo_says_how_to_install_it(tmp_path: Path) -> None:
    path = tmp_path / "a.svo"
    path.write_bytes(b"SVO")
    assert not zed_sdk.is_available()
    assert zed_sdk.recognises(path, b"SVO")
    with pytest.raises(
        InputError, match=r"a\.svo: .*stereolabs\.com/developers and run the get_python_api\.py"
    ) as info:
        zed_sdk.opened(path, SourceOptions())
    assert str(info.value).count(". ") == 0  # one sentence


@pytest.mark.usefixtures("without_sdk")
def test_without_the_sdk_svo2_is_left_to_its_own_reader(tmp_path: Path) -> None:
    for name in ("a.svo2", "b.svo"):
        (tmp_path / name).write_bytes(MAGIC)
        assert not zed_sdk.recognises(tmp_path / name, MAGIC)


@pytest.fixture
def _broken_sdk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for name in ("pyzed", "pyzed.sl"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    package = tmp_path / "site" / "pyzed"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "sl.py").write_text("raise ImportError('libsl_zed.so: cannot open shared object file')")
    monkeypatch.syspath_prepend(package.parent)
    yield
    # Popped before monkeypatch puts back what was there: its delitem would put the broken one back.
    for name in ("pyzed", "pyzed.sl"):
        sys.modules.pop(name, None)


@pytest.mark.usefixtures("_broken_sdk")
def test_an_sdk_that_cannot_be_loaded_says_why(tmp_path: Path) -> None:
    path = tmp_path / "a.svo"
    path.write_bytes(b"SVO")
    assert not zed_sdk.is_available()
    with pytest.raises(InputError, match=r"cannot be loaded \(libsl_zed\.so: cannot open shared object file\)"):
        zed_sdk.opened(path, SourceOptions())


def test_a_broken_sdk_is_not_left_to_the_tests_that_follow() -> None:
    assert "pyzed" not in sys.modules or zed_sdk.is_available()


def test_the_reader_itself_is_imported_without_the_sdk() -> None:
    code = "import sys; sys.modules['pyzed'] = None; import rigcal.sources.zed_sdk"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_stand_in_refuses_what_the_sdk_would_refuse() -> None:
    sl: Any = FakeSdk({}).modules()["pyzed.sl"]
    parameters = sl.InitParameters()
    with pytest.raises(AttributeError):
        parameters.no_such_setting = 1
    with pytest.raises(TypeError):
        parameters.depth_mode = "NEURAL"
    assert sl.Camera().open(parameters) is sl.ERROR_CODE.INVALID_SVO_FILE
    assert replace(svo_of(), serial=1).serial == 1
