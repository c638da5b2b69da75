"""Kalibr's camchain: the chain as Kalibr defines it, read by PyYAML and projected by OpenCV."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from format_rigs import format_rig, lens, pixels, points_before, worst_pose_difference
from hypothesis import given, settings
from hypothesis import strategies as st
from loguru import logger

from aruco.errors import InputError
from aruco.pose_math import exp_se3, invert_transform
from rigcal.formats import registry
from rigcal.formats.kalibr import FORMAT
from rigcal.formats.rig import ExportOptions, Rig

KINDS = {"front left": "brown", "34563472": "fisheye", "zwölf": "pinhole"}
OPTIONS = ExportOptions()


def written(rig: Rig, tmp_path: Path) -> Path:
    out = tmp_path / "camchain.yaml"
    FORMAT.write(rig, out, OPTIONS)
    return out


def in_first_camera(rig: Rig) -> Rig:
    """What Kalibr keeps: the world of the first camera."""
    T_first_world = invert_transform(next(iter(rig.T_world_cam.values())))
    poses = {name: T_first_world @ T for name, T in rig.T_world_cam.items()}
    return Rig(T_world_cam=poses, cameras=rig.cameras)


def kalibr_pixels(chain: dict, n: int, points_cam0: np.ndarray, *, backwards: bool = False) -> np.ndarray:
    """Kalibr's own arithmetic: p_n = T_n_(n-1) ... T_1_0 p_0, then the lens."""
    T = np.eye(4)
    for k in range(1, n + 1):
        step = np.array(chain[f"cam{k}"]["T_cn_cnm1"])
        T = (np.linalg.inv(step) if backwards else step) @ T
    points = points_cam0 @ T[:3, :3].T + T[:3, 3]
    camera = chain[f"cam{n}"]
    fu, fv, pu, pv = camera["intrinsics"]
    K, D, zero = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]]), np.array(camera["distortion_coeffs"]), np.zeros(3)
    if camera["distortion_model"] == "equi":
        return cv2.fisheye.projectPoints(points[:, None], zero, zero, K, D)[0][:, 0]
    return cv2.projectPoints(points, zero, zero, K, D)[0][:, 0]


def test_kalibrs_arithmetic_gets_the_same_pixels(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    chain = yaml.safe_load(written(rig, tmp_path).read_text())
    assert [camera["rostopic"] for camera in chain.values()] == [f"/{name}/image_raw" for name in sorted(KINDS)]
    first = rig.T_world_cam[min(KINDS)]
    for n, name in enumerate(sorted(KINDS)):
        assert chain[f"cam{n}"]["resolution"] == [1280, 720]
        points = points_before(rig, name)
        local = (points - first[:3, 3]) @ first[:3, :3]  # the points in the first camera
        np.testing.assert_allclose(kalibr_pixels(chain, n, local), pixels(rig, name, points), atol=1e-6)
        if n:  # The check can fail: with the inverse of each step no pixel is where it should be.
            wrong = kalibr_pixels(chain, n, local, backwards=True)
            assert np.abs(wrong - pixels(rig, name, points)).max() > 100


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    rig = format_rig(KINDS)
    again = registry.read_rig(written(rig, tmp_path))
    # Two products of transforms of some metres: 16 digits less two.
    assert worst_pose_difference(again, in_first_camera(rig)) < 1e-12
    assert again.up is None
    for name, camera in rig.cameras.items():
        got = again.cameras[name]
        assert (got.width, got.height, got.distortion_model) == (1280, 720, camera.distortion_model)
        assert (got.K == camera.K).all()
        assert (got.distortion == camera.distortion).all()
    # The world is lost, which the line that explains the format says.
    assert worst_pose_difference(again, rig) > 1
    assert "world is lost" in FORMAT.explain


@settings(max_examples=30, deadline=None)
@given(xi=st.lists(st.floats(-3, 3), min_size=12, max_size=12))
def test_any_two_cameras_come_back(xi: list[float], tmp_path_factory: pytest.TempPathFactory) -> None:
    poses = {"a": exp_se3(np.array(xi[:6])), "b": exp_se3(np.array(xi[6:]))}
    rig = Rig(T_world_cam=poses, cameras={name: lens(name, "brown") for name in poses})
    again = registry.read_rig(written(rig, tmp_path_factory.mktemp("kalibr")))
    assert worst_pose_difference(again, in_first_camera(rig)) < 1e-12


def test_kalibrs_own_files_are_read(tmp_path: Path) -> None:
    """As Kalibr writes them: its own order of keys, overlaps, topics that are not ours."""
    path = tmp_path / "camchain-imucam.yaml"
    path.write_text(
        """cam0:
  T_cam_imu:
  - [0.0, 1.0, 0.0, 0.0]
  - [-1.0, 0.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0001, 1e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.2, 367.2, 248.3]
  resolution: [752, 480]
  rostopic: /stereo/left/image_rect
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [457.6, 456.1, 379.9, 255.2]
  resolution: [752, 480]
  rostopic: /stereo/right/image_rect
"""
    )
    rig = registry.read_rig(path)
    assert list(rig.T_world_cam) == ["cam0", "cam1"]
    np.testing.assert_allclose(rig.T_world_cam["cam1"][:3, 3], [0.11, 0, 0], atol=1e-15)
    assert rig.cameras["cam0"].distortion[3] == 1e-05
    assert not rig.cameras["cam1"].has_distortion


LENS = """camera_model: pinhole, distortion_coeffs: [-0.28, 0.07, 0.0, 1.0e-05], distortion_model: radtan,
  intrinsics: [458.6, 457.2, 367.2, 248.3], resolution: [752, 480], rostopic: /left/image_raw"""


@pytest.mark.parametrize(
    "text",
    [
        f"%YAML:1.0 # of OpenVINS\n\ncam0: {{{LENS}}}\n",
        f"%YAML 1.2\n---\ncam0: {{{LENS}}}\n",
        f"cam0: # the left one\n  {{{LENS}}}\n",
        f"\ufeffcam0: {{{LENS}}}\n",
        f"cam0 :\r\n  {{{LENS}}}\r\n",
    ],
)
def test_files_of_other_programs_in_kalibrs_layout_are_known(text: str, tmp_path: Path) -> None:
    path = tmp_path / "kalibr_imucam_chain.yaml"
    path.write_bytes(text.encode())
    assert registry.detect(path).name == "kalibr"
    cameras = registry.cameras_of(path)
    assert cameras["left"].K[0, 0] == 458.6


def test_lines_are_counted_from_the_top_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "chain.yaml"
    path.write_text(f"%YAML:1.0\ncam0: {{{LENS}}}\ncam0: {{{LENS}}}\n")
    with pytest.raises(InputError, match="line 4: 'cam0' is there twice"):
        registry.read_rig(path)


@pytest.mark.parametrize("kind", ["brown_k3", "rational"])
def test_a_lens_that_kalibr_cannot_hold_is_refused(kind: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"kalibr cannot hold the .* distortion of camera a"):
        written(format_rig({"a": kind}), tmp_path)
    assert not list(tmp_path.iterdir())


def test_cameras_without_intrinsics_are_named(tmp_path: Path) -> None:
    rig = format_rig({"a": "brown", "b": "brown"})
    with pytest.raises(InputError, match=r"camera b .*--recording"):
        written(Rig(T_world_cam=rig.T_world_cam, cameras={"a": rig.cameras["a"]}), tmp_path)


def test_intrinsics_need_no_chain(tmp_path: Path) -> None:
    chain = yaml.safe_load(written(format_rig(KINDS), tmp_path).read_text())
    del chain["cam1"]["T_cn_cnm1"]
    path = tmp_path / "mono.yaml"
    path.write_text(yaml.safe_dump(chain))
    assert set(registry.cameras_of(path)) == set(KINDS)
    with pytest.raises(InputError, match="cam1 has no T_cn_cnm1"):
        registry.read_rig(path)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("T_cn_cnm1", [[1, 0], [0, 1]], "list of 4 rows"),
        ("T_cn_cnm1", [[2.0 * (i == j) for j in range(4)] for i in range(4)], "rigid"),
        ("intrinsics", [1, 2, 3], "4 numbers"),
        ("intrinsics", [-1.0, 2, 3, 4], "focal lengths"),
        ("intrinsics", ["nan", 2, 3, 4], "ordinary number"),
        ("intrinsics", "x", "list of numbers"),
        ("resolution", [640.5, 480], "whole number"),
        ("resolution", [640], "width and height"),
        ("distortion_coeffs", [1, 2], "4 numbers"),
        ("camera_model", "omni", "'omni'"),
        ("distortion_model", "fov", "'fov'"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(key: str, value: object, words: str, tmp_path: Path) -> None:
    path = written(format_rig(KINDS), tmp_path)
    chain = yaml.safe_load(path.read_text())
    chain["cam1"][key] = value
    path.write_text(yaml.safe_dump(chain))
    with pytest.raises(InputError, match=words) as caught:
        registry.read_rig(path)
    assert str(path) in str(caught.value)
    assert "cam1" in str(caught.value)


def test_gaps_and_references_without_end_are_refused(tmp_path: Path) -> None:
    path = written(format_rig(KINDS), tmp_path)
    chain = yaml.safe_load(path.read_text())
    chain["cam7"] = chain.pop("cam2")
    path.write_text(yaml.safe_dump(chain))
    with pytest.raises(InputError, match="without a gap"):
        registry.read_rig(path)
    levels = "\n".join(f"l{k}: &l{k} [{', '.join([f'*l{k - 1}'] * 9)}]" for k in range(1, 12))
    path.write_text(f"l0: &l0 [1,1]\n{levels}\ncam0:\n  camera_model: pinhole\n  intrinsics: *l11\n  rostopic: *l11\n")
    with pytest.raises(InputError) as caught:
        registry.read_rig(path)
    assert len(str(caught.value)) < 500


def said_of(path: Path) -> tuple[Rig | None, list[str]]:
    """What reading gives, or None, and the warnings."""
    said: list[str] = []
    handler = logger.add(said.append, level="WARNING")
    try:
        return registry.read_rig(path), said
    except InputError as error:
        return None, [str(error)]
    finally:
        logger.remove(handler)


def test_a_chain_that_was_cut_anywhere_is_refused_or_told(tmp_path: Path) -> None:
    path = written(format_rig(KINDS), tmp_path)
    whole = path.read_bytes()
    assert said_of(path)[1] == []
    for end in range(whole.index(b"cam2"), len(whole)):
        path.write_bytes(whole[:end])
        rig, said = said_of(path)
        # A camera that is gone to its last letter cannot be missed: Kalibr states no number of cameras.
        assert said or (rig is not None and len(rig.T_world_cam) == 2 and path.read_bytes().endswith(b"image_raw\n"))


def test_topics_that_are_whole_still_name_their_cameras(tmp_path: Path) -> None:
    path = written(format_rig(KINDS), tmp_path)
    path.write_text(path.read_text().replace("/zwölf/image_raw", "/zw"))
    rig, said = said_of(path)
    assert rig is not None
    assert list(rig.T_world_cam) == ["34563472", "cam2", "front left"]
    assert "cam2 keeps the name that Kalibr gave" in said[0]


@pytest.mark.parametrize("topic", ["/front left/image_raw", "/cam0/image_raw"])
def test_topics_that_name_two_cameras_alike_name_none(topic: str, tmp_path: Path) -> None:
    path = written(format_rig(KINDS), tmp_path)
    text = path.read_text().replace("/34563472/image_raw", "/34563472")
    path.write_text(text.replace("/zwölf/image_raw", topic))
    rig, said = said_of(path)
    assert rig is not None
    assert list(rig.T_world_cam) == ["cam0", "cam1", "cam2"]
    assert "do not tell its cameras apart" in said[0]
