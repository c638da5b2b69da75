"""nerfstudio's transforms.json: read back, and by the arithmetic of nerfstudio's own loader."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from format_rigs import format_rig, lens, pixels, points_before, worst_pose_difference

from aruco.errors import InputError
from aruco.pose_math import Pose, invert_transform, transform_points
from rigcal.formats import registry
from rigcal.formats.nerfstudio import FORMAT
from rigcal.formats.rig import ExportOptions, Rig, y_up

BENT = {"a": "pinhole", "b12": "brown", "front": "brown_k3"}
FISH = {"a": "fisheye", "b12": "fisheye"}
# Quarter turns and (cx + 0.5) - 0.5 lose the last digits of a double.
ROUND_TRIP = 1e-12
PIXEL_TOLERANCE = 1e-6


def written(rig: Rig, folder: Path, **options: Any) -> dict[str, Any]:
    FORMAT.write(rig, folder / "transforms.json", ExportOptions(**options))
    return json.loads((folder / "transforms.json").read_text())


def loaded_pixels(content: dict[str, Any], frame: dict[str, Any], points_file: np.ndarray) -> np.ndarray:
    """Pixels as nerfstudio's loader takes the file: its keys, its axes, half a pixel less for OpenCV."""
    T_file_gl = np.array(frame["transform_matrix"])
    p_gl = transform_points(np.linalg.inv(T_file_gl), points_file)
    p_cv = p_gl * [1, -1, -1]
    K = np.array([[frame["fl_x"], 0, frame["cx"] - 0.5], [0, frame["fl_y"], frame["cy"] - 0.5], [0, 0, 1]])
    if content["camera_model"] == "OPENCV_FISHEYE":
        d = np.array([frame[f"k{k}"] for k in (1, 2, 3, 4)])
        found, _ = cv2.fisheye.projectPoints(p_cv[:, None], np.zeros(3), np.zeros(3), K, d)
    else:
        d = np.array([frame[key] for key in ("k1", "k2", "p1", "p2", "k3")])
        found, _ = cv2.projectPoints(p_cv, np.zeros(3), np.zeros(3), K, d)
    return found.reshape(-1, 2)


def z_up_points(content: dict[str, Any], points_world: np.ndarray) -> np.ndarray:
    """What nerfstudio does to a point cloud of the original world."""
    A = np.array(content["applied_transform"])
    return points_world @ A[:, :3].T + A[:, 3]


@pytest.mark.parametrize("kinds", [BENT, FISH])
@pytest.mark.parametrize("up", ["+y", "-y"])
def test_what_was_written_comes_back(kinds: dict[str, str], up: Any, tmp_path: Path):
    rig = format_rig(kinds, up)
    written(rig, tmp_path)
    path = tmp_path / "transforms.json"
    assert FORMAT.recognises(path, path.read_bytes())
    back = FORMAT.read(path)
    assert back.up == up
    assert worst_pose_difference(rig, back) < ROUND_TRIP
    for name, camera in rig.cameras.items():
        assert (back.cameras[name].width, back.cameras[name].height) == (1280, 720)
        assert np.allclose(back.cameras[name].K, camera.K, rtol=0, atol=ROUND_TRIP)
        assert back.cameras[name].distortion.tolist() == camera.distortion.tolist()


@pytest.mark.parametrize("kinds", [BENT, FISH])
@pytest.mark.parametrize("up", ["+y", "-y"])
def test_the_loader_projects_the_same_points_to_the_same_pixels(kinds: dict[str, str], up: Any, tmp_path: Path):
    rig = format_rig(kinds, up)
    content = written(rig, tmp_path)
    for frame in content["frames"]:
        name = frame["camera_name"]
        points = points_before(rig, name)
        found = loaded_pixels(content, frame, z_up_points(content, points))
        assert np.abs(found - pixels(rig, name, points)).max() < PIXEL_TOLERANCE


def test_the_world_has_z_up(tmp_path: Path):
    for up in ("+y", "-y"):
        rig = format_rig(BENT, up)
        content = written(rig, tmp_path)
        for frame in content["frames"]:
            T = np.array(frame["transform_matrix"])
            height = y_up(rig, "test")[frame["camera_name"]][1, 3]
            assert abs(T[2, 3] - height) < ROUND_TRIP
            assert T[2, 1] > 0.7  # OpenGL's camera y is up, for a camera that looks a little down
            assert T[2, 2] > 0.2  # and it looks along -z: downwards


@pytest.mark.parametrize("wrong", ["opencv axes", "inverse", "no turn", "half a pixel"])
def test_the_usual_mistakes_would_be_seen(wrong: str, tmp_path: Path):
    rig = format_rig(BENT)
    content = written(rig, tmp_path)
    for frame in content["frames"]:
        points = points_before(rig, frame["camera_name"])
        seen_from = points if wrong == "no turn" else z_up_points(content, points)
        T: Pose = np.array(frame["transform_matrix"])
        if wrong == "opencv axes":
            frame["transform_matrix"] = (T @ np.diag([1, -1, -1, 1])).tolist()
        elif wrong == "inverse":
            frame["transform_matrix"] = invert_transform(T).tolist()
        elif wrong == "half a pixel":
            frame["cx"] -= 0.5
        found = loaded_pixels(content, frame, seen_from)
        assert np.abs(found - pixels(rig, frame["camera_name"], points)).max() > 0.4


def test_an_unknown_up_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="which way is up"):
        written(format_rig(BENT, None), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("kinds", "told"),
    [
        ({"a": "rational"}, "cannot hold the rational_polynomial distortion of camera a"),
        ({"a": "fisheye", "b": "brown"}, "camera a has a fisheye lens"),
    ],
)
def test_lenses_that_the_file_cannot_hold_are_refused(kinds: dict[str, str], told: str, tmp_path: Path):
    with pytest.raises(InputError, match=told):
        written(format_rig(kinds), tmp_path)


def test_images_can_be_called_as_they_are(tmp_path: Path):
    content = written(format_rig(BENT), tmp_path, image_name="images/{camera}_17.jpg")
    assert [frame["file_path"] for frame in content["frames"]] == [f"images/{n}_17.jpg" for n in BENT]
    bad = Rig(T_world_cam={"../x": np.eye(4)}, up="+y", cameras={"../x": lens("../x", "pinhole")})
    with pytest.raises(InputError, match="rename"):
        written(bad, tmp_path)


FOREIGN = {
    "fl_x": 500, "fl_y": 501, "cx": 320, "cy": 240, "w": 640, "h": 480, "camera_model": "OPENCV", "k1": 0.1,
    "frames": [{"file_path": "./images/frame_01.png", "transform_matrix": [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3],
                                                                           [0, 0, 0, 1]]}],
}  # fmt: skip


def foreign(folder: Path, **changes: Any) -> Path:
    path = folder / "transforms.json"
    path.write_text(json.dumps({**FOREIGN, **changes}))
    return path


def test_files_of_other_programs_are_read(tmp_path: Path):
    rig = FORMAT.read(foreign(tmp_path))
    assert rig.up == "+y"
    assert rig.T_world_cam["frame_01"][:3, 3].tolist() == [1, 3, -2]
    assert rig.cameras["frame_01"].K.tolist() == [[500, 0, 319.5], [0, 501, 239.5], [0, 0, 1]]
    assert rig.cameras["frame_01"].distortion.tolist() == [0.1, 0, 0, 0, 0]


def test_a_world_that_somebody_turned_is_given_back_as_it_was_and_its_up_is_unknown(tmp_path: Path):
    applied = [[0, 0, 1, 0.5], [1, 0, 0, 0], [0, 1, 0, 0]]
    rig = FORMAT.read(foreign(tmp_path, applied_transform=applied, applied_scale=2.0))
    assert rig.up is None
    p_world = rig.T_world_cam["frame_01"][:3, 3]
    assert np.allclose(2.0 * (np.array(applied) @ [*p_world, 1]), [1, 2, 3], rtol=0, atol=1e-15)


@pytest.mark.parametrize(
    ("changes", "kind", "distortion"),
    [
        ({"is_fisheye": False}, "plumb_bob", [0.1, 0.02, 0, 0, 0]),
        ({"is_fisheye": True}, "equidistant", [0.1, 0.02, 0, 0]),  # as instant-ngp's scripts write it
        ({"is_fisheye": True, "camera_model": "OPENCV_FISHEYE"}, "equidistant", [0.1, 0.02, 0, 0]),
        ({"is_fisheye": False, "camera_model": "OPENCV_FISHEYE"}, "equidistant", [0.1, 0.02, 0, 0]),
        ({"camera_model": "RADIAL"}, "plumb_bob", [0.1, 0.02, 0, 0, 0]),
        ({"camera_model": "RADIAL_FISHEYE"}, "equidistant", [0.1, 0.02, 0, 0]),
        ({"camera_model": "SIMPLE_RADIAL_FISHEYE", "k2": 0}, "equidistant", [0.1, 0, 0, 0]),
    ],
)
def test_which_lens_a_file_means(changes: dict[str, Any], kind: str, distortion: list[float], tmp_path: Path):
    content = {key: value for key, value in FOREIGN.items() if key != "camera_model"}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**content, "k2": 0.02, **changes}))
    camera = FORMAT.read(path).cameras["frame_01"]
    assert (camera.distortion_model, camera.distortion.tolist()) == (kind, distortion)


def test_what_the_files_root_says_goes_before_what_a_frame_says(tmp_path: Path):
    """As in nerfstudio's loader: a key is looked for in the root first."""
    frame = {**FOREIGN["frames"][0], "fl_x": 1, "cx": 2, "k2": 0.03}
    camera = FORMAT.read(foreign(tmp_path, frames=[frame])).cameras["frame_01"]
    assert camera.K.tolist() == [[500, 0, 319.5], [0, 501, 239.5], [0, 0, 1]]
    assert camera.distortion.tolist() == [0.1, 0.03, 0, 0, 0]  # and what it does not say is the frame's


@pytest.mark.parametrize(
    ("image", "name"),
    [
        ("./train/r_0", "train-r_0"),  # Blender's sets have no suffixes
        ("r_0", "r_0"),
        ("images/left.0/1.png", "left.0-1"),
        ("images/left.0/r_1", "left.0-r_1"),
        ("./images/a.b.png", "a.b"),
    ],
)
def test_cameras_are_called_like_their_images(image: str, name: str, tmp_path: Path):
    rig = FORMAT.read(foreign(tmp_path, frames=[{**FOREIGN["frames"][0], "file_path": image}]))
    assert list(rig.T_world_cam) == [name]


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"frames": []}, "no frames"),
        ({"frames": [1]}, "no frames"),
        ({"frames": FOREIGN["frames"] * 2}, "there twice"),
        ({"frames": [{"file_path": "a.png"}]}, "transform_matrix must be"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": np.diag([2, 2, 2, 1]).tolist()}]}, "rotation"),
        ({"frames": [{"transform_matrix": np.eye(4).tolist()}]}, "file_path"),
        ({"camera_model": "EQUIRECTANGULAR"}, "no counterpart"),
        ({"k4": 0.1}, "k4"),
        ({"w": -640}, "whole number"),
        ({"cx": None}, "cx must be"),
        ({"applied_scale": 0}, "positive"),
        ({"applied_scale": 1e-300}, "applied_scale of 1e-300"),
        ({"applied_scale": 1e-30, "frames": [{**FOREIGN["frames"][0], "transform_matrix":
          [[1, 0, 0, 10], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}]}, "frame 0: its place"),
        ({"is_fisheye": True}, "is_fisheye is true, and camera_model OPENCV"),
        ({"is_fisheye": "yes"}, "true or false"),
        ({"frames": [{**FOREIGN["frames"][0], "file_path": ""}]}, "cannot be called"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused_in_one_sentence(changes: dict[str, Any], told: str, tmp_path: Path):
    path = foreign(tmp_path, **changes)
    with pytest.raises(InputError, match=told) as caught:
        FORMAT.read(path)
    assert str(path) in str(caught.value)


def test_a_file_without_focal_length_gives_poses_only(tmp_path: Path):
    path = foreign(tmp_path)
    content = json.loads(path.read_text())
    del content["fl_x"]
    path.write_text(json.dumps(content))
    assert FORMAT.read(path).cameras == {}


@pytest.mark.parametrize("model", [["OPENCV"], {}, 1, None])
def test_a_camera_model_that_is_no_word_is_refused(model: object, tmp_path: Path):
    content = written(format_rig(BENT), tmp_path)
    path = tmp_path / "other.json"
    path.write_text(json.dumps({**content, "camera_model": model}))
    with pytest.raises(InputError, match="no counterpart"):
        FORMAT.read(path)


def test_what_cannot_be_one_is_told_what_is_wanted(tmp_path: Path) -> None:
    path = tmp_path / "file.json"
    head = '{"frames": [{"transform_matrix": 1}], "x": "'
    for text, words in ((head + "x" * 2**24, "over 16 MiB, which is not"), (head, "not a JSON file .*; give")):
        for mark in ("", "\ufeff"):
            path.write_text(mark + text, encoding="utf-8")
            with pytest.raises(InputError, match=f"{words} a transforms.json of nerfstudio") as caught:
                registry.read_rig(path)
            assert "extrinsics" not in str(caught.value)
