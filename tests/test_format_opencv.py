"""OpenCV's FileStorage, read by cv2.FileStorage and projected by cv2.projectPoints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from format_rigs import format_rig, pixels, points_before, worst_pose_difference
from hypothesis import given, settings
from hypothesis import strategies as st

from aruco.errors import InputError
from aruco.model import UpAxis
from aruco.pose_math import exp_se3
from rigcal.formats import registry
from rigcal.formats.opencv import FORMAT
from rigcal.formats.rig import ExportOptions, Rig

KINDS = {"front left": "brown_k3", "34563472": "fisheye", 'zw"ölf: #1': "rational", "true": "pinhole"}


def written(rig: Rig, folder: Path) -> Path:
    FORMAT.write(rig, folder / "rig.yaml", ExportOptions())
    return folder / "rig.yaml"


def opencv_pixels(node: cv2.FileNode, points: np.ndarray, *, inverse: bool = False) -> np.ndarray:
    K, D = node.getNode("camera_matrix").mat(), node.getNode("distortion_coefficients").mat()
    rvec, tvec = node.getNode("rvec").mat(), node.getNode("tvec").mat()
    if inverse:
        R = cv2.Rodrigues(rvec)[0].T
        rvec, tvec = cv2.Rodrigues(R)[0], -R @ tvec
    if node.getNode("distortion_model").string() == "equidistant":
        return cv2.fisheye.projectPoints(points[:, None], rvec, tvec, K, D)[0][:, 0]
    return cv2.projectPoints(points, rvec, tvec, K, D)[0][:, 0]


def test_opencv_gets_the_same_pixels(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    storage = cv2.FileStorage(str(written(rig, tmp_path)), cv2.FILE_STORAGE_READ)
    nodes = storage.getNode("cameras")
    assert nodes.size() == len(KINDS)
    for index, name in enumerate(sorted(KINDS)):
        node = nodes.at(index)
        assert node.getNode("name").string() == name
        assert (node.getNode("image_width").real(), node.getNode("image_height").real()) == (1280, 720)
        assert np.abs(node.getNode("T_world_cam").mat() - rig.T_world_cam[name]).max() == 0
        points = points_before(rig, name)
        np.testing.assert_allclose(opencv_pixels(node, points), pixels(rig, name, points), atol=1e-6)
        # The check can fail: as camera to world the same numbers give other pixels.
        assert np.abs(opencv_pixels(node, points, inverse=True) - pixels(rig, name, points)).max() > 100


@pytest.mark.parametrize("up", ["+y", "-y", None])
def test_what_is_written_is_read_back(up: UpAxis | None, tmp_path: Path) -> None:
    rig = format_rig(KINDS, up=up)
    again = registry.read_rig(written(rig, tmp_path))
    assert worst_pose_difference(again, rig) == 0
    assert again.up == up
    for name, camera in rig.cameras.items():
        got = again.cameras[name]
        assert (got.width, got.height, got.distortion_model) == (1280, 720, camera.distortion_model)
        assert (got.K == camera.K).all()
        assert (got.distortion == camera.distortion).all()


def test_poses_alone_are_enough(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    again = registry.read_rig(written(Rig(T_world_cam=rig.T_world_cam), tmp_path))
    assert worst_pose_difference(again, rig) == 0
    assert not again.cameras
    with pytest.raises(InputError, match="no intrinsics"):
        registry.cameras_of(tmp_path / "rig.yaml")


@settings(max_examples=50, deadline=None)
@given(xi=st.lists(st.floats(-4, 4), min_size=6, max_size=6))
def test_any_pose_comes_back(xi: list[float], tmp_path_factory: pytest.TempPathFactory) -> None:
    rig = Rig(T_world_cam={"a": exp_se3(np.array(xi))})
    again = registry.read_rig(written(rig, tmp_path_factory.mktemp("opencv")))
    assert worst_pose_difference(again, rig) <= 1e-30  # what is smaller is written as zero


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
@pytest.mark.parametrize(("keys", "flag"), [(("image_width", "image_height"), 0), (("image_Width", "image_Height"), 1)])
def test_intrinsics_as_opencvs_samples_write_them(
    suffix: str, keys: tuple[str, str], flag: int, tmp_path: Path
) -> None:
    path = tmp_path / f"left.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    K = np.array([[701.25, 0, 640.5], [0, 702.5, 360.25], [0, 0, 1]])
    D = np.array([[0.1, -0.2, 1e-05, 1e-3, 0.3]] if not flag else [[0.1, -0.2, 1e-05, 1e-3]])
    storage.write("calibration_time", "Sat Nov 22 20:00:00 2025")
    storage.write(keys[0], 1280)
    storage.write(keys[1], 720)
    if suffix != "json":  # OpenCV forgets a comma there
        storage.writeComment("flags: +fix_aspectRatio")
    storage.write("fisheye_model", flag)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", D)
    storage.write("avg_reprojection_error", 0.25)
    storage.release()
    (camera,) = registry.cameras_of(path).values()
    assert (camera.name, camera.width, camera.height) == ("left", 1280, 720)
    assert camera.distortion_model == ("equidistant" if flag else "plumb_bob")
    assert (camera.K == K).all()
    assert (camera.distortion == D[0]).all()
    with pytest.raises(InputError, match="no pose"):
        registry.read_rig(path)


def test_eight_or_more_coefficients_are_a_rational_lens(tmp_path: Path) -> None:
    path = tmp_path / "cam.yaml"
    for tail, fine in ((0.0, True), (0.1, False)):
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", 640)
        storage.write("image_height", 480)
        storage.write("camera_matrix", np.diag([500.0, 500, 1]))
        storage.write("distortion_coefficients", np.array([[0.1, 0.2, 0, 0, 0.3, 0.4, 0.5, 0.6, tail, 0, 0, 0]]))
        storage.release()
        if fine:
            assert registry.cameras_of(path)["cam"].distortion_model == "rational_polynomial"
        else:  # a thin prism, which no recording here can have
            with pytest.raises(InputError, match="wants 8 distortion_coefficients, got 12"):
                registry.cameras_of(path)


def test_a_pose_that_was_changed_in_one_place_only_is_refused(tmp_path: Path) -> None:
    rig = format_rig({"a": "brown"})
    path = written(rig, tmp_path)
    text = path.read_text()
    place = text.index("tvec")
    number = text[text.index("[", place) + 2 : text.index(",", place)]
    path.write_text(text[:place] + text[place:].replace(number, "9.75", 1))
    with pytest.raises(InputError, match="camera a: rvec and tvec are not the inverse of T_world_cam"):
        registry.read_rig(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("rows: 4", "rows: 999999999", "T_world_cam must be 4 x 4"),
        ("rows: 3", "rows: -3", "whole number"),
        ('name: "b"', "name: a", "a name of its own"),
        ('name: "b"', 'name: "a/../b"', "cannot be called 'a/../b'"),
        ("image_width: 1280", "image_width: 1e9", "whole number"),
        ("cameras:", "cameras: 5\nrest:", "sequence of maps"),
        ("cameras:", "cameras: [", "not readable as YAML"),
    ],
)
def test_what_is_wrong_is_said(old: str, new: str, words: str, tmp_path: Path) -> None:
    path = written(format_rig({"a": "brown", "b": "brown"}), tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        registry.read_rig(path)
    assert str(path) in str(caught.value)


def test_xml_that_swells_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.xml"
    path.write_text(
        '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">]><opencv_storage>'
        '<camera_matrix type_id="opencv-matrix">&a;</camera_matrix></opencv_storage>'
    )
    with pytest.raises(InputError, match="DOCTYPE"):
        registry.cameras_of(path)


def test_skew_is_refused(tmp_path: Path) -> None:
    rig = format_rig({"a": "pinhole"})
    K = rig.cameras["a"].K.copy()
    K[0, 1] = 0.5
    skewed = replace(rig, cameras={"a": replace(rig.cameras["a"], K=K)})
    with pytest.raises(InputError, match="skew of camera a"):
        written(skewed, tmp_path)
    assert not list(tmp_path.iterdir())


# What cv2, left alone, writes so that it is read as something else, by OpenCV 4, OpenCV 5 or YAML.
ODD_NAMES = ["a'b", " a", "a ", '"a"', '"', "'", 'a"', 'zw"ölf', "true", "null", "~", "1e5", "- a", "a: b", "#x", "[a]"]


def test_odd_names_are_read_by_opencv_and_by_yaml(tmp_path: Path) -> None:
    rig = Rig(T_world_cam={name: np.eye(4) for name in ODD_NAMES})
    path = written(rig, tmp_path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    nodes = storage.getNode("cameras")
    assert [nodes.at(index).getNode("name").string() for index in range(nodes.size())] == sorted(ODD_NAMES)
    assert list(registry.read_rig(path).T_world_cam) == sorted(ODD_NAMES)


def test_a_name_that_fits_in_no_line_of_cv2_is_refused(tmp_path: Path) -> None:
    for name in ("x" * 5000, '"' * 2100, "\u00e4" * 2100):
        with pytest.raises(InputError, match="opencv cannot hold the name"):
            written(Rig(T_world_cam={name: np.eye(4)}), tmp_path)
        assert not list(tmp_path.iterdir())
    longest = "x" * 3990
    assert list(registry.read_rig(written(Rig(T_world_cam={longest: np.eye(4)}), tmp_path)).T_world_cam) == [longest]
    storage = cv2.FileStorage(str(tmp_path / "rig.yaml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("cameras").at(0).getNode("name").string() == longest


@pytest.mark.parametrize("suffix", ["yaml", "xml", "json"])
@pytest.mark.parametrize(("key", "value"), [(None, 0), ("fisheye_model", 0), ("distortion_model", "plumb_bob")])
def test_four_coefficients_that_may_be_a_fisheyes_are_doubted(
    key: str | None, value: int | str, suffix: str, tmp_path: Path, said: list[str]
) -> None:
    path = tmp_path / f"cam.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    if key:
        storage.write(key, value)
    storage.write("camera_matrix", np.diag([500.0, 500, 1]))
    storage.write("distortion_coefficients", np.array([[-0.01], [0.003], [-0.002], [0.0004]]))  # as cv2.fisheye has it
    storage.release()
    assert registry.cameras_of(path)["cam"].distortion_model == "plumb_bob"
    assert len(said) == (key is None)
    assert all(word in line for line in said for word in (str(path), "k1, k2, p1, p2", "fisheye_model: 1"))
