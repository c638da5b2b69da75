"""URDF: the robot description of ROS, with the cameras as links on fixed joints.

Owns      writing links and fixed joints, reading them back wherever in a tree of fixed joints they hang.
Leaves    names of frames and walking the tree to ros_frames, roll, pitch and yaw to rotations.

A joint's origin is the pose of the child link in the parent link; ``rpy`` turns about the parent's fixed axes, first
x (roll), then y (pitch), then z (yaw).
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.pose_math import Pose, make_pose
from rigcal.formats.reading import numbers, parsed_xml, read_text
from rigcal.formats.rig import ExportOptions, Format, Rig
from rigcal.formats.ros_frames import MAX_FILE_BYTES, Link, frames_of, note, rig_of, upright
from rigcal.formats.rotations import nearest_rotation, rotation_of_rpy, rpy_of_rotation, words

NAME = "urdf"
_WHAT = "a URDF"
# Its namespace had several addresses. Expanded files keep the declaration, which says nothing.
_XACRO = re.compile(r"\{https?://[^}]*xacro[^}]*\}")


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write one link and one fixed joint a camera; whole or not at all.

    Raises:
        InputError: ROS does not take a name, or nobody knows what is up.
        OutputError: The file cannot be written.
    """
    poses, frames = upright(rig, NAME), frames_of(rig, options, NAME)
    robot = ElementTree.Element("robot", name="rig")
    about = f" {note(options)}; they are optical (x right, y down, z forward). {options.parent_frame} has z up. "
    robot.append(ElementTree.Comment(about))
    ElementTree.SubElement(robot, "link", name=options.parent_frame)
    for camera, frame in frames.items():
        ElementTree.SubElement(robot, "link", name=frame)
        robot.append(_joint(options.parent_frame, frame, poses[camera]))
    ElementTree.indent(robot)
    write_whole(out, ElementTree.tostring(robot, encoding="utf-8", xml_declaration=True) + b"\n")


def read(path: Path) -> Rig:
    """The cameras of a URDF, in a world with Y up.

    Raises:
        InputError: It cannot be read, or holds no cameras on fixed joints; the message names the file.
    """
    text = read_text(path, _WHAT, MAX_FILE_BYTES)
    robot = parsed_xml(text, path, _WHAT)
    if robot.tag != "robot":
        raise InputError(f"{path}: its root is <{robot.tag[:40]}>, not <robot>; give {_WHAT}.")
    if _wants_xacro(robot):
        raise InputError(f"{path}: is a xacro file; expand it first: xacro {path.name} > rig.urdf.")
    links: dict[str, Link] = {}
    for joint in robot.findall("joint"):
        where = f"{path}: joint {joint.get('name', '')[:80]!r}"
        child = _linked(joint, "child", where)
        if child in links:
            raise InputError(f"{where}: its child {child!r} is on another joint already; remove one of the joints.")
        T_parent_child = _origin(joint, where) if joint.get("type") == "fixed" else None
        links[child] = Link(parent=_linked(joint, "parent", where), T_parent_child=T_parent_child)
    return rig_of(links, text, path)


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file begins as a URDF does."""
    return b"<robot" in head and head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")


def _wants_xacro(robot: ElementTree.Element) -> bool:
    """Whether macros stand in for joints or their numbers."""
    joints = (element for joint in robot.findall("joint") for element in joint.iter())
    computed = any("${" in value for element in joints for value in element.attrib.values())
    return computed or any(_XACRO.match(element.tag) for element in robot.iter() if isinstance(element.tag, str))


def _joint(parent: str, frame: str, T_parent_frame: Pose) -> ElementTree.Element:
    joint = ElementTree.Element("joint", name=f"{frame}_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=frame)
    R = nearest_rotation(T_parent_frame[:3, :3], frame)
    xyz, rpy = " ".join(words(T_parent_frame[:3, 3])), " ".join(words(rpy_of_rotation(R)))
    ElementTree.SubElement(joint, "origin", xyz=xyz, rpy=rpy)
    return joint


def _linked(joint: ElementTree.Element, tag: str, where: str) -> str:
    element = joint.find(tag)
    name = element.get("link") if element is not None else None
    if not name:
        raise InputError(f'{where}: names no {tag}; it wants <{tag} link="...">.')
    return name


def _origin(joint: ElementTree.Element, where: str) -> Pose:
    """The pose of the child in the parent; what is not said is zero."""
    origin = joint.find("origin")
    said = origin.attrib if origin is not None else {}
    xyz = numbers(said.get("xyz", "0 0 0").split(), f"{where}: xyz", 3)
    rpy = numbers(said.get("rpy", "0 0 0").split(), f"{where}: rpy", 3)
    return make_pose(rotation_of_rpy(rpy), xyz)


FORMAT = Format(
    name=NAME,
    suffix=".urdf",
    explain=(
        "URDF: a link for each camera's optical frame (x right, y down, z forward), on a fixed joint whose origin is "
        "the link's pose in the parent frame, metres, rpy about the fixed axes x, y, z [rad], world Z up (REP-103); "
        "poses only."
    ),
    put=write,
    read=read,
    recognises=recognises,
    needs_up=True,
    takes=frozenset({"parent_frame", "frame_name"}),
)
