"""One simulated rig in every kind of recording: the commands find the same poses in all of them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import svo2_writer
from bag_writers import Ros, write_bag1, write_bag2
from click.testing import CliRunner, Result
from video_writer import write_video

from aruco.model import Camera, Frame
from aruco.pose_math import Pose
from calibrate_extrinsics import main as calibrate_extrinsics
from rigcal.__main__ import main as rigcal
from rigcal.formats.native import read_poses
from rigcal.quality.truth import pair_errors, tilt_error
from rigcal.sim import Simulation
from rigcal.sources import zed_sdk
from rigcal.sources.camera_info import dump_camera_info, load_camera_info
from rigcal.sources.rgbd_folder import RgbdFolder

# The same pixels and stamps give the same poses but for the rounding of sums.
SAME_M, SAME_RAD = 1e-9, 1e-9
# Video has 219 grey levels instead of 255; their rounding moves corners by some hundredths of a pixel, which is 4 mm.
FILMED_M, FILMED_RAD = 5e-4, 2e-4
# The simulator's noise; what this rig reaches is in docs/accuracy.md.
TRUE_M = 5e-3


def calibrated(demo: Simulation, folder: Path, *inputs: object) -> dict[str, Pose]:
    """Poses that the command writes for a recording of the demo rig."""
    out = folder / "extrinsics.json"
    given = [*inputs, "--markers", folder / "markers.parquet", "--aruco-dictionary", demo.dictionary, "-o", out]
    result = CliRunner().invoke(calibrate_extrinsics, [str(a) for a in given])
    assert result.exit_code == 0, result.output
    poses = read_poses(out)
    errors = pair_errors(poses, demo.T_world_cam)
    assert len(errors) == 6
    assert max(distance for _, distance in errors.values()) < TRUE_M
    return dict(poses)


def convert(*arguments: object) -> Result:
    result = CliRunner().invoke(rigcal, ["convert", *(str(a) for a in arguments)])
    assert result.exit_code == 0, result.output
    return result


def assert_close(found: dict[str, Pose], expected: dict[str, Pose], metres: float, radians: float) -> None:
    assert found.keys() == expected.keys()
    for angle, distance in pair_errors(found, expected).values():
        assert distance < metres
        assert angle < radians


@pytest.fixture
def here(demo_folder: Path, tmp_path: Path) -> Path:
    shutil.copy(demo_folder / "markers.parquet", tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def expected(demo: Simulation, demo_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Pose]:
    folder = tmp_path_factory.mktemp("expected")
    shutil.copy(demo_folder / "markers.parquet", folder)
    return calibrated(demo, folder, "--input", demo_folder)


def films(folder: Path, recording: RgbdFolder) -> Path:
    """A video, intrinsics and a table of stamps for each camera."""
    folder.mkdir()
    for camera in recording.cameras:
        stamps = recording.stamps_ns(camera.name)
        images = [
            np.repeat(frame.image[..., None], 3, axis=2) if frame.image.ndim == 2 else frame.image
            for frame in recording.frames(camera.name, range(len(stamps)))
            if isinstance(frame, Frame)
        ]
        write_video(folder / f"{camera.name}.mp4", images, options={"crf": "0"})
        (folder / f"{camera.name}.yaml").write_text(dump_camera_info(camera))
        rows = "".join(f"{k},{stamp}\n" for k, stamp in enumerate(stamps.tolist()))
        (folder / f"{camera.name}.csv").write_text("frame,timestamp_ns\n" + rows)
    return folder


def test_a_converted_mcap_file_gives_the_same_poses(
    demo: Simulation, demo_folder: Path, expected: dict[str, Pose], here: Path
) -> None:
    said = convert(demo_folder, here / "rig.mcap").output
    assert f"Wrote 12 frames of 4 cameras to {here / 'rig.mcap'}." in said
    assert_close(calibrated(demo, here, "--input", here / "rig.mcap"), expected, SAME_M, SAME_RAD)


def test_a_folder_of_an_mcap_file_is_the_folder_that_it_was_made_of(demo_folder: Path, here: Path) -> None:
    convert(demo_folder, here / "rig.mcap")
    convert(here / "rig.mcap", here / "back")
    for image in demo_folder.glob("*/image/*.png"):
        copy = here / "back" / image.relative_to(demo_folder)
        assert copy.read_bytes() == image.read_bytes()
    for info in demo_folder.glob("*/camera_info.yaml"):
        camera, before = (load_camera_info(path, "c") for path in (here / "back" / info.parent.name / info.name, info))
        np.testing.assert_array_equal(camera.K, before.K)
        np.testing.assert_array_equal(camera.distortion, before.distortion)


@pytest.mark.parametrize("kind", ["bag", "rosbag2"])
def test_a_bag_gives_the_same_poses(
    demo: Simulation, demo_folder: Path, expected: dict[str, Pose], here: Path, kind: str
) -> None:
    ros = Ros(1 if kind == "bag" else 2)
    recording = RgbdFolder(demo_folder)
    messages = []
    for camera in recording.cameras:
        for frame in recording.frames(camera.name, range(len(recording.stamps_ns(camera.name)))):
            assert isinstance(frame, Frame)
            topic = f"/rig/camera_{camera.name}"
            encoding = "mono8" if frame.image.ndim == 2 else "bgr8"
            messages.append(ros.image(f"{topic}/image_raw", frame.stamp_ns, frame.image, encoding))
            size = (camera.width, camera.height)
            messages.append(
                ros.info(f"{topic}/camera_info", frame.stamp_ns, size=size, k=camera.K, d=camera.distortion.tolist())
            )
    messages.sort(key=lambda message: message.log_ns)
    path = write_bag1(here / "rig.bag", messages) if kind == "bag" else write_bag2(here / "rig", messages)
    topics = [
        word
        for camera in recording.cameras
        for word in (
            "--topics",
            f"{camera.name}=/rig/camera_{camera.name}/image_raw,/rig/camera_{camera.name}/camera_info",
        )
    ]
    assert_close(calibrated(demo, here, "--input", path, *topics), expected, SAME_M, SAME_RAD)


def test_videos_give_the_same_poses_whole_or_converted(
    demo: Simulation, demo_folder: Path, expected: dict[str, Pose], here: Path
) -> None:
    folder = films(here / "films", RgbdFolder(demo_folder))
    found = calibrated(demo, here, "--input", folder)
    assert_close(found, expected, FILMED_M, FILMED_RAD)
    one_by_one = [word for path in sorted(folder.glob("*.mp4")) for word in ("--input", path)]
    assert_close(calibrated(demo, here, *one_by_one), found, SAME_M, SAME_RAD)
    for name in ("folder", "rig.mcap"):
        convert(folder, here / name)
        assert_close(calibrated(demo, here, "--input", here / name), found, SAME_M, SAME_RAD)


def test_the_tolerance_of_videos_is_missed_with_other_intrinsics(
    demo: Simulation, demo_folder: Path, expected: dict[str, Pose], here: Path
) -> None:
    folder = films(here / "films", RgbdFolder(demo_folder))
    path = next(iter(sorted(folder.glob("*.yaml"))))
    camera = load_camera_info(path, path.stem)
    K = camera.K.copy()
    K[0, 0] *= 1.001
    K[1, 1] *= 1.001
    path.write_text(dump_camera_info(Camera(name=camera.name, width=camera.width, height=camera.height, K=K)))
    errors = pair_errors(calibrated(demo, here, "--input", folder), expected)
    assert max(distance for _, distance in errors.values()) > FILMED_M


def zed_takes(folder: Path, demo: Simulation, recording: RgbdFolder) -> Path:
    """The rig as ZED cameras would have recorded it: both eyes as they are, and what the accelerometer measured."""
    folder.mkdir()
    (folder / "factory.conf").write_text(svo2_writer.conf_text())
    width, height = svo2_writer.SIZE
    left, _ = svo2_writer.eyes()
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 1, 2).astype(np.float64)
    rays = cv2.undistortPoints(pixels, left.K, left.distortion, R=svo2_writer.R_rect_left()).reshape(height, width, 2)
    for camera in recording.cameras:
        seen = (rays @ camera.K[:2, :2].T + camera.K[:2, 2]).astype(np.float32)
        stamps = recording.stamps_ns(camera.name).tolist()
        pairs = []
        for frame in recording.frames(camera.name, range(len(stamps))):
            assert isinstance(frame, Frame)
            eye = cv2.remap(frame.image, seen[..., 0], seen[..., 1], cv2.INTER_CUBIC)
            pairs.append(np.repeat(np.hstack([eye, eye])[..., None], 3, axis=2))
        up = demo.T_world_cam[camera.name][1, :3]  # of the true world, +Y up, in the camera's axes
        clip = svo2_writer.Clip(pairs=pairs, stamps_ns=stamps, accelerations=[(9.81 * up).tolist()] * 20)
        svo2_writer.write_svo2(folder / f"{camera.name}.svo2", {camera.name: clip})
        (folder / "factory.conf").replace(folder / f"SN{camera.name}.conf")
        (folder / "factory.conf").write_text(svo2_writer.conf_text())
    return folder


def test_zed_takes_without_the_sdk_give_the_same_poses(
    demo: Simulation, demo_folder: Path, expected: dict[str, Pose], here: Path
) -> None:
    if zed_sdk.is_available():
        pytest.skip("the SDK is installed, and would be used")
    folder = zed_takes(here / "takes", demo, RgbdFolder(demo_folder))
    found = calibrated(demo, here, "--svo", folder)
    # Images were resampled twice and compressed once, which moves corners by tenths of a pixel of 8 mm. Leaving out
    # the rectification alone would turn cameras by 0.01 rad.
    assert_close(found, expected, 5e-3, 3e-3)
    convert(folder, here / "rig.mcap")
    assert_close(calibrated(demo, here, "--input", here / "rig.mcap"), found, SAME_M, SAME_RAD)


def test_accelerometers_turn_the_world_upright(demo: Simulation, demo_folder: Path, here: Path) -> None:
    if zed_sdk.is_available():
        pytest.skip("the SDK is installed, and would be used")
    folder = zed_takes(here / "takes", demo, RgbdFolder(demo_folder))
    found = calibrated(demo, here, "--svo", folder, "--auto-align", "--up-from", "imu")
    # Poses of the cameras relative to the target are off by less than this.
    assert tilt_error(found, demo.T_world_cam, (0, 1, 0)) < np.radians(0.1)


def test_recordings_of_several_kinds_are_calibrated_together(
    demo: Simulation, demo_folder: Path, expected: dict[str, Pose], here: Path
) -> None:
    names = sorted(path.name for path in demo_folder.iterdir() if path.is_dir())
    convert(demo_folder / names[0], demo_folder / names[1], here / "two.mcap")
    folder = films(here / "films", RgbdFolder(demo_folder))
    inputs = ["--input", here / "two.mcap", "--input", folder / f"{names[2]}.mp4", "--svo", demo_folder / names[3]]
    assert_close(calibrated(demo, here, *inputs), expected, FILMED_M, FILMED_RAD)


def test_videos_without_stamps_want_to_know_about_their_clocks(demo: Simulation, demo_folder: Path, here: Path) -> None:
    folder = films(here / "films", RgbdFolder(demo_folder))
    for table in folder.glob("*.csv"):
        table.unlink()
    given = ["--input", folder, "--markers", here / "markers.parquet", "--aruco-dictionary", demo.dictionary]
    given += ["-o", here / "extrinsics.json"]
    result = CliRunner().invoke(calibrate_extrinsics, [str(a) for a in given])
    assert result.exit_code == 1
    assert "--same-clock" in result.output
    calibrated(demo, here, "--input", folder, "--same-clock")


def test_a_calibration_says_which_bytes_it_was_made_from(demo: Simulation, demo_folder: Path, here: Path) -> None:
    convert(demo_folder, here / "rig.mcap")
    digests = []
    for recording in (demo_folder, here / "rig.mcap"):
        calibrated(demo, here, "--input", recording)
        digests.append(json.loads((here / "extrinsics.json").read_text())["_meta"]["provenance"])
    assert digests[0] != digests[1]  # files and messages are other bytes, though the pixels are the same


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--every", "3"], "Wrote 4 frames of 4 cameras"),
        (["--depth"], "no camera of the recording has depth"),
        (["--depth-mode", "FILL"], "invents distances"),
    ],
)
def test_options_of_a_conversion(demo_folder: Path, tmp_path: Path, arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(rigcal, ["convert", str(demo_folder), str(tmp_path / "out"), *arguments])
    assert words in result.output
    assert "Traceback" not in result.output
    assert result.exit_code == (0 if words.startswith("Wrote") else 1)


def test_a_recording_is_never_converted_over_itself(demo_folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(demo_folder, tmp_path / "rec"))
    before = sorted((path, path.stat().st_mtime_ns) for path in copy.rglob("*"))
    camera = next(path for path in copy.iterdir() if path.is_dir())
    for out in (copy, camera, camera / "more"):
        result = CliRunner().invoke(rigcal, ["convert", str(copy), str(out)])
        assert result.exit_code == 1, result.output
        assert "Error:" in result.output
    assert sorted((path, path.stat().st_mtime_ns) for path in copy.rglob("*")) == before
