from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SHARED_DATA
from hypothesis import given, settings
from hypothesis import strategies as st
from loguru import logger
from scipy.spatial.transform import Rotation
from upright_rigs import SAME, SAME_PX, farthest, level_camera, pixels, points_before, random_rig

from aruco.errors import InputError, OutputError
from aruco.model import UpAxis
from aruco.pose_math import Array, Pose, make_pose
from rigcal.formats import json_edit
from rigcal.formats.rig import ExportOptions, Rig
from rigcal.formats.zed_fusion import FORMAT

# A pose that a real ZED360 of SDK 5.4 wrote, and where the SDK says that the camera is in three of its systems.
REAL_POSE = (
    "0.302219 -0.063902 -0.951094 1.755632 -0.038873 0.996094 -0.079278 -0.571798 0.952446 0.060931 0.298555 1.295626 "
    "0.000000 0.000000 0.000000 1.000000"
)
REAL_CENTRES = {
    "IMAGE": (1.755632, -0.571798, 1.295626),
    "LEFT_HANDED_Y_UP": (1.755632, 0.571798, 1.295626),
    "RIGHT_HANDED_Y_UP": (1.756, 0.572, -1.296),
    "RIGHT_HANDED_Z_UP": (1.756, 1.296, 0.572),
    "LEFT_HANDED_Z_UP": (1.295626, 1.755632, 0.571798),
    "RIGHT_HANDED_Z_UP_X_FWD": (1.296, -1.756, 0.572),
}
MILLIMETRE = 1e-3  # as many decimals as the vector is given with

# The SDK's coordinate systems: their axes in terms of the IMAGE axes.
SYSTEMS: Mapping[str, Array] = {
    "IMAGE": np.eye(3),
    "LEFT_HANDED_Y_UP": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1]]),
    "RIGHT_HANDED_Y_UP": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]),
    "RIGHT_HANDED_Z_UP": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "LEFT_HANDED_Z_UP": np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]]),
    "RIGHT_HANDED_Z_UP_X_FWD": np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]),
}


def sdk_pose(T_disk: Pose, system: str) -> Pose:
    """The pose that the SDK gives for one in a file, when it is told to use a coordinate system of SYSTEMS."""
    M = np.eye(4)
    M[:3, :3] = SYSTEMS[system]
    return M @ T_disk @ M.T


@pytest.fixture
def real_file():
    path = SHARED_DATA / "zed" / "zed360_sdk5.4_fusion_example.json"
    if not path.is_file():
        pytest.skip("needs the real Fusion configuration")
    return path


@pytest.fixture
def warnings_said():
    said: list[str] = []
    logger.add(lambda message: said.append(str(message)), level="WARNING", format="{message}")
    return said


def entry(pose: Any = REAL_POSE, serial: str = "19321109", **more: Any):
    return {serial: {"FusionConfiguration": {"override_gravity": True, "pose": pose, **more}}}


def old_entry(rotation: object, translation: object, serial: str = "34563472", gravity: object = "true"):
    world = {"rotation": rotation, "translation": translation, "override_gravity": gravity}
    source = {
        "zed": {"type": "USB_SERIAL", "configuration": serial},
        "fusion": {"type": "INTRA_PROCESS", "configuration": {"ip": "", "port": 0}},
    }
    return {serial: {"input": source, "world": world}}


def written(tmp_path: Path, content: Any, name: str = "given.json"):
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content, indent=4), encoding="utf-8")
    return path


def matrix(pose: Any):
    return np.array([float(word) for word in pose.split()]).reshape(4, 4)


# --- what the numbers mean


def test_a_camera_above_the_floor_has_a_negative_ty(tmp_path: Path):
    FORMAT.write(Rig(T_world_cam={"123": level_camera(1.2)}, up="+y"), tmp_path / "f.json", ExportOptions())
    fusion = json.loads((tmp_path / "f.json").read_text())["123"]["FusionConfiguration"]
    assert fusion["pose"] == "1.0 0.0 0.0 0.0 0.0 1.0 0.0 -1.2 0.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0"
    assert fusion["override_gravity"] is True


@pytest.mark.parametrize("up", ["+y", "-y"])
def test_both_worlds_give_the_same_file(tmp_path: Path, up: UpAxis):
    turn = np.diag([1.0, 1.0, 1.0, 1.0]) if up == "+y" else np.diag([1.0, -1.0, -1.0, 1.0])
    FORMAT.write(Rig(T_world_cam={"123": turn @ level_camera(1.2)}, up=up), tmp_path / "f.json", ExportOptions())
    assert "-1.2" in json.loads((tmp_path / "f.json").read_text())["123"]["FusionConfiguration"]["pose"]


def test_the_layout_is_that_of_the_real_file(tmp_path: Path, real_file: Path):
    theirs = json.loads(real_file.read_text())["19321109"]["FusionConfiguration"]
    FORMAT.write(random_rig(1, names=("19321109",)), tmp_path / "f.json", ExportOptions())
    ours = json.loads((tmp_path / "f.json").read_text())["19321109"]["FusionConfiguration"]
    assert {**ours, "pose": 0, "override_gravity": 0} == {**theirs, "pose": 0, "override_gravity": 0}


@pytest.mark.parametrize("seed", range(5))
def test_points_land_on_the_same_pixels_in_every_system_of_the_sdk(tmp_path: Path, seed: int):
    rig = random_rig(seed)
    FORMAT.write(rig, tmp_path / "f.json", ExportOptions())
    for serial, camera in json.loads((tmp_path / "f.json").read_text()).items():
        T_world_cam = rig.T_world_cam[serial]
        points = points_before(T_world_cam)
        truth = pixels(points, T_world_cam[:3, :3], T_world_cam[:3, 3])
        T_disk = matrix(camera["FusionConfiguration"]["pose"])
        points_down = points * [1.0, -1.0, -1.0]
        assert np.abs(pixels(points_down, T_disk[:3, :3], T_disk[:3, 3]) - truth).max() < SAME_PX
        for system, M in SYSTEMS.items():
            # What the SDK gives maps points of the camera, in that system's axes, to its world.
            T = sdk_pose(T_disk, system)
            seen = pixels(points_down @ M.T, T[:3, :3] @ M, T[:3, 3])
            assert np.abs(seen - truth).max() < SAME_PX
        # The same tolerance catches a world that is not turned, one that is turned on the right too, an inverse.
        turn = np.diag([1.0, -1.0, -1.0, 1.0])
        for wrong in (turn @ T_disk, T_disk @ turn, np.linalg.inv(T_disk)):
            assert np.abs(pixels(points_down, wrong[:3, :3], wrong[:3, 3]) - truth).max() > 1.0


def test_the_sdks_test_vector_holds_in_all_six_systems():
    T_disk = matrix(REAL_POSE)
    assert set(REAL_CENTRES) == set(SYSTEMS)
    for system, centre in REAL_CENTRES.items():
        assert np.abs(sdk_pose(T_disk, system)[:3, 3] - centre).max() < MILLIMETRE
    handed = {system: round(np.linalg.det(M)) for system, M in SYSTEMS.items()}
    assert {system for system, sign in handed.items() if sign < 0} == {"LEFT_HANDED_Y_UP", "LEFT_HANDED_Z_UP"}


def test_our_world_is_the_sdks_right_handed_one_with_y_up(tmp_path: Path):
    # Only the camera's own axes differ: the SDK's look along -z with y up there, OpenCV's along z with y down.
    T_world_cam = FORMAT.read(written(tmp_path, entry())).T_world_cam["19321109"]
    T_sdk = sdk_pose(matrix(REAL_POSE), "RIGHT_HANDED_Y_UP")
    assert np.abs(T_world_cam @ np.diag([1.0, -1.0, -1.0, 1.0]) - T_sdk).max() < 2e-6  # six decimals
    assert np.abs(T_world_cam[:3, 3] - REAL_CENTRES["RIGHT_HANDED_Y_UP"]).max() < MILLIMETRE


def test_the_real_file_is_read_and_its_gravity_told(real_file: Path, warnings_said: list[str]):
    rig = FORMAT.read(real_file)
    assert rig.up == "+y"
    a, b = (rig.T_world_cam[serial] for serial in ("13870389", "19321109"))
    assert np.linalg.norm(a[:3, 3] - b[:3, 3]) == pytest.approx(2.1844, abs=5e-5)
    assert a[1, 3] == 0.674864  # above the floor
    assert len(warnings_said) == 1
    assert "override_gravity is false for camera 13870389, 19321109" in warnings_said[0]


# --- round trips


@pytest.mark.parametrize("seed", range(5))
def test_written_and_read_it_is_the_same_rig(tmp_path: Path, seed: int, warnings_said: list[str]):
    rig = random_rig(seed)
    FORMAT.write(rig, tmp_path / "a.json", ExportOptions())
    once = FORMAT.read(tmp_path / "a.json")
    assert farthest(once.T_world_cam, rig.T_world_cam) == 0.0  # signs only: every bit comes back
    FORMAT.write(once, tmp_path / "b.json", ExportOptions())
    assert (tmp_path / "b.json").read_bytes() == (tmp_path / "a.json").read_bytes()
    assert not warnings_said


def test_a_file_of_six_decimals_reads_as_rotations(tmp_path: Path):
    # About one rotation in twenty is further from one than 1e-6 after rounding; none may be refused.
    turns = Rotation.from_quat(np.random.default_rng(2).normal(size=(100, 4))).as_matrix()
    content = {}
    for nth, R in enumerate(turns, start=1):
        pose = " ".join(f"{number:.6f}" for number in make_pose(R, np.ones(3)).ravel())
        content |= entry(pose, str(nth))
    worst = max(np.abs(np.round(R, 6) @ np.round(R, 6).T - np.eye(3)).max() for R in turns)
    assert worst > 1e-6
    assert len(FORMAT.read(written(tmp_path, content)).T_world_cam) == 100


def test_tiny_numbers_are_written_as_zero(tmp_path: Path):
    # A reader that parses float32 stumbles over 1e-40.
    T = level_camera(1.0).copy()
    T[0, 1], T[2, 3] = 1e-40, -5e-324
    FORMAT.write(Rig(T_world_cam={"123": T}, up="+y"), tmp_path / "f.json", ExportOptions())
    assert "e-" not in json.loads((tmp_path / "f.json").read_text())["123"]["FusionConfiguration"]["pose"]


# --- SDK 4.x


def test_the_old_layout_is_read(tmp_path: Path, warnings_said: list[str]):
    rig = FORMAT.read(written(tmp_path, old_entry([0.001, -0.002, 0.003], [0.5, -1.2, 0.25])))
    T = rig.T_world_cam["34563472"]
    assert T[:3, 3].tolist() == [0.5, 1.2, -0.25]
    R_disk = Rotation.from_rotvec([0.001, -0.002, 0.003]).as_matrix()
    assert np.abs(np.diag([1.0, -1.0, -1.0]) @ T[:3, :3] - R_disk).max() < SAME
    assert not warnings_said


def test_the_old_layouts_rotation_is_said_to_be_presumed(tmp_path: Path, warnings_said: list[str]):
    FORMAT.read(written(tmp_path, old_entry([0.3, -0.2, 0.1], [0.0, 0.0, 0.0])))
    assert len(warnings_said) == 1
    assert "Rodrigues" in warnings_said[0]
    assert "34563472" in warnings_said[0]


@pytest.mark.parametrize("gravity", ["false", False, "False", None])
def test_the_old_layouts_gravity_is_told(tmp_path: Path, warnings_said: list[str], gravity: object):
    FORMAT.read(written(tmp_path, old_entry([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], gravity=gravity)))
    assert "override_gravity" in warnings_said[0]


@pytest.mark.parametrize("more", [{"_comment": "of the hall"}, {"version": "5.1"}, {"settings": {"fps": 30}, "": None}])
def test_remarks_beside_the_cameras_are_left_alone(tmp_path: Path, more: dict[str, Any], warnings_said: list[str]):
    path = written(tmp_path, {**more, **entry()})
    assert list(FORMAT.read(path).T_world_cam) == ["19321109"]
    rig = random_rig(2, names=("19321109",))
    FORMAT.write(rig, tmp_path / "f.json", ExportOptions(into=path))
    filled = json.loads((tmp_path / "f.json").read_text())
    assert {key: filled[key] for key in more} == more
    assert farthest(FORMAT.read(tmp_path / "f.json").T_world_cam, rig.T_world_cam) == 0.0
    assert not [line for line in warnings_said if "is not in the calibration" in line]


# --- into a file that is there


def test_only_poses_and_gravity_of_the_real_file_change(tmp_path: Path, real_file: Path):
    rig = random_rig(4, names=("13870389", "19321109"))
    FORMAT.write(rig, tmp_path / "f.json", ExportOptions(into=real_file))
    before, after = real_file.read_text().splitlines(), (tmp_path / "f.json").read_text().splitlines()
    changed = [now for was, now in zip(before, after, strict=True) if was != now]
    assert [line.split('"')[1] for line in changed] == ["override_gravity", "pose"] * 2
    assert farthest(FORMAT.read(tmp_path / "f.json").T_world_cam, rig.T_world_cam) == 0.0


def test_everything_else_is_kept_to_the_character(tmp_path: Path):
    odd = (
        '\t{ "7" :{"extra":[1.50,1e+3, "\\u00e9 \\" }{"],\r\n"FusionConfiguration":{"pose"  :   "' + REAL_POSE + '" ,'
        '"x":{"pose":"not this"}, "override_gravity":false}} ,"8":{"FusionConfiguration":{"pose":"'
        + REAL_POSE
        + '","z":1.0}}}\n\n'
    )
    path = tmp_path / "odd.json"
    path.write_bytes(odd.encode())
    T_disk = "1.0 0.0 0.0 0.0 0.0 1.0 0.0 -1.2 0.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0"
    FORMAT.write(Rig(T_world_cam={"7": level_camera(1.2)}, up="+y"), path, ExportOptions(into=path))
    assert path.read_bytes().decode() == odd.replace(REAL_POSE, T_disk, 1).replace("false", "true")


def test_gravity_is_put_in_where_it_is_missing(tmp_path: Path):
    content = entry()
    del content["19321109"]["FusionConfiguration"]["override_gravity"]
    path = written(tmp_path, content)
    FORMAT.write(
        Rig(T_world_cam={"19321109": level_camera(1.2)}, up="+y"), tmp_path / "f.json", ExportOptions(into=path)
    )
    fusion = json.loads((tmp_path / "f.json").read_text())["19321109"]["FusionConfiguration"]
    assert list(fusion) == ["override_gravity", "pose"]
    assert fusion["override_gravity"] is True


def test_the_old_layout_is_filled_too(tmp_path: Path, warnings_said: list[str]):
    path = written(tmp_path, old_entry([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], gravity="false"))
    rig = random_rig(8, names=("34563472",))
    FORMAT.write(rig, tmp_path / "f.json", ExportOptions(into=path))
    assert "Rodrigues" in warnings_said[0]
    filled = json.loads((tmp_path / "f.json").read_text())["34563472"]
    assert filled["world"]["override_gravity"] == "true"
    assert filled["input"] == json.loads(path.read_text())["34563472"]["input"]
    assert farthest(FORMAT.read(tmp_path / "f.json").T_world_cam, rig.T_world_cam) < SAME


def test_cameras_missing_on_either_side_are_told(tmp_path: Path, warnings_said: list[str]):
    path = written(tmp_path, entry(serial="1") | entry(serial="2"))
    FORMAT.write(random_rig(3, names=("2", "3")), tmp_path / "f.json", ExportOptions(into=path))
    filled = json.loads((tmp_path / "f.json").read_text())
    assert list(filled) == ["1", "2"]
    assert filled["1"]["FusionConfiguration"]["pose"] == REAL_POSE
    assert filled["2"]["FusionConfiguration"]["pose"] != REAL_POSE
    assert len(warnings_said) == 2
    assert "lacks camera 3" in warnings_said[0]
    assert "camera 1 is not in the calibration" in warnings_said[1]


def test_a_configuration_of_other_cameras_is_refused_and_nothing_written(tmp_path: Path):
    path = written(tmp_path, entry(serial="1"))
    with pytest.raises(InputError, match=r"none of the calibration's cameras \(it has 1; the calibration has 2\)"):
        FORMAT.write(random_rig(3, names=("2",)), tmp_path / "f.json", ExportOptions(into=path))
    assert not (tmp_path / "f.json").exists()


def test_an_entry_without_a_pose_cannot_be_filled(tmp_path: Path):
    path = written(tmp_path, {"1": {"FusionConfiguration": {}}})
    with pytest.raises(InputError, match="lacks pose"):
        FORMAT.write(random_rig(3, names=("1",)), tmp_path / "f.json", ExportOptions(into=path))


KEYS = st.text(max_size=5).filter(lambda key: not key.startswith("new "))
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=100, deadline=None)
@given(st.dictionaries(KEYS, VALUES, max_size=4), st.sampled_from([None, 2, "\t"]), st.booleans())
def test_members_of_any_object_are_found_and_exchanged(content: Any, indent: Any, is_ascii: bool):
    text = json.dumps(content, indent=indent, ensure_ascii=is_ascii)
    found = json_edit.members(text)
    assert {key: json.loads(text[span.start : span.end]) for key, span in found} == content
    edits = [json_edit.Edit(start=span.start, end=span.end, words="0") for _, span in found]
    edits += [json_edit.before(text, span, f'"new {nth}": 1') for nth, (_, span) in enumerate(found)]
    now = json.loads(json_edit.edited(text, edits))
    assert dict.fromkeys(content, 0).items() <= now.items()
    assert len(now) == 2 * len(content)


# --- what cannot be used


@pytest.mark.parametrize("name", ["left", "cam0", "SN123", "007", "-5", "1.0", "4294967296", "٣٤", "12 "])
def test_names_that_are_no_serial_numbers_are_refused(tmp_path: Path, name: str):
    with pytest.raises(InputError, match="not named by a serial number"):
        FORMAT.write(Rig(T_world_cam={name: np.eye(4)}, up="+y"), tmp_path / "f.json", ExportOptions())
    assert not list(tmp_path.iterdir())


def test_a_world_that_may_lie_on_its_side_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"zed-fusion .*--auto-align"):
        FORMAT.write(random_rig(1, up=None), tmp_path / "f.json", ExportOptions())


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path):
    with pytest.raises(OutputError):
        FORMAT.write(random_rig(1), tmp_path / "no" / "f.json", ExportOptions())


TOO_DEEP = '{"1": ' + "[" * 100_000 + "]" * 100_000 + "}"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "not readable as JSON"),
        ("[]", "not readable as JSON"),
        ('{"1": {', "not readable as JSON"),
        (TOO_DEEP, "not readable as JSON"),
        ({}, "holds no camera"),
        ({"version": "5.1"}, "holds no camera"),
        ("{" + " " * 17 * 2**20 + "}", "over 16384 KiB"),
        ('{"1": {"world": {}}, "1": {"world": {}}}', "camera 1 is there twice"),
        ({"left": {"FusionConfiguration": {"pose": REAL_POSE}}}, "'left' is not a camera"),
        ({"../x": {"FusionConfiguration": {"pose": REAL_POSE}}}, "is not a camera"),
        ({"1": {"FusionConfiguration": []}}, "'1' is not a camera"),
        ({"1": 5}, "'1' is not a camera"),
        (entry(5), "no pose of sixteen numbers"),
        (entry("1 2 3"), "no pose of sixteen numbers"),
        (entry(REAL_POSE.replace("0.302219", "nan")), "pose must be an ordinary number"),
        (entry(REAL_POSE.replace("0.302219", "1e999")), "pose must be an ordinary number"),
        (entry(REAL_POSE.replace("0.302219", "zero")), "pose must be an ordinary number"),
        (entry(REAL_POSE.replace("0.302219", "0.9")), "rotation is not a proper rotation"),
        (entry(REAL_POSE.replace("0.302219", "-0.302219")), "rotation is not a proper rotation"),
        (entry(REAL_POSE[:-8] + "7.0"), "not the 4 x 4 matrix"),
        (old_entry([0.0, 0.0], [0.0, 0.0, 0.0]), "world.rotation must be 3 numbers"),
        (old_entry("0 0 0", [0.0, 0.0, 0.0]), "world.rotation must be a list"),
        (old_entry([0.0, 0.0, 0.0], [0.0, None, 0.0]), "world.translation must be an ordinary number"),
        ('{"1": {"world": {"rotation": [NaN, 0, 0], "translation": [0, 0, 0]}}}', "must be an ordinary number"),
    ],
)
def test_files_that_cannot_be_used_say_why(tmp_path: Path, content: Any, message: str):
    path = written(tmp_path, content)
    with pytest.raises(InputError, match=re.escape(str(path))) as caught:
        FORMAT.read(path)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 600


def test_another_serial_number_inside_is_told(tmp_path: Path, warnings_said: list[str]):
    assert list(FORMAT.read(written(tmp_path, entry(serial_number=5))).T_world_cam) == ["19321109"]
    assert "has serial_number 5" in warnings_said[0]


def test_it_is_recognised_by_its_content(tmp_path: Path, real_file: Path):
    assert FORMAT.recognises(real_file, real_file.read_bytes())
    assert FORMAT.recognises(tmp_path, json.dumps(old_entry([0, 0, 0], [0, 0, 0])).encode())
    for head in (b"", b"{", b'{"1": {"pose": "1 0 0"}}', b"<robot>", b'["FusionConfiguration"]', b"\xff\xfe\x00"):
        assert not FORMAT.recognises(tmp_path, head)


def test_many_cameras_are_refused_as_fast_as_they_are_read(tmp_path: Path):
    path = tmp_path / "many.json"
    path.write_text("{" + ",".join(f'"{k}": {{"world": 0}}' for k in range(1, 60_000)) + "}")
    with pytest.raises(InputError, match="is not a camera"):
        FORMAT.read(path)  # counting each name among all others takes half a minute
