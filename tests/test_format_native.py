"""The extrinsics file as one of the formats."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from format_rigs import format_rig, pixels, points_before, worst_pose_difference
from loguru import logger
from scipy.spatial.transform import Rotation

from aruco.errors import InputError
from aruco.model import Calibration, CameraPose, UpAxis
from aruco.pose_math import make_pose
from rigcal.formats import registry
from rigcal.formats.native import read_poses, write_extrinsics
from rigcal.formats.native_rig import FORMAT
from rigcal.formats.rig import ExportOptions, Rig, y_up
from rigcal.kept import kept_from_file
from rigcal.solve.graph import graph_health

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
    assert (kept.up, kept.origin) == ("-y", "target")
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
    content["_meta"]["without_pose"] = {"c": "saw no marker"}
    content["_meta"]["parts"] = [{"b": {"pose": "..."}, "_meta": {}}]
    content["_meta"]["quality"] = {"verdict": "bad", "reasons": ["..."]}
    path.write_text(json.dumps(content))
    said: list[str] = []
    logger.add(said.append, level="WARNING")
    registry.read_rig(path)
    assert "camera b stands in a world of its own" in said[0]
    assert "camera c has no pose there" in said[1]
    assert "calls itself bad" in said[2]


@pytest.mark.parametrize("digits", [4, 5, 6, 7])
def test_rounded_poses_are_set_to_the_nearest_rotation(digits: int, tmp_path: Path) -> None:
    turns = Rotation.from_quat(np.random.default_rng(0).normal(size=(100, 4))).as_matrix()
    entries = {
        f"c{n}": {"pose": " ".join(f"{x:.{digits}f}" for x in make_pose(R, np.ones(3)).ravel())}
        for n, R in enumerate(turns)
    }
    path = tmp_path / "rounded.json"
    path.write_text(json.dumps(entries))
    rig = registry.read_rig(path)
    for n, R in enumerate(turns):
        got = rig.T_world_cam[f"c{n}"][:3, :3]
        assert np.abs(got @ got.T - np.eye(3)).max() < 1e-14
        # Rounding moves an entry by half a digit, the nearest rotation by no more again (norms of 3 x 3 matrices).
        assert np.abs(got - R).max() < 3 * 10.0**-digits
    # As written some are no rotations, so that they were refused where that was asked for.
    rounded = np.round(turns, digits)
    assert np.abs(rounded @ rounded.transpose(0, 2, 1) - np.eye(3)).max() > 0.5 * 10.0**-digits


def test_a_mark_of_the_byte_order_does_not_matter(tmp_path: Path) -> None:
    path = written(format_rig(KINDS), tmp_path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert registry.detect(path).name == "native"
    assert set(registry.read_rig(path).T_world_cam) == set(KINDS)
    assert kept_from_file(path).T_world_cam.keys() == set(KINDS)


def test_a_file_larger_than_any_calibration_is_not_parsed(tmp_path: Path) -> None:
    path = tmp_path / "bomb.json"
    path.write_text('{"a": {"pose": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "x": [' + "{}," * (6 * 2**20) + "{}]}}")
    with pytest.raises(InputError, match="over 16 MiB, which is not an extrinsics file"):
        registry.read_rig(path)


def test_a_rig_of_hundreds_of_cameras_that_share_frames_is_read(tmp_path: Path) -> None:
    names = [str(30000000 + n) for n in range(260)]
    health = graph_health({name: range(20) for name in names}).as_dict()
    cameras = [
        CameraPose(
            camera=name,
            T_world_cam=np.eye(4),
            n_frames=20,
            n_markers=40,
            rms_px=0.123456789012,
            spread_m=0.00123456789,
            spread_rad=0.001234567,
            covariance=np.full((6, 6), 1.2345678901234567e-8) + np.eye(6) * 1e-6,
        )
        for name in names
    ]
    path = tmp_path / "hall.json"
    write_extrinsics(
        path, Calibration(cameras=tuple(cameras), notes={"connections": health}, lost={}, up="+y", frames={})
    )
    assert path.stat().st_size > 4 * 2**20  # more than was read once
    assert kept_from_file(path).T_world_cam.keys() == set(names)


@pytest.mark.parametrize(
    ("origin", "advice"), [("target", "again with --auto-align"), ("camera", "rigcal's own extri")]
)
def test_only_rigcals_own_files_are_to_be_calibrated_again(origin: str, advice: str) -> None:
    rig = replace(format_rig(KINDS, up=None), origin=origin)
    with pytest.raises(InputError, match="zed-fusion wants a world that stands upright") as caught:
        y_up(rig, "zed-fusion")
    assert advice in str(caught.value)
    assert ("--auto-align" in str(caught.value)) == (origin == "target")
    assert str(caught.value).count(". ") == 0


def test_the_advice_for_files_of_others_can_be_followed(tmp_path: Path) -> None:
    poses = {str(n): T for n, T in enumerate(format_rig(KINDS).T_world_cam.values(), start=1)}
    path = written(Rig(T_world_cam=poses), tmp_path)
    with pytest.raises(InputError, match=r"write \[0, 1, 0\] for up under _meta\.world"):
        y_up(registry.read_rig(path), "zed-fusion")
    content = json.loads(path.read_text())
    content["_meta"]["world"]["up"] = [0, 1, 0]
    path.write_text(json.dumps(content))
    assert y_up(registry.read_rig(path), "zed-fusion").keys() == poses.keys()


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


@pytest.mark.parametrize("name", ["tum", "opencv", "open3d", "aniposelib", "usd", "colmap", "zed-fusion", "urdf"])
def test_nobody_knows_the_origin_of_a_world_from_elsewhere(name: str, tmp_path: Path) -> None:
    rig = format_rig({"1": "pinhole", "2": "pinhole"})
    foreign = registry.format_named(name)
    foreign.write(rig, tmp_path / "foreign.usda", ExportOptions())
    path = written(registry.read_rig(tmp_path / "foreign.usda"), tmp_path)
    assert json.loads(path.read_text())["_meta"]["world"]["origin"] == "unknown"
    # It stays so, and the other commands take it.
    assert registry.read_rig(written(registry.read_rig(path), tmp_path)).origin == "unknown"
    assert kept_from_file(path).origin == "unknown"
    assert registry.read_rig(written(rig, tmp_path)).origin == "target"


def test_the_origin_of_a_world_that_is_a_cameras_is_known(tmp_path: Path) -> None:
    registry.format_named("kalibr").write(
        format_rig({"a": "pinhole", "b": "brown"}), tmp_path / "chain.yaml", ExportOptions()
    )
    assert registry.read_rig(tmp_path / "chain.yaml").origin == "camera"
    (tmp_path / "poses.json").write_text(json.dumps({"a": {"pose": "1 0 0 1 0 1 0 2 0 0 1 3 0 0 0 1"}}))
    assert registry.read_rig(tmp_path / "poses.json").origin == "unknown"


def test_every_origin_that_is_written_is_explained() -> None:
    page = (Path(__file__).parents[1] / "docs" / "conventions.md").read_text(encoding="utf-8")
    for origin in ("target", "floor", "camera", "unknown"):
        assert f'`"{origin}"`' in page


@pytest.mark.parametrize(
    ("meta", "words"),
    [
        ({"version": 99}, "of version 99, and this program reads 1; update it"),
        ({"version": "1"}, "of version '1', and this program reads 1"),
        ({"version": True}, "of version"),
        ({"version": None}, "of version"),
        ({"format": "foo"}, "says that it is 'foo'"),
        ({"format": "rigcal.ground_refined", "version": 1}, "says that it is 'rigcal.ground_refined'"),
    ],
)
def test_another_version_or_layout_is_refused(meta: dict[str, object], words: str, tmp_path: Path) -> None:
    path = written(format_rig(KINDS), tmp_path)
    content = json.loads(path.read_text())
    content["_meta"].update(meta)
    path.write_text(json.dumps(content))
    for reading in (registry.read_rig, registry.cameras_of, read_poses, kept_from_file):
        with pytest.raises(InputError, match=words) as caught:
            reading(path)
        assert str(path) in str(caught.value)


def test_a_file_that_does_not_state_its_version_is_read(tmp_path: Path) -> None:
    path = written(format_rig(KINDS), tmp_path)
    content = json.loads(path.read_text())
    del content["_meta"]["version"], content["_meta"]["format"]
    path.write_text(json.dumps(content))
    assert registry.read_rig(path).T_world_cam.keys() == set(KINDS)


@pytest.mark.parametrize("name", ["tum", "kalibr", "opencv", "urdf", "usd", "open3d", "zed-fusion", "nerfstudio"])
def test_who_wants_an_extrinsics_file_and_gets_another_is_told_how_to_convert_it(name: str, tmp_path: Path) -> None:
    path = tmp_path / "foreign.usda"
    registry.format_named(name).write(format_rig({"1": "pinhole", "2": "brown"}), path, ExportOptions())
    for reading in (kept_from_file, read_poses):
        with pytest.raises(InputError, match=rf"another format \({name}\).*rigcal convert .* --to native -o") as caught:
            reading(path)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        (b"", "is empty"),
        (b"\0" * 4096, "holds nothing but zeros"),
        (b"\n \n", "only blanks"),
        (b"\xef\xbb\xbf", "empty"),
    ],
)
def test_an_empty_file_is_called_so(raw: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "extrinsics.json"
    path.write_bytes(raw)
    for reading in (registry.read_rig, registry.cameras_of, kept_from_file):
        with pytest.raises(InputError, match=f"{words}.*copy or make it again") as caught:
            reading(path)
        assert str(path) in str(caught.value)
