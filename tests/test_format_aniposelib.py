"""aniposelib's and caliscope's TOML, read by tomllib and projected by OpenCV as aniposelib does."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from format_rigs import format_rig, lens, pixels, points_before, worst_pose_difference
from hypothesis import given, settings
from hypothesis import strategies as st
from loguru import logger

from aruco.errors import InputError
from aruco.model import UpAxis
from aruco.pose_math import exp_se3
from rigcal.formats import registry
from rigcal.formats.aniposelib import FORMAT
from rigcal.formats.rig import ExportOptions, Rig

KINDS = {"front left": "brown_k3", "34563472": "fisheye", 'zw"ölf # 1': "pinhole"}
CALISCOPE = """
[cameras.0]
cam_id = 0
rotation_count = 0
error = 0.2
grid_count = 20
fisheye = false
size = [1920, 1080]
matrix = [[1121.5, 0.0, 943.5], [0.0, 1120.25, 532.0], [0.0, 0.0, 1.0]]
distortions = [0.07, -0.1, -0.0003, 6.5e-06, 0.04]
translation = [-0.25, 0.125, 2.0]
rotation = [0.0, 0.5, 0.0]

[cameras.3]
cam_id = 3
exposure = "null"
size = [1280, 720]
matrix = [[700.0, 0.0, 640.0], [0.0, 700.0, 360.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
fisheye = true
translation = "null"
rotation = "null"
"""
OLD_CALISCOPE = """
CreationDate = 2023-03-31T09:56:43.193358
[cam_2]
port = 2
size = [ 1280, 720,]
matrix = [ [ 900.5, 0.0, 618.25,], [ 0.0, 907.5, 394.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ [-0.3, 0.05, -0.004, 0.004, 0.06]]
ignore = false
translation = [ [1.0], [2.0], [3.0],]
rotation = [ [ 0.0, -1.0, 0.0,], [ 1.0, 0.0, 0.0,], [ 0.0, 0.0, 1.0,],]
[cam_4]
size = [ 1280, 720,]
ignore = true
matrix = [ [ 900.5, 0.0, 618.25,], [ 0.0, 907.5, 394.0,], [ 0.0, 0.0, 1.0,],]
[charuco]
columns = 4
"""


def written(rig: Rig, folder: Path) -> Path:
    FORMAT.write(rig, folder / "calibration.toml", ExportOptions())
    return folder / "calibration.toml"


def anipose_pixels(table: dict[str, Any], points: np.ndarray, *, inverse: bool = False) -> np.ndarray:
    rvec, tvec = np.array(table["rotation"]), np.array(table["translation"])
    if inverse:
        R = cv2.Rodrigues(rvec)[0].T
        rvec, tvec = cv2.Rodrigues(R)[0], -R @ tvec
    K, D = np.array(table["matrix"]), np.array(table["distortions"])
    if table.get("fisheye"):
        return cv2.fisheye.projectPoints(points[:, None], rvec, tvec, K, D)[0][:, 0]
    return cv2.projectPoints(points, rvec, tvec, K, D)[0][:, 0]


def test_anipose_gets_the_same_pixels(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    content = tomllib.loads(written(rig, tmp_path).read_text(encoding="utf-8"))
    # As aniposelib loads them: all tables but metadata, sorted by key.
    tables = [content[key] for key in sorted(content) if key != "metadata"]
    assert [table["name"] for table in tables] == sorted(KINDS)
    for table in tables:
        assert table["size"] == [1280, 720]
        assert len(table["distortions"]) == (4 if table["fisheye"] else 5)
        points = points_before(rig, table["name"])
        np.testing.assert_allclose(anipose_pixels(table, points), pixels(rig, table["name"], points), atol=1e-6)
        # The check can fail: as camera to world the same numbers give other pixels.
        wrong = anipose_pixels(table, points, inverse=True)
        assert np.abs(wrong - pixels(rig, table["name"], points)).max() > 100


def test_many_cameras_keep_their_order(tmp_path: Path) -> None:
    rig = format_rig({f"c{k:02d}": "pinhole" for k in range(12)})
    content = tomllib.loads(written(rig, tmp_path).read_text(encoding="utf-8"))
    names = [content[key]["name"] for key in sorted(content) if key != "metadata"]
    assert names == list(rig.T_world_cam)


@pytest.mark.parametrize("up", ["+y", "-y", None])
def test_what_is_written_is_read_back(up: UpAxis | None, tmp_path: Path) -> None:
    rig = format_rig(KINDS, up=up)
    again = registry.read_rig(written(rig, tmp_path))
    assert worst_pose_difference(again, rig) < 1e-13  # through a rotation vector and two inverses
    assert again.up == up
    for name, camera in rig.cameras.items():
        got = again.cameras[name]
        assert (got.width, got.height, got.distortion_model) == (1280, 720, camera.distortion_model)
        assert (got.K == camera.K).all()
        assert (got.distortion == camera.distortion).all()


@settings(max_examples=50, deadline=None)
@given(xi=st.lists(st.floats(-4, 4), min_size=6, max_size=6))
def test_any_pose_comes_back(xi: list[float], tmp_path_factory: pytest.TempPathFactory) -> None:
    rig = Rig(T_world_cam={"a": exp_se3(np.array(xi))}, cameras={"a": lens("a", "brown")})
    again = registry.read_rig(written(rig, tmp_path_factory.mktemp("anipose")))
    assert worst_pose_difference(again, rig) < 1e-12


def test_caliscopes_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "camera_array.toml"
    path.write_text(CALISCOPE)
    said: list[str] = []
    logger.add(said.append, level="WARNING")
    rig = registry.read_rig(path)
    assert list(rig.T_world_cam) == ["cam_0"]
    T_cam_world = np.linalg.inv(rig.T_world_cam["cam_0"])
    np.testing.assert_allclose(T_cam_world[:3, 3], [-0.25, 0.125, 2.0], atol=1e-15)
    np.testing.assert_allclose(T_cam_world[:3, :3], cv2.Rodrigues(np.array([0, 0.5, 0]))[0], atol=1e-15)
    assert "camera cam_3 has no rotation" in said[0]
    assert "taken for metres" in said[1]
    cameras = registry.cameras_of(path)
    assert {name: camera.distortion_model for name, camera in cameras.items()} == {
        "cam_0": "plumb_bob",
        "cam_3": "equidistant",
    }


def test_caliscopes_older_files_are_read(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text(OLD_CALISCOPE)
    rig = registry.read_rig(path)
    assert list(rig.T_world_cam) == ["cam_2"]
    # T_cam_world turns x into y, and then moves: its inverse has -R.T t.
    np.testing.assert_allclose(rig.T_world_cam["cam_2"][:3, 3], [-2, 1, -3], atol=1e-15)
    assert rig.cameras["cam_2"].distortion.tolist() == [-0.3, 0.05, -0.004, 0.004, 0.06]


def test_cameras_that_are_ignored_are_named(tmp_path: Path, said: list[str]) -> None:
    path = tmp_path / "config.toml"
    path.write_text(OLD_CALISCOPE)
    for read in (registry.read_rig, registry.cameras_of):
        said.clear()
        read(path)
        assert [line for line in said if "ignore = true" in line] == [
            f"{path}: camera cam_4 has ignore = true there and is left out"
        ]


def test_a_rational_lens_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="aniposelib cannot hold the rational_polynomial distortion of camera a"):
        written(format_rig({"a": "rational"}), tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("rotation = [0.0, 0.5, 0.0]", "rotation = [0.0, 0.5]", "rotation must be 3 numbers"),
        ("rotation = [0.0, 0.5, 0.0]", 'rotation = ["x", 0, 0]', "ordinary number"),
        ("rotation = [0.0, 0.5, 0.0]", "rotation = [nan, 0, 0]", "ordinary number"),
        ("rotation = [0.0, 0.5, 0.0]", 'rotation = "null"', "no camera has a rotation"),
        ("rotation = [0.0, 0.5, 0.0]", "rotation = [[2,0,0],[0,2,0],[0,0,2]]", "rotation"),
        ("translation = [-0.25, 0.125, 2.0]", "", "translation must be 3 numbers"),
        ("size = [1920, 1080]", "size = [1920]", "width and height"),
        ("size = [1920, 1080]", "size = [0, 1080]", "image size"),
        ("matrix = [[1121.5, 0.0, 943.5],", "matrix = [[1121.5, 0.0],", "3 rows of 3"),
        ("fisheye = false", "fisheye = true", "wants 4"),
        ("fisheye = false", 'name = "../x"', "cannot be called '../x'"),
        ("fisheye = false", "fisheye = false\nfisheye = true", "not readable as TOML"),
    ],
)
def test_what_is_wrong_is_said(old: str, new: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "camera_array.toml"
    assert old in CALISCOPE
    path.write_text(CALISCOPE.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        registry.read_rig(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("part", ["a", "a0-_", '"a b"', "'a.b'"])
@pytest.mark.parametrize("form", ["{} = 1", "[{}]", "x = {{ {} = 1 }}"])
def test_keys_that_would_swell_are_refused(part: str, form: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    for joint in (".", " . "):
        path.write_text(form.format(joint.join([part] * 20_000)))
        with pytest.raises(InputError, match="key of 20000 parts"):  # tomllib takes minutes for it
            FORMAT.read(path)


def test_dots_in_texts_and_comments_are_no_keys(tmp_path: Path) -> None:
    path = written(format_rig(KINDS), tmp_path)
    dots = "a." * 100
    path.write_text(f'x = "{dots}"\ny = \'{dots}\'\nz = """\n{dots}\n"""  # {dots}\n' + path.read_text())
    assert list(FORMAT.read(path).T_world_cam) == sorted(KINDS)
