"""Cameras that an earlier calibration placed stay to the bit; a rig in parts is solved in parts."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from aruco.marker_geometry import save_faces
from aruco.pose_math import invert_transform, pose_distance
from calibrate_extrinsics import main
from rigcal.formats.native import read_poses, write_json
from rigcal.quality.truth import pair_errors
from rigcal.sim import Simulation, simulate
from rigcal.sources.rgbd_folder import write_recording


@pytest.fixture(scope="module")
def moved() -> Simulation:
    return simulate("box-moved", seed=2, n_frames=8, depth=False)


@pytest.fixture(scope="module")
def folder(moved: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("moved") / "recording"
    write_recording(moved.recording, where, depth=False)
    save_faces(where / "markers.parquet", moved.faces)
    return where


@pytest.fixture(scope="module")
def three(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration of all cameras but the last."""
    out = tmp_path_factory.mktemp("three") / "three.json"
    assert calibrate(cameras_of(folder)[:3], folder, out).exit_code == 0
    return out


def cameras_of(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.is_dir())


def calibrate(inputs: list[Path], folder: Path, out: Path, *more: object, moving: bool = True) -> Result:
    flags = ["--moving-target"] if moving else []
    given = [word for path in inputs for word in ("-i", str(path))]
    words = [*given, "--markers", str(folder / "markers.parquet"), "-o", str(out), *flags, *map(str, more)]
    return CliRunner().invoke(main, words)


def moved_in_file(source: Path, out: Path, name: str, shift_m: float) -> Path:
    """An extrinsics file in which one camera stands elsewhere."""
    content = json.loads(source.read_text())
    numbers = [float(word) for word in content[name]["pose"].split()]
    numbers[3] += shift_m
    content[name]["pose"] = " ".join(map(repr, numbers))
    write_json(out, content)
    return out


def test_kept_cameras_keep_every_bit_and_the_new_one_fits(
    moved: Simulation, folder: Path, three: Path, tmp_path: Path
) -> None:
    result = calibrate([folder], folder, tmp_path / "four.json", "--fix", three)
    assert result.exit_code == 0, result.output
    before, after = json.loads(three.read_text()), json.loads((tmp_path / "four.json").read_text())
    kept = [name for name in before if not name.startswith("_")]
    assert len(kept) == 3
    assert all(after[name]["pose"] == before[name]["pose"] for name in kept)
    assert after["_meta"]["world"] == before["_meta"]["world"]
    assert all(after["_meta"]["covariance"][name] == before["_meta"]["covariance"][name] for name in kept)
    errors = pair_errors(read_poses(tmp_path / "four.json"), moved.T_world_cam)
    # Moved boxes give 0.1 mm with 16 frames and 4 cameras; half the frames, and the error of the three stays.
    assert max(shift for _, shift in errors.values()) < 0.5e-3
    # The tolerance bites: a calibration of its own has another world, and its poses differ.
    calibrate([folder], folder, tmp_path / "own.json")
    own = read_poses(tmp_path / "own.json")
    assert any((own[name] != read_poses(three)[name]).any() for name in kept)


def test_a_kept_camera_that_is_not_in_the_recording_stays_in_the_file(
    moved: Simulation, folder: Path, three: Path, tmp_path: Path
) -> None:
    first, *_, last = cameras_of(folder)
    result = calibrate([first, last], folder, tmp_path / "out.json", "--fix", three)
    assert result.exit_code == 0, result.output
    poses, before = read_poses(tmp_path / "out.json"), read_poses(three)
    assert len(poses) == 4
    assert all((poses[name] == before[name]).all() for name in before)
    assert "as its file says; not in this recording" in result.output
    assert "Wrote 4 camera poses" in result.output
    # One shared camera carries the world: the new one is as good as a pair of cameras.
    assert max(shift for _, shift in pair_errors(poses, moved.T_world_cam).values()) < 0.5e-3


@pytest.mark.parametrize("joint", ["--joint", "--no-joint"])
def test_a_resting_target_ties_new_cameras_to_kept_ones(
    demo: Simulation, demo_folder: Path, tmp_path: Path, joint: str
) -> None:
    first, second, *_ = cameras_of(demo_folder)
    old = tmp_path / "old.json"
    assert calibrate([first, second], demo_folder, old, "--auto-align", moving=False).exit_code == 0
    result = calibrate([demo_folder], demo_folder, tmp_path / "new.json", "--fix", old, joint, moving=False)
    assert result.exit_code == 0, result.output
    poses, before = read_poses(tmp_path / "new.json"), read_poses(old)
    assert all((poses[name] == before[name]).all() for name in before)
    meta = json.loads((tmp_path / "new.json").read_text())["_meta"]
    assert meta["world"] == {"up": [0, 1, 0], "origin": "target"}
    # As for the demo rig by itself: 2.5 mm.
    assert max(shift for _, shift in pair_errors(poses, demo.T_world_cam).values()) < 2.5e-3


def test_a_kept_camera_that_was_moved_since_is_told(
    moved: Simulation, folder: Path, three: Path, tmp_path: Path
) -> None:
    first, second, _, last = (path.name for path in cameras_of(folder))
    stale = moved_in_file(three, tmp_path / "stale.json", first, 0.05)
    result = calibrate([folder], folder, tmp_path / "out.json", "--fix", stale)
    assert result.exit_code == 3, result.output
    assert f"Camera {first} is displaced: the other cameras of stale.json put it 50." in result.output
    assert f"kept: camera {first}: as its file says; it took no part: the other cameras" in result.output
    poses, before = read_poses(tmp_path / "out.json"), read_poses(stale)
    assert all((poses[name] == before[name]).all() for name in before)
    # Nothing hangs on it: the new camera is as good as beside two cameras that stand where they are kept.
    found = invert_transform(poses[second]) @ poses[last]
    true = invert_transform(moved.T_world_cam[second]) @ moved.T_world_cam[last]
    assert pose_distance(found, true)[1] < 0.5e-3


def test_files_that_cannot_be_kept(folder: Path, three: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    result = calibrate([cameras_of(folder)[3]], folder, out, "--fix", three)
    assert result.exit_code == 1
    assert "record at least one of them together with the new ones" in result.output
    assert calibrate([folder], folder, out, "--fix", three, "--auto-align").exit_code == 2
    assert "an input" in calibrate([folder], folder, three, "--fix", three).output
    missing = calibrate([folder], folder, out, "--fix", tmp_path / "none.json")
    assert missing.exit_code == 1
    assert "none.json: cannot be read" in missing.output
    content = json.loads(three.read_text())
    content["_meta"]["covariance"] = {next(iter(content)): [1.0, 2.0]}
    write_json(tmp_path / "odd.json", content)
    assert "36 numbers" in calibrate([folder], folder, out, "--fix", tmp_path / "odd.json").output
    assert not out.exists()


def test_a_file_with_nothing_but_poses_is_kept(folder: Path, three: Path, tmp_path: Path) -> None:
    content = json.loads(three.read_text())
    plain = {name: {"pose": entry["pose"]} for name, entry in content.items() if not name.startswith("_")}
    write_json(tmp_path / "plain.json", plain)
    result = calibrate([folder], folder, tmp_path / "out.json", "--fix", tmp_path / "plain.json")
    assert result.exit_code == 0, result.output
    meta = json.loads((tmp_path / "out.json").read_text())["_meta"]
    assert meta["world"] == {"up": None, "origin": "unknown"}


# --- parts ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def in_two(folder: Path, tmp_path: Path) -> Path:
    """The first two cameras recorded the first half, the others the second."""
    copy = Path(shutil.copytree(folder, tmp_path / "in_two"))
    for k, camera in enumerate(cameras_of(copy)):
        images = sorted((camera / "image").iterdir())
        for image in images[4:] if k < 2 else images[:4]:
            image.unlink()
    return copy


def test_a_graph_in_parts_is_solved_in_parts(moved: Simulation, in_two: Path, tmp_path: Path) -> None:
    result = calibrate([in_two], in_two, tmp_path / "out.json")
    assert result.exit_code == 3, result.output
    content = json.loads((tmp_path / "out.json").read_text())
    names = [path.name for path in cameras_of(in_two)]
    assert [name for name in content if not name.startswith("_")] == names[:2]
    (other,) = content["_meta"]["parts"]
    assert [name for name in other if not name.startswith("_")] == names[2:]
    assert other["_meta"]["quality"]["verdict"] in ("good", "usable")
    assert "in a world of their own" in result.output
    write_json(tmp_path / "other.json", other)
    for poses in (read_poses(tmp_path / "out.json"), read_poses(tmp_path / "other.json")):
        i, j = poses
        found, true = (invert_transform(T[i]) @ T[j] for T in (poses, moved.T_world_cam))
        # Four frames of a pair: three times the error of eight frames of four cameras.
        assert pose_distance(found, true)[1] < 1.5e-3
    # Nothing ties the worlds: put into one, they disagree by far more than that.
    a, b = read_poses(tmp_path / "out.json"), read_poses(tmp_path / "other.json")
    together = invert_transform(a[names[0]]) @ b[names[2]]
    true = invert_transform(moved.T_world_cam[names[0]]) @ moved.T_world_cam[names[2]]
    assert pose_distance(together, true)[1] > 0.05


def test_kept_cameras_tie_parts_together(moved: Simulation, folder: Path, in_two: Path, tmp_path: Path) -> None:
    names = [path.name for path in cameras_of(folder)]
    whole = tmp_path / "whole.json"
    assert calibrate([folder], folder, whole).exit_code == 0
    content = json.loads(whole.read_text())
    one_each = {name: {"pose": content[name]["pose"]} for name in (names[0], names[2])}
    write_json(tmp_path / "one_each.json", one_each)
    result = calibrate([in_two], in_two, tmp_path / "out.json", "--fix", tmp_path / "one_each.json")
    assert result.exit_code == 0, result.output
    assert "never see the target together" not in result.output
    poses = read_poses(tmp_path / "out.json")
    assert sorted(poses) == names
    assert max(shift for _, shift in pair_errors(poses, moved.T_world_cam).values()) < 1.5e-3


def test_both_ways_are_repeatable(in_two: Path, tmp_path: Path) -> None:
    for name in ("a.json", "b.json"):
        calibrate([in_two], in_two, tmp_path / name)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert np.isfinite(list(read_poses(tmp_path / "a.json").values())).all()
