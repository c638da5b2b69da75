"""Camera trajectories, read by Open3D."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pytest
from format_rigs import format_rig, pixels, points_before, worst_pose_difference

from aruco.errors import InputError
from rigcal.formats import registry
from rigcal.formats.open3d import FORMAT
from rigcal.formats.rig import ExportOptions, Rig

KINDS = {"front left": "pinhole", "34563472": "pinhole", "zwölf": "pinhole"}


def written(rig: Rig, tmp_path: Path) -> Path:
    FORMAT.write(rig, tmp_path / "cameras.json", ExportOptions())
    return tmp_path / "cameras.json"


def open3d_pixels(parameters: Any, points: np.ndarray, *, inverse: bool = False) -> np.ndarray:
    """Open3D's convention: K (E p)."""
    E = np.linalg.inv(parameters.extrinsic) if inverse else np.asarray(parameters.extrinsic)
    p = points @ E[:3, :3].T + E[:3, 3]
    q = p @ np.asarray(parameters.intrinsic.intrinsic_matrix).T
    return q[:, :2] / q[:, 2:]


def test_open3d_gets_the_same_pixels(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    trajectory = o3d.io.read_pinhole_camera_trajectory(str(written(rig, tmp_path)))
    assert len(trajectory.parameters) == 3
    for name, parameters in zip(sorted(KINDS), trajectory.parameters):
        assert (parameters.intrinsic.width, parameters.intrinsic.height) == (1280, 720)
        points = points_before(rig, name)
        np.testing.assert_allclose(open3d_pixels(parameters, points), pixels(rig, name, points), atol=1e-6)
        # The check can fail: the inverse, or a matrix read row by row, puts them elsewhere.
        wrong = open3d_pixels(parameters, points, inverse=True)
        assert np.abs(wrong - pixels(rig, name, points)).max() > 100


def test_open3ds_renderer_sees_the_floor_where_it_is(tmp_path: Path) -> None:
    """Not only its numbers: a point cloud projected by Open3D's own tensor code falls on the same pixels."""
    rig = format_rig(KINDS)
    trajectory = o3d.io.read_pinhole_camera_trajectory(str(written(rig, tmp_path)))
    name, parameters = min(KINDS), trajectory.parameters[0]
    points = points_before(rig, name, 5)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points.astype(np.float32)))
    image = cloud.project_to_depth_image(
        1280,
        720,
        o3d.core.Tensor(np.asarray(parameters.intrinsic.intrinsic_matrix)),
        o3d.core.Tensor(np.asarray(parameters.extrinsic)),
        depth_scale=1000.0,
        depth_max=10.0,
    )
    depth = np.asarray(image.to_legacy())
    rows, cols = np.nonzero(depth)
    for u, v in pixels(rig, name, points):
        # Open3D rounds pixels down or to the nearest one.
        assert np.hypot(cols - u, rows - v).min() < 1.5


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    for up in ("+y", "-y", None):
        rig = format_rig(KINDS, up=up)
        again = registry.read_rig(written(rig, tmp_path))
        assert worst_pose_difference(again, rig) < 1e-14  # inverted twice: the last digit
        assert again.up == up
        assert all((again.cameras[name].K == camera.K).all() for name, camera in rig.cameras.items())


def test_open3ds_own_files_are_read(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    trajectory = o3d.io.read_pinhole_camera_trajectory(str(written(rig, tmp_path)))
    o3d.io.write_pinhole_camera_trajectory(str(tmp_path / "own.json"), trajectory)
    own = registry.read_rig(tmp_path / "own.json")
    assert list(own.T_world_cam) == ["cam0", "cam1", "cam2"]  # it keeps no names
    for T, name in zip(own.T_world_cam.values(), sorted(KINDS)):
        np.testing.assert_allclose(T, rig.T_world_cam[name], atol=1e-14)
    o3d.io.write_pinhole_camera_parameters(str(tmp_path / "one.json"), trajectory.parameters[1])
    one = registry.read_rig(tmp_path / "one.json")
    np.testing.assert_allclose(one.T_world_cam["cam0"], own.T_world_cam["cam1"], atol=0)


def test_distortion_is_not_dropped_silently(tmp_path: Path, said: list[str]) -> None:
    rig = format_rig({"a": "pinhole", "b": "brown", "c": "fisheye", "d": "rational"})
    path = written(rig, tmp_path)
    assert len(said) == 1
    assert "camera b, c, d" in said[0]
    assert "undistorted" in said[0]
    for cameras in (registry.cameras_of(path), registry.read_rig(path).cameras):
        for name, camera in rig.cameras.items():
            assert cameras[name].distortion_model == camera.distortion_model
            assert cameras[name].distortion.tolist() == camera.distortion.tolist()
    assert len(said) == 1  # what is known is not doubted


def test_a_file_that_does_not_know_the_distortion_says_so(tmp_path: Path, said: list[str]) -> None:
    trajectory = o3d.io.read_pinhole_camera_trajectory(str(written(format_rig(KINDS), tmp_path)))
    own = tmp_path / "own.json"
    o3d.io.write_pinhole_camera_trajectory(str(own), trajectory)  # of ours, Open3D keeps what it knows
    for read in (registry.cameras_of, registry.read_rig):
        said.clear()
        read(own)
        (doubt,) = [line for line in said if "distortion" in line]
        assert doubt.startswith(
            f"{own}: Open3D's format has no place for lens distortion, so camera cam0, cam1, cam2 is"
        )
    content = json.loads(written(format_rig({"a": "brown"}), tmp_path).read_text())
    content["parameters"][0]["distortion_model"] = "fov"
    own.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"camera a: .*fov"):
        registry.cameras_of(own)


@pytest.mark.parametrize(
    ("path_to", "value", "words"),
    [
        (("extrinsic",), [1.0] * 15, "must be 16 numbers"),
        (("extrinsic",), [2.0] * 16, "rigid|rotation"),
        (("intrinsic", "width"), "x", "whole number"),
        (("intrinsic", "width"), 0, "image size"),
        (("intrinsic", "intrinsic_matrix"), None, "list of numbers"),
        (("intrinsic",), 5, "no intrinsic"),
        (("name",), "34563472", "one name"),
        (("name",), "_meta", "names that start with _"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(
    path_to: tuple[str, ...], value: object, words: str, tmp_path: Path
) -> None:
    path = written(format_rig(KINDS), tmp_path)
    content = json.loads(path.read_text())
    node = content["parameters"][1]
    for key in path_to[:-1]:
        node = node[key]
    node[path_to[-1]] = value
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=words) as caught:
        registry.read_rig(path)
    assert str(path) in str(caught.value)


def test_what_cannot_be_one_is_told_what_is_wanted(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    head = '{"class_name": "PinholeCameraTrajectory", "x": "'
    for text, words in ((head + "x" * 2**24, "over 16 MiB, which is not"), (head, "not a JSON file .*; give")):
        for mark in ("", "\ufeff"):
            path.write_text(mark + text, encoding="utf-8")
            with pytest.raises(InputError, match=f"{words} a camera trajectory as Open3D writes it") as caught:
                registry.read_rig(path)
            assert "extrinsics" not in str(caught.value)
