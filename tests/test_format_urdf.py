from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from upright_rigs import SAME, SAME_PX, farthest, level_camera, pixels, points_before, random_rig

from aruco.errors import InputError, OutputError
from aruco.model import UpAxis
from aruco.pose_math import make_pose
from rigcal.formats.rig import ExportOptions, Rig
from rigcal.formats.urdf import FORMAT

DEFAULT = ExportOptions()
ROS_OF_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def joints(path: Path):
    """Child link -> (parent link, rotation, translation), as URDF defines them: rpy about the fixed axes x, y, z."""
    robot = ElementTree.parse(path).getroot()
    assert robot.tag == "robot"
    assert robot.get("name")
    links = {link.get("name") for link in robot.iter("link")}
    found = {}
    for joint in robot.iter("joint"):
        assert joint.get("type") == "fixed"
        parent, child, origin = (joint.find(tag) for tag in ("parent", "child", "origin"))
        assert parent is not None
        assert child is not None
        assert origin is not None
        assert {parent.get("link"), child.get("link")} <= links
        rpy, xyz = ([float(word) for word in origin.attrib[key].split()] for key in ("rpy", "xyz"))
        found[child.get("link")] = parent.get("link"), Rotation.from_euler("xyz", rpy).as_matrix(), np.array(xyz)
    assert len(links) == len(found) + 1  # a tree with one root
    return found


def urdf_of(tmp_path: Path, body: str):
    path = tmp_path / "given.urdf"
    path.write_text(f'<robot name="r">{body}</robot>')
    return path


def joint_of(parent: str, child: str, *, xyz: str = "0 0 0", rpy: str = "0 0 0", kind: str = "fixed"):
    return (
        f'<joint name="{child}_j" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/></joint>'
    )


# --- what the numbers mean


def test_a_level_camera_above_the_floor_has_a_positive_z(tmp_path: Path):
    FORMAT.write(Rig(T_world_cam={"1": level_camera(1.2)}, up="+y"), tmp_path / "r.urdf", DEFAULT)
    parent, R, t = joints(tmp_path / "r.urdf")["1_left_camera_optical_frame"]
    assert parent == "world"
    assert t.tolist() == [0.0, 0.0, 1.2]
    assert np.abs(R - np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])).max() < 1e-15


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("up", ["+y", "-y"])
def test_points_land_on_the_same_pixels(tmp_path: Path, seed: int, up: UpAxis):
    rig = random_rig(seed, up=up)
    FORMAT.write(rig, tmp_path / "r.urdf", DEFAULT)
    found = joints(tmp_path / "r.urdf")
    for camera, T in rig.T_world_cam.items():
        points = points_before(T)
        truth = pixels(points, T[:3, :3], T[:3, 3])
        _, R, t = found[f"{camera}_left_camera_optical_frame"]
        y_up = points if up == "+y" else points * [1.0, -1.0, -1.0]
        points_ros = y_up @ ROS_OF_Y_UP.T
        assert np.abs(pixels(points_ros, R, t) - truth).max() < SAME_PX
        # The same tolerance catches the inverse, a transposed rotation, rpy about moving axes, a world not turned.
        rpy = Rotation.from_matrix(R).as_euler("xyz")
        for R_wrong, t_wrong in ((R.T, -R.T @ t), (R.T, t), (Rotation.from_euler("XYZ", rpy).as_matrix(), t)):
            assert np.abs(pixels(points_ros, R_wrong, t_wrong) - truth).max() > 1.0
        assert np.abs(pixels(points, R, t) - truth).max() > 1.0


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2])
@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-10, 1e-8])
def test_a_camera_in_gimbal_lock_keeps_its_pixels(tmp_path: Path, pitch: float, off: float):
    for nth in range(20):
        roll, yaw = np.random.default_rng(nth).uniform(-np.pi, np.pi, size=2)
        R_ros = Rotation.from_euler("xyz", [roll, pitch - off, yaw]).as_matrix()
        T = make_pose(ROS_OF_Y_UP.T @ R_ros, np.array([1.0, 2.0, 3.0]))
        FORMAT.write(Rig(T_world_cam={"1": T}, up="+y"), tmp_path / "r.urdf", DEFAULT)
        _, R, t = joints(tmp_path / "r.urdf")["1_left_camera_optical_frame"]
        points = points_before(T)
        seen = pixels(points @ ROS_OF_Y_UP.T, R, t)
        assert np.abs(seen - pixels(points, T[:3, :3], T[:3, 3])).max() < SAME_PX


# --- round trips


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("pattern", [DEFAULT.frame_name, "{camera}", "rig/{camera}/cam_{camera}"])
def test_written_and_read_it_is_the_same_rig(tmp_path: Path, seed: int, pattern: str, said: list[str]):
    rig = random_rig(seed, names=("34563472", "front_left", "cam-1 <é>&", "a_x2d_", "x"))
    options = ExportOptions(frame_name=pattern, parent_frame="map")
    FORMAT.write(rig, tmp_path / "a.urdf", options)
    once = FORMAT.read(tmp_path / "a.urdf")
    assert once.up == "+y"
    assert farthest(once.T_world_cam, rig.T_world_cam) < SAME
    FORMAT.write(once, tmp_path / "b.urdf", options)
    assert farthest(FORMAT.read(tmp_path / "b.urdf").T_world_cam, rig.T_world_cam) < SAME
    assert not said


# --- files of others


def test_fixed_joints_that_hang_on_each_other_are_joined(tmp_path: Path, said: list[str]):
    body = (
        '<link name="base"/><joint name="bare" type="fixed"><parent link="base"/><child link="plate"/></joint>'
        + joint_of("plate", "mast", xyz="5 0 0", rpy="0 0 0.5")
        + joint_of("mast", "a_optical_frame", xyz="0 0 1.2", rpy="-1.5707963267948966 0 0")
        + joint_of("mast", "arm", kind="revolute")
        + joint_of("arm", "tool")
    )
    rig = FORMAT.read(urdf_of(tmp_path, body))
    assert list(rig.T_world_cam) == ["a"]
    T = rig.T_world_cam["a"]
    assert np.abs(T[:3, 3] - [5.0, 1.2, 0.0]).max() < SAME
    turn = Rotation.from_euler("y", 0.5).as_matrix()
    assert np.abs(T[:3, :3] - turn @ level_camera(1.2)[:3, :3]).max() < SAME
    assert not said


def test_links_without_an_optical_name_are_read_with_a_warning(tmp_path: Path, said: list[str]):
    rig = FORMAT.read(urdf_of(tmp_path, joint_of("world", "base") + joint_of("base", "tip")))
    assert list(rig.T_world_cam) == ["tip"]
    assert "tip" in said[0]


def test_a_tree_that_hangs_from_a_camera_keeps_both_cameras_and_knows_no_up(tmp_path: Path, said: list[str]):
    # Points of the right camera's frame are moved into the left one's, as tf2 does; whichever way the left one looks.
    rpy = [0.1, -0.2, 0.3]
    body = joint_of("left_optical_frame", "right_optical_frame", xyz="0.5 0.2 0.1", rpy=" ".join(map(str, rpy)))
    rig = FORMAT.read(urdf_of(tmp_path, body))
    assert list(rig.T_world_cam) == ["left", "right"]
    assert rig.up is None
    assert "left_optical_frame" in said[0]
    points_right = np.random.default_rng(3).uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 5.0], size=(20, 3))
    points_left = Rotation.from_euler("xyz", rpy).apply(points_right) + np.array([0.5, 0.2, 0.1])
    truth = pixels(points_right, np.eye(3), np.zeros(3))
    right = rig.T_world_cam["right"]
    assert np.abs(pixels(points_left, right[:3, :3], right[:3, 3]) - truth).max() < SAME_PX
    left = rig.T_world_cam["left"]
    assert np.abs(left - np.eye(4)).max() == 0.0
    # The inverse, and a world turned as one with z up is, are somewhere else.
    turn = np.eye(4)
    turn[:3, :3] = ROS_OF_Y_UP.T
    for wrong in (np.linalg.inv(right), turn @ right):
        assert np.abs(pixels(points_left, wrong[:3, :3], wrong[:3, 3]) - truth).max() > 1.0
    with pytest.raises(InputError, match="does not say which way is up; convert rigcal's own"):
        FORMAT.write(rig, tmp_path / "r.urdf", DEFAULT)


@pytest.mark.parametrize(
    "root", ["camera_link", "zed_camera_center", "cam0", "left_camera_frame", "rig/cam_1/base", "camera_rig"]
)
def test_the_body_of_a_camera_is_no_upright_world(tmp_path: Path, root: str, said: list[str]):
    rig = FORMAT.read(urdf_of(tmp_path, joint_of(root, "a_optical_frame", xyz="1 2 3")))
    assert rig.up is None
    assert rig.T_world_cam["a"][:3, 3].tolist() == [1.0, 2.0, 3.0]
    assert root in said[0]
    assert "if its z points up, rename it" in said[0]


@pytest.mark.parametrize(
    ("tree", "cameras"),
    [
        ({"cam1": "cam0", "cam2": "cam0"}, {"cam0": 0, "cam1": 1, "cam2": 1}),
        ({"cam1": "cam0", "cam2": "cam1"}, {"cam0": 0, "cam1": 1, "cam2": 2}),
        ({"cam1": "cam0_optical_frame", "cam2": "cam0_optical_frame"}, {"cam0": 0, "cam1": 1, "cam2": 1}),
        ({"cam0": "cam0_optical_frame"}, {"cam0_optical_frame": 0, "cam0": 1}),
        ({"rig/cam1": "rig/cam0"}, {"rig/cam0": 0, "rig/cam1": 1}),
        # The body of a camera is none, nor is a link of an arm.
        ({"cam0_lens": "cam0"}, {"cam0_lens": 1}),
        ({"link1": "link0", "link2": "link1"}, {"link2": 2}),
    ],
)
def test_a_camera_that_others_hang_from_is_a_camera_too(
    tmp_path: Path, tree: dict[str, str], cameras: dict[str, int], said: list[str]
):
    body = "".join(joint_of(parent, child, xyz="0 0 1") for child, parent in tree.items())
    rig = FORMAT.read(urdf_of(tmp_path, body))
    # How far along z: the world is the root's frame, or y up of it.
    assert {name: np.abs(T[:3, 3]).max() for name, T in rig.T_world_cam.items()} == cameras
    told = " ".join(said)
    assert all(frame in told for frame in (*tree, *tree.values()) if frame.startswith(("cam", "rig")))


def test_ends_that_move_are_left_out_beside_those_that_do_not(tmp_path: Path, said: list[str]):
    body = joint_of("world", "a_link") + joint_of("world", "arm", kind="revolute") + joint_of("arm", "tool")
    assert list(FORMAT.read(urdf_of(tmp_path, body)).T_world_cam) == ["a_link"]
    assert "tool have no place that is known and fixed, and are left out" in said[0]
    body = joint_of("world", "cam0") + joint_of("world", "cam1", kind="revolute") + joint_of("cam1", "cam1_lens")
    assert list(FORMAT.read(urdf_of(tmp_path, body)).T_world_cam) == ["cam0"]
    assert "cam1 are left out" in said[-1]
    with pytest.raises(InputError, match="tool hangs on arm, which moves"):
        FORMAT.read(urdf_of(tmp_path, joint_of("world", "arm", kind="revolute") + joint_of("arm", "tool")))


@pytest.mark.parametrize(
    "root", ["world", "map", "base_link", "campus", "optical_table", "cam_world", "camera_map", "mocapcam"]
)
def test_another_root_is_believed_to_have_z_up(tmp_path: Path, root: str, said: list[str]):
    rig = FORMAT.read(urdf_of(tmp_path, joint_of(root, "a_optical_frame", xyz="1 2 3")))
    assert rig.up == "+y"
    assert rig.T_world_cam["a"][:3, 3].tolist() == [1.0, 3.0, -2.0]
    assert not said


@pytest.mark.parametrize("parent", ["cam0", "left_optical_frame", "x_left_camera_optical_frame"])
def test_our_own_files_are_upright_whatever_the_parent_frame_is_called(tmp_path: Path, parent: str, said: list[str]):
    rig = random_rig(3)
    FORMAT.write(rig, tmp_path / "r.urdf", ExportOptions(parent_frame=parent))
    again = FORMAT.read(tmp_path / "r.urdf")
    assert again.up == "+y"
    assert farthest(again.T_world_cam, rig.T_world_cam) < SAME
    assert not said


def test_the_new_names_of_zeds_wrapper_are_known_and_right_eyes_told(tmp_path: Path, said: list[str]):
    body = "".join(
        joint_of("map", f"{n}_camera_link")
        + joint_of(f"{n}_camera_link", f"{n}_left_camera_frame_optical", xyz="0 0.06 1", rpy="-1.57 0 -1.57")
        + joint_of(f"{n}_camera_link", f"{n}_right_camera_frame_optical", xyz="0 -0.06 1", rpy="-1.57 0 -1.57")
        + joint_of(f"{n}_camera_link", f"{n}_imu_link")
        for n in ("front", "rear")
    )
    rig = FORMAT.read(urdf_of(tmp_path, body))
    assert list(rig.T_world_cam) == ["front", "rear"]
    assert len(said) == 1
    assert "front_right_camera_frame_optical, rear_right_camera_frame_optical are left out" in said[0]
    one = urdf_of(tmp_path, joint_of("map", "side_frame_optical"))
    assert list(FORMAT.read(one).T_world_cam) == ["side"]


def test_what_xacro_has_expanded_is_read_though_it_names_xacro(tmp_path: Path):
    path = tmp_path / "expanded.urdf"
    path.write_text(
        '<?xml version="1.0" ?><!-- This document was autogenerated by xacro from rig.urdf.xacro -->'
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">' + joint_of("world", OPTICAL) + "</robot>"
    )
    assert list(FORMAT.read(path).T_world_cam) == ["a"]


# --- what cannot be used


def test_what_cannot_be_written_is_refused_and_nothing_left(tmp_path: Path):
    with pytest.raises(InputError, match=r"urdf .*--auto-align"):
        FORMAT.write(random_rig(1, up=None), tmp_path / "r.urdf", DEFAULT)
    with pytest.raises(InputError, match="--parent-frame"):
        FORMAT.write(random_rig(1), tmp_path / "r.urdf", ExportOptions(parent_frame="a b"))
    with pytest.raises(InputError, match="--frame-name"):
        FORMAT.write(random_rig(1), tmp_path / "r.urdf", ExportOptions(frame_name="{camera}--"))
    with pytest.raises(OutputError):
        FORMAT.write(random_rig(1), tmp_path / "no" / "r.urdf", DEFAULT)
    assert not list(tmp_path.iterdir())


OPTICAL = "a_optical_frame"


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("", "holds no frame of a camera"),
        ('<link name="world"/>', "holds no frame of a camera"),
        (joint_of("world", OPTICAL, xyz="0 0"), "xyz must be 3 numbers, got 2"),
        (joint_of("world", OPTICAL, rpy="0 0 nan"), "rpy must be an ordinary number"),
        (joint_of("world", OPTICAL, xyz="one 0 0"), "xyz must be an ordinary number"),
        (joint_of("world", OPTICAL, xyz="${x} 0 0"), "is a xacro file"),
        (joint_of("world", OPTICAL, kind="continuous"), f"frame {OPTICAL} moves; give"),
        (joint_of("world", "arm", kind="revolute") + joint_of("arm", OPTICAL), "hangs on arm, which moves; give"),
        (joint_of("world", OPTICAL) * 2, "on another joint already"),
        (joint_of("world", OPTICAL) + joint_of("other", "b_optical_frame"), "several roots (other, world)"),
        (joint_of("x", OPTICAL) + joint_of(OPTICAL, "x"), "circle"),
        (f'<joint name="j" type="fixed"><child link="{OPTICAL}"/></joint>', "names no parent"),
        ('<joint name="j" type="fixed"><parent link="world"/><child/></joint>', "names no child"),
        ('<x:include xmlns:x="http://www.ros.org/wiki/xacro" filename="a"/>', "is a xacro file"),
        ('<x:property xmlns:x="http://ros.org/wiki/xacro" name="a" value="1"/>', "is a xacro file"),
    ],
)
def test_joints_that_cannot_be_used_say_why(tmp_path: Path, body: str, message: str):
    path = urdf_of(tmp_path, body)
    with pytest.raises(InputError, match=re.escape(str(path))) as caught:
        FORMAT.read(path)
    assert message in str(caught.value)


LAUGHS = '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;">]><robot name="&b;"/>'


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (b"", "not readable as XML"),
        (b"<robot>", "not readable as XML"),
        (b"<sdf/>", "its root is <sdf>"),
        (LAUGHS.encode(), "DOCTYPE"),
        (LAUGHS.encode("utf-16"), "not UTF-8"),
        (b'<?xml version="1.0" encoding="utf-7"?><robot>+ADwAIQ-DOCTYPE</robot>', "holds no frame"),
        (b'<!DOCTYPE r SYSTEM "file:///etc/passwd"><robot/>', "DOCTYPE"),
        (b"<robot>" + b"<a>" * 100_000, "not readable as XML"),
        (b"<robot>" + b" " * 5 * 2**20 + b"</robot>", "over 1024 KiB"),
    ],
)
def test_files_that_cannot_be_used_say_why(tmp_path: Path, raw: bytes, message: str):
    path = tmp_path / "given.urdf"
    path.write_bytes(raw)
    with pytest.raises(InputError, match=re.escape(str(path))) as caught:
        FORMAT.read(path)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 500


def test_it_is_recognised_by_its_content(tmp_path: Path):
    FORMAT.write(random_rig(1), tmp_path / "r.urdf", DEFAULT)
    assert FORMAT.recognises(tmp_path / "r.urdf", (tmp_path / "r.urdf").read_bytes())
    for head in (b"", b"<launch/>", b'{"a": "<robot"}', b"\xff\xfe<\x00r\x00"):
        assert not FORMAT.recognises(tmp_path / "r.urdf", head)


def test_a_long_chain_of_frames_is_refused(tmp_path: Path):
    body = "".join(joint_of(f"l{k}", f"l{k + 1}") for k in range(2000))
    with pytest.raises(InputError, match="hangs below more than 64"):
        FORMAT.read(urdf_of(tmp_path, body))


@pytest.mark.parametrize("name", ["a" * 230, "\u00fc" * 46, "camera"])
def test_names_that_would_not_be_read_are_not_written(tmp_path: Path, name: str):
    out = tmp_path / "r.urdf"
    FORMAT.write(random_rig(1, names=(name[:-1],)), out, DEFAULT)
    assert list(FORMAT.read(out).T_world_cam) == [name[:-1]]
    out.unlink()
    options = ExportOptions(frame_name="x" * 248 + "{camera}") if name == "camera" else DEFAULT
    with pytest.raises(InputError, match=r"255 (signs )?at most"):
        FORMAT.write(random_rig(1, names=(name,)), out, options)
    assert not out.exists()
