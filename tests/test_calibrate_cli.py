"""The command as a user meets it: results, exit codes, files, and one sentence for every kind of bad input."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result
from level_runs import assert_one_sentence

from aruco.board import board_text
from aruco.marker_geometry import SHIPPED_MAPS, load_faces
from calibrate_extrinsics import main
from rigcal.formats.native import read_poses
from rigcal.quality.truth import pair_errors, tilt_error
from rigcal.sim import Simulation, simulate
from rigcal.sources.camera_info import load_camera_info
from rigcal.sources.rgbd_folder import write_recording

BOX = SHIPPED_MAPS / "standard_box_markers.parquet"


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(a) for a in arguments])


def calibrate(recording: Path, out: Path, *more: object, markers: Path = BOX) -> Result:
    return run("--input", recording, "--markers", markers, "--output", out, *more)


@pytest.fixture
def copy(demo_folder: Path, tmp_path: Path) -> Path:
    """A recording that a test may spoil."""
    return Path(shutil.copytree(demo_folder, tmp_path / "rec"))


def images(recording: Path, camera: int) -> list[Path]:
    folder = sorted(p for p in recording.iterdir() if p.is_dir())[camera] / "image"
    return sorted(folder.iterdir())


def test_poses_agree_with_the_truth_and_up_is_up(demo: Simulation, demo_folder: Path, tmp_path: Path) -> None:
    result = calibrate(demo_folder, tmp_path / "out.json", "--auto-align")
    assert result.exit_code == 0, result.output
    poses = read_poses(tmp_path / "out.json")
    errors = pair_errors(poses, demo.T_world_cam)
    # 640 x 480 at 2 m: a corner error of 0.03 px is 0.15 mm across and some ten times that in depth.
    assert max(distance for _, distance in errors.values()) < 2.5e-3
    assert np.degrees(max(angle for angle, _ in errors.values())) < 0.06
    assert np.degrees(tilt_error(poses, demo.T_world_cam, (0, 1, 0))) < 0.05
    # The tolerance bites: without alignment the world is the box's frame, here turned about the vertical; with Y down
    # it is upside down.
    calibrate(demo_folder, tmp_path / "down.json", "--auto-align", "--up-axis", "-y")
    assert np.degrees(tilt_error(read_poses(tmp_path / "down.json"), demo.T_world_cam, (0, 1, 0))) > 179


def test_same_input_same_bytes_whatever_the_jobs(demo_folder: Path, tmp_path: Path) -> None:
    for name, jobs in (("a.json", 1), ("b.json", 3)):
        assert calibrate(demo_folder, tmp_path / name, "--jobs", jobs).exit_code == 0
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert str(tmp_path) not in (tmp_path / "a.json").read_text()


def test_alignment_off_leaves_the_targets_frame(demo: Simulation, demo_folder: Path, tmp_path: Path) -> None:
    calibrate(demo_folder, tmp_path / "out.json")
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["_meta"]["world"] == {"up": None, "origin": "target"}
    assert "aligned" not in content["_meta"]
    poses = read_poses(tmp_path / "out.json")
    T_target_world = np.linalg.inv(demo.T_world_target[0])
    for name, T in demo.T_world_cam.items():
        # The same accuracy as pairs: 2.5 mm.
        assert np.linalg.norm((T_target_world @ T - poses[name])[:3, 3]) < 2.5e-3


def test_ground_face_by_name_and_by_marker(demo_folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    for option, value in (("--ground-face", "top"), ("--ground-marker-id", 21)):
        result = calibrate(demo_folder, tmp_path / f"{value}.json", "--auto-align", option, value)
        assert result.exit_code == 0, result.output
    a, b = (read_poses(tmp_path / name) for name in ("top.json", "21.json"))
    # Top and bottom give the same axis, and the cameras its sign; about the axis both keep the target's x.
    assert all(np.allclose(a[name], b[name], atol=1e-9) for name in a)


def test_sampling_and_counts(demo_folder: Path, tmp_path: Path) -> None:
    calibrate(demo_folder, tmp_path / "out.json", "--sample-interval", 2)
    meta = json.loads((tmp_path / "out.json").read_text())["_meta"]
    assert meta["sync"]["used"] == 2
    assert meta["provenance"]["options"]["frames"]["sample_interval"] == 2
    calibrate(demo_folder, tmp_path / "one.json", "--max-samples", 1)
    assert json.loads((tmp_path / "one.json").read_text())["_meta"]["sync"]["used"] == 1


def test_preview_writes_a_picture_a_frame(demo_folder: Path, tmp_path: Path) -> None:
    calibrate(demo_folder, tmp_path / "out.json", "--preview")
    assert len(list((tmp_path / "out_preview").rglob("*.jpg"))) == 12


def test_one_bad_frame_is_skipped_counted_and_told(copy: Path, tmp_path: Path) -> None:
    victim = images(copy, 0)[1]
    victim.write_bytes(victim.read_bytes()[:2000])
    images(copy, 1)[0].write_bytes(b"")
    result = calibrate(copy, tmp_path / "out.json")
    assert result.exit_code == 0, result.output
    assert "unreadable" in result.output
    frames = json.loads((tmp_path / "out.json").read_text())["_meta"]["frames"]
    assert [f["unreadable"] for f in frames.values()] == [1, 1, 0, 0]


def test_a_camera_without_readable_frames_is_named_and_the_others_written(copy: Path, tmp_path: Path) -> None:
    for image in images(copy, 2):
        image.write_bytes(b"not an image")
    result = calibrate(copy, tmp_path / "out.json")
    assert result.exit_code == 3, result.output
    assert "no pose: camera 41000003" in result.output
    assert sorted(read_poses(tmp_path / "out.json")) == ["41000001", "41000002", "41000004"]


def test_a_camera_that_never_sees_the_target_is_named(copy: Path, tmp_path: Path) -> None:
    import cv2

    for image in images(copy, 3):
        cv2.imwrite(str(image), np.full((480, 640), 128, np.uint8))
    result = calibrate(copy, tmp_path / "out.json")
    assert result.exit_code == 3
    assert "never sees the target" in result.output


def empty_folder(copy: Path) -> None:
    shutil.rmtree(copy)
    copy.mkdir()


def no_camera_info(copy: Path) -> None:
    next(copy.rglob("camera_info.yaml")).unlink()


def edit_info(old: str, new: str) -> Callable[[Path], None]:
    def edit(copy: Path) -> None:
        info = sorted(copy.rglob("camera_info.yaml"))[0]
        lines = info.read_text().splitlines()
        index = next(i for i, line in enumerate(lines) if old in line)
        text = "\n".join(lines)
        if old == "camera_matrix":
            import yaml

            content = yaml.safe_load(text)
            content["camera_matrix"]["data"][0] = new
            text = yaml.safe_dump(content)
        else:
            lines[index] = new
            text = "\n".join(lines)
        info.write_text(text)

    return edit


def stamps_that_never_meet(copy: Path) -> None:
    for k, camera in enumerate(sorted(p for p in copy.iterdir() if p.is_dir())):
        for image in (camera / "image").iterdir():
            image.rename(image.with_name(f"{int(image.stem) + k * 10**10}{image.suffix}"))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (shutil.rmtree, ("rec",)),
        (empty_folder, ("rec",)),
        (no_camera_info, ("camera_info.yaml",)),
        (edit_info("camera_matrix", "nan"), ("camera_info.yaml",)),
        (edit_info("camera_matrix", "0.0"), ("camera_info.yaml", "positive")),
        (stamps_that_never_meet, ("--sync-tolerance-ms", "ms apart")),
    ],
)
def test_a_spoilt_recording_gets_one_sentence(
    spoil: Callable[[Path], None], words: tuple[str, ...], copy: Path, tmp_path: Path
) -> None:
    spoil(copy)
    assert_one_sentence(calibrate(copy, tmp_path / "out.json"), *words)
    assert not list(tmp_path.glob("out.json*"))


def test_images_of_another_size_are_bad_frames(copy: Path, tmp_path: Path) -> None:
    import cv2

    for image in copy.rglob("*.png"):
        cv2.imwrite(str(image), np.zeros((100, 100), np.uint8))
    assert_one_sentence(calibrate(copy, tmp_path / "out.json"), "100", "640")


def damaged_map(tmp_path: Path, change: Callable[[list[dict]], None], columns: tuple[str, ...] = ()) -> Path:
    rows = pq.read_table(BOX).to_pylist()
    change(rows)
    table = pa.Table.from_pylist(rows)
    path = tmp_path / "map.parquet"
    pq.write_table(table.drop_columns(list(columns)) if columns else table, path)
    return path


def twice(rows: list[dict]) -> None:
    rows[1]["ids"] = rows[0]["ids"]


def not_square(rows: list[dict]) -> None:
    rows[2]["corners"][0][0][0] *= 1.3


def collapsed(rows: list[dict]) -> None:
    rows[2]["corners"][0] = [rows[2]["corners"][0][0]] * 4


def strange_ids(rows: list[dict]) -> None:
    for row in rows:
        row["ids"] = [i + 500 for i in row["ids"]]


@pytest.mark.parametrize(
    ("change", "columns", "words"),
    [
        (twice, (), ("map.parquet", "row 1", "marker 21", "twice")),
        (not_square, (), ("map.parquet", "row 2", "marker 23", "not square")),
        (collapsed, (), ("map.parquet", "row 2", "marker 23", "collapsed")),
        (lambda rows: None, ("corners",), ("map.parquet", "corners")),
        (strange_ids, (), ("521", "23", "--markers")),
    ],
)
def test_a_damaged_map_gets_one_sentence(
    change: Callable[[list[dict]], None],
    columns: tuple[str, ...],
    words: tuple[str, ...],
    demo_folder: Path,
    tmp_path: Path,
) -> None:
    markers = damaged_map(tmp_path, change, columns)
    assert_one_sentence(calibrate(demo_folder, tmp_path / "out.json", markers=markers), *words)
    assert not (tmp_path / "out.json").exists()


def test_a_missing_map_and_a_map_that_is_none(demo_folder: Path, tmp_path: Path) -> None:
    absent = tmp_path / "absent.parquet"
    assert_one_sentence(calibrate(demo_folder, tmp_path / "out.json", markers=absent), "absent.parquet")
    absent.write_text("not parquet")
    assert_one_sentence(calibrate(demo_folder, tmp_path / "out.json", markers=absent), "absent.parquet", "parquet")


def test_the_right_dictionary_is_named(demo_folder: Path, tmp_path: Path) -> None:
    result = calibrate(demo_folder, tmp_path / "out.json", "--aruco-dictionary", "DICT_6X6_250")
    assert_one_sentence(result, "DICT_6X6_250", "DICT_APRILTAG_36h11", "--aruco-dictionary")
    result = calibrate(demo_folder, tmp_path / "out.json", "--aruco-dictionary", "DICT_77")
    assert_one_sentence(result, "DICT_77", "DICT_4X4_50")


def test_unknown_faces_and_markers_are_answered_with_the_known_ones(demo_folder: Path, tmp_path: Path) -> None:
    face = calibrate(demo_folder, tmp_path / "out.json", "--auto-align", "--ground-face", "cellar")
    assert_one_sentence(face, "cellar", "bottom", "top", "front")
    marker = calibrate(demo_folder, tmp_path / "out.json", "--auto-align", "--ground-marker-id", 99)
    assert_one_sentence(marker, "99", "21")


def test_outputs_that_cannot_be_written(demo_folder: Path, tmp_path: Path) -> None:
    assert_one_sentence(calibrate(demo_folder, tmp_path / "no" / "out.json"), "does not exist")
    assert_one_sentence(calibrate(demo_folder, tmp_path), "folder")


def test_inputs_are_never_overwritten(copy: Path, tmp_path: Path) -> None:
    markers = tmp_path / "map.parquet"
    shutil.copy(BOX, markers)
    info = next(copy.rglob("camera_info.yaml"))
    for target in (markers, info, copy / "41000001" / "new.json"):
        assert_one_sentence(calibrate(copy, target, markers=markers), "input")
    assert markers.read_bytes() == BOX.read_bytes()
    assert load_camera_info(info, "x").width == 640


def test_a_link_stays_a_link_and_a_pipe_a_pipe(demo_folder: Path, tmp_path: Path) -> None:
    link, pipe = tmp_path / "link.json", tmp_path / "pipe"
    link.symlink_to(tmp_path / "goal.json")
    assert calibrate(demo_folder, link).exit_code == 0
    assert link.is_symlink()
    assert len(read_poses(tmp_path / "goal.json")) == 4
    os.mkfifo(pipe)
    assert_one_sentence(calibrate(demo_folder, pipe), "pipe")


def test_a_map_that_fits_no_image_is_refused(demo_folder: Path, tmp_path: Path) -> None:
    def swapped(rows: list[dict]) -> None:
        rows[2]["ids"], rows[3]["ids"] = rows[3]["ids"], rows[2]["ids"]

    result = calibrate(demo_folder, tmp_path / "out.json", "--auto-align", markers=damaged_map(tmp_path, swapped))
    assert result.exit_code in (1, 3)
    assert "marker map" in result.output
    assert "Traceback" not in result.output


def test_a_camera_named_like_the_files_own_entries_is_refused(copy: Path, tmp_path: Path) -> None:
    (copy / "41000001").rename(copy / "_meta")
    assert_one_sentence(calibrate(copy, tmp_path / "out.json"), "_meta", "rename")


def test_wrong_usage_is_exit_code_2(demo_folder: Path, tmp_path: Path) -> None:
    assert run("--markers", BOX).exit_code == 2
    assert run("--input", demo_folder).exit_code == 2
    assert calibrate(demo_folder, tmp_path / "o.json", "--sample-interval", 0).exit_code == 2
    assert calibrate(demo_folder, tmp_path / "o.json", "--up-axis", "+z").exit_code == 2


def test_an_svo_says_what_to_do(tmp_path: Path) -> None:
    svo = tmp_path / "rec.svo2"
    svo.write_bytes(bytes(range(256)))
    assert_one_sentence(run("--svo", svo, "--markers", BOX, "-o", tmp_path / "o.json"), "rec.svo2", "ZED SDK")


def test_a_board_in_place_of_a_map(tmp_path: Path) -> None:
    simulation = simulate("board-moved", seed=1, n_frames=6, depth=False)
    write_recording(simulation.recording, tmp_path / "rec", depth=False)
    assert simulation.target.board is not None
    out = tmp_path / "out.json"
    board = board_text(simulation.target.board)
    result = run("--input", tmp_path / "rec", "--board", board, "--moving-target", "-o", out)
    assert result.exit_code == 0, result.output
    errors = pair_errors(read_poses(out), simulation.T_world_cam)
    # Six views of 24 corners at 0.02 px and 3 mm a pixel: a fifth of a millimetre; the issue asks for 1.6 mm at worst.
    assert max(distance for _, distance in errors.values()) < 1e-3
    exchanged = run("--input", tmp_path / "rec", "--board", board.replace("7x5", "5x7"), "-o", tmp_path / "no.json")
    assert_one_sentence(exchanged, "--board")


def test_markers_and_board_together_or_neither_are_wrong_usage(demo_folder: Path) -> None:
    assert run("--input", demo_folder, "--board", "charuco:4x5:1:0.5:DICT_4X4_50", "--markers", BOX).exit_code == 2
    assert run("--input", demo_folder).exit_code == 2


def test_a_target_that_was_moved_asks_for_the_flag(cube3_b: Path, tmp_path: Path) -> None:
    more = ("--aruco-dictionary", "DICT_4X4_50", "--max-samples", 12)
    result = calibrate(cube3_b / "recording", tmp_path / "o.json", *more, markers=cube3_b / "markers.parquet")
    assert_one_sentence(result, "--moving-target")


def test_the_real_cube_agrees_with_its_reference(cube3_b: Path, tmp_path: Path) -> None:
    more = ("--aruco-dictionary", "DICT_4X4_50", "--moving-target")
    result = calibrate(cube3_b / "recording", tmp_path / "o.json", *more, markers=cube3_b / "markers.parquet")
    assert result.exit_code == 0, result.output
    reference = {k: np.array(T) for k, T in json.loads((cube3_b / "reference.json").read_text()).items()}
    errors = pair_errors(read_poses(tmp_path / "o.json"), reference).values()
    # The reference is itself good to about 10 mm; the issue asks for 2 degrees and 15 mm.
    assert max(np.degrees(angle) for angle, _ in errors) < 2
    assert max(distance for _, distance in errors) < 15e-3


def test_help_does_not_load_heavy_packages() -> None:
    code = (
        "import sys\n"
        "from click.testing import CliRunner\n"
        "import calibrate_extrinsics, rigcal.__main__ as m\n"
        "assert CliRunner().invoke(calibrate_extrinsics.main, ['--help']).exit_code == 0\n"
        "assert CliRunner().invoke(m.main, ['--help']).exit_code == 0\n"
        "heavy = {'numpy', 'cv2', 'scipy', 'open3d', 'pyarrow', 'h5py', 'plotly', 'rich', 'yaml'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_shipped_maps_load() -> None:
    assert {face.name for face in load_faces(BOX)} == {"bottom", "back", "top", "front", "left", "right"}


@pytest.mark.parametrize(("spoil", "word"), [(lambda i: i[:, ::-1], "mirrored image"), (lambda i: 255 - i, "inverted")])
def test_mirrored_and_inverted_markers_are_named(
    copy: Path, tmp_path: Path, spoil: Callable[[np.ndarray], np.ndarray], word: str
) -> None:
    for camera in range(4):
        for path in images(copy, camera):
            image = cv2.imread(str(path))
            assert image is not None
            cv2.imwrite(str(path), spoil(image))
    assert_one_sentence(calibrate(copy, tmp_path / "out.json"), word)
