from __future__ import annotations

import re
import sys
import types
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from upright_rigs import SAME, SAME_PX, farthest, level_camera, pixels, points_before, random_rig

from aruco.errors import InputError, OutputError
from aruco.model import UpAxis
from rigcal.formats.rig import ExportOptions, Rig
from rigcal.formats.ros2_launch import FORMAT
from rigcal.formats.ros_frames import camera_of, frame_of

DEFAULT = ExportOptions()
BOTH = pytest.mark.parametrize("name", ["rig.launch.py", "rig.launch.xml"])
# Y up to Z up, (x, y, z) -> (x, -z, y), written out once more.
ROS_OF_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def published(path: Path, monkeypatch: pytest.MonkeyPatch):
    """What ROS 2 would run: the arguments of every node of a launch file, by flag, and the rest of each node."""
    if path.suffix == ".xml":
        nodes = [dict(node.attrib) for node in ElementTree.parse(path).getroot()]
        nodes = [n | {"package": n["pkg"], "executable": n["exec"], "arguments": n["args"].split(" ")} for n in nodes]
    else:
        launch, launch_ros, actions = (types.ModuleType(n) for n in ("launch", "launch_ros", "launch_ros.actions"))
        launch.LaunchDescription = list  # pyright: ignore[reportAttributeAccessIssue]
        actions.Node = dict  # pyright: ignore[reportAttributeAccessIssue]
        for module in (launch, launch_ros, actions):
            monkeypatch.setitem(sys.modules, module.__name__, module)
        space: dict[str, Any] = {}
        exec(compile(path.read_text(), path, "exec"), space)
        nodes = space["generate_launch_description"]()
    for node in nodes:
        assert node["package"] == "tf2_ros"
        assert node["executable"] == "static_transform_publisher"
        assert re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", node["name"])  # what ROS takes for a node
        assert all(isinstance(word, str) for word in node["arguments"])
    flags = [dict(zip(node["arguments"][::2], node["arguments"][1::2], strict=True)) for node in nodes]
    return {said["--child-frame-id"]: said for said in flags}


def rotation_and_translation(said: dict[str, str]):
    """As tf2 takes them: the quaternion's real part last."""
    q, t = ([float(said[f"--{key}"]) for key in keys] for keys in (("qx", "qy", "qz", "qw"), "xyz"))
    assert abs(np.linalg.norm(q) - 1.0) < 1e-15
    return Rotation.from_quat(q).as_matrix(), np.array(t)


def launch_of(tmp_path: Path, arguments: Any, more: str = ""):
    text = f"""
from launch import LaunchDescription
from launch_ros.actions import Node
def generate_launch_description():
    return LaunchDescription([
        Node(package="tf2_ros", executable="static_transform_publisher", arguments={arguments}), {more}
    ])
"""
    path = tmp_path / "given.launch.py"
    path.write_text(text)
    return path


# --- what the numbers mean


@BOTH
def test_a_level_camera_above_the_floor_has_a_positive_z(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str):
    FORMAT.write(Rig(T_world_cam={"1": level_camera(1.2)}, up="+y"), tmp_path / name, DEFAULT)
    said = published(tmp_path / name, monkeypatch)["1_left_camera_optical_frame"]
    R, t = rotation_and_translation(said)
    assert said["--frame-id"] == "world"
    assert t.tolist() == [0.0, 0.0, 1.2]
    # Its right is the world's x, its down the world's -z, and it looks along the world's y.
    assert np.abs(R - np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])).max() < 1e-15


@BOTH
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("up", ["+y", "-y"])
def test_points_land_on_the_same_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, seed: int, up: UpAxis
):
    rig = random_rig(seed, up=up)
    FORMAT.write(rig, tmp_path / name, DEFAULT)
    nodes = published(tmp_path / name, monkeypatch)
    for camera, T in rig.T_world_cam.items():
        points = points_before(T)
        truth = pixels(points, T[:3, :3], T[:3, 3])
        R, t = rotation_and_translation(nodes[f"{camera}_left_camera_optical_frame"])
        y_up = points if up == "+y" else points * [1.0, -1.0, -1.0]
        points_ros = y_up @ ROS_OF_Y_UP.T
        assert np.abs(pixels(points_ros, R, t) - truth).max() < SAME_PX
        # The same tolerance catches the inverse, a transposed rotation, a quaternion read scalar first, no turn.
        q = Rotation.from_matrix(R).as_quat()
        for R_wrong, t_wrong in ((R.T, -R.T @ t), (R.T, t), (Rotation.from_quat(q[[3, 0, 1, 2]]).as_matrix(), t)):
            assert np.abs(pixels(points_ros, R_wrong, t_wrong) - truth).max() > 1.0
        assert np.abs(pixels(points, R, t) - truth).max() > 1.0


def test_both_kinds_of_files_say_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rig = random_rig(9)
    for name in ("a.launch.py", "a.launch.xml"):
        FORMAT.write(rig, tmp_path / name, DEFAULT)
    assert published(tmp_path / "a.launch.py", monkeypatch) == published(tmp_path / "a.launch.xml", monkeypatch)


# --- round trips


@BOTH
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("pattern", [DEFAULT.frame_name, "{camera}", "rig/{camera}/cam_{camera}", "zed_{camera}_x2d_"])
def test_written_and_read_it_is_the_same_rig(tmp_path: Path, name: str, seed: int, pattern: str, said: list[str]):
    rig = random_rig(seed, names=("34563472", "front_left", "cam-1 é", "a_x2d_", "x"))
    options = ExportOptions(frame_name=pattern, parent_frame="map/hall")
    FORMAT.write(rig, tmp_path / name, options)
    once = FORMAT.read(tmp_path / name)
    assert once.up == "+y"
    assert farthest(once.T_world_cam, rig.T_world_cam) < SAME
    FORMAT.write(once, tmp_path / f"b{name}", options)
    assert farthest(FORMAT.read(tmp_path / f"b{name}").T_world_cam, rig.T_world_cam) < SAME
    assert not said


@settings(max_examples=300, deadline=None)
@given(
    st.text(alphabet=st.sampled_from("_x25fd-é/") | st.characters(), min_size=1, max_size=8),
    st.sampled_from(["{camera}", "a_{camera}_x2d_", "{camera}_x", "x_{camera}/{camera}_"]),
)
def test_every_name_comes_back_from_its_frame(camera: str, pattern: str):
    frame = frame_of(camera, pattern)
    assert re.fullmatch("[A-Za-z0-9_/]+", frame)
    assert camera_of(frame, pattern) == camera


# --- files of others


@pytest.mark.parametrize(
    "arguments",
    [
        ["--z", "1.2", "--roll", "-1.5707963267948966", "--frame-id", "map", "--child-frame-id", "1_optical_frame"],
        ["0", "0", "1.2", "0", "0", "-1.5707963267948966", "map", "1_optical_frame"],  # x y z yaw pitch roll
        ["0", "0", "1.2", "-0.70711", "0", "0", "0.70711", "/map", "/1_optical_frame"],
    ],
)
def test_all_ways_to_say_a_transform_are_read(tmp_path: Path, arguments: Any):
    rig = FORMAT.read(launch_of(tmp_path, arguments))
    assert np.abs(rig.T_world_cam["1"] - level_camera(1.2)).max() < 1e-5  # five digits of a quaternion
    assert rig.up == "+y"


def test_transforms_that_hang_on_each_other_are_joined(tmp_path: Path, said: list[str]):
    base = ["--x", "5", "--yaw", "0.5", "--frame-id", "world", "--child-frame-id", "base"]
    arm = ["--z", "1.2", "--roll", "-1.5707963267948966", "--frame-id", "base", "--child-frame-id", "a_optical_frame"]
    node = f'Node(package="tf2_ros", executable="static_transform_publisher", arguments={base})'
    rig = FORMAT.read(launch_of(tmp_path, arm, node))
    assert list(rig.T_world_cam) == ["a"]
    T = rig.T_world_cam["a"]
    assert np.abs(T[:3, 3] - [5.0, 1.2, 0.0]).max() < SAME
    turn = Rotation.from_euler("y", 0.5).as_matrix()  # about the vertical, which is y here
    assert np.abs(T[:3, :3] - turn @ level_camera(1.2)[:3, :3]).max() < SAME
    assert not said


def test_frames_without_an_optical_name_are_read_with_a_warning(tmp_path: Path, said: list[str]):
    assert list(FORMAT.read(launch_of(tmp_path, ["--frame-id", "world", "--child-frame-id", "tip"])).T_world_cam) == [
        "tip"
    ]
    assert "tip" in said[0]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        # Of two quaternions and of Euler angles, ROS 1's tf with its period, its tf2_ros without.
        (("tf", "0 0 1.2 0 0 -1.5707963267948966 world a_optical_frame 100"), level_camera(1.2)),
        (("tf", "0 0 1.2 -0.70710678118 0 0 0.70710678118 /world /a_optical_frame 100"), level_camera(1.2)),
        (("tf2_ros", "0 0 1.2 0 0 -1.5707963267948966 world a_optical_frame"), level_camera(1.2)),
        (("tf2_ros", "0 0 1.2 -0.70710678118 0 0 0.70710678118 world a_optical_frame"), level_camera(1.2)),
    ],
)
def test_launch_files_of_ros_1_are_read(tmp_path: Path, arguments: tuple[str, str], expected: Any):
    package, words = arguments
    path = tmp_path / "given.launch"
    path.write_text(f'<launch><node pkg="{package}" type="static_transform_publisher" args="{words}"/></launch>')
    rig = FORMAT.read(path)
    assert np.abs(rig.T_world_cam["a"] - expected).max() < 1e-10  # eleven digits of a quaternion


@pytest.mark.parametrize("more", [["--ros-args", "--log-level", "warn"], ["--ros-args", "-p", "a:=1", "--"]])
def test_what_is_meant_for_ros_itself_is_left_to_it(tmp_path: Path, more: list[str]):
    ends = ["--frame-id", "world", "--child-frame-id", "a_optical_frame"]
    for arguments in ([*ends, *more], [*more, *ends] if more[-1] == "--" else [*ends, *more]):
        assert list(FORMAT.read(launch_of(tmp_path, arguments)).T_world_cam) == ["a"]


@pytest.mark.parametrize(
    "other",
    [
        "['--x', LaunchConfiguration('x'), '--frame-id', 'world', '--child-frame-id', 'robot']",
        "[x, y, z, '0', '0', '0', 'world', 'robot']",
        "['--frame-id', 'world', '--child-frame-id', name]",
        "compute()",
        "['0', '0', *rest, 'world', 'robot']",
    ],
)
def test_a_computed_publisher_of_something_else_does_not_matter(tmp_path: Path, other: str, said: list[str]):
    node = f'Node(package="tf2_ros", executable="static_transform_publisher", arguments={other}), '
    path = launch_of(tmp_path, ["--frame-id", "world", "--child-frame-id", "a_optical_frame"], node)
    assert list(FORMAT.read(path).T_world_cam) == ["a"]
    assert all("computed" in line and "line 6" in line for line in said)
    assert bool(said) == ("robot" not in other or "*" in other)  # told where nobody knows whose it is


def test_a_camera_on_a_computed_frame_is_refused(tmp_path: Path):
    path = tmp_path / "rig.launch.xml"
    node = '<node pkg="tf2_ros" exec="static_transform_publisher" args="--x {} --frame-id {} --child-frame-id {}"/>'
    nodes = node.format("$(var x 5)", "world", "mast") + node.format("1", "mast", "a_optical_frame")
    path.write_text(f"<launch>{nodes}</launch>")
    with pytest.raises(
        InputError, match="frame a_optical_frame hangs on mast, which is placed by numbers that are comp"
    ):
        FORMAT.read(path)


@pytest.mark.parametrize("x", ["$(eval '(1+2)/1000')", "$(eval '((1)+(2))' $(var (y)))", "$(var x)$(var y)"])
@pytest.mark.parametrize("camera", ["a_optical_frame", "a_link"])
def test_a_computed_publisher_of_something_else_does_not_matter_in_xml(
    tmp_path: Path, x: str, camera: str, said: list[str]
):
    path = tmp_path / "rig.launch.xml"
    node = '<node pkg="tf2_ros" exec="static_transform_publisher" args="--x {} --frame-id {} --child-frame-id {}"/>'
    nodes = node.format("1", "world", camera) + node.format(x, "base", "imu")
    path.write_text(f"<launch>{nodes}</launch>")
    assert list(FORMAT.read(path).T_world_cam) == [camera.removesuffix("_optical_frame")]
    assert any("imu have no place that is known" in line for line in said) == (camera == "a_link")


def test_cameras_that_hang_from_another_one_know_no_up(tmp_path: Path, said: list[str]):
    between = ["--x", "0.5", "--frame-id", "left_optical_frame", "--child-frame-id", "right_optical_frame"]
    rig = FORMAT.read(launch_of(tmp_path, between))
    assert rig.up is None
    assert rig.T_world_cam["left"].tolist() == np.eye(4).tolist()
    assert rig.T_world_cam["right"][:3, 3].tolist() == [0.5, 0.0, 0.0]  # the child's place in its parent
    assert "up stays unknown" in said[0]


@pytest.mark.parametrize("name", ["zed_x", "zed_x_mini", "a_x", "_", "x_1", "cam_xg_"])
def test_ordinary_names_stay_as_they_are(name: str):
    assert frame_of(name, DEFAULT.frame_name) == f"{name}_left_camera_optical_frame"
    assert frame_of("zed_x2d_", "{camera}") == "zed_x5f_x2d_"  # not zed-


def test_other_nodes_and_the_style_of_the_file_do_not_matter(tmp_path: Path):
    path = launch_of(tmp_path, ["--frame-id", "world", "--child-frame-id", "a_optical_frame"], r"Node(x='\d'), f(), ")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(FORMAT.read(path).T_world_cam) == ["a"]


def test_a_launch_file_is_never_run(tmp_path: Path):
    path = launch_of(tmp_path, ["--frame-id", "world", "--child-frame-id", "a_optical_frame"])
    path.write_text(f"open({str(tmp_path / 'trap')!r}, 'w')\n" + path.read_text())
    FORMAT.read(path)
    assert not (tmp_path / "trap").exists()


# --- what cannot be used


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parent_frame": "my world"}, "--parent-frame"),
        ({"parent_frame": "/world"}, "--parent-frame"),
        ({"parent_frame": ""}, "--parent-frame"),
        ({"parent_frame": '", evil(), "'}, "--parent-frame"),
        ({"frame_name": "{camera}-->"}, "--frame-name"),
        ({"frame_name": "{camera}\n"}, "--frame-name"),
        ({"frame_name": "/{camera}"}, "--frame-name"),
        ({"frame_name": "{camera}", "parent_frame": "13870389"}, "is the frame of a camera as well"),
    ],
)
@BOTH
def test_names_that_ros_does_not_take_are_refused(tmp_path: Path, name: str, options: Any, message: str):
    with pytest.raises(InputError, match=message):
        FORMAT.write(random_rig(1), tmp_path / name, ExportOptions(**options))
    assert not list(tmp_path.iterdir())


def test_a_name_that_ros2_launch_does_not_run_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"\.launch\.py or \.launch\.xml"):
        FORMAT.write(random_rig(1), tmp_path / "rig.json", DEFAULT)


@BOTH
def test_a_world_that_may_lie_on_its_side_is_refused(tmp_path: Path, name: str):
    with pytest.raises(InputError, match=r"ros2-launch .*--auto-align"):
        FORMAT.write(random_rig(1, up=None), tmp_path / name, DEFAULT)
    with pytest.raises(OutputError):
        FORMAT.write(random_rig(1), tmp_path / "no" / name, DEFAULT)


ENDS = ["--frame-id", "world", "--child-frame-id", "a_optical_frame"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("[str(x)]", "computed"),
        ("compute()", "computed"),
        ("['--x', '1', *FRAMES]", "computed"),
        (
            "['--x', str(1.0), '--frame-id', 'world', '--child-frame-id', 'a_optical_frame']",
            "frame a_optical_frame is p",
        ),
        ([], "lacks --frame-id"),
        (ENDS[:2], "lacks --frame-id or --child-frame-id"),
        ([*ENDS, "--x"], "'--x' is not understood"),
        ([*ENDS, "--w", "1"], "'--w' is not understood"),
        ([*ENDS, "--x", "one"], "--x must be an ordinary number"),
        ([*ENDS, "--x", "inf"], "--x must be an ordinary number"),
        ([*ENDS, "--qx", "1", "--yaw", "1"], "both a quaternion and roll"),
        ([*ENDS, "--qx", "1", "--qw", "1"], "length is 1.414, not 1"),
        (["--frame-id", "a_optical_frame", "--child-frame-id", "a_optical_frame"], "circle"),
    ],
)
def test_transforms_that_cannot_be_used_say_why(tmp_path: Path, arguments: Any, message: str):
    path = launch_of(tmp_path, arguments)
    with pytest.raises(InputError, match=re.escape(str(path))) as caught:
        FORMAT.read(path)
    assert message in str(caught.value)


def test_frames_in_two_worlds_or_twice_are_refused(tmp_path: Path):
    node = 'Node(executable="static_transform_publisher", arguments=["--frame-id", "%s", "--child-frame-id", "%s"])'
    with pytest.raises(InputError, match="several roots"):
        FORMAT.read(launch_of(tmp_path, ENDS, node % ("elsewhere", "b_optical_frame")))
    with pytest.raises(InputError, match="'a_optical_frame' is published twice"):
        FORMAT.read(launch_of(tmp_path, ENDS, node % ("world", "a_optical_frame")))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no frame of a camera"),
        ("def (", "not readable as Python"),
        ("x = " + "(" * 10_000, "not readable as Python"),
        ("x = 1" + "+1" * 400_000, ""),  # whether it is too deep or has no camera
        ("\0", "not readable as Python"),
        ("<launch>", "not readable as XML"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><launch/>', "DOCTYPE"),
        ("<launch/>", "holds no frame of a camera"),
        ('<launch><node exec="static_transform_publisher" args="&quot;"/></launch>', "cannot be parted"),
        ('<launch><node exec="static_transform_publisher" args="--x $(var x)"/></launch>', "lacks --frame-id"),
        ('<launch><node exec="static_transform_publisher" args="--x $(x $(y z)) $(a"/></launch>', "are computed"),
        ('<launch><node exec="static_transform_publisher" args="--x $(a"/></launch>', "lacks --frame-id"),
        ('<launch><node exec="static_transform_publisher" args="$(var all of it)"/></launch>', "computed"),
        ("#" * (5 * 2**20), "over 1024 KiB"),
    ],
)
def test_files_that_cannot_be_used_say_why(tmp_path: Path, text: str, message: str):
    path = tmp_path / "given.launch"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(str(path))) as caught:
        FORMAT.read(path)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 500


@BOTH
def test_it_is_recognised_by_its_content(tmp_path: Path, name: str):
    FORMAT.write(random_rig(1), tmp_path / name, DEFAULT)
    assert FORMAT.recognises(tmp_path / name, (tmp_path / name).read_bytes()[: 2**16])
    for head in (b"", b"<launch></launch>", b"static_transform_publisher", b"<robot/>", b"\xff\xfe\x00"):
        assert not FORMAT.recognises(tmp_path / name, head)


@pytest.mark.parametrize("name", ["a" * 230, "\u00fc" * 46, "camera"])
def test_names_that_would_not_be_read_are_not_written(tmp_path: Path, name: str):
    out = tmp_path / "r.launch.py"
    FORMAT.write(random_rig(1, names=(name[:-1],)), out, DEFAULT)
    assert list(FORMAT.read(out).T_world_cam) == [name[:-1]]
    out.unlink()
    options = ExportOptions(frame_name="x" * 248 + "{camera}") if name == "camera" else DEFAULT
    with pytest.raises(InputError, match=r"255 (signs )?at most"):
        FORMAT.write(random_rig(1, names=(name,)), out, options)
    assert not out.exists()
