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
from scipy.spatial.transform import Rotation

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


def said_of(path: Path) -> tuple[Rig | None, list[str]]:
    """What reading gives, or None, and the warnings."""
    said: list[str] = []
    handler = logger.add(said.append, level="WARNING")
    try:
        return FORMAT.read(path), said
    except InputError as error:
        return None, [str(error)]
    finally:
        logger.remove(handler)


def test_a_file_that_was_cut_anywhere_is_refused_or_told(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    path = written(rig, tmp_path)
    whole = path.read_bytes()
    for end in range(len(whole)):
        path.write_bytes(whole[:end])
        assert said_of(path)[1], end
    path.write_bytes(whole)
    assert said_of(path)[1] == []


@pytest.mark.parametrize(
    ("quaternion", "is_whole"),
    [
        # 3 -5 4 7 in four decimals: whole, and with the last number cut.
        ("0.3015 -0.5025 0.4020 0.7035", True),
        ("0.3015 -0.5025 0.4020 0.70", False),
        ("0.3015 -0.5025 0.4020 0.703", False),
        ("0.71 0.71 0 0", True),
        ("0.707107 0.0 0.0 0.707107", True),
        ("7.07107e-01 0.0 0.0 7.07107e-01", True),
        ("0.7071067811865476 0.0 0.0 0.707", True),
        ("0.7071067811865476 0.0 0.0 0.70", False),
        ("0.018 0.020 0.000 1.000", True),
        ("0.50 0.50 0.500 0.500", True),
        ("0.500 0.500 0.500 0.49", False),
        ("1e-99999999999999999999999 0 0 1", True),
    ],
)
def test_a_quaternion_is_as_long_as_its_digits_allow(quaternion: str, is_whole: bool, tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(f"0 1 2 3 0 0 0 1\n1 1 2 3 {quaternion}\n")
    rig, said = said_of(path)
    assert (rig is not None) == is_whole
    assert is_whole or "line 2: the quaternion's length is 0." in said[0]


@pytest.mark.parametrize("style", [".2f", ".3f", ".4f", ".2e", ".3e", ".2g", ".3g", ".4g"])
@pytest.mark.parametrize("most_rad", [0.03, 0.1, 3.0])
def test_few_digits_of_any_style_are_never_taken_for_damage(style: str, most_rad: float, tmp_path: Path) -> None:
    """Of small turns too, whose w is 1.000, and whose x is 1.23e-05."""
    rng = np.random.default_rng(4)
    rotvecs = rng.normal(size=(1000, 3))
    rotvecs *= (rng.uniform(0, most_rad, 1000) / np.linalg.norm(rotvecs, axis=1))[:, None]
    values = Rotation.from_rotvec(rotvecs).as_quat()
    lines = [f"{n} 0 0 0 {' '.join(f'{x:{style}}' for x in row)}\n" for n, row in enumerate(values)]
    (tmp_path / "poses.txt").write_text("".join(lines))
    assert len(FORMAT.read(tmp_path / "poses.txt").T_world_cam) == 1000


@pytest.mark.parametrize("digits", [3, 4, 6, 9])
def test_rounding_and_cutting_digits_is_never_taken_for_damage(digits: int, tmp_path: Path) -> None:
    q = np.random.default_rng(3).normal(size=(300, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    for values in (q, np.trunc(q * 10.0**digits) / 10.0**digits):
        lines = [f"{n} 0 0 0 {' '.join(f'{x:.{digits}f}' for x in row)}\n" for n, row in enumerate(values)]
        (tmp_path / "poses.txt").write_text("".join(lines))
        assert len(FORMAT.read(tmp_path / "poses.txt").T_world_cam) == 300


def test_a_last_line_without_an_end_is_told_where_others_wrote_it(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text("0 1 2 3 0 0 0 1\n1 1 2 3 0.5 0.5 0.5 0.5")
    rig, said = said_of(path)
    assert rig is not None
    assert "ends without the end of a line" in said[0]
