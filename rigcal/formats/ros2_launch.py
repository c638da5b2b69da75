"""ROS 2 launch files with one static_transform_publisher a camera: Python or XML, as the suffix says.

Owns      writing both, reading both without running them.
Leaves    names of frames and walking the tree to ros_frames.

A transform is the pose of the child frame in the parent frame, the quaternion in the order xyzw.
"""

from __future__ import annotations

import ast
import re
import shlex
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.pose_math import Array, Pose, make_pose
from rigcal.formats.reading import number, parsed_xml, read_text
from rigcal.formats.rig import ExportOptions, Format, Rig
from rigcal.formats.ros_frames import MAX_FILE_BYTES, Link, frames_of, note, rig_of, upright
from rigcal.formats.rotations import nearest_rotation, rotation_of_rpy, rotation_of_xyzw, words, xyzw_of_rotation

NAME = "ros2-launch"
PROGRAM = "static_transform_publisher"
_WHAT = f"a ROS 2 launch file with a {PROGRAM} for each camera"
_XYZ, _XYZW, _RPY = ("--x", "--y", "--z"), ("--qx", "--qy", "--qz", "--qw"), ("--roll", "--pitch", "--yaw")
_FRAMES = ("--frame-id", "--child-frame-id")
# Without flags, as ROS 2 took them before Humble: with Euler angles, with a quaternion.
_UNFLAGGED = {8: (*_XYZ, "--yaw", "--pitch", "--roll", *_FRAMES), 9: (*_XYZ, *_XYZW, *_FRAMES)}


def write(rig: Rig, out: Path, options: ExportOptions) -> None:
    """Write a launch file, in XML if the name ends in .xml, in Python if in .py; whole or not at all.

    Raises:
        InputError: The name has another end, ROS does not take a name, or nobody knows what is up.
        OutputError: The file cannot be written.
    """
    if out.suffix not in (".py", ".xml"):
        raise InputError(f"{out}: ros2 launch takes files that end in .launch.py or .launch.xml; name it like that.")
    poses, frames = upright(rig, NAME), frames_of(rig, options, NAME)
    publishers = {frame: _arguments(options.parent_frame, frame, poses[camera]) for camera, frame in frames.items()}
    about = [
        f"{note(options)}; they are optical (x right, y down, z forward).",
        f"Frame {options.parent_frame} has z up (REP-103); metres, quaternions.",
    ]
    text = _xml(publishers, about) if out.suffix == ".xml" else _python(publishers, about)
    write_whole(out, text.encode())


def read(path: Path) -> Rig:
    """The cameras of a launch file, in a world with Y up. A Python file is not run: its arguments must be literals.

    Raises:
        InputError: It cannot be read, or its transforms are not literal; the message names the file.
    """
    text = read_text(path, _WHAT, MAX_FILE_BYTES)
    publishers = _in_xml(text, path) if text.lstrip().startswith("<") else _in_python(text, path)
    links: dict[str, Link] = {}
    for nth, words_of_one in enumerate(publishers, start=1):
        parent, child, T_parent_child = _transform(words_of_one, f"{path}: {PROGRAM} {nth}")
        if child in links:
            raise InputError(f"{path}: frame {child!r} is published twice; remove one of the transforms.")
        links[child] = Link(parent=parent, T_parent_child=T_parent_child)
    return rig_of(links, text, path)


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file begins as such a launch file does."""
    return PROGRAM.encode() in head and (b"LaunchDescription" in head or b"<launch" in head)


def _arguments(parent: str, frame: str, T_parent_frame: Pose) -> list[str]:
    xyzw = xyzw_of_rotation(nearest_rotation(T_parent_frame[:3, :3], frame))
    values = words([*T_parent_frame[:3, 3], *xyzw])
    flags = zip((*_XYZ, *_XYZW, *_FRAMES), (*values, parent, frame), strict=True)
    return [word for pair in flags for word in pair]


def _node_name(frame: str) -> str:
    return "static_tf_" + frame.replace("/", "_")


def _python(publishers: Mapping[str, Sequence[str]], about: Sequence[str]) -> str:
    lines = [
        '"""Static transforms of a camera rig; run it with ros2 launch.',
        "",
        *about,
        '"""',
        "",
        "from launch import LaunchDescription",
        "from launch_ros.actions import Node",
        "",
        "",
        "def generate_launch_description():",
        "    return LaunchDescription(",
        "        [",
    ]
    for frame, arguments in publishers.items():
        pairs = [f'                    "{a}", "{b}",' for a, b in zip(arguments[::2], arguments[1::2], strict=True)]
        lines += [
            "            Node(",
            '                package="tf2_ros",',
            f'                executable="{PROGRAM}",',
            f'                name="{_node_name(frame)}",',
            "                arguments=[",
            *pairs,
            "                ],",
            "            ),",
        ]
    return "\n".join([*lines, "        ]", "    )", ""])


def _xml(publishers: Mapping[str, Sequence[str]], about: Sequence[str]) -> str:
    launch = ElementTree.Element("launch")
    launch.append(ElementTree.Comment(f" {' '.join(about)} "))
    for frame, arguments in publishers.items():
        said = {"pkg": "tf2_ros", "exec": PROGRAM, "name": _node_name(frame), "args": " ".join(arguments)}
        ElementTree.SubElement(launch, "node", said)
    ElementTree.indent(launch)
    return ElementTree.tostring(launch, encoding="unicode") + "\n"


def _in_xml(text: str, path: Path) -> Iterator[Sequence[str]]:
    root = parsed_xml(text, path, _WHAT)
    for node in root.iter("node"):
        if node.get("exec", node.get("type")) == PROGRAM:
            try:
                yield shlex.split(node.get("args", ""))
            except ValueError as error:
                raise InputError(f"{path}: the args of a {PROGRAM} cannot be parted ({error}); mend them.") from error


def _in_python(text: str, path: Path) -> Iterator[Sequence[str]]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about the style of somebody else's file
            tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"{path}: not readable as Python ({str(error)[:200]}); give {_WHAT}.") from error
    for call in ast.walk(tree):
        if isinstance(call, ast.Call):
            said = {keyword.arg: keyword.value for keyword in call.keywords}
            program = said.get("executable", said.get("node_executable"))
            if isinstance(program, ast.Constant) and program.value == PROGRAM:
                yield _literals(said.get("arguments"), f"{path}: line {call.lineno}")


def _literals(arguments: ast.expr | None, where: str) -> Sequence[str]:
    items = arguments.elts if isinstance(arguments, ast.List | ast.Tuple) else [arguments]
    if not all(isinstance(item, ast.Constant) for item in items):
        raise InputError(
            f"{where}: the arguments of this {PROGRAM} are computed, and a launch file is not run here; write them as "
            "a list of texts."
        )
    return [str(item.value) for item in items if isinstance(item, ast.Constant)]


def _transform(arguments: Sequence[str], where: str) -> tuple[str, str, Pose]:
    """Parent, child and T_parent_child of one publisher."""
    said = _flags(arguments, where)
    parent, child = (re.sub("^/", "", said.pop(flag, "")) for flag in _FRAMES)
    if not parent or not child:
        raise InputError(f"{where}: lacks --frame-id or --child-frame-id; give both.")
    values = {flag: number(word, f"{where}: {flag}") for flag, word in said.items()}
    if values.keys() & set(_RPY) and values.keys() & set(_XYZW):
        raise InputError(f"{where}: gives both a quaternion and roll, pitch, yaw; remove one of them.")
    if values.keys() & set(_XYZW):
        R = rotation_of_xyzw(_values(values, _XYZW, (0.0, 0.0, 0.0, 1.0)), where)
    else:
        R = rotation_of_rpy(_values(values, _RPY))
    return parent, child, make_pose(R, _values(values, _XYZ))


def _values(values: Mapping[str, float], flags: Sequence[str], default: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
    return np.array([values.get(flag, rest) for flag, rest in zip(flags, default, strict=True)])


def _flags(arguments: Sequence[str], where: str) -> dict[str, str]:
    """Flag -> word, of arguments with flags or in the old order without."""
    if len(arguments) in _UNFLAGGED and not any(word.startswith("--") for word in arguments):
        return dict(zip(_UNFLAGGED[len(arguments)], arguments, strict=True))
    known = (*_XYZ, *_XYZW, *_RPY, *_FRAMES)
    strange = [word for word in arguments[::2] if word not in known]
    if strange or len(arguments) % 2:
        raise InputError(f"{where}: {(strange or arguments)[-1][:40]!r} is not understood; known: {', '.join(known)}.")
    return dict(zip(arguments[::2], arguments[1::2], strict=True))


FORMAT = Format(
    name=NAME,
    suffix=".launch.py",
    explain=(
        "ROS 2 launch file (Python, or XML for a name that ends in .xml): one static_transform_publisher a camera, "
        "the pose of the camera's optical frame (x right, y down, z forward) in the parent frame, metres, quaternion "
        "xyzw, world Z up (REP-103); poses only."
    ),
    put=write,
    read=read,
    recognises=recognises,
    needs_up=True,
    takes=frozenset({"parent_frame", "frame_name"}),
)
