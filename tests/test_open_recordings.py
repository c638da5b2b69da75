"""Opening recordings: chosen by what files hold, joined into one, and one sentence for what cannot be."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from format_rigs import format_rig
from numpy.typing import NDArray

from aruco.errors import InputError, MissingExtraError
from aruco.model import BadFrame, Camera, Frame, KnowsUp
from aruco.pose_math import Array
from rigcal.formats import colmap
from rigcal.formats.rig import ExportOptions
from rigcal.recording_conversion import convert_recording
from rigcal.recordings import options_from, read_cameras
from rigcal.sources import open_recordings, svo2, video, zed_sdk
from rigcal.sources.camera_info import dump_camera_info
from rigcal.sources.joined import JoinedRecording, disagreeing_clocks, joined
from rigcal.sources.options import DEPTH_MODES, SourceOptions
from rigcal.sources.rgbd_folder import RgbdFolder
from rigcal.sources.rosbag2_sqlite import SqliteStore
from rigcal.sources.unknown import KNOWN
from rigcal.sources.zed_player import RefusedError

W, H = 64, 48
K = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])
START_NS = 1_700_000_000_000_000_000
SECOND_NS = 10**9


class Source:
    """A recording in memory."""

    def __init__(self, name: str, start_ns: int = START_NS, n: int = 4) -> None:
        self.cameras = (Camera(name=name, width=W, height=H, K=K),)
        self._stamps = start_ns + SECOND_NS * np.arange(n)

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        return self._stamps

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        return np.arange(0)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        for k in indices:
            yield Frame(camera=camera, stamp_ns=int(self._stamps[k]), image=np.full((H, W), k, dtype=np.uint8))


class Upright(Source):
    """One that measured gravity."""

    def up_in_camera(self, camera: str) -> Array | None:
        return np.array([0.0, -1.0, 0.0])


def rgbd(path: Path, source: Source, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The source as files: an RGB-D folder, or an MCAP file by its name."""
    with monkeypatch.context() as patch:
        patch.setattr("rigcal.recording_conversion.open_recordings", lambda paths, options: source)
        path.parent.mkdir(parents=True, exist_ok=True)
        convert_recording([Path("memory")], path)
    return path


@pytest.fixture
def write(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path, Source], Path]:
    return lambda path, source: rgbd(path, source, monkeypatch)


# Joining


def test_recordings_that_know_up_say_so_when_joined_and_others_do_not() -> None:
    recording = joined([(Path("a"), Upright("a")), (Path("b"), Source("b"))])
    assert isinstance(recording, KnowsUp)
    up = recording.up_in_camera("a")
    assert up is not None
    assert up.tolist() == [0, -1, 0]
    assert recording.up_in_camera("b") is None
    assert joined([(Path("a"), source := Source("a"))]) is source


def test_clocks_that_share_no_moment_are_named_with_both_spans(said: list[str]) -> None:
    opened = [(Path("early"), Source("a")), (Path("late"), Source("b", START_NS + 3600 * SECOND_NS))]
    for pair in (opened, opened[::-1]):
        said.clear()
        joined(pair)
        (sentence,) = said
        assert sentence.startswith(
            "early lasts from 2023-11-14 22:13:20 UTC to 2023-11-14 22:13:23 UTC, but late lasts"
        )
        assert "from 2023-11-14 23:13:20 UTC to" in sentence
        assert "record them at one time and on one clock" in sentence


def test_a_clock_from_zero_beside_one_of_1970_is_told_in_seconds(said: list[str]) -> None:
    joined([(Path("video"), Source("a", 0)), (Path("bag"), Source("b"))])
    (sentence,) = said
    assert sentence.startswith("video lasts from 0.000 s to 3.000 s, but bag lasts from 2023-11-14")


def test_of_many_recordings_only_those_apart_are_named() -> None:
    opened = [(Path(f"r{k}"), Source(f"c{k}", START_NS + k * SECOND_NS)) for k in range(4)]
    assert list(disagreeing_clocks(opened)) == []
    far = (Path("far"), Source("far", START_NS + 10**5 * SECOND_NS))
    empty = (Path("empty"), Source("empty", n=0))
    (sentence,) = disagreeing_clocks([far, empty, *opened])
    assert sentence.startswith("r3 lasts")  # the last to end before it
    assert "far lasts" in sentence


def test_clocks_that_miss_each_other_by_less_than_a_second_are_left_to_pairing() -> None:
    assert not list(disagreeing_clocks([(Path("a"), Source("a", 5, 1)), (Path("b"), Source("b", 6, 1))]))


def test_one_recording_given_twice_is_called_that(write: Callable[[Path, Source], Path], tmp_path: Path) -> None:
    path = write(tmp_path / "one", Source("a"))
    with pytest.raises(InputError, match="one: is given twice; leave one out"):
        open_recordings([path, tmp_path / "." / "one"])


def test_two_cameras_of_one_name_are_refused_with_the_ways_out() -> None:
    ways = r"camera a is in one and in two; give one of them at a time or, if these are two cameras, {}\."

    class Film(Source):
        def file_of(self, camera: str) -> Path:
            return Path("films", f"{camera}.mp4")

    plain, film = (Path("one"), Source("a")), (Path("two"), Film("a"))
    with pytest.raises(InputError, match=ways.format("rename films/a.mp4")):
        JoinedRecording([plain, film])
    # Of a serial number or a topic the name cannot be changed in the file.
    with pytest.raises(InputError, match=ways.format("make one a folder with rigcal convert and rename .* there")):
        JoinedRecording([plain, (Path("two"), Source("a"))])


# Choosing by content


def test_a_recording_is_known_by_its_content_whatever_its_name(
    write: Callable[[Path, Source], Path], tmp_path: Path
) -> None:
    path = write(tmp_path / "take.mcap", Source("cam"))
    for name in ("take", "take.bin", "take.mp4", "take.png"):
        copy = Path(shutil.copy(path, tmp_path / name))
        assert [camera.name for camera in open_recordings([copy]).cameras] == ["cam"]
        copy.unlink()


def test_recordings_of_all_kinds_become_one(write: Callable[[Path, Source], Path], tmp_path: Path) -> None:
    paths = [write(tmp_path / "a", Source("a")), write(tmp_path / "b.mcap", Source("b"))]
    recording = open_recordings(paths)
    assert [camera.name for camera in recording.cameras] == ["a", "b"]
    for name in ("a", "b"):
        (frame,) = recording.frames(name, [2])
        assert isinstance(frame, Frame)
        assert (frame.image == 2).all()


def test_a_folder_of_recordings_of_one_kind_is_joined(write: Callable[[Path, Source], Path], tmp_path: Path) -> None:
    for name in ("a", "b"):
        write(tmp_path / "takes" / f"{name}.mcap", Source(name))
    (tmp_path / "takes" / "notes.txt").write_text("two cameras")
    (tmp_path / "takes" / "c.mcap.part").mkdir()
    assert [camera.name for camera in open_recordings([tmp_path / "takes"]).cameras] == ["a", "b"]


def test_a_folder_of_several_kinds_is_not_guessed_about(write: Callable[[Path, Source], Path], tmp_path: Path) -> None:
    write(tmp_path / "takes" / "a.mcap", Source("a"))
    write(tmp_path / "takes" / "b", Source("b"))
    with pytest.raises(InputError, match=r"several kinds, a\.mcap \(MCAP\), b \(RGB-D folder\); give those"):
        open_recordings([tmp_path / "takes"])


# The ZED SDK, where it is installed


@pytest.fixture
def zed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Readers of ZED files that only note that they were asked."""
    asked: list[str] = []

    def reader(name: str) -> Callable[[Path, SourceOptions], Source]:
        return lambda path, options: asked.append(name) or Source(path.stem)

    monkeypatch.setattr(svo2, "recognises", lambda path, head: path.suffix == ".svo2")
    monkeypatch.setattr(svo2, "opened", reader("svo2"))
    monkeypatch.setattr(zed_sdk, "opened", reader("sdk"))
    monkeypatch.setattr(zed_sdk, "is_available", lambda: False)
    return asked


def put(path: Path, data: bytes = b"\x01\xff" * 9) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def test_svo2_goes_through_the_sdk_only_where_that_is_installed(
    zed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = put(tmp_path / "a.svo2")
    open_recordings([path])
    monkeypatch.setattr(zed_sdk, "is_available", lambda: True)
    open_recordings([path])
    open_recordings([path], SourceOptions(stereo_depth=True))  # the SDK has no such depth
    assert zed == ["svo2", "sdk", "svo2"]


@pytest.mark.parametrize("reason", ["NO_GPU_DETECTED", "CALIBRATION_FILE_NOT_AVAILABLE", "INVALID_SVO_FILE"])
def test_svo2_that_the_sdk_refuses_is_read_without_it(
    zed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: list[str], reason: str
) -> None:
    def refusing(path: Path, options: SourceOptions) -> Source:
        raise RefusedError(f"{path}: the ZED SDK cannot open it ({reason}); do something.")

    monkeypatch.setattr(zed_sdk, "is_available", lambda: True)
    monkeypatch.setattr(zed_sdk, "opened", refusing)
    open_recordings([put(tmp_path / "a.svo2")])
    assert zed == ["svo2"]
    (sentence,) = said
    assert f"a.svo2: the ZED SDK cannot open it ({reason})" in sentence
    assert "read without the SDK" in sentence

    with pytest.raises(InputError, match=reason):  # nobody else reads these
        open_recordings([put(tmp_path / "a.svo")])

    def damaged(path: Path, options: SourceOptions) -> Source:
        raise InputError(f"{path}: damaged")

    monkeypatch.setattr(svo2, "opened", damaged)
    with pytest.raises(InputError, match=r"a\.svo2: damaged"):
        open_recordings([tmp_path / "a.svo2"])


def test_other_errors_of_the_sdk_are_the_users_to_mend(
    zed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(path: Path, options: SourceOptions) -> Source:
        raise InputError("--depth-mode TERRA: no such mode")

    monkeypatch.setattr(zed_sdk, "is_available", lambda: True)
    monkeypatch.setattr(zed_sdk, "opened", wrong)
    with pytest.raises(InputError, match="TERRA"):
        open_recordings([put(tmp_path / "a.svo2")])
    assert zed == []


def test_stereo_depth_of_svo_files_is_said_to_be_the_sdks(zed: list[str], tmp_path: Path, said: list[str]) -> None:
    paths = [put(tmp_path / name) for name in ("a.svo", "b.svo", "c.svo2")]
    open_recordings(paths, SourceOptions(stereo_depth=True))
    assert zed == ["sdk", "sdk", "svo2"]
    (sentence,) = said
    assert f"{paths[0]}, {paths[1]} only the ZED SDK reads, so its own depth is used" in sentence
    said.clear()
    open_recordings(paths)
    open_recordings(paths[2:], SourceOptions(stereo_depth=True))
    assert said == []


def test_one_unnamed_conf_is_not_that_of_two_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    conf = put(tmp_path / "mine.conf", b"[STEREO]")

    class Unread(svo2.Svo2):
        def __init__(self, path: Path, options: SourceOptions) -> None:
            self.source = Source(path.stem)

        @property
        def cameras(self) -> tuple[Camera, ...]:
            return self.source.cameras

        def stamps_ns(self, camera: str) -> NDArray[np.int64]:
            return self.source.stamps_ns(camera)

    monkeypatch.setattr(svo2, "recognises", lambda path, head: path.suffix == ".svo2")
    monkeypatch.setattr(svo2, "opened", Unread)
    monkeypatch.setattr(zed_sdk, "is_available", lambda: False)
    paths = [put(tmp_path / "111.svo2"), put(tmp_path / "222.svo2")]
    open_recordings(paths[:1], SourceOptions(zed_conf=conf))
    with pytest.raises(InputError, match=r"mine\.conf: does not say whose .* 111, 222"):
        open_recordings(paths, SourceOptions(zed_conf=conf))


def test_a_folder_of_svo_files_is_one_recording(zed: list[str], tmp_path: Path) -> None:
    for name in ("a.svo2", "b.svo2", "c.svo"):
        put(tmp_path / "takes" / name)
    put(tmp_path / "takes" / "SN123.conf", b"[STEREO]")
    assert [camera.name for camera in open_recordings([tmp_path / "takes"]).cameras] == ["a", "b", "c"]
    assert zed == ["svo2", "svo2", "sdk"]


def test_an_svo_file_without_the_sdk_names_the_way_out(tmp_path: Path) -> None:
    if zed_sdk.is_available():
        pytest.skip("the SDK is installed")
    with pytest.raises(InputError, match=r"a\.svo: \.svo files are read by the ZED SDK.*install the SDK"):
        open_recordings([put(tmp_path / "a.svo")])


def test_videos_of_all_paths_are_opened_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[list[Path]] = []

    def together(paths: Sequence[Path], options: SourceOptions) -> Source:
        given.append(list(paths))
        return Source("film")

    monkeypatch.setattr(video, "recognises", lambda path, head: head.startswith(b"film"))
    monkeypatch.setattr(video, "opened_together", together)
    paths = [put(tmp_path / name, b"film\xff") for name in ("a/one.mp4", "b/two.mp4", "b/three.mp4")]
    open_recordings([paths[0], tmp_path / "b"])
    assert given == [[paths[0], paths[2], paths[1]]]


def test_what_is_missing_is_said_only_of_what_was_given(
    write: Callable[[Path, Source], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write(tmp_path / "folder", Source("a"))
    mcap = write(tmp_path / "b.mcap", Source("b"))
    for package in ("av", "mcap", "rosbags", "pyzed"):
        for name in [name for name in sys.modules if name.partition(".")[0] == package]:
            monkeypatch.delitem(sys.modules, name)
        monkeypatch.setitem(sys.modules, package, None)
    assert len(open_recordings([folder]).cameras) == 1
    with pytest.raises(InputError, match="is a text file"):
        open_recordings([put(tmp_path / "notes", b"two cameras")])
    with pytest.raises(MissingExtraError, match=r"pip install 'rigcal\[bags\]'"):
        open_recordings([mcap])


# What is no recording


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.svo2", b"", "is empty"),
        ("a.bag", bytes(500), "zero bytes"),
        ("a.png", b"\x89PNG\r\n\x1a\n", "PNG image; give the recording's folder"),
        ("a.jpg", b"\xff\xd8\xff\xe0", "JPEG image; give the recording's folder"),
        ("depth.h5", b"\x89HDF\r\n\x1a\n", "--input-depth"),
        ("box.parquet", b"PAR1\x15", "--markers"),
        ("a.zip", b"PK\x03\x04", "unpack it"),
        ("a.bag.gz", b"\x1f\x8b\x08", "unpack it"),
        ("a.xyz", b"\x00\xff\x13" * 50, "although it is named .xyz; it may be damaged"),
        ("notes", b"two cameras", "is a text file, not a recording"),
        ("camera_info.yaml", b"image_width: 3", "give the folder above"),
        ("kalibr.yaml", b"cam0: {}", "--intrinsics"),
        ("metadata.yaml", b"rosbag2_bagfile_information:", "rosbag2 recording; give its folder"),
    ],
)
def test_other_files_are_told_what_they_look_like(tmp_path: Path, name: str, data: bytes, words: str) -> None:
    path = put(tmp_path / name, data)
    with pytest.raises(InputError) as error:
        open_recordings([path])
    assert str(error.value).startswith(f"{path}: ")
    assert words in str(error.value)
    assert str(error.value).endswith(f"Known recordings: {KNOWN}.")


def test_noise_is_never_taken_for_a_recording(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(30):
        path = put(tmp_path / f"{k}", rng.bytes(int(rng.integers(1, 70_000))))
        with pytest.raises(InputError, match="does not begin like any recording"):
            open_recordings([path])


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="neither a file nor a folder"):
        open_recordings([tmp_path / "pipe"])
    with pytest.raises(InputError, match="no recording there"):
        open_recordings([tmp_path])


def test_looking_for_a_reader_loads_no_package_of_another_format(demo_folder: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from rigcal.sources import open_recordings\n"
        "open_recordings([Path(sys.argv[1])])\n"
        "print(sorted({'av', 'mcap', 'rosbags', 'pyzed', 'zstandard', 'lz4'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code, str(demo_folder)], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


# Options


GIVEN = {
    "depth_mode": "NEURAL",
    "zed_conf": None,
    "stereo_depth": False,
    "topics": (),
    "same_clock": False,
    "intrinsics": None,
}


def test_options_of_the_command_reach_the_readers() -> None:
    given = {
        "depth_mode": "ultra",
        "zed_conf": Path("conf"),
        "stereo_depth": True,
        "topics": ("a=/a",),
        "same_clock": True,
        "intrinsics": Path("k.yaml"),
    }
    options = options_from(given)
    assert {key: getattr(options, key) for key in given} == {**given, "depth_mode": "ULTRA"}
    assert options.read_cameras is read_cameras
    assert {options_from({**GIVEN, "depth_mode": mode}).depth_mode for mode in DEPTH_MODES} == set(DEPTH_MODES)
    assert options_from(GIVEN).depth_mode == SourceOptions().depth_mode


@pytest.mark.parametrize(("mode", "words"), [("FILL", "invents distances"), ("fast", "the ZED SDK has no such mode")])
def test_depth_modes_that_cannot_be_are_refused(mode: str, words: str) -> None:
    with pytest.raises(InputError, match=f"--depth-mode {mode}: .*{words}"):
        options_from({**GIVEN, "depth_mode": mode})


def test_a_ros_file_of_intrinsics_is_one_camera_under_its_own_name(tmp_path: Path) -> None:
    camera = Camera(name="left", width=W, height=H, K=K, distortion=np.array([0.1, 0.2, 0.0, 0.0, 0.3]))
    text = dump_camera_info(camera)
    (tmp_path / "cam0.yaml").write_text(text)
    (found,) = read_cameras(tmp_path / "cam0.yaml").values()
    assert found.name == "left"
    np.testing.assert_array_equal(found.K, K)
    np.testing.assert_array_equal(found.distortion, camera.distortion)
    (tmp_path / "cam0.yaml").write_text(text.replace("camera_name: left\n", ""))
    assert list(read_cameras(tmp_path / "cam0.yaml")) == ["cam0"]


def test_intrinsics_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: no such file"):
        read_cameras(tmp_path / "none.yaml")


def test_a_folder_of_intrinsics_is_a_calibration_or_told_to_be_none(tmp_path: Path) -> None:
    rig = format_rig({"left": "brown", "right": "pinhole"})
    colmap.FORMAT.write(rig, tmp_path / "model", ExportOptions())
    found = read_cameras(tmp_path / "model")
    assert found.keys() == {"left", "right"}
    np.testing.assert_allclose(found["left"].K, rig.cameras["left"].K, atol=1e-12)  # half a pixel forth and back
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: no intrinsics there; give a file of them, a COLMAP text model"):
        read_cameras(tmp_path / "empty")


def test_a_converted_folder_is_read_by_the_plain_reader_too(
    write: Callable[[Path, Source], Path], tmp_path: Path
) -> None:
    assert RgbdFolder(write(tmp_path / "out", Source("a"))).stamps_ns("a")[0] == START_NS


# What a newcomer met


@pytest.mark.parametrize("kind", ["folder", "files"])
def test_a_file_that_is_named_like_a_recording_and_is_none_is_not_passed_over(
    kind: str, write: Callable[[Path, Source], Path], tmp_path: Path, said: list[str]
) -> None:
    """It may be a camera that was lost, and the others alone would look like the whole rig."""
    takes = tmp_path / "takes"
    for name in ("a", "b"):
        write(takes / (name if kind == "folder" else f"{name}.mcap"), Source(name))
    put(takes / "notes.txt", b"to be recorded")
    assert len(open_recordings([takes]).cameras) == 2
    assert said == []
    for name, data, why in (("c.mkv", b"", "is empty"), ("d.mp4", b"to be recorded", "is a text file")):
        path = put(takes / name, data)
        with pytest.raises(InputError, match=f"{name}: {why}.*move it out of the folder"):
            open_recordings([takes])
        path.unlink()
    if hasattr(os, "mkfifo"):
        os.mkfifo(takes / "e.mp4")
        with pytest.raises(InputError, match=r"e.mp4: is no file.*move it out of the folder"):
            open_recordings([takes])


def test_text_named_svo_is_called_text(tmp_path: Path) -> None:
    for name in ("a.svo", "a.svo2"):
        with pytest.raises(InputError, match=f"is a text file, not a recording although it is named {name[1:]}"):
            open_recordings([put(tmp_path / name, b"version https://git-lfs.github.com/spec/v1")])


def cut_off_bag(folder: Path) -> Path:
    """A rosbag2 folder of 40 images of one topic, all of them before the cut, and 40 of another, all behind it."""
    folder.mkdir()
    with closing(sqlite3.connect(folder / "rig.db3")) as base, base:
        base.execute("CREATE TABLE topics (id INTEGER PRIMARY KEY, name, type, serialization_format)")
        base.execute("CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        topics = [(k, f"/{name}/image_raw", "sensor_msgs/msg/Image", "cdr") for k, name in enumerate(("a", "b"))]
        base.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", topics)
        rows = [(k, k // 40, START_NS + k, bytes(5000)) for k in range(80)]
        base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    about = [{"topic_metadata": {"name": name, "type": kind}, "message_count": 40} for _, name, kind, _ in topics]
    bag = {"relative_file_paths": ["rig.db3"], "message_count": 80, "topics_with_message_count": about}
    (folder / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": bag}))  # which is YAML too
    data = (folder / "rig.db3").read_bytes()
    (folder / "rig.db3").write_bytes(data[: len(data) // 3])
    return folder / "rig.db3"


def test_of_a_cut_off_bag_it_is_said_how_much_is_lost_and_which_cameras(tmp_path: Path, said: list[str]) -> None:
    path = cut_off_bag(tmp_path / "bag")
    found = SqliteStore(path).topics["/a/image_raw"].count
    assert 0 < found < 40
    assert said == [
        f"{path}: is damaged or cut off; the {found} of 80 messages that are found are used",
        f"{path}: nothing was found of /b/image_raw (40)",
    ]
    said.clear()
    path.with_name("metadata.yaml").write_text("rosbag2_bagfile_information: [3]")
    SqliteStore(path)
    assert said == [f"{path}: is damaged or cut off; the {found} messages that are found are used"]
