"""Video files as cameras: their times, the frames asked for, what is cut, clocks, intrinsics."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loguru import logger
from video_writer import H264, H265, MJPEG, moving_images, number_of, write_video

from aruco.errors import InputError
from aruco.model import BadFrame, Camera, Frame
from rigcal.sources import open_recordings
from rigcal.sources.camera_info import dump_camera_info, load_camera_info
from rigcal.sources.decoding import import_av
from rigcal.sources.options import SourceOptions
from rigcal.sources.video import VideoFiles, opened, opened_together, recognises
from rigcal.sources.video_index import VideoIndex
from rigcal.sources.video_reader import VideoReader

SIZE = (160, 120)


def camera(name: str, size: tuple[int, int] = SIZE) -> Camera:
    return Camera(name=name, width=size[0], height=size[1], K=np.array([[200, 0, 80], [0, 200, 60], [0, 0, 1]]))


def read_ros(path: Path) -> Mapping[str, Camera]:
    """One camera with the name that follows "camera_name:"."""
    name = path.read_text().split("camera_name:")[1].split()[0]
    return {name: load_camera_info(path, name)}


OPTIONS = SourceOptions(read_cameras=read_ros)


def give_intrinsics(video: Path, size: tuple[int, int] = SIZE) -> Path:
    video.with_suffix(".yaml").write_text(dump_camera_info(camera("made_by_ros", size)))
    return video


def made(path: Path, n: int = 40, **options: Any) -> Path:
    """A video of n images with intrinsics beside it."""
    write_video(path, moving_images(n), **options)
    return give_intrinsics(path)


def seen(recording: VideoFiles, name: str, indices: list[int]) -> list[int | str]:
    frames = list(recording.frames(name, indices))
    assert [frame.stamp_ns for frame in frames] == recording.stamps_ns(name)[indices].tolist()
    return [number_of(frame.image) if isinstance(frame, Frame) else frame.reason for frame in frames]


def n_frames(recording: VideoFiles) -> int:
    return len(recording.stamps_ns(recording.cameras[0].name))


@pytest.fixture
def warnings() -> object:
    """What is logged as a warning."""
    told: list[str] = []
    sink = logger.add(lambda message: told.append(message.record["message"]), level="WARNING")
    yield told
    logger.remove(sink)


KINDS: dict[str, dict[str, Any]] = {
    "plain.mp4": {},
    "h264.mp4": {"b_frames": 3},
    "hevc.mp4": {"codec": H265, "b_frames": 3},
    "open.mkv": {"b_frames": 3, "open_gop": True},
    "open_hevc.mkv": {"codec": H265, "b_frames": 3, "open_gop": True},
    "fragments.mp4": {"container": {"movflags": "frag_keyframe+empty_moov"}},
    "mjpeg.avi": {"codec": MJPEG, "pixels": "yuvj420p"},
    "stream.ts": {"b_frames": 2},
    "mpeg2.ts": {"codec": "mpeg2video"},
    "vp9.webm": {"codec": "libvpx-vp9"},
    # No key pictures but the first: the image is refreshed column by column.
    "refresh.mkv": {"options": {"x264-params": "intra-refresh=1:keyint=10:bframes=0:log-level=none"}},
}


@pytest.mark.parametrize("name", list(KINDS))
def test_any_frame_of_any_container_is_the_one_asked_for(tmp_path: Path, name: str) -> None:
    path = made(tmp_path / name, **KINDS[name])
    assert recognises(path, path.read_bytes()[: 64 * 1024])
    recording = opened(path, OPTIONS)
    assert [known.name for known in recording.cameras] == [path.stem]
    stamps = recording.stamps_ns(path.stem)
    np.testing.assert_array_equal(stamps - stamps[0], np.arange(40) * 40_000_000)
    assert seen(recording, path.stem, list(range(40))) == list(range(40))
    for indices in ([0, 30], [39], [9, 10, 11], [8, 9], [19, 20], [5, 35, 36], []):
        assert seen(recording, path.stem, indices) == indices
    assert len(recording.depth_indices(path.stem)) == 0


def test_the_clock_of_a_file_is_kept_with_irregular_frames(tmp_path: Path) -> None:
    stamps_ms = [0, 33, 70, 71, 500, 2000, 2001, 2100, 90_000, 90_040]
    write_video(tmp_path / "a.mkv", moving_images(10), stamps_ms=stamps_ms, b_frames=2)
    recording = opened(give_intrinsics(tmp_path / "a.mkv"), OPTIONS)
    assert recording.stamps_ns("a").tolist() == [ms * 1_000_000 for ms in stamps_ms]
    assert seen(recording, "a", list(range(10))) == list(range(10))


def test_times_become_whole_nanoseconds_without_loss(tmp_path: Path) -> None:
    index = VideoIndex.read(made(tmp_path / "a.mp4", n=4))
    index.ticks[:] = 2**53 // 10_000 + np.arange(4)  # a time in nanoseconds that a float does not hold
    base = Fraction(1, 90_000)
    object.__setattr__(index, "time_base", base)
    assert index.stamps_ns().tolist() == [round(int(tick) * base * 10**9) for tick in index.ticks]
    index.ticks[3] = 2**62
    with pytest.raises(InputError, match="beyond any clock"):
        index.stamps_ns()


def test_a_frame_has_the_digest_of_its_packet(tmp_path: Path) -> None:
    path = made(tmp_path / "a.mp4", b_frames=2)
    with import_av().open(str(path)) as container:
        packets = {packet.pts: bytes(packet) for packet in container.demux(video=0) if packet.size}
    digests = [hashlib.sha256(packets[pts]).hexdigest() for pts in sorted(packets)]
    frames = list(opened(path, OPTIONS).frames("a", [3, 17, 18]))
    assert [frame.digest for frame in frames if isinstance(frame, Frame)] == [digests[i] for i in (3, 17, 18)]


@pytest.mark.parametrize(("every", "most"), [(30, 5), (40, 38)])
def test_sampling_decodes_only_what_it_needs(tmp_path: Path, every: int, most: int) -> None:
    """Every 30th of 150 frames: where key pictures fall together with them nothing else, else about half of the way."""
    path = made(tmp_path / "long.mp4", n=150, codec=H265, b_frames=3, key_every=every)
    recording = opened(path, OPTIONS)
    wanted = list(range(0, 150, 30))
    assert seen(recording, "long", wanted) == wanted
    index = VideoIndex.read(path)
    with VideoReader(index) as reader:
        for run in index.runs([int(index.frames[i]) for i in wanted]):
            list(reader.pictures(run, {}))
        # From the first frame on it would be 121 pictures, from the last key pictures 31 + 21 + 11 + 1 = 64.
        assert len(wanted) <= reader.decoder.n_decoded <= most


def test_wanted_frames_of_one_group_are_decoded_in_one_go(tmp_path: Path) -> None:
    index = VideoIndex.read(made(tmp_path / "a.mp4", b_frames=2, key_every=20))
    runs = list(index.runs([int(index.frames[i]) for i in (2, 5, 19, 20, 33)]))
    assert [(run.start, len(run.packets)) for run in runs] == [(0, 3), (20, 2)]


def test_opening_decodes_no_more_than_the_first_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = made(tmp_path / "a.mp4", n=60)

    def fail(*_: object) -> None:
        raise AssertionError("decoded while opening")

    monkeypatch.setattr("rigcal.sources.decoding.PacketDecoder.decoded", fail)
    assert n_frames(opened(path, OPTIONS)) == 60


# What is cut, damaged or odd.


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_cut_mp4_without_index_says_that_nothing_can_be_read_and_why(tmp_path: Path, share: float) -> None:
    path = made(tmp_path / "a.mp4")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(InputError, match=r"a\.mp4: nothing of it can be read, .*index \(moov\) is missing"):
        opened(path, OPTIONS)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.mkv", {"codec": H265}),
        ("a.ts", {}),
        ("a.avi", {"codec": MJPEG, "pixels": "yuvj420p"}),
        ("a.mp4", {"container": {"movflags": "faststart"}}),
        ("f.mp4", {"container": {"movflags": "frag_keyframe+empty_moov"}}),
    ],
)
def test_of_other_cut_files_the_whole_part_is_used_and_the_loss_told(
    tmp_path: Path, name: str, options: dict[str, Any], warnings: list[str]
) -> None:
    path = made(tmp_path / name, **options)
    data = path.read_bytes()
    cut = int(0.6 * len(data)) // 188 * 188 + 100
    path.write_bytes(data[:cut])
    recording = opened(path, OPTIONS)
    n = n_frames(recording)
    assert 15 < n < 35
    found = seen(recording, path.stem, list(range(n)))
    assert found[: n - 1] == list(range(n - 1))  # of the last a part may be there
    (told,) = warnings
    assert f"is cut off at byte {cut}" in told
    assert f"the {n} frames before that, up to" in told


def test_a_stream_that_begins_in_the_middle_begins_with_its_first_key_picture(
    tmp_path: Path, warnings: list[str]
) -> None:
    path = made(tmp_path / "a.ts")
    path.write_bytes(path.read_bytes()[14 * 188 :])
    recording = opened(path, OPTIONS)
    assert seen(recording, "a", list(range(n_frames(recording)))) == list(range(10, 40))
    assert any("lack the key picture" in told for told in warnings)


def test_a_gap_in_a_stream_harms_its_group_only(tmp_path: Path) -> None:
    path = made(tmp_path / "a.ts")
    data = bytearray(path.read_bytes())
    del data[20 * 188 : 23 * 188]
    path.write_bytes(data)
    recording = opened(path, OPTIONS)
    found = seen(recording, "a", list(range(n_frames(recording))))
    reasons = [reason for reason in found if isinstance(reason, str)]
    assert 1 <= len(reasons) <= 9
    assert all("damaged" in reason or "not wholly" in reason for reason in reasons)
    assert [number for number in found if isinstance(number, int)][-30:] == list(range(10, 40))


@pytest.mark.parametrize("content", [b"", b"\x00\x00\x00\x18ftypisom" + bytes(100), b"\x1a\x45\xdf\xa3" + bytes(5000)])
def test_rubbish_is_refused_with_a_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mp4: .*record"):
        opened(give_intrinsics(path), OPTIONS)


def test_damaged_files_never_raise_anything_else(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    kinds: dict[str, dict[str, Any]] = {"a.mp4": {"b_frames": 2}, "a.mkv": {"codec": H265}, "a.ts": {}}
    for name, options in kinds.items():
        path = made(tmp_path / name, n=20, **options)
        whole = path.read_bytes()
        for _ in range(40):
            data = bytearray(whole)
            for at in rng.integers(0, len(data), 6):
                data[at : at + 4] = rng.bytes(4)
            path.write_bytes(data)
            try:
                recording = opened(path, OPTIONS)
            except InputError:
                continue
            stamps = recording.stamps_ns("a")
            assert (np.diff(stamps) > 0).all()
            assert len(list(recording.frames("a", range(len(stamps))))) == len(stamps)


def test_frames_before_the_start_of_an_edit_list_are_not_shown(tmp_path: Path) -> None:
    path = made(tmp_path / "a.mp4", b_frames=2)
    data = bytearray(path.read_bytes())
    at = data.find(b"elst") + 16  # the media time at which the only edit begins
    (media_time,) = struct.unpack_from(">i", data, at)
    struct.pack_into(">i", data, at, media_time + 13 * 512)  # 512 ticks a frame: in the middle of the second group
    path.write_bytes(data)
    recording = opened(path, OPTIONS)
    assert seen(recording, "a", list(range(27))) == list(range(13, 40))
    assert recording.stamps_ns("a").tolist() == [i * 40_000_000 for i in range(27)]


def test_times_below_zero_are_kept(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mkv", moving_images(4), stamps_ms=[0, 40, 80, 120])
    index = VideoIndex.read(tmp_path / "a.mkv")
    index.ticks[:] -= 100
    assert index.stamps_ns().tolist() == [-100_000_000, -60_000_000, -20_000_000, 20_000_000]


def test_pictures_out_of_order_without_times_are_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", moving_images(20), b_frames=2)
    write_video(tmp_path / "b.h264", moving_images(20), b_frames=2)
    for name in ("a.avi", "b.h264"):
        with pytest.raises(InputError, match=rf"{name}: its pictures are stored out of order .*MKV or MP4"):
            opened(give_intrinsics(tmp_path / name), OPTIONS)


def test_a_bare_stream_wants_a_table_of_times(tmp_path: Path) -> None:
    path = made(tmp_path / "a.h265", n=12, codec=H265)
    assert recognises(path, path.read_bytes()[: 64 * 1024])
    with pytest.raises(InputError, match=r"does not say when its frames were taken; put a\.csv"):
        opened(path, OPTIONS)
    (tmp_path / "a.csv").write_text("timestamp_ms\n" + "".join(f"{1000 + 50 * i}\n" for i in range(12)))
    recording = opened(path, OPTIONS)
    assert recording.stamps_ns("a")[:2].tolist() == [1_000_000_000, 1_050_000_000]
    assert seen(recording, "a", [0, 7, 11]) == [0, 7, 11]


def test_a_clock_that_begins_anew_is_refused(tmp_path: Path) -> None:
    data = made(tmp_path / "a.ts", n=40).read_bytes()
    (tmp_path / "a.ts").write_bytes(data + data)
    with pytest.raises(InputError, match=r"its clock jumps back from .*split it"):
        opened(tmp_path / "a.ts", OPTIONS)


def test_a_size_that_changes_is_refused_frame_by_frame(tmp_path: Path) -> None:
    write_video(tmp_path / "a.ts", moving_images(10))
    write_video(tmp_path / "b.ts", moving_images(10, (320, 240)), stamps_ms=[5000 + 40 * i for i in range(10)])
    (tmp_path / "a.ts").write_bytes((tmp_path / "a.ts").read_bytes() + (tmp_path / "b.ts").read_bytes())
    frames = list(opened(give_intrinsics(tmp_path / "a.ts"), OPTIONS).frames("a", range(20)))
    assert all(isinstance(frame, Frame) for frame in frames[:8])
    assert all(isinstance(frame, BadFrame) and "is 320 x 240 where 160 x 120" in frame.reason for frame in frames[10:])


def test_an_absurd_size_is_refused_before_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = made(tmp_path / "a.mp4")
    monkeypatch.setattr("rigcal.sources.video_container.MAX_PIXELS", 160 * 120 - 1)
    with pytest.raises(InputError, match="says that it is 160 x 120, which is not a camera's image"):
        opened(path, OPTIONS)


def test_too_many_frames_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = made(tmp_path / "a.mp4")
    monkeypatch.setattr("rigcal.sources.video_index.MAX_PACKETS", 39)
    with pytest.raises(InputError, match="more than 39 frames"):
        opened(path, OPTIONS)


def test_images_stay_as_stored_and_the_rotation_is_named(tmp_path: Path, warnings: list[str]) -> None:
    path = made(tmp_path / "a.mp4", turned_deg=90)
    assert seen(opened(path, OPTIONS), "a", [0, 21]) == [0, 21]
    assert warnings == [
        f"{path}: players turn it by 90 degrees; its images stay as stored, 160 x 120, and need intrinsics of that size"
    ]
    give_intrinsics(path, (120, 160))
    with pytest.raises(InputError, match=r"120 x 160, but a\.mp4 has 160 x 120; they are of turned images"):
        opened(path, OPTIONS)


def test_interlaced_videos_are_told_of(tmp_path: Path, warnings: list[str]) -> None:
    path = made(tmp_path / "a.mp4", options={"x264-params": "interlaced=1:tff=1:log-level=none"})
    opened(path, OPTIONS)
    assert "is interlaced" in warnings[0]


@pytest.mark.parametrize(
    ("head", "is_video"),
    [
        (b"\x00\x00\x00\x18ftypmp42", True),
        (b"\x00\x00\x00\x18ftypheic", False),
        (b"\x1a\x45\xdf\xa3", True),
        (b"RIFF\x00\x00\x00\x00AVI LIST", True),
        (b"RIFF\x00\x00\x00\x00WAVEfmt ", False),
        ((b"\x47" + bytes(187)) * 3, True),
        ((bytes(4) + b"\x47" + bytes(187)) * 3, True),
        (b"G" * 3 + bytes(500), False),
        (b"\x00\x00\x00\x01\x67", True),
        (b"\x89PNG\r\n\x1a\n", False),
        (b"\x89MCAP0\r\n", False),
        (b"#ROSBAG V2.0\n", False),
        (b"", False),
    ],
)
def test_videos_are_known_by_their_first_bytes(head: bytes, is_video: bool) -> None:
    assert recognises(Path("any"), head) is is_video


# Several, and their clocks.


@pytest.fixture
def two(tmp_path: Path) -> list[Path]:
    return [made(tmp_path / "left.mp4", n=12), made(tmp_path / "right.mkv", n=12, codec=H265)]


def test_clocks_of_several_videos_must_be_known(two: list[Path]) -> None:
    with pytest.raises(InputError, match=r"left\.mp4, right\.mkv: .*--same-clock .*left\.csv"):
        opened_together(two, OPTIONS)
    recording = opened_together(two, SourceOptions(read_cameras=read_ros, same_clock=True))
    assert [known.name for known in recording.cameras] == ["left", "right"]
    np.testing.assert_array_equal(recording.stamps_ns("left"), recording.stamps_ns("right"))
    assert seen(recording, "right", [3]) == [3]
    with pytest.raises(InputError, match="no camera up among the videos; they are left, right"):
        recording.stamps_ns("up")
    opened(two[0], OPTIONS)  # one alone has no clock to compare with


def test_one_moment_is_that_of_the_first_pictures_whatever_the_container(tmp_path: Path) -> None:
    containers: dict[str, dict[str, Any]] = {
        "a.mp4": {},
        "b.ts": {},
        "c.mp4": {"container": {"movflags": "frag_keyframe+empty_moov"}},
    }
    paths = [made(tmp_path / name, n=12, b_frames=2, **more) for name, more in containers.items()]
    # The containers do not agree by themselves.
    assert len({int(opened(path, OPTIONS).stamps_ns(path.stem)[0]) for path in paths}) > 1
    recording = opened_together(paths, SourceOptions(read_cameras=read_ros, same_clock=True))
    for path in paths:
        np.testing.assert_array_equal(recording.stamps_ns(path.stem), np.arange(12) * 40_000_000)


def test_tables_of_different_clocks_are_told_by_file(two: list[Path], warnings: list[str]) -> None:
    for name, start_ns in (("left", 0), ("right", 1_700_000_000 * 10**9)):
        rows = "".join(f"{start_ns + 40_000_000 * i}\n" for i in range(12))
        (two[0].parent / f"{name}.csv").write_text("timestamp_ns\n" + rows)
    open_recordings(two, OPTIONS)
    (sentence,) = warnings
    assert sentence.startswith(f"{two[0]} lasts from 0.000 s to 0.440 s, but {two[1]} lasts from 2023-11-14")


def test_tables_of_times_tell_the_clock(two: list[Path]) -> None:
    start_ns = 1_700_000_000_123_456_789
    (two[0].parent / "left.csv").write_text(
        "frame,timestamp_ns\n" + "".join(f"{i},{start_ns + i}\n" for i in range(12))
    )
    with pytest.raises(InputError, match=r"right\.mkv: no table of time stamps, while others have one"):
        opened_together(two, SourceOptions(read_cameras=read_ros, same_clock=True))
    rows = "".join(f"1700000000.{123456789 + 1000 * i:09d};{i}\n" for i in range(12))
    (two[0].parent / "right_timestamps.csv").write_text("Time Stamp [s]; index\n" + rows)
    recording = opened_together(two, OPTIONS)
    assert recording.stamps_ns("left").tolist() == [start_ns + i for i in range(12)]
    assert recording.stamps_ns("right").tolist() == [start_ns + 1000 * i for i in range(12)]


def test_one_table_can_serve_several(two: list[Path]) -> None:
    rows = [f"{name},{i},{i * 50_000 + shift}" for i in range(12) for name, shift in (("left", 0), ("right", 7))]
    (two[0].parent / "timestamps.csv").write_text("camera,frame,stamp_us\n" + "\n".join(rows) + "\n\n")
    recording = opened_together(two, OPTIONS)
    assert recording.stamps_ns("right").tolist() == [i * 50_000_000 + 7000 for i in range(12)]
    (two[0].parent / "timestamps.csv").write_text("stamp_us\n" + "".join(f"{i}\n" for i in range(12)))
    with pytest.raises(InputError, match="add a column camera"):
        opened_together(two, OPTIONS)
    assert opened(two[0], OPTIONS).stamps_ns("left").tolist() == [1000 * i for i in range(12)]


def test_frames_without_a_row_are_left_out(two: list[Path], warnings: list[str]) -> None:
    kept = [0, 1, 4, 5, 11]
    table = two[0].with_suffix(".csv")
    table.write_text("frame,timestamp_ns\n" + "".join(f"{i},{100 * i}\n" for i in kept))
    recording = opened(two[0], OPTIONS)
    assert recording.stamps_ns("left").tolist() == [100 * i for i in kept]
    assert seen(recording, "left", [0, 1, 2, 3, 4]) == kept
    assert "7 frames of the video have no row" in warnings[0]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("timestamp\n1\n", "column 'timestamp' does not say its unit; call it timestamp_ns"),
        ("frame,time_fortnights\n0,1\n", "does not say its unit"),
        ("x,y\n1,2\n", "wants one column of times"),
        ("stamp_ns,time_s\n1,2\n", "wants one column of times"),
        ("", "wants one column of times"),
        ("stamp_ns\n1\n2\n", "has 2 rows, but the video has 12 frames; add a column frame"),
        ("frame,stamp_ns\n12,1\n", "up to frame 12, but the video has 12 frames; number them from 0"),
        ("frame,stamp_ns\n-1,1\n", "row 2 has the frame '-1'"),
        ("frame,stamp_ns\n0,1\n0,2\n", "two rows for frame 0"),
        ("frame,stamp_ns\n0,5\n1,5\n", "frame 1 is not later than the one before"),
        ("frame,stamp_ns\n0,soon\n", "row 2 has the time 'soon'"),
        ("frame,stamp_ns\n0,nan\n", "row 2 has the time 'nan'"),
        ("frame,stamp_s\n0,1e999999999\n", "which no clock shows"),
        ("frame,stamp_ns\n0\n", "row 2 has only 1 columns"),
        ("frame,stamp_ns\n", "has no row for left"),
        ("frame,stamp_ns\n0," + "1" * 5000 + "\n", "over 4096 characters"),
        ("\xff\xfe\x00", "cannot be read as a CSV table"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_with_a_sentence(two: list[Path], text: str, complaint: str) -> None:
    table = two[0].with_suffix(".csv")
    table.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError) as caught:
        opened(two[0], OPTIONS)
    assert str(caught.value).startswith(f"{table}: ")
    assert complaint in str(caught.value)


def test_of_a_cut_video_the_rest_of_the_table_is_not_needed(tmp_path: Path, warnings: list[str]) -> None:
    path = made(tmp_path / "a.mkv", n=40)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (tmp_path / "a.csv").write_text("time_ms\n" + "".join(f"{500 + i}\n" for i in range(40)))
    recording = opened(path, OPTIONS)
    n = n_frames(recording)
    assert 10 < n < 30
    assert recording.stamps_ns("a").tolist() == [(500 + i) * 1_000_000 for i in range(n)]
    assert f"{40 - n} rows have no frame" in warnings[-1]


# Names and intrinsics.


def test_two_cameras_of_one_name_are_refused(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "cam.mp4").touch()
    with pytest.raises(InputError, match=r"camera cam is .*a/cam\.mp4 and .*b/cam\.mp4"):
        opened_together([tmp_path / "a/cam.mp4", tmp_path / "b/cam.mp4"], OPTIONS)


def test_a_name_that_leads_elsewhere_is_refused(tmp_path: Path) -> None:
    (tmp_path / "...mp4").touch()
    with pytest.raises(InputError, match=r"a folder cannot have this name"):
        opened(tmp_path / "...mp4", OPTIONS)


def test_missing_intrinsics_name_the_option_and_the_formats(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", moving_images(3))
    with pytest.raises(InputError, match=r"a\.mp4: no intrinsics .*--intrinsics FILE .*Kalibr.*as a\.yaml"):
        opened(tmp_path / "a.mp4", OPTIONS)


@pytest.mark.parametrize(
    "name", ["a.yml", "a.xml", "a.json", "a.toml", "a/camera_info.yaml", "camera_info.yaml", "intrinsics.json",
             "camchain-rig.yaml", "calibration.toml"],
)  # fmt: skip
def test_intrinsics_are_found_beside_a_video(tmp_path: Path, name: str) -> None:
    write_video(tmp_path / "a.mp4", moving_images(3))
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).touch()
    options = SourceOptions(read_cameras=lambda path: {"other": camera("other")} if path == tmp_path / name else {})
    (found,) = opened(tmp_path / "a.mp4", options).cameras
    assert found.name == "a"
    np.testing.assert_array_equal(found.K, camera("a").K)


def test_intrinsics_of_several_go_by_name(two: list[Path], tmp_path: Path) -> None:
    for path in two:
        path.with_suffix(".yaml").unlink()
    given = tmp_path / "rig.toml"
    given.touch()
    cameras = {"left": camera("left"), "cam1": camera("cam1")}
    options = SourceOptions(read_cameras=lambda _: cameras, same_clock=True, intrinsics=given)
    with pytest.raises(InputError, match=r"rig\.toml has cam1, left, none of which is called right"):
        opened_together(two, options)
    # A single camera may be meant for a single video, but not for two.
    del cameras["left"]
    with pytest.raises(InputError, match="has cam1, none of which is called left"):
        opened_together(two, options)
    assert opened(two[0], options).cameras[0].name == "left"
    cameras["right"] = camera("right")
    cameras["left"] = camera("left")
    assert [known.name for known in opened_together(two, options).cameras] == ["left", "right"]


def test_what_the_user_gives_comes_before_what_lies_beside(two: list[Path], tmp_path: Path) -> None:
    given = tmp_path / "given.yaml"
    options = SourceOptions(read_cameras=read_ros, intrinsics=given)
    given.write_text(dump_camera_info(camera("any", (320, 240))))
    with pytest.raises(InputError, match=r"given\.yaml: the intrinsics are of images of 320 x 240, but left\.mp4 has"):
        opened(two[0], options)
    given.write_text("rubbish: camera_name: a")
    with pytest.raises(InputError, match=r"given\.yaml"):
        opened(two[0], options)
    folder = tmp_path / "folder"
    folder.mkdir()
    give_intrinsics(folder / "left.mp4", (320, 240))
    with pytest.raises(InputError, match=r"folder/left\.yaml"):
        opened(two[0], SourceOptions(read_cameras=read_ros, intrinsics=folder))


def test_a_folder_that_is_a_calibration_gives_the_intrinsics(two: list[Path], tmp_path: Path) -> None:
    model = tmp_path / "model"
    model.mkdir()
    cameras = {"left": camera("left"), "right": camera("right")}
    options = SourceOptions(read_cameras=lambda path: {model: cameras}[path], same_clock=True, intrinsics=model)
    assert [known.name for known in opened_together(two, options).cameras] == ["left", "right"]
    del cameras["right"]
    with pytest.raises(
        InputError, match=r"right\.mkv: .* in what --intrinsics gives \(.*model has left, none .* right\)"
    ):
        opened_together(two, options)

    def refuse(path: Path) -> Mapping[str, Camera]:
        raise InputError(f"{path}: no intrinsics there.")

    with pytest.raises(InputError, match=r"model: no intrinsics there\."):
        opened_together(two, SourceOptions(read_cameras=refuse, same_clock=True, intrinsics=model))


def test_files_of_equal_rank_beside_a_video_are_not_chosen_among(tmp_path: Path) -> None:
    write_video(tmp_path / "a.mp4", moving_images(3))
    known = {tmp_path / "camchain.yaml": {"a": camera("a")}, tmp_path / "camchain-2.yaml": {"a": camera("b")}}
    for path in known:
        path.touch()
    options = SourceOptions(read_cameras=lambda path: known[path])
    assert opened(tmp_path / "a.mp4", options).cameras[0].name == "a"  # they say the same
    K = camera("a").K.copy()
    K[0, 0] += 1
    known[tmp_path / "camchain-2.yaml"] = {"a": replace(camera("a"), K=K)}
    with pytest.raises(
        InputError, match=r"a\.mp4: camchain-2\.yaml and camchain\.yaml .* different .*--intrinsics FILE"
    ):
        opened(tmp_path / "a.mp4", options)
    # Of the one that has the camera there is no doubt.
    known[tmp_path / "camchain-2.yaml"] = {"b": replace(camera("b"), K=K), "c": camera("c")}
    assert opened(tmp_path / "a.mp4", options).cameras[0].K[0, 0] == K[0, 0] - 1


def test_videos_in_both_codecs_are_read_from_a_name_with_signs(tmp_path: Path) -> None:
    for codec in (H264, H265):
        path = made(tmp_path / f"concat:a%03d {codec}.mkv", n=3, codec=codec)
        assert seen(opened(path, OPTIONS), path.stem, [0, 2]) == [0, 2]


def test_nothing_is_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = made(tmp_path / "a.mkv", codec=H265)
    path.write_bytes(path.read_bytes()[:6000])
    logger.disable("rigcal")
    try:
        recording = opened(path, OPTIONS)
        list(recording.frames("a", range(n_frames(recording))))
    finally:
        logger.enable("rigcal")
    assert capfd.readouterr() == ("", "")
