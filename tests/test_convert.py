"""The command ``rigcal convert`` as a user meets it: every format, exit codes, one sentence for what is wrong."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from format_rigs import worst_pose_difference
from level_runs import assert_one_sentence

from aruco.errors import InputError
from aruco.model import Camera
from aruco.pose_math import invert_transform
from rigcal.__main__ import main
from rigcal.formats.registry import MODULES, NAMES, cameras_of, detect, format_named, read_rig
from rigcal.formats.rig import ExportOptions, Rig, y_up, y_up_of_z_up, z_up
from rigcal.sources import open_recordings

UPRIGHT = ("zed-fusion", "ros2-launch", "urdf", "nerfstudio")
WITH_LENSES = ("kalibr", "colmap", "nerfstudio", "aniposelib", "open3d")


def convert(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["convert", *(str(argument) for argument in arguments)])


def out_of(name: str, folder: Path) -> Path:
    suffix = {"": "", ".py": ".launch.py"}.get(format_named(name).suffix, format_named(name).suffix)
    return folder / f"rig{suffix}"


@pytest.fixture
def truth(demo_folder: Path, tmp_path: Path) -> Path:
    """A calibration that a test may spoil."""
    return Path(shutil.copy(demo_folder / "truth.json", tmp_path / "truth.json"))


def with_up(path: Path, up: list[int] | None) -> Path:
    content = json.loads(path.read_text())
    content["_meta"]["world"]["up"] = up
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("name", NAMES)
def test_every_format_is_written_and_recognised(name: str, truth: Path, demo_folder: Path, tmp_path: Path) -> None:
    out = out_of(name, tmp_path)
    result = convert(truth, "--to", name, "-o", out, "--recording", demo_folder)
    assert result.exit_code == 0, result.output
    assert f"Wrote 4 cameras to {out}" in result.output
    assert format_named(name).explain in result.output
    assert detect(out).name == name
    ours, theirs = read_rig(truth), read_rig(out)
    if name == "kalibr":  # keeps no world
        first = invert_transform(next(iter(ours.T_world_cam.values())))
        ours = Rig(T_world_cam={camera: first @ T for camera, T in ours.T_world_cam.items()})
    assert worst_pose_difference(ours, theirs) < 1e-12  # some metres, a few products
    # and back
    again = convert(out, "--to", "native", "-o", tmp_path / "again.json")
    assert again.exit_code == 0, again.output
    assert worst_pose_difference(read_rig(tmp_path / "again.json"), theirs) < 1e-12
    if format_named(name).read_cameras:
        recorded = {camera.name: camera for camera in open_recordings([demo_folder]).cameras}
        for camera in cameras_of(out).values():
            # The demo's lenses bend nothing; a principal point that is shifted and shifted back loses a digit.
            np.testing.assert_allclose(camera.K, recorded[camera.name].K, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_y_down_worlds_are_the_same_rig(name: str, truth: Path, demo_folder: Path, tmp_path: Path) -> None:
    """Whichever way y points in the file, cameras stand where they stand, seen from above."""
    ours = read_rig(truth)
    down = Rig(
        T_world_cam={n: np.diag([1.0, -1.0, -1.0, 1.0]) @ T for n, T in ours.T_world_cam.items()},
        up="-y",
        cameras=ours.cameras,
    )
    path, out = tmp_path / "down.json", out_of(name, tmp_path)
    format_named("native").write(down, path, ExportOptions())
    assert convert(path, "--to", name, "-o", out, "--recording", demo_folder).exit_code == 0
    theirs = read_rig(out)
    if theirs.up is None:  # kalibr, colmap: the file's own world, or none
        return
    assert worst_pose_difference(Rig(T_world_cam=y_up(theirs, "test")), ours) < 1e-12
    # The check can fail: y down read as y up is upside down.
    assert worst_pose_difference(down, ours) > 0.5


@pytest.mark.parametrize("name", NAMES)
def test_an_unknown_up_is_refused_where_it_matters(name: str, truth: Path, demo_folder: Path, tmp_path: Path) -> None:
    with_up(truth, None)
    out = out_of(name, tmp_path)
    result = convert(truth, "--to", name, "-o", out, "--recording", demo_folder)
    assert format_named(name).needs_up == (name in UPRIGHT)
    if name in UPRIGHT:
        assert_one_sentence(result, name, "--auto-align")
        assert not out.exists()
    else:
        assert result.exit_code == 0, result.output


@pytest.mark.parametrize("name", NAMES)
def test_missing_intrinsics_are_named_where_they_matter(name: str, truth: Path, tmp_path: Path) -> None:
    out = out_of(name, tmp_path)
    result = convert(truth, "--to", name, "-o", out)
    assert format_named(name).needs_cameras == (name in WITH_LENSES or name == "usd")
    if format_named(name).needs_cameras:
        assert_one_sentence(result, name, "--recording", min(read_rig(truth).T_world_cam))
        assert not out.exists()
    else:
        assert result.exit_code == 0, result.output


def test_z_up_is_a_quarter_turn(truth: Path) -> None:
    for T in read_rig(truth).T_world_cam.values():
        x, y, z = T[:3, 3]
        np.testing.assert_allclose(z_up(T)[:3, 3], [x, -z, y], atol=0)
        np.testing.assert_allclose(y_up_of_z_up(z_up(T)), T, atol=0)


def test_intrinsics_come_from_another_calibration_too(truth: Path, demo_folder: Path, tmp_path: Path) -> None:
    chain = tmp_path / "camchain.yaml"
    assert convert(truth, "--to", "kalibr", "-o", chain, "--recording", demo_folder).exit_code == 0
    result = convert(truth, "--to", "opencv", "-o", tmp_path / "rig.yaml", "--intrinsics", chain)
    assert result.exit_code == 0, result.output
    assert set(cameras_of(tmp_path / "rig.yaml")) == set(read_rig(truth).T_world_cam)


def test_a_recording_of_other_cameras_is_named(truth: Path, demo_folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    shutil.copytree(demo_folder / min(read_rig(truth).T_world_cam), other / "webcam")
    result = convert(truth, "--to", "opencv", "-o", tmp_path / "rig.yaml", "--recording", other)
    assert_one_sentence(result, "has camera webcam", min(read_rig(truth).T_world_cam), "give the recording")
    lens = tmp_path / "left.json"
    lines = (other / "webcam" / "camera_info.yaml").read_text().splitlines()
    lens.write_text("\n".join(line for line in lines if not line.startswith("camera_name")))
    result = convert(truth, "--to", "opencv", "-o", tmp_path / "rig.yaml", "--intrinsics", lens)
    assert_one_sentence(result, "left.json: has camera left", "rename the file")


def test_new_poses_in_a_configuration_are_told_as_such(truth: Path, tmp_path: Path) -> None:
    fusion, one = tmp_path / "fusion.json", tmp_path / "one.json"
    assert convert(truth, "--to", "zed-fusion", "-o", fusion).exit_code == 0
    content = json.loads(fusion.read_text())
    fusion.write_text(json.dumps(dict([content.popitem()])))
    result = convert(truth, "--to", "zed-fusion", "--into", fusion, "-o", one)
    assert result.exit_code == 0, result.output
    assert "4 cameras" not in result.output  # one was written
    assert f"Wrote {one}: {fusion} with new poses for its cameras that the calibration has." in result.output


def test_inputs_are_never_written_to(truth: Path, demo_folder: Path, tmp_path: Path) -> None:
    before = truth.read_bytes()
    link = tmp_path / "link.json"
    link.symlink_to(truth)
    hard = tmp_path / "hard.json"
    os.link(truth, hard)
    for out in (truth, link, hard):
        assert_one_sentence(convert(truth, "--to", "native", "-o", out), "is an input")
    folder = tmp_path / "model"
    assert convert(truth, "--to", "colmap", "-o", folder, "--recording", demo_folder).exit_code == 0
    for out in (folder, folder / "images.txt"):
        assert_one_sentence(convert(folder, "--to", "native", "-o", out), "is an input")
    camera = next(path for path in demo_folder.iterdir() if path.is_dir())
    result = convert(truth, "--to", "tum", "-o", camera / "poses.txt", "--recording", demo_folder)
    assert_one_sentence(result, "camera folder")
    fusion = tmp_path / "fusion.json"
    assert convert(truth, "--to", "zed-fusion", "-o", fusion).exit_code == 0
    assert_one_sentence(convert(truth, "--to", "zed-fusion", "--into", fusion, "-o", fusion), "is an input")
    assert truth.read_bytes() == before


def test_what_a_recording_consists_of_is_not_replaced(truth: Path, tmp_path: Path) -> None:
    video, elsewhere = tmp_path / "vid", tmp_path / "elsewhere"
    video.mkdir()
    elsewhere.mkdir()
    (elsewhere / "c.avi").write_bytes(b"precious")
    (video / "c.avi").symlink_to(elsewhere / "c.avi")
    for name in ("b.avi", "a.yaml", "markers.parquet"):
        (video / name).write_bytes(b"precious")
    for out in (video / "b.avi", video / "c.avi", elsewhere / "c.avi"):
        for recording in (video, video / "b.avi"):
            result = convert(truth, "--to", "opencv", "-o", out, "--recording", recording)
            assert_one_sentence(result, "lies in a recording that is given, or beside it", out.name)
    for name in ("a.yaml", "markers.parquet"):
        result = convert(truth, "--to", "tum", "-o", video / name, "--recording", video / "b.avi")
        assert_one_sentence(result, "lies in a recording that is given, or beside it", name)
    assert {path.read_bytes() for path in video.iterdir()} == {b"precious"}
    assert len(list(video.iterdir())) == 4


@pytest.mark.parametrize("name", NAMES)
def test_an_earlier_output_is_replaced_but_not_in_a_recording(
    name: str, truth: Path, demo_folder: Path, tmp_path: Path
) -> None:
    recording = shutil.copytree(demo_folder, tmp_path / "rec")
    out, inside = out_of(name, tmp_path), out_of(name, recording)
    written = []
    for _ in range(2):
        result = convert(truth, "--to", name, "-o", out, "--recording", recording)
        assert result.exit_code == 0, result.output
        written.append(files_of(out))
    assert written[0] == written[1]
    arguments = (truth, "--to", name, "-o", inside, "--recording", recording)
    assert convert(*arguments).exit_code == 0
    assert_one_sentence(convert(*arguments), inside.name, "lies in a recording that is given, or beside it")
    assert files_of(inside) == written[0]


def files_of(out: Path) -> dict[str, bytes]:
    return {
        path.name.removesuffix(out.suffix): path.read_bytes() for path in ([out] if out.is_file() else out.iterdir())
    }


@pytest.mark.parametrize(("name", "file"), [("native", "truth.json"), ("tum", "groundtruth.txt")])
def test_the_truth_of_a_recording_is_not_replaced(
    name: str, file: str, truth: Path, demo_folder: Path, tmp_path: Path
) -> None:
    """Though it has the format that is written."""
    recording = shutil.copytree(demo_folder, tmp_path / "rec")
    one = Rig(T_world_cam={min(read_rig(truth).T_world_cam): np.eye(4)}, up="+y")
    format_named(name).write(one, recording / file, ExportOptions())
    before = (recording / file).read_bytes()
    result = convert(truth, "--to", name, "-o", recording / file, "--recording", recording)
    assert_one_sentence(result, file, "lies in a recording that is given, or beside it", "remove it")
    assert (recording / file).read_bytes() == before


def test_the_lens_of_a_video_beside_is_not_replaced(tmp_path: Path) -> None:
    camera = Camera(name="right", width=160, height=120, K=np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]]))
    rig = Rig(T_world_cam={"right": np.eye(4)}, up="+y", cameras={"right": camera})
    format_named("native").write(rig, tmp_path / "in.json", ExportOptions())
    video = tmp_path / "vids" / "left.mp4"
    video.parent.mkdir()
    video.write_bytes(b"precious")
    lens = video.with_name("right.yaml")
    format_named("opencv").write(rig, lens, ExportOptions())
    before = lens.read_bytes()
    result = convert(tmp_path / "in.json", "--to", "opencv", "-o", lens, "--recording", video)
    assert_one_sentence(result, "right.yaml: lies in a recording that is given, or beside it")
    assert lens.read_bytes() == before


def test_intrinsics_that_a_recording_was_read_with_are_not_replaced(tmp_path: Path) -> None:
    pytest.importorskip("av")
    from video_writer import moving_images, write_video

    write_video(tmp_path / "left.mp4", moving_images(2))
    camera = Camera(name="left", width=160, height=120, K=np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]]))
    rig = Rig(T_world_cam={"left": np.eye(4)}, up="+y", cameras={"left": camera})
    source, chain = tmp_path / "in.json", tmp_path / "left" / "camera_info.yaml"
    chain.parent.mkdir()
    format_named("native").write(rig, source, ExportOptions())
    format_named("kalibr").write(rig, chain, ExportOptions())
    before = chain.read_bytes()
    arguments = (source, "--to", "kalibr", "-o", chain, "--recording", tmp_path / "left.mp4")
    assert_one_sentence(convert(*arguments), "camera_info.yaml: is an input, where the recording's intrinsics are")
    assert chain.read_bytes() == before
    # Where they are not looked for it is an earlier output like any other.
    result = convert(*arguments, "--intrinsics", source)
    assert result.exit_code == 0, result.output


def test_a_calibration_in_another_format_is_not_replaced(truth: Path, tmp_path: Path) -> None:
    other = Path(shutil.copy(truth, tmp_path / "other.json"))
    before = other.read_bytes()
    for arguments in ((truth, other, "--to", "tum"), (truth, "--to", "tum", "-o", other)):
        assert_one_sentence(convert(*arguments), "other.json: is a calibration in another format (native)", "remove it")
    assert other.read_bytes() == before


def test_the_name_that_writing_passes_through_may_be_an_inputs(truth: Path, tmp_path: Path) -> None:
    source = truth.rename(tmp_path / "x.json.part")
    before = source.read_bytes()
    assert_one_sentence(convert(source, "--to", "tum", "-o", tmp_path / "x.json"), "is in the way", source.name)
    assert source.read_bytes() == before
    assert not (tmp_path / "x.json").exists()


@pytest.mark.parametrize("sign", ["\ud800", "\u2028", "\x85", "\x7f", "/", "\n"])
def test_names_that_cannot_be_printed_are_refused_both_ways(sign: str, tmp_path: Path) -> None:
    name, path = f"a{sign}b", tmp_path / "in.json"
    pose = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
    path.write_text(json.dumps({name: {"pose": pose}}))
    assert_one_sentence(convert(path, "--to", "opencv", "-o", tmp_path / "x.yaml"), "cannot be called", str(path))
    for format_name in ("native", "opencv", "tum"):
        with pytest.raises(InputError, match="cannot be called"):
            format_named(format_name).write(Rig(T_world_cam={name: np.eye(4)}), tmp_path / "out", ExportOptions())
    assert not (tmp_path / "out").exists()


def test_two_cameras_of_one_name_are_told(tmp_path: Path) -> None:
    entry = '"a": {"pose": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"}'
    (tmp_path / "in.json").write_text(f"{{{entry}, {entry}}}")
    assert_one_sentence(convert(tmp_path / "in.json", "--to", "tum", "-o", tmp_path / "x"), "'a' is there twice")
    lens = "  camera_model: pinhole\n  intrinsics: [1]\n"
    (tmp_path / "in.yaml").write_text(f"cam0:\n{lens}cam0:\n{lens}")
    result = convert(tmp_path / "in.yaml", "--to", "tum", "-o", tmp_path / "x")
    assert_one_sentence(result, "line 4: 'cam0' is there twice")


def test_a_failed_conversion_leaves_what_was_there(truth: Path, tmp_path: Path) -> None:
    out = tmp_path / "rig.yaml"
    out.write_text("mine")
    assert_one_sentence(convert(truth, "--to", "kalibr", "-o", out), "--recording")
    assert out.read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rig.yaml", "truth.json"]
    nowhere = tmp_path / "no" / "such" / "place.txt"
    assert_one_sentence(convert(truth, "--to", "tum", "-o", nowhere), "does not exist")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ("--to FORMAT", "RECORDING OUT")),
        (("--explain", "tum", "--every", "2"), ("leave out the rest",)),
        (("--formats", "--same-clock"), ("leave out the rest",)),
        (("truth.json", "--to", "tum", "-o", "x", "--depth-mode", "NEURAL"), ("--depth-mode", "--recording")),
        (("truth.json", "--to", "tum", "-o", "x", "--same-clock"), ("--same-clock", "--recording")),
        (("truth.json",), ("--to FORMAT",)),
        (("truth.json", "--to", "tum"), ("-o",)),
        (("truth.json", "b.json", "c.json", "--to", "tum"), ("one calibration",)),
        (("--to", "tum", "-o", "x"), ("one calibration",)),
        (("truth.json", "--to", "nonsense", "-o", "x"), ("nonsense", "zed-fusion")),
        (("--explain", "nonsense"), ("nonsense", "zed-fusion")),
        (("--explain", "tum", "truth.json"), ("leave out the rest",)),
        (("truth.json", "--to", "tum", "-o", "x", "--every", "2"), ("--every",)),
        (("truth.json", "--to", "tum", "-o", "x", "--no-depth"), ("--no-depth",)),
        (("truth.json", "--to", "tum", "-o", "x", "--into", "y"), ("--into means nothing to tum",)),
        (("truth.json", "--to", "urdf", "-o", "x", "--image-name", "y"), ("--image-name means nothing to urdf",)),
        (("rec", "out", "--recording", "rec"), ("--recording", "--to FORMAT")),
        (("rec", "out", "--frame-name", "{camera}"), ("--frame-name", "--to FORMAT")),
    ],
)
def test_wrong_usage_is_exit_code_2(arguments: tuple[str, ...], words: tuple[str, ...]) -> None:
    assert_one_sentence(convert(*arguments), *words, code=2)


def test_a_calibration_without_a_format_and_a_recording_with_one(
    truth: Path, demo_folder: Path, tmp_path: Path
) -> None:
    assert_one_sentence(convert(truth, tmp_path / "x"), "is a calibration (native)", "--to")
    result = convert(demo_folder / "markers.parquet", "--to", "tum", "-o", tmp_path / "x")
    assert_one_sentence(result, "not a calibration", "without --to")
    assert_one_sentence(convert(tmp_path / "none.json", "--to", "tum", "-o", tmp_path / "x"), "cannot be read")
    assert not (tmp_path / "x").exists()


def test_a_pattern_without_the_camera_is_refused(truth: Path, tmp_path: Path) -> None:
    result = convert(truth, "--to", "urdf", "-o", tmp_path / "x.urdf", "--frame-name", "optical")
    assert_one_sentence(result, "--frame-name", "{camera}")


def test_the_output_may_be_the_last_argument(truth: Path, tmp_path: Path) -> None:
    assert convert(truth, tmp_path / "a.txt", "--to", "tum").exit_code == 0
    assert convert("--to", "tum", truth, "-o", tmp_path / "b.txt").exit_code == 0
    assert (tmp_path / "a.txt").read_bytes() == (tmp_path / "b.txt").read_bytes()


def test_a_recording_is_converted_without_a_format(demo_folder: Path, tmp_path: Path) -> None:
    result = convert(demo_folder, tmp_path / "copy", "--every", 2)
    assert result.exit_code == 0, result.output
    ours, theirs = open_recordings([demo_folder]), open_recordings([tmp_path / "copy"])
    assert [camera.name for camera in theirs.cameras] == [camera.name for camera in ours.cameras]
    name = ours.cameras[0].name
    assert list(theirs.stamps_ns(name)) == list(ours.stamps_ns(name)[::2])


def test_every_format_explains_itself_in_a_line() -> None:
    listing = convert("--formats")
    assert listing.exit_code == 0
    assert [line.split(":")[0] for line in listing.output.splitlines()] == list(NAMES)
    for name in NAMES:
        result = convert("--explain", name)
        assert result.exit_code == 0
        assert result.output == f"{format_named(name).explain}\n"
        assert "metre" in result.output  # units, always
        assert format_named(name).name == name


def test_the_page_on_formats_lists_them_all() -> None:
    page = (Path(__file__).parents[1] / "docs" / "formats.md").read_text(encoding="utf-8")
    for name in NAMES:
        assert f"## {name}\n" in page
        assert f"--to {name} " in page


def test_files_of_any_kind_are_refused_with_a_sentence(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    beginnings = [b"", b"{", b"{}", b"[]", b"<", b"<?xml version='1.0'?><robot/>", b"%YAML:1.0\n---\n", b"#usda 1.0\n"]
    for beginning in beginnings:
        for tail in (b"", rng.bytes(300), b'"pose": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"', b"\xff\xfe\x00", b"[[[" * 5000):
            path = tmp_path / "file"
            path.write_bytes(beginning + tail)
            with pytest.raises(InputError) as caught:
                read_rig(path)
            assert str(path) in str(caught.value)
            assert len(str(caught.value)) < 1000


def test_pipes_and_large_files_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert_one_sentence(convert(tmp_path / "pipe", "--to", "tum", "-o", tmp_path / "x"), "is not a file")
    for name, head in (
        ("a.json", b'{"a": {"pose": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"}, "b": "'),
        ("b.yaml", b"cam0:\n  camera_model: pinhole\n  intrinsics: [1]\n"),
        ("c.txt", b"0 0 0 0 0 0 0 1\n"),
        ("d.toml", b"[cam_0]\nmatrix = [1]\ndistortions = [1]\nsize = [1]\n"),
    ):
        path = tmp_path / name
        path.write_bytes(head)
        os.truncate(path, 2**36)  # holes: no room is taken
        assert_one_sentence(convert(path, "--to", "tum", "-o", tmp_path / "x"), "over", name)


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from click.testing import CliRunner\n"
        "import rigcal.__main__ as m\n"
        "assert CliRunner().invoke(m.main, ['convert', '--help']).exit_code == 0\n"
        "heavy = {'numpy', 'cv2', 'scipy', 'open3d', 'pyarrow', 'h5py', 'plotly', 'rich', 'yaml'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_explaining_a_format_loads_no_optional_package() -> None:
    code = (
        "import sys\n"
        "from rigcal.formats.registry import MODULES, format_named\n"
        "[format_named(name) for name in MODULES]\n"
        "heavy = {'open3d', 'pxr', 'pycolmap', 'evo', 'scipy', 'av', 'mcap', 'rosbags'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert len(MODULES) == 12


def test_a_pattern_of_the_shell_does_not_replace_a_calibration(truth: Path, tmp_path: Path) -> None:
    """``rigcal convert *.json --to native``, of two files."""
    other = tmp_path / "other.json"
    rig = read_rig(truth)
    format_named("native").write(Rig(T_world_cam={"x": np.eye(4)}), other, ExportOptions())
    before = other.read_bytes()
    assert_one_sentence(convert(truth, other, "--to", "native"), "other.json: is a calibration already", "-o")
    assert other.read_bytes() == before
    # Given as the output it is one.
    assert convert(truth, "--to", "native", "-o", other).exit_code == 0
    assert worst_pose_difference(read_rig(other), rig) == 0
