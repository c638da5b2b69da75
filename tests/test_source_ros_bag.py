"""ROS bags: from every container come the same pixels, stamps and intrinsics, and what is wrong with one is said."""

from __future__ import annotations

import shutil
import sqlite3
import struct
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writers import KINDS, SIZE, K, Message, Ros, pictures, write, write_bag1, write_bag2, write_mcap
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.model import BadFrame, Frame, Recording
from rigcal.sources import open_recordings, sqlite_file
from rigcal.sources.options import SourceOptions
from rigcal.sources.ros_bag import BagStore, recognises
from rigcal.sources.rosbag1_index import Rosbag1Index

T0 = 1_700_000_000_000_000_000
PERIOD = 33_000_000
N = 8
IMAGES = pictures(N)
DEPTHS = [np.random.default_rng(k).integers(0, 5000, (SIZE[1], SIZE[0])).astype(np.uint16) for k in range(N)]


def rig(ros: Ros, n: int = N, camera: str = "/front") -> Iterator[Message]:
    """A camera with aligned depth; depth comes a little later and without its last image."""
    for k in range(n):
        stamp = T0 + k * PERIOD
        yield ros.info(f"{camera}/color/camera_info", stamp)
        yield ros.image(f"{camera}/color/image_raw", stamp, IMAGES[k], "bgr8")
        if k < n - 1:
            yield ros.info(f"{camera}/aligned_depth_to_color/camera_info", stamp)
            yield ros.image(f"{camera}/aligned_depth_to_color/image_raw", stamp + 1000, DEPTHS[k], "16UC1")


def frames(recording: Recording, camera: str = "front", *, depth: bool = False) -> list[Frame | BadFrame]:
    return list(recording.frames(camera, range(len(recording.stamps_ns(camera))), depth=depth))


def good(recording: Recording, camera: str = "front", *, depth: bool = False) -> list[Frame]:
    found = frames(recording, camera, depth=depth)
    assert all(isinstance(frame, Frame) for frame in found), found
    return [frame for frame in found if isinstance(frame, Frame)]


def complaint(path: Path, **options: Any) -> str:
    with pytest.raises(InputError) as caught:
        open_recordings([path], SourceOptions(**options))
    return str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_every_container_gives_back_pixels_stamps_depth_and_intrinsics(kind: str, tmp_path: Path):
    recording = open_recordings([write(kind, tmp_path, rig)])
    (camera,) = recording.cameras
    assert (camera.name, camera.width, camera.height) == ("front", *SIZE)
    np.testing.assert_array_equal(camera.K, K)
    assert recording.stamps_ns("front").tolist() == [T0 + k * PERIOD for k in range(N)]
    assert recording.depth_indices("front").tolist() == list(range(N - 1))
    for k, frame in enumerate(good(recording, depth=True)):
        np.testing.assert_array_equal(frame.image, IMAGES[k])
        assert frame.stamp_ns == T0 + k * PERIOD
        if k < N - 1:
            assert frame.depth_m is not None
            np.testing.assert_array_equal(np.nan_to_num(frame.depth_m), (DEPTHS[k] * 0.001).astype(np.float32))
            assert np.isnan(frame.depth_m[DEPTHS[k] == 0]).all()


def test_frames_are_read_where_they_are_asked_for_and_say_from_which_bytes(tmp_path: Path):
    recording = open_recordings([write("bag", tmp_path, rig)])
    some = [frame for frame in recording.frames("front", [2, 5]) if isinstance(frame, Frame)]
    np.testing.assert_array_equal([frame.image for frame in some], [IMAGES[2], IMAGES[5]])
    assert all(frame.depth_m is None and len(frame.digest) == 64 for frame in some)
    assert some[0].digest != some[1].digest


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_chunks_of_ros1_bags_may_be_compressed(compression: str, tmp_path: Path):
    bag = write_bag1(tmp_path / "rig.bag", rig(Ros(1)), compression=compression)
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([bag]))], IMAGES)


@pytest.mark.parametrize("mcap", [False, True])
def test_messages_of_rosbag2_may_be_compressed_one_by_one(mcap: bool, tmp_path: Path):
    bag = write_bag2(tmp_path / "rig", rig(Ros(2)), mcap=mcap, compression="message")
    recording = open_recordings([bag])
    assert recording.stamps_ns("front").tolist() == [T0 + k * PERIOD for k in range(N)]
    np.testing.assert_array_equal([frame.image for frame in good(recording)], IMAGES)


def test_files_that_are_compressed_whole_are_named(tmp_path: Path):
    bag = write_bag2(tmp_path / "rig", rig(Ros(2)), compression="file")
    assert "compressed whole (rig.db3.zstd); undo that with zstd -d" in complaint(bag)


def test_headers_stamps_count_not_the_times_of_recording(tmp_path: Path):
    def late(ros: Ros) -> Iterator[Message]:
        yield ros.info("/cam/camera_info")
        for k in (0, 2, 1, 2):  # out of order, and one twice
            yield ros.image("/cam/image_raw", T0 + k * PERIOD, IMAGES[k], "bgr8", log_ns=T0 + 10**9)

    recording = open_recordings([write("bag", tmp_path, late)])
    assert recording.stamps_ns("cam").tolist() == [T0 + k * PERIOD for k in range(3)]
    np.testing.assert_array_equal([frame.image for frame in good(recording, "cam")], IMAGES[:3])


def test_times_of_recording_count_where_headers_have_none(tmp_path: Path, said: list[str]):
    def unstamped(ros: Ros) -> Iterator[Message]:
        yield ros.info("/cam/camera_info")
        for k in range(3):
            yield ros.image("/cam/image_raw", 0, IMAGES[k], "bgr8", log_ns=T0 + k * PERIOD)

    recording = open_recordings([write("sqlite3", tmp_path, unstamped)])
    assert recording.stamps_ns("cam").tolist() == [T0 + k * PERIOD for k in range(3)]
    assert any("headers have no stamps" in line for line in said)


def cut(path: Path, keep: float | Callable[[bytes], int], name: str = "cut.bag") -> Path:
    data = path.read_bytes()
    size = keep(data) if callable(keep) else int(len(data) * keep)
    out = path.with_name(name)
    out.write_bytes(data[:size])
    return out


@pytest.mark.parametrize("compression", ["", "lz4"])
@pytest.mark.parametrize("keep", [0.4, 0.7, 0.9])
def test_of_a_bag_that_is_cut_off_what_is_whole_is_used(compression: str, keep: float, tmp_path: Path, said: list[str]):
    whole = write_bag1(tmp_path / "rig.bag", rig(Ros(1)), compression=compression)
    recording = open_recordings([cut(whole, keep)])
    found = good(recording)
    assert 1 <= len(found) < N
    np.testing.assert_array_equal([frame.image for frame in found], IMAGES[: len(found)])
    assert any(
        "is cut off or damaged: the record at byte" in line and "s of messages before are used" in line for line in said
    )
    # Not one image less than there are bytes for; noise does not become smaller.
    assert len(found) >= int(keep * N) - 1


def test_a_bag_without_index_is_read_like_any_other(tmp_path: Path):
    """As a killed rosbag record leaves it: nothing after the chunks, and the header says that nothing is known."""
    whole = write_bag1(tmp_path / "rig.bag", rig(Ros(1)))
    data = bytearray(whole.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    index = struct.unpack_from("<Q", data, at)[0]
    data[at : at + 8] = bytes(8)
    active = tmp_path / "rig.bag.active"
    active.write_bytes(data[:index])
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([active]))], IMAGES)


def without_index(data: bytes) -> bytearray:
    out, at = bytearray(b"#ROSBAG V2.0\n"), len(b"#ROSBAG V2.0\n")
    while at < len(data):
        head = struct.unpack_from("<I", data, at)[0]
        end = at + 8 + head + struct.unpack_from("<I", data, at + 4 + head)[0]
        if b"op=\x04" not in data[at + 4 : at + 4 + head]:
            out += data[at:end]
        at = end
    return out


def test_chunks_without_message_index_are_looked_into(tmp_path: Path, said: list[str]):
    bag = write_bag1(tmp_path / "rig.bag", rig(Ros(1)))
    data = without_index(bag.read_bytes())
    bag.write_bytes(data)
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([bag]))], IMAGES)
    assert said == []
    at = data.index(b"time=", data.index(b"op=\x02"))
    data[at] ^= 1
    bag.write_bytes(data)
    found = good(open_recordings([bag]))
    assert len(found) in (N - 1, N)  # an image, or a CameraInfo
    assert len(said) == 1
    assert "damaged records left out: 1; first one in the chunk at byte" in said[0]
    assert said[0].endswith("which lacks its time")


def test_a_damaged_chunk_costs_its_own_messages_only(tmp_path: Path, said: list[str]):
    whole = write_bag1(tmp_path / "rig.bag", rig(Ros(1)), compression="lz4")
    data = bytearray(whole.read_bytes())
    places = [k for k in range(len(data)) if data.startswith(b"\x04\x22\x4d\x18", k)]  # LZ4 frames
    data[places[2] : places[2] + 4] = b"\xff\xff\xff\xff"
    whole.write_bytes(data)
    recording = open_recordings([whole])
    found = good(recording)
    assert N - 3 <= len(found) < N
    for frame in found:
        np.testing.assert_array_equal(frame.image, IMAGES[(frame.stamp_ns - T0) // PERIOD])
    assert any("cannot be decompressed" in line and "its messages are lost" in line for line in said)


def middle(data: bytes | bytearray, op: bytes) -> int:
    """Where the kind stands in the header of the middle one of some records."""
    places = [k for k in range(len(data)) if data.startswith(b"op=" + op, k)]
    return places[len(places) // 2]


@pytest.mark.parametrize("compression", ["", "lz4"])
def test_a_chunk_of_absurd_size_costs_its_own_messages_only(compression: str, tmp_path: Path, said: list[str]):
    whole = write_bag1(tmp_path / "rig.bag", rig(Ros(1)), compression=compression)
    data = bytearray(whole.read_bytes())
    at = middle(data, b"\x05")
    at = data.index(b"size=", at - 60) + len(b"size=")
    data[at : at + 4] = struct.pack("<I", 2**31)
    whole.write_bytes(data)
    tracemalloc.start()
    try:
        found = [frame for frame in frames(open_recordings([whole])) if isinstance(frame, Frame)]
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert N - 3 <= len(found) < N
    for frame in found:
        np.testing.assert_array_equal(frame.image, IMAGES[(frame.stamp_ns - T0) // PERIOD])
    assert any("states 2147483648 bytes, more than 1 GiB; its messages are lost" in line for line in said)
    assert peak < 50 * 2**20  # nowhere near what the chunk states


@pytest.mark.parametrize("field", [b"count=", b"conn="])
def test_a_damaged_index_costs_nothing(field: bytes, tmp_path: Path, said: list[str]):
    whole = write_bag1(tmp_path / "rig.bag", rig(Ros(1)))
    data = bytearray(whole.read_bytes())
    at = middle(data, b"\x04")
    header = slice(at - 60, at + 60)
    at = at - 60 + data[header].index(field)
    data[at if field == b"conn=" else at + len(field)] ^= 1  # another name, another number
    whole.write_bytes(data)
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([whole]))], IMAGES)
    assert said == []


def test_a_record_of_no_known_kind_is_left_out_and_told(tmp_path: Path, said: list[str]):
    """The index of a chunk that is not known for one is not taken for that of the chunk before."""
    whole = write_bag1(tmp_path / "rig.bag", rig(Ros(1)))
    data = bytearray(whole.read_bytes())
    data[middle(data, b"\x05") + 3] = 0
    whole.write_bytes(data)
    found = good(open_recordings([whole]))
    assert N - 3 <= len(found) < N
    for frame in found:
        np.testing.assert_array_equal(frame.image, IMAGES[(frame.stamp_ns - T0) // PERIOD])
    assert len(said) == 1
    assert "damaged records left out: 1; first the one at byte" in said[0]
    assert said[0].endswith("which is of no known kind")


def test_a_chunk_that_yields_more_than_it_states_is_lost(tmp_path: Path, said: list[str]):
    whole = write_bag1(tmp_path / "rig.bag", rig(Ros(1)), compression="bz2", chunk_bytes=10**7)
    data = bytearray(whole.read_bytes())
    at = data.index(b"op=\x05")
    at = data.index(b"size=", at - 60) + len(b"size=")
    data[at : at + 4] = struct.pack("<I", 5000)
    whole.write_bytes(data)
    assert "no images" in complaint(whole) or any("yields more than" in line for line in said)


def test_old_encrypted_and_other_files_are_named(tmp_path: Path):
    old = tmp_path / "old.bag"
    old.write_bytes(b"#ROSBAG V1.2\n" + bytes(100))
    assert "is a bag of version 1.2, only 2.0 is read" in complaint(old)
    whole = write_bag1(tmp_path / "rig.bag", rig(Ros(1)))
    data = whole.read_bytes()
    at = data.index(b"index_pos=") - 4
    field = struct.pack("<I", len(b"encryptor=rosbag/AesCbc")) + b"encryptor=rosbag/AesCbc"
    head = struct.unpack_from("<I", data, 13)[0]
    secret = tmp_path / "secret.bag"
    secret.write_bytes(data[:13] + struct.pack("<I", head + len(field)) + data[17:at] + field + data[at:])
    assert "is encrypted (rosbag/AesCbc); decrypt it" in complaint(secret)
    empty = tmp_path / "empty.bag"
    empty.write_bytes(b"#ROSBAG V2.0\n")
    assert "holds no images that are read; its topics: none" in complaint(empty)


def test_split_bags_are_one_recording(tmp_path: Path):
    messages = list(rig(Ros(1)))
    folder = tmp_path / "split"
    folder.mkdir()
    write_bag1(folder / "rig_0.bag", messages[:15])
    write_bag1(folder / "rig_1.bag", messages[15:])
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([folder]))], IMAGES)


def test_bags_of_one_moment_are_not_taken_for_a_split_one(tmp_path: Path):
    """Two computers recorded the same topics: that is two cameras of one name."""
    folder = tmp_path / "two"
    folder.mkdir()
    for k in range(2):
        write_bag1(folder / f"rig_{k}.bag", rig(Ros(1)))
    assert "camera front is in" in complaint(folder)


@pytest.mark.parametrize("mcap", [False, True])
def test_a_split_rosbag2_is_read_with_its_metadata_and_without(mcap: bool, tmp_path: Path):
    messages, suffix = list(rig(Ros(2))), "mcap" if mcap else "db3"
    folder = write_bag2(tmp_path / "whole", messages[:15], mcap=mcap)
    other = write_bag2(tmp_path / "other", messages[15:], mcap=mcap)
    (folder / f"whole.{suffix}").rename(folder / f"rig_0.{suffix}")
    (other / f"other.{suffix}").rename(folder / f"rig_1.{suffix}")
    text = (folder / "metadata.yaml").read_text().replace(f"whole.{suffix}", f"rig_0.{suffix}")
    (folder / "metadata.yaml").unlink()
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([folder]))], IMAGES)
    # Older versions wrote paths; a bag's files lie in its folder, whatever they say.
    line = next(line for line in text.splitlines() if line.endswith(f"- rig_0.{suffix}"))
    more = line.replace(f"rig_0.{suffix}", f"../elsewhere/rig_1.{suffix}")
    (folder / "metadata.yaml").write_text(text.replace(line, f"{line}\n{more}", 1))
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([folder]))], IMAGES)


def test_a_bare_db3_file_is_a_recording(tmp_path: Path):
    folder = write("sqlite3", tmp_path, rig)
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([folder / "rig.db3"]))], IMAGES)


def test_of_a_db3_file_that_is_cut_off_what_is_found_is_used(tmp_path: Path, said: list[str]):
    folder = write("sqlite3", tmp_path, lambda ros: list(rig(ros)) * 8)
    half = cut(folder / "rig.db3", 0.6, "half.db3")
    recording = open_recordings([half])
    for frame in frames(recording):
        if isinstance(frame, Frame):
            np.testing.assert_array_equal(frame.image, IMAGES[(frame.stamp_ns - T0) // PERIOD])
    assert any("damaged or cut off" in line or "messages are damaged" in line for line in said)


def contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_reading_a_db3_file_leaves_its_folder_as_it_is(tmp_path: Path):
    """SQLite makes files beside one that keeps a log, even where it only reads."""
    folder = write("sqlite3", tmp_path, rig)
    with closing(sqlite3.connect(folder / "rig.db3")) as base:
        base.execute("PRAGMA journal_mode=WAL")
    before = contents(folder)
    assert sorted(before) == ["metadata.yaml", "rig.db3"]
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([folder]))], IMAGES)
    assert contents(folder) == before


@pytest.mark.parametrize("with_index", [True, False])
def test_what_a_killed_recorder_left_in_a_log_is_read(with_index: bool, tmp_path: Path):
    folder = write("sqlite3", tmp_path, rig)
    killed = tmp_path / "killed"
    with closing(sqlite3.connect(folder / "rig.db3")) as base:
        base.execute("PRAGMA journal_mode=WAL")
        base.execute("UPDATE messages SET data = (SELECT data FROM messages WHERE id = 2) WHERE id = 6")
        base.commit()
        shutil.copytree(folder, killed)
    if not with_index:
        (killed / "rig.db3-shm").unlink()
    before = contents(killed)
    assert len(before["rig.db3-wal"]) > 0
    found = good(open_recordings([killed]))
    # The second image is the first again, which only the log says.
    np.testing.assert_array_equal([frame.image for frame in found], [IMAGES[0], *IMAGES[2:]])
    assert contents(killed) == before
    (killed / "rig.db3-wal").unlink()
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([killed]))], IMAGES)


def test_a_log_that_cannot_be_read_is_told(tmp_path: Path, said: list[str], monkeypatch: pytest.MonkeyPatch):
    """As in a folder that nobody may write to, where SQLite cannot make the index that the log needs."""
    folder = write("sqlite3", tmp_path, rig)
    (folder / "rig.db3-wal").write_bytes(b"x")
    monkeypatch.setattr(sqlite_file.SqliteFile, "_works", lambda self, way: not way.reads_log)
    assert len(good(open_recordings([folder]))) == N
    assert [line for line in said if "what was recorded last lies in rig.db3-wal and cannot be read" in line]


def test_a_db3_file_without_tables_or_with_absurd_ones_is_named(tmp_path: Path):
    folder = write("sqlite3", tmp_path, rig)
    with sqlite3.connect(folder / "rig.db3") as base:
        base.execute("DROP TABLE messages")
    base.close()
    assert "is not a whole rosbag2 file" in complaint(folder)


def test_a_description_that_is_damaged_or_names_nothing_is_named(tmp_path: Path):
    folder = write("sqlite3", tmp_path, rig)
    (folder / "metadata.yaml").write_text("a: [b")
    assert "metadata.yaml: not a readable YAML file" in complaint(folder)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  relative_file_paths: [gone.db3]\n")
    assert "no bag there" in complaint(folder)


def test_other_peoples_metadata_is_no_bag(tmp_path: Path):
    (tmp_path / "metadata.yaml").write_text("author: somebody\n")
    assert not recognises(tmp_path, b"")
    assert not recognises(tmp_path / "absent", b"")


def test_message_definitions_are_not_needed(tmp_path: Path):
    """ROS 2 before Iron stored none in .db3; the types that are read have never changed."""
    folder = write("sqlite3", tmp_path, rig)
    with sqlite3.connect(folder / "rig.db3") as base:
        base.execute("DELETE FROM message_definitions")
    base.close()
    np.testing.assert_array_equal([frame.image for frame in good(open_recordings([folder]))], IMAGES)


def test_memory_stays_flat_however_long_the_bag_is(tmp_path: Path):
    size = (320, 240)
    images: list[NDArray[np.uint8]] = pictures(20, size=size)

    def long(ros: Ros) -> Iterator[Message]:
        yield ros.info("/cam/camera_info", size=size)
        for k in range(200):
            yield ros.image("/cam/image_raw", T0 + k * PERIOD, images[k % 20], "bgr8")

    bag = write_mcap(tmp_path / "long.mcap", long(Ros(2)), chunk_bytes=10**6)
    assert bag.stat().st_size > 40 * 10**6
    open_recordings([bag])  # imports
    tracemalloc.start()
    recording = open_recordings([bag])
    n = sum(isinstance(frame, Frame) for frame in recording.frames("cam", range(200)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert n == 200
    # One chunk compressed and not (1.2 MB each), a message and some images (0.23 MB each), the decompressor.
    assert peak < 8 * 10**6


def test_topics_are_taken_from_records_when_connections_do_not_repeat_them(tmp_path: Path):
    whole = write_bag1(tmp_path / "rig.bag", rig(Ros(1)))
    assert {c.topic for c in Rosbag1Index(whole).connections} == set(BagStore(whole).topics)
    assert BagStore(whole).topics["/front/color/image_raw"].type == "sensor_msgs/Image"


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """With a few bytes flipped, overwritten or missing, anywhere or where the structure is."""
    out = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        near = int(rng.integers(0, min(5000, len(out) - 30)))
        at = [near, len(out) - 30 - near, int(rng.integers(0, len(out) - 30))][rng.integers(0, 3)]
        kind = rng.integers(0, 3)
        if kind == 0:
            out[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            out[at : at + 8] = b"\xff" * 8
        else:
            del out[at : at + int(rng.integers(1, 20))]
    return bytes(out)


@pytest.mark.parametrize("kind", ["bag", "lz4.bag", "mcap", "db3"])
def test_damage_anywhere_ends_in_frames_bad_frames_or_a_sentence(kind: str, tmp_path: Path):
    rng = np.random.default_rng(7)
    whole = {
        "bag": lambda: write_bag1(tmp_path / "rig.bag", rig(Ros(1), 3)),
        "lz4.bag": lambda: write_bag1(tmp_path / "rig.bag", rig(Ros(1), 3), compression="lz4"),
        "mcap": lambda: write_mcap(tmp_path / "rig.mcap", rig(Ros(2), 3)),
        "db3": lambda: write_bag2(tmp_path / "rig", rig(Ros(2), 3)) / "rig.db3",
    }[kind]().read_bytes()
    path, outcomes = tmp_path / f"damaged.{kind}", set[str]()
    for _ in range(30):
        path.write_bytes(damaged(whole, rng))
        try:
            recording = open_recordings([path])
        except InputError:
            outcomes.add("sentence")
            continue
        for camera in recording.cameras:
            outcomes |= {type(frame).__name__ for frame in frames(recording, camera.name, depth=True)}
    assert {"sentence", "Frame"} <= outcomes <= {"sentence", "Frame", "BadFrame"}


def test_one_damaged_camera_info_does_not_matter(tmp_path: Path):
    def torn(ros: Ros) -> Iterator[Message]:
        for k, message in enumerate(rig(ros)):
            yield message._replace(data=message.data[:30]) if k == 0 else message

    np.testing.assert_array_equal(
        [frame.image for frame in good(open_recordings([write("bag", tmp_path, torn)]))], IMAGES
    )
