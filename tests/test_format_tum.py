"""TUM trajectories, read by evo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from format_rigs import format_rig, pixels, points_before, worst_pose_difference
from hypothesis import given, settings
from hypothesis import strategies as st
from loguru import logger

from aruco.errors import InputError
from aruco.model import UpAxis
from aruco.pose_math import exp_se3
from rigcal.formats import registry
from rigcal.formats.rig import ExportOptions, Rig
from rigcal.formats.tum import FORMAT

KINDS = {"front left": "brown", '12"#x': "fisheye", "zwölf": "rational"}


def written(rig: Rig, folder: Path) -> Path:
    FORMAT.write(rig, folder / "poses.txt", ExportOptions())
    return folder / "poses.txt"


def test_evo_gets_the_same_pixels(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    trajectory = file_interface.read_tum_trajectory_file(str(written(rig, tmp_path)))
    assert trajectory.timestamps.tolist() == [0, 1, 2]
    seen = Rig(T_world_cam=dict(zip(sorted(KINDS), trajectory.poses_se3)), cameras=rig.cameras)
    turned = Rig(T_world_cam={name: np.linalg.inv(T) for name, T in seen.T_world_cam.items()}, cameras=rig.cameras)
    for name in KINDS:
        points = points_before(rig, name)
        np.testing.assert_allclose(pixels(seen, name, points), pixels(rig, name, points), atol=1e-6)
        # The check can fail: taken for world to camera, no camera sees its points where it should.
        assert not np.allclose(pixels(turned, name, points), pixels(rig, name, points), atol=100)


@pytest.mark.parametrize("up", ["+y", "-y", None])
def test_what_is_written_is_read_back(up: UpAxis | None, tmp_path: Path) -> None:
    rig = format_rig(KINDS, up=up)
    again = registry.read_rig(written(rig, tmp_path))
    assert worst_pose_difference(again, rig) < 1e-14  # a rotation through a quaternion: the last digit
    assert again.up == up


@settings(max_examples=50, deadline=None)
@given(xi=st.lists(st.floats(-4, 4), min_size=6, max_size=6))
def test_any_pose_comes_back(xi: list[float], tmp_path_factory: pytest.TempPathFactory) -> None:
    rig = Rig(T_world_cam={"a": exp_se3(np.array(xi))})
    assert worst_pose_difference(registry.read_rig(written(rig, tmp_path_factory.mktemp("tum"))), rig) < 1e-12


def test_a_trajectory_without_names_is_read_and_said(tmp_path: Path) -> None:
    path = tmp_path / "groundtruth.txt"
    path.write_text("# ground truth\n1305031098.6659 1.3563 0.6305 1.6380 0.0 0.0 0.0 1.0\n1305031099 1 2 3 0 0 1 0\n")
    said: list[str] = []
    logger.add(said.append, level="WARNING")
    rig = registry.read_rig(path)
    assert list(rig.T_world_cam) == ["cam0", "cam1"]
    assert rig.T_world_cam["cam0"][:3, 3].tolist() == [1.3563, 0.6305, 1.6380]
    assert "have no name" in said[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("0 1 2 3 0 0 0 1\n1 2 3\n", "line 2 must be 8 numbers"),
        ("0 1 2 3 0 0 0 0.5\n", "line 1.*length"),
        ("0 1 2 3 0 0 0 1\n1 x 2 3 0 0 0 1\n", "line 2 must be an ordinary number"),
        ("0 1 2 inf 0 0 0 1\n", "ordinary number"),
        ('# camera: "a"\n0 1 2 3 0 0 0 1\n# camera: "a"\n1 1 2 3 0 0 0 1\n', "a second camera called 'a'"),
        ('# camera: "../x"\n0 1 2 3 0 0 0 1\n', "cannot be called '../x'"),
        ("# nothing\n", "not a calibration"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        registry.read_rig(path)
    assert str(path) in str(caught.value)


def test_a_long_trajectory_is_no_rig(tmp_path: Path) -> None:
    path = tmp_path / "way.txt"
    path.write_text("0 0 0 0 0 0 0 1\n" * 70_000)
    with pytest.raises(InputError, match="over 1024 KiB"):
        FORMAT.read(path)
