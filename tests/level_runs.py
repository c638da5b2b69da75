"""Runs of the levelling command on a small rough rig: its files, what it ends with, what it says of bad input."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from click.testing import CliRunner, Result
from floor_rooms import cameras, nudged

from aruco.depth_save import CameraDepth, save_depth_data
from aruco.floor_model import centre_jacobian
from aruco.pose_math import Pose, exp_so3, make_pose, pose_text
from refine_ground_plane import main

TRUE = cameras()
ROUGH = nudged(TRUE, seed=4)
# What markers leave the poses of ROUGH with: 12 mm and 0.6 degrees.
ROUGH_COVARIANCE = np.diag([0.0105**2] * 3 + [0.012**2] * 3)
# Where the target's frame is: the whole rig lies 0.3 m too low and a little aslant in its own world.
T_TARGET_ROOM = make_pose(exp_so3(np.radians([0.8, 0.0, -0.5])), np.array([0.2, -0.3, -0.1]))
TURN = np.diag([1.0, -1.0, -1.0, 1.0])  # from y up to y down


def given_poses(T_world_cam: Mapping[str, Pose] = ROUGH) -> dict[str, Pose]:
    """Poses of the room in the world of the target."""
    return {name: T_TARGET_ROOM @ T for name, T in T_world_cam.items()}


def document(T_world_cam: Mapping[str, Pose], at_centre: np.ndarray = ROUGH_COVARIANCE, **meta: Any) -> dict[str, Any]:
    """The content of an extrinsics file of an upright world; entries of meta come on top.

    Args:
        T_world_cam: Its poses.
        at_centre: (6, 6) covariance of (turn, shift of the centre) of each.
        meta: Under ``_meta``.
    """
    about = {
        "format": "rigcal.extrinsics",
        "version": 1,
        "world": {"up": [0, 1, 0], "origin": "target"},
        "covariance": {name: [float(x) for x in at(T, at_centre).ravel()] for name, T in T_world_cam.items()},
        **meta,
    }
    return {**{name: {"pose": pose_text(T)} for name, T in T_world_cam.items()}, "_meta": about}


def at(T_world_cam: Pose, at_centre: np.ndarray = ROUGH_COVARIANCE) -> np.ndarray:
    """A covariance of turn and centre as one of the left perturbation in the world's axes."""
    J = centre_jacobian(T_world_cam[:3, 3], inverse=True)
    return J @ at_centre @ J.T


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def level(rig: Path, store: Path, out: Path, *more: object) -> Result:
    return run("-i", rig, "-d", store, "-o", out, *more)


def levelled(rig: Path, store: Path, out: Path, *more: object, code: int = 0) -> dict[str, Any]:
    """The levelled file of a run that ends with an exit code."""
    result = level(rig, store, out, *more)
    assert result.exit_code == code, result.output
    return json.loads(out.read_text())


def assert_one_sentence(result: Result, *words: str, code: int = 1) -> None:
    """An error as promised: its code, no traceback, the words that help, and not a page of text."""
    assert result.exit_code == code, result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert "Traceback" not in result.output
    errors = [line for line in result.output.splitlines() if line.startswith("Error:")]
    assert len(errors) == 1, result.output
    for word in words:
        assert word in errors[0], f"{word!r} not in {errors[0]!r}"


def change(path: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def store_of(path: Path, depth: Mapping[str, CameraDepth]) -> Path:
    save_depth_data(path, depth)
    return path


def registered(rig: Path, store: Path, out: Path, *more: object, code: int = 0) -> tuple[dict[str, Any], str]:
    """The file of a run with --icp that ends with an exit code, and what it said."""
    result = level(rig, store, out, "--icp", *more)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return json.loads(out.read_text()), " ".join(result.output.split())


def failed(rig: Path, store: Path, folder: Path, *words: str, more: tuple[object, ...] = ()) -> dict[str, Any]:
    """A run whose clouds could not be registered writes the levelled poses, says why, and ends with 3."""
    level(rig, store, folder / "level.json", *more)
    content, said = registered(rig, store, folder / "out.json", "--plot", *more, code=3)
    levelled = json.loads((folder / "level.json").read_text())
    assert all(content[name] == levelled[name] for name in levelled if not name.startswith("_"))
    assert {**content["_meta"], "icp_refined": None} == {**levelled["_meta"], "icp_refined": None}
    note = content["_meta"]["icp_refined"]
    assert note["success"] is False
    assert note["moved"] == []
    assert len(re.findall(r"ICP refinement failed: .*?[^.]\. Using ground-plane-only extrinsics\.", said)) == 1, said
    assert "Traceback" not in said
    for word in words:
        assert word in note["message"], note["message"]
        assert word in said
    page = (folder / "out.html").read_text()
    assert "Using ground-plane-only extrinsics" in page
    assert "Clouds from above" not in page
    return content
