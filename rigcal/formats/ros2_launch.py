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
from loguru import logger

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
# ROS 1's tf, not its tf2_ros, wants a period [ms] after them.
_WITH_PERIOD = (9, 10)
# What stands for a $(var x) in the meantime: no XML holds it.
_COMPUTED = "\0"
_NOT_RUN = "computed, and a launch file is not run here"
# A word of a publisher's arguments; None: it is computed.
Word = str | None


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
    """The cameras of a launch file, in a world with Y up. It is not run: what places a camera must be literal.

    Raises:
        InputError: It cannot be read, or its transforms are not literal; the message names the file.
    """
    text = read_text(path, _WHAT, MAX_FILE_BYTES)
    publishers = _in_xml(text, path) if text.lstrip().startswith("<") else _in_python(text, path)
    links: dict[str, Link] = {}
    unread: list[str] = []
    for where, arguments in publishers:
        said = _flags(arguments, where)
        if said is None:
            unread.append(f"{where}: the arguments of this {PROGRAM} are {_NOT_RUN}")
            continue
        child, link = _link(said, where)
        if child in links:
            raise InputError(f"{path}: frame {child!r} is published twice; remove one of the transforms.")
        links[child] = link
    if unread and not links:
        raise InputError(f"{unread[0]}; write them as texts.")
    for reason in unread:
        logger.warning("{}; it is left out, so write them as texts if a camera hangs on it", reason)
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


def _in_xml(text: str, path: Path) -> Iterator[tuple[str, Sequence[Word]]]:
    """Where each publisher stands, and its arguments."""
    root = parsed_xml(text, path, _WHAT)
    nodes = (node for node in root.iter("node") if node.get("exec", node.get("type")) == PROGRAM)
    for nth, node in enumerate(nodes, start=1):
        where, said = f"{path}: {PROGRAM} {nth}", _unsubstituted(node.get("args", ""))
        try:
            arguments = [None if _COMPUTED in word else word for word in shlex.split(said)]
        except ValueError as error:
            raise InputError(f"{where}: its args cannot be parted ({error}); mend them.") from error
        has_period = node.get("pkg") == "tf" and len(arguments) in _WITH_PERIOD
        yield where, arguments[:-1] if has_period else arguments


def _unsubstituted(said: str) -> str:
    """The text with a sign for every $(...) that closes, whatever parentheses stand inside: $(eval '(1 + 2) / 3')."""
    kept, at = "", 0
    while (start := said.find("$(", at)) >= 0 and (end := _closed(said, start + 1)):
        kept, at = f"{kept}{said[at:start]}{_COMPUTED}", end
    return kept + said[at:]


def _closed(said: str, start: int) -> int | None:
    """Where what follows the parenthesis begins that opens at ``start``; None: it does not close."""
    depth = 0
    for at in range(start, len(said)):
        depth += {"(": 1, ")": -1}.get(said[at], 0)
        if depth == 0:
            return at + 1
    return None


def _in_python(text: str, path: Path) -> Iterator[tuple[str, Sequence[Word]]]:
    """The same."""
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
                yield f"{path}: line {call.lineno}", _literals(said.get("arguments"))


def _literals(arguments: ast.expr | None) -> Sequence[Word]:
    if arguments is None:
        return []
    items = arguments.elts if isinstance(arguments, ast.List | ast.Tuple) else [arguments]
    if any(isinstance(item, ast.Starred) for item in items):
        return [None]  # nobody knows how many
    return [str(item.value) if isinstance(item, ast.Constant) else None for item in items]


def _link(said: Mapping[str, Word], where: str) -> tuple[str, Link]:
    """The child of one publisher, and where it is in its parent."""
    parent, child = (re.sub("^/", "", said.get(flag) or "") for flag in _FRAMES)
    if not parent or not child:
        raise InputError(f"{where}: lacks --frame-id or --child-frame-id; give both.")
    words_of = {flag: word for flag, word in said.items() if flag not in _FRAMES}
    if None in words_of.values():
        unknown = f"is placed by numbers that are {_NOT_RUN}; write them as texts"
        return child, Link(parent=parent, T_parent_child=None, unknown=unknown)
    values = {flag: number(word, f"{where}: {flag}") for flag, word in words_of.items()}
    if values.keys() & set(_RPY) and values.keys() & set(_XYZW):
        raise InputError(f"{where}: gives both a quaternion and roll, pitch, yaw; remove one of them.")
    if values.keys() & set(_XYZW):
        R = rotation_of_xyzw(_values(values, _XYZW, (0.0, 0.0, 0.0, 1.0)), where)
    else:
        R = rotation_of_rpy(_values(values, _RPY))
    return child, Link(parent=parent, T_parent_child=make_pose(R, _values(values, _XYZ)))


def _values(values: Mapping[str, float], flags: Sequence[str], default: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
    return np.array([values.get(flag, rest) for flag, rest in zip(flags, default, strict=True)])


def _flags(arguments: Sequence[Word], where: str) -> Mapping[str, Word] | None:
    """Flag -> word, of arguments with flags or in the old order without; None: which frames are meant is computed."""
    arguments = _without_ros_args(arguments)
    if len(arguments) in _UNFLAGGED and not any(word is not None and word.startswith("--") for word in arguments):
        said = dict(zip(_UNFLAGGED[len(arguments)], arguments, strict=True))
    else:
        flags = arguments[::2]
        known = (*_XYZ, *_XYZW, *_RPY, *_FRAMES)
        strange = [word for word in flags if word not in known]
        if (strange or len(arguments) % 2) and None in arguments:
            return None
        if strange or len(arguments) % 2:
            odd = (strange or arguments)[-1] or ""
            raise InputError(f"{where}: {odd[:40]!r} is not understood; known: {', '.join(known)}.")
        said = {flag: word for flag, word in zip(flags, arguments[1::2], strict=True) if flag is not None}
    return None if any(flag in said and said[flag] is None for flag in _FRAMES) else said


def _without_ros_args(arguments: Sequence[Word]) -> Sequence[Word]:
    """What is left for the program: ROS takes what stands between --ros-args and -- or the end."""
    if "--ros-args" not in arguments:
        return arguments
    first = arguments.index("--ros-args")
    rest = arguments[first + 1 :]
    return [*arguments[:first], *(rest[rest.index("--") + 1 :] if "--" in rest else [])]


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
