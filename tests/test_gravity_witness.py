"""Accelerometers in a calibration: they turn the world when asked, and always check what the target says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from click.testing import CliRunner
from loguru import logger
from numpy.typing import NDArray

from aruco import alignment
from aruco.errors import CalibrationError, InputError
from aruco.gravity import up_by_accelerometers
from aruco.model import SILENT, BadFrame, Calibration, Camera, Frame, KnowsUp, Recording
from aruco.pose_math import Array, exp_so3, make_pose
from calibrate_extrinsics import main
from rigcal.config import AlignConfig, CalibrateConfig
from rigcal.evidence import Evidence, look
from rigcal.gravity_witness import (
    GravityTestimony,
    beside_world,
    gravity_readings,
    gravity_remarks,
    hear_gravity,
    heard_again,
    require_upright,
    trusted_up,
)
from rigcal.pipeline import calibrate, calibrate_seen
from rigcal.quality.truth import tilt_error
from rigcal.sim import Simulation
from rigcal.sources import open_recordings
from rigcal.target import marker_target_from_file

UP, DOWN = (0, 1, 0), (0, -1, 0)


class WithAccelerometers:
    """A recording whose cameras know up, or some of them."""

    def __init__(self, recording: Recording, up: Mapping[str, Array]) -> None:
        self._recording, self._up = recording, up

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self._recording.cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        return self._recording.stamps_ns(camera)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        return self._recording.depth_indices(camera)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        return self._recording.frames(camera, indices, depth=depth)

    def up_in_camera(self, camera: str) -> Array | None:
        return self._up.get(camera)


def true_up(demo: Simulation, tilt_deg: float = 0.0) -> dict[str, Array]:
    """What accelerometers measure in the room, or would if it were tilted."""
    tilted = exp_so3(np.radians([tilt_deg, 0.0, 0.0])) @ np.array(UP)
    return {name: T[:3, :3].T @ tilted for name, T in demo.T_world_cam.items()}


@pytest.fixture(scope="module")
def seen(demo: Simulation, demo_folder: Path) -> Evidence:
    """What the demo's cameras saw, once for all tests."""
    target = marker_target_from_file(demo_folder / "markers.parquet", demo.dictionary)
    return look(open_recordings([demo_folder]), target, CalibrateConfig(), jobs=2, progress=SILENT)


def calibrated(seen: Evidence, up_cam: Mapping[str, Array] | None = None, **align: Any) -> Calibration:
    """The calibration of a recording with accelerometers; of the plain one where there are none."""
    recording = seen.recording if up_cam is None else WithAccelerometers(seen.recording, up_cam)
    config = CalibrateConfig(align=AlignConfig(**{"enabled": True, **align}))
    return calibrate_seen(replace(seen, recording=recording, config=config))


def check_of(calibration: Calibration, name: str) -> dict[str, Any] | None:
    checks = calibration.notes["quality"]["checks"]
    return next((check for check in checks if check["name"] == name), None)


def test_the_wrapper_is_a_recording_that_knows_up(demo: Simulation, seen: Evidence):
    assert isinstance(WithAccelerometers(demo.recording, {}), KnowsUp)
    assert not isinstance(demo.recording, KnowsUp)


def test_the_target_is_checked_by_accelerometers(demo: Simulation, seen: Evidence):
    found = calibrated(seen, true_up(demo))
    check = check_of(found, "up by accelerometers")
    assert check is not None
    assert check["passed"]
    # The target stands on the floor; poses are known to some hundredths of a degree.
    assert check["value"] < 0.1
    note = found.notes["accelerometers"]
    assert note["odd"] == []
    assert note["tilt_deg"] == check["value"]
    assert sorted(note["disagreement_deg"]) == sorted(demo.T_world_cam)
    assert any("Up agrees with the accelerometers" in reason for reason in found.notes["quality"]["reasons"])
    # Without accelerometers nothing is said of them, and nothing else changes.
    plain = calibrated(seen)
    assert check_of(plain, "up by accelerometers") is None
    assert "accelerometers" not in plain.notes
    for name, T in plain.T_world_cam.items():
        assert np.array_equal(T, found.T_world_cam[name])


@pytest.mark.parametrize(("tilt_deg", "verdict"), [(2.0, "usable"), (8.0, "bad")])
def test_a_target_that_does_not_lie_level_is_found_out(demo: Simulation, seen: Evidence, tilt_deg: float, verdict: str):
    found = calibrated(seen, true_up(demo, tilt_deg))
    check = check_of(found, "up by accelerometers")
    assert check is not None
    assert not check["passed"]
    assert check["value"] == pytest.approx(tilt_deg, abs=0.1)
    order = ["good", "usable", "bad"]
    assert order.index(found.notes["quality"]["verdict"]) >= order.index(verdict)
    assert any("--up-from imu" in reason for reason in found.notes["quality"]["reasons"])


@pytest.mark.parametrize("up_axis", ["+y", "-y"])
def test_up_from_accelerometers_is_up(demo: Simulation, seen: Evidence, up_axis: Any):
    tilt_deg = 8.0
    ups = true_up(demo, tilt_deg)
    found = calibrated(seen, ups, up_from="imu", up_axis=up_axis)
    up = UP if up_axis == "+y" else DOWN
    tilted = exp_so3(np.radians([tilt_deg, 0.0, 0.0]))
    room = {name: make_pose(tilted.T, np.zeros(3)) @ T for name, T in demo.T_world_cam.items()}
    # Poses are known to some hundredths of a degree.
    assert np.degrees(tilt_error(found.T_world_cam, room, up)) < 0.1
    assert found.up == up_axis
    assert found.notes["aligned"]["up_from"] == "imu"
    # A witness cannot check itself.
    assert found.notes["accelerometers"]["tilt_deg"] is None
    assert check_of(found, "up by accelerometers") is None
    # The target's up would miss it.
    assert np.degrees(tilt_error(calibrated(seen, ups).T_world_cam, room, UP)) > 7


def test_accelerometers_of_the_wrong_sign_do_not_turn_the_world(demo: Simulation, seen: Evidence):
    negated = {name: -up for name, up in true_up(demo).items()}
    with pytest.raises(CalibrationError, match=r"most cameras hang upside down.*--up-from target"):
        calibrated(seen, negated, up_from="imu")
    found = calibrated(seen, negated)
    reasons = " ".join(found.notes["quality"]["reasons"])
    assert "they point the other way: their sign or axes are not what is assumed" in reasons
    assert "--up-from imu" not in reasons
    assert found.notes["quality"]["verdict"] == "bad"


def test_only_a_majority_that_can_tell_hangs_upside_down():
    up = np.array(UP)
    upright = np.diag([1.0, -1.0, -1.0, 1.0])
    hanging = np.diag([-1.0, 1.0, -1.0, 1.0])
    downwards = make_pose(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))
    # Looking 60 degrees down and rolled by 60 degrees it is not upside down, by 120 degrees it is.
    pitch = exp_so3(np.radians([-60.0, 0, 0]))
    rolled = {
        deg: make_pose(pitch @ upright[:3, :3] @ exp_so3(np.radians([0, 0, deg])), np.zeros(3)) for deg in (60.0, 120.0)
    }
    for cameras in ([upright, hanging], [downwards], [upright, downwards, rolled[60.0]]):
        require_upright({str(k): T for k, T in enumerate(cameras)}, up)
    for cameras in ([hanging], [upright, hanging, hanging], [downwards, rolled[120.0]]):
        with pytest.raises(CalibrationError, match="upside down"):
            require_upright({str(k): T for k, T in enumerate(cameras)}, up)


def test_one_odd_accelerometer_is_named_and_changes_nothing(demo: Simulation, seen: Evidence):
    ups = true_up(demo)
    name = min(ups)
    ups[name] = exp_so3(np.array([0.3, 0, 0])) @ ups[name]
    found = calibrated(seen, ups, up_from="imu")
    assert np.degrees(tilt_error(found.T_world_cam, demo.T_world_cam, UP)) < 0.1
    assert found.notes["accelerometers"]["odd"] == [name]
    check = check_of(found, "cameras whose accelerometer contradicts the others")
    assert check is not None
    assert check["value"] == 1
    assert any(f"camera {name} 17.2 degrees" in reason for reason in found.notes["quality"]["reasons"])


def test_without_alignment_only_the_cameras_are_compared(demo: Simulation, seen: Evidence):
    found = calibrated(seen, true_up(demo), enabled=False)
    assert found.notes["accelerometers"]["tilt_deg"] is None
    assert check_of(found, "up by accelerometers") is None
    check = check_of(found, "cameras whose accelerometer contradicts the others")
    assert check is not None
    assert check["passed"]


def test_a_recording_without_accelerometers_is_told_before_the_work(demo: Simulation, seen: Evidence):
    for recording in (demo.recording, WithAccelerometers(demo.recording, {})):
        with pytest.raises(InputError, match="--up-from imu: no camera"):
            calibrate(recording, seen.target, CalibrateConfig(align=AlignConfig(enabled=True, up_from="imu")))


def test_accelerometers_that_contradict_are_no_up(demo: Simulation, seen: Evidence):
    ups = dict(list(true_up(demo).items())[:2])
    name = min(ups)
    ups[name] = exp_so3(np.array([0.3, 0, 0])) @ ups[name]
    with pytest.raises(CalibrationError, match="contradict each other"):
        calibrated(seen, ups, up_from="imu")
    found = calibrated(seen, ups)
    assert found.notes["accelerometers"]["tilt_deg"] is None
    assert any("contradict each other about up" in reason for reason in found.notes["quality"]["reasons"])


def test_an_ambiguous_target_names_the_accelerometers(
    demo: Simulation, seen: Evidence, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("aruco.alignment.MIN_MARGIN", 1e9)
    with pytest.raises(CalibrationError, match="--up-from imu"):
        calibrated(seen, true_up(demo))
    with pytest.raises(CalibrationError) as caught:
        calibrated(seen)
    assert "--up-from" not in str(caught.value)


def test_accelerometers_bear_out_an_up_of_a_single_frame(
    demo: Simulation, seen: Evidence, monkeypatch: pytest.MonkeyPatch
):
    found = alignment.find_up
    monkeypatch.setattr(alignment, "find_up", lambda *a, **k: replace(found(*a, **k), is_guess=True))
    gate = "up from one frame only"
    assert check_of(calibrated(seen), gate) is not None
    assert check_of(calibrated(seen, true_up(demo)), gate) is None
    assert check_of(calibrated(seen, true_up(demo, 5.0)), gate) is not None


def test_the_command_says_where_accelerometers_come_from(demo_folder: Path, tmp_path: Path):
    given = ["--input", str(demo_folder), "--markers", str(demo_folder / "markers.parquet"), "--auto-align"]
    result = CliRunner().invoke(main, [*given, "--up-from", "imu", "-o", str(tmp_path / "out.json")])
    assert result.exit_code == 1
    assert "Error: --up-from imu: no camera of this recording comes with an accelerometer" in result.output
    assert list(tmp_path.iterdir()) == []


def of_one(tilt_deg: float | None) -> GravityTestimony:
    heard = up_by_accelerometers({"a": np.eye(4)}, {"a": np.array(UP)})
    assert heard is not None
    return GravityTestimony(heard=heard, tilt_deg=tilt_deg)


def test_only_a_small_tilt_confirms():
    assert of_one(0.4).confirms
    assert not of_one(5.0).confirms
    assert not of_one(None).confirms
    assert "within 0.4 degrees" in gravity_remarks(of_one(0.4))[0]
    assert "to better than 0.1 degrees" in gravity_remarks(of_one(0.0))[0]
    assert gravity_remarks(of_one(5.0)) == gravity_remarks(None) == ()
    assert [reading.gate for reading in gravity_readings(of_one(0.4))] == ["up by accelerometers"]
    assert list(gravity_readings(None)) == []


def test_the_world_of_kept_cameras_is_checked_too():
    heard = of_one(None).heard
    turn = exp_so3(np.radians([5.0, 0, 0]))
    off = AlignConfig()
    assert beside_world(heard, turn, off, "+y").tilt_deg == pytest.approx(5.0)
    assert beside_world(heard, turn, off, "-y").tilt_deg == pytest.approx(175.0)
    assert beside_world(heard, turn, off, None).tilt_deg is None
    assert beside_world(heard, turn, replace(off, enabled=True, up_from="imu"), None).tilt_deg is None


def test_no_placed_camera_with_an_accelerometer_is_a_calibration_error(demo: Simulation, seen: Evidence):
    with pytest.raises(CalibrationError, match="leave out --up-from imu"):
        trusted_up(None)
    assert hear_gravity(demo.recording, cast(Any, None)) is None


def test_a_levelled_rig_is_heard_again():
    note = of_one(0.0).as_dict()
    tilted = make_pose(exp_so3(np.radians([2.0, 0, 0])), np.zeros(3))
    told: list[str] = []
    handler = logger.add(lambda message: told.append(str(message)), level="WARNING", format="{message}")
    again = heard_again(note, {"a": tilted}, "+y")
    logger.remove(handler)
    assert again["tilt_deg"] == pytest.approx(2.0)
    assert again["up_in_camera"] == note["up_in_camera"]
    assert "2.0 degrees off" in "".join(told)
    assert heard_again(note, {"a": np.eye(4)}, "+y")["tilt_deg"] == 0.0
    for damaged in (None, {}, {"up_in_camera": [1]}, {"up_in_camera": {"a": "x"}}, {"up_in_camera": {"a": [0, 0]}}):
        assert heard_again(damaged, {"a": np.eye(4)}, "+y") is None
