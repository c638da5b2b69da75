"""The extrinsics file as one of the formats."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from format_rigs import format_rig, pixels, points_before, worst_pose_difference
from loguru import logger

from aruco.errors import InputError
from aruco.model import UpAxis
from rigcal.formats import registry
from rigcal.formats.native import read_poses
from rigcal.formats.native_rig import FORMAT
from rigcal.formats.rig import ExportOptions, Rig
from rigcal.kept import kept_from_file

KINDS = {"front left": "brown", "34563472": "fisheye", "zwölf": "rational"}


def written(rig: Rig, tmp_path: Path) -> Path:
    FORMAT.write(rig, tmp_path / "extrinsics.json", ExportOptions())
    return tmp_path / "extrinsics.json"


@pytest.mark.parametrize("up", ["+y", "-y", None])
def test_what_is_written_is_read_back(up: UpAxis | None, tmp_path: Path) -> None:
    rig = format_rig(KINDS, up=up)
    again = registry.read_rig(written(rig, tmp_path))
    assert worst_pose_difference(again, rig) == 0
    assert again.up == up
    for name in rig.cameras:
        points = points_before(rig, name)
        assert (pixels(again, name, points) == pixels(rig, name, points)).all()
    assert set(registry.cameras_of(tmp_path / "extrinsics.json")) == set(KINDS)


def test_the_numbers_are_camera_to_world(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    content = json.loads(written(rig, tmp_path).read_text())
    T = np.array([float(word) for word in content["zwölf"]["pose"].split()]).reshape(4, 4)
    assert (T[:3, 3] == rig.T_world_cam["zwölf"][:3, 3]).all()  # the camera's centre in the world
    assert not np.allclose(np.linalg.inv(T)[:3, 3], T[:3, 3], atol=0.1)


def test_the_other_commands_read_it(tmp_path: Path) -> None:
    rig = format_rig(KINDS, up="-y")
    path = written(rig, tmp_path)
    assert read_poses(path).keys() == set(KINDS)
    kept = kept_from_file(path)
    assert (kept.up, kept.origin) == ("-y", "camera")
    assert "intrinsics" in kept.entries["zwölf"]


def test_poses_alone_are_enough(tmp_path: Path) -> None:
    path = tmp_path / "poses.json"
    path.write_text(json.dumps({"a": {"pose": "1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1"}}))
    rig = registry.read_rig(path)
    assert rig.T_world_cam["a"][:3, 3].tolist() == [1, 2, 3]
    assert (rig.up, dict(rig.cameras)) == (None, {})
    with pytest.raises(InputError, match=r"no intrinsics \(native\)"):
        registry.cameras_of(path)


def test_what_is_left_behind_is_said(tmp_path: Path) -> None:
    path = written(format_rig({"a": "pinhole"}), tmp_path)
    content = json.loads(path.read_text())
    content["_meta"]["parts"] = [{"b": {"pose": "..."}, "_meta": {}}]
    content["_meta"]["quality"] = {"verdict": "bad", "reasons": ["..."]}
    path.write_text(json.dumps(content))
    said: list[str] = []
    logger.add(said.append, level="WARNING")
    registry.read_rig(path)
    assert "camera b stands in a world of its own" in said[0]
    assert "calls itself bad" in said[1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"_meta": {"world": {"up": [0, 0, 1]}}}, "_meta.world wants up"),
        ({"_meta": {"world": 5}}, "_meta.world wants up"),
        ({"a": {"pose": "1 0 0 1 0 1 0 2 0 0 1 3 0 0 0"}}, "camera a has no sixteen numbers"),
        ({"../a": {"pose": "1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1"}}, "cannot be called '../a'"),
        ({"a\n": {"pose": "1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1"}}, "cannot be called"),
        ({"a": {"pose": "1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1", "intrinsics": []}}, "must be an object"),
        (
            {"a": {"pose": "1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1", "intrinsics": {"image_width": "x"}}},
            "camera a: intrinsics: image_width must be a whole number",
        ),
    ],
)
def test_what_is_wrong_is_said(change: dict[str, object], words: str, tmp_path: Path) -> None:
    path = written(format_rig({"a": "pinhole", "b": "pinhole"}), tmp_path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError, match=words) as caught:
        registry.read_rig(path)
    assert str(path) in str(caught.value)
