"""MCAP files: the index of any file, whole or not, and ROS messages in it."""

from __future__ import annotations

import struct
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writers import SIZE, Message, Ros, pictures, write_mcap
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter

from aruco.errors import InputError, MissingExtraError
from aruco.model import BadFrame, Frame
from rigcal.sources import message_places, open_recordings
from rigcal.sources.chunked_file import ChunkedFile
from rigcal.sources.mcap_index import DamagedError, McapIndex
from rigcal.sources.message_places import Chunk

COMPRESSIONS = ["NONE", "LZ4", "ZSTD"]
SIZE_BYTES = 3000
N = 60


def payload(k: int) -> bytes:
    return np.random.default_rng(k).bytes(SIZE_BYTES)


def plain(path: Path, compression: str = "ZSTD", **options: Any) -> Path:
    """Two channels in turn, message k at k milliseconds, each of other noise."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, compression=CompressionType[compression], chunk_size=10_000, **options)
        writer.start(profile="ros2", library="a test")
        schema = writer.register_schema("a/msg/A", "ros2msg", b"int32 x")
        channels = [writer.register_channel(topic, "cdr", schema, {"key": topic}) for topic in ("/a", "/b")]
        writer.add_metadata("about", {"k": "v"})
        for k in range(N):
            writer.add_message(channels[k % 2], k * 1_000_000, payload(k), k)
        writer.finish()
    return path


def read(index: McapIndex) -> dict[int, bytes]:
    """Every message that can be had by its time in milliseconds."""
    found = {}
    for channel in index.channels:
        for k, time_ns in enumerate(index.log_times_ns(channel.id).tolist()):
            try:
                found[time_ns // 1_000_000] = index.message(channel.id, k)
            except DamagedError:
                continue
    return found


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("chunked", [True, False])
def test_every_message_is_found(compression: str, chunked: bool, tmp_path: Path):
    index = McapIndex(plain(tmp_path / "a.mcap", compression, use_chunking=chunked))
    assert [(c.topic, c.schema_name, c.encoding, dict(c.metadata)) for c in index.channels] == [
        ("/a", "a/msg/A", "cdr", {"key": "/a"}),
        ("/b", "a/msg/A", "cdr", {"key": "/b"}),
    ]
    assert index.metadata == {"about": {"k": "v"}}
    assert (index.profile, index.loss) == ("ros2", None)
    assert [index.count(channel.id) for channel in index.channels] == [N // 2, N // 2]
    assert read(index) == {k: payload(k) for k in range(N)}


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_file_without_any_index_is_the_same(compression: str, tmp_path: Path):
    bare = plain(
        tmp_path / "a.mcap", compression, index_types=IndexType.NONE, repeat_channels=False, use_summary_offsets=False
    )
    assert read(McapIndex(bare)) == {k: payload(k) for k in range(N)}


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("chunked", [True, False])
def test_of_a_file_cut_off_anywhere_what_is_whole_is_read(compression: str, chunked: bool, tmp_path: Path):
    data = plain(tmp_path / "a.mcap", compression, use_chunking=chunked).read_bytes()
    before = -1
    for size in np.linspace(300, len(data) - 1, 41).astype(int).tolist():
        half = tmp_path / "half.mcap"
        half.write_bytes(data[:size])
        index = McapIndex(half)
        found = read(index)
        assert found == {k: payload(k) for k in range(len(found))}
        assert len(found) >= before  # more bytes, more messages
        before = len(found)
        if len(found) < N:
            assert index.loss is not None
            assert "is cut off or damaged: the record at byte" in index.loss
            # Of what does not compress at most the message at the cut, and what its compression holds back, is lost.
            if compression != "ZSTD":
                assert len(found) >= size // (SIZE_BYTES + 200) - (1 if compression == "NONE" else 10)
    assert before == N


def test_parts_come_in_the_files_order_and_from_either_end(tmp_path: Path):
    for compression in COMPRESSIONS:
        index = McapIndex(plain(tmp_path / "a.mcap", compression))
        ids = [channel.id for channel in index.channels]
        for start, wanted in ((0, slice(0, 5)), (-5, slice(-5, None)), (10, slice(10, 15))):
            parts = list(index.parts(ids, 5, start=start))
            assert [part.data for part in parts] == [payload(k)[wanted] for k in range(N)]
            assert {part.total for part in parts} == {SIZE_BYTES}
        assert [part.data for part in index.parts(ids, 5, start=SIZE_BYTES)] == [b""] * N
        some = list(index.parts(ids, 5, step=7))
        assert [part.index for part in some] == [k for k in range(0, N // 2, 7) for _ in ids]
        assert [part.data for part in some] == [payload(2 * k + i)[:5] for k in range(0, N // 2, 7) for i in (0, 1)]


def test_a_damaged_chunk_costs_its_own_messages_only(tmp_path: Path, said: list[str]):
    path = plain(tmp_path / "a.mcap", "NONE")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    index = McapIndex(path)
    found = read(index)
    assert N - 4 <= len(found) < N
    assert all(found[k] == payload(k) for k in found)
    assert said == [line for line in said if "does not fit its checksum; its messages are lost" in line]
    assert len(said) == 1


def chunk_at(data: bytes | bytearray) -> int:
    """Where the first chunk's record begins."""
    at = 8
    while data[at] != 6:
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    return at


def records(data: bytes | bytearray) -> Iterator[tuple[int, int, int]]:
    """(opcode, where it begins, where its contents begin) of each record."""
    at = 8
    while at < len(data) - 8:
        yield data[at], at, at + 9
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]


def middle(data: bytes | bytearray, opcode: int) -> int:
    """Where the contents of the middle one of some records begin."""
    found = [body for kind, _, body in records(data) if kind == opcode]
    return found[len(found) // 2]


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize(
    ("field", "value", "what"),
    [
        (16, struct.pack("<Q", 2**40), "states 1099511627776 bytes, more than 1 GiB"),
        (16, struct.pack("<Q", 2**30 + 1), "states 1073741825 bytes, more than 1 GiB"),
        (28, struct.pack("<I", 2**31), "has a damaged header"),  # length of the compression's name
        (28, struct.pack("<I", 65), "has a damaged header"),
    ],
)
def test_a_damaged_head_of_a_chunk_costs_its_own_messages_only(
    field: int, value: bytes, what: str, indexed: bool, tmp_path: Path, said: list[str]
):
    path = plain(tmp_path / "a.mcap", index_types=IndexType.ALL if indexed else IndexType.NONE)
    data = bytearray(path.read_bytes())
    at = middle(data, 6) + field
    data[at : at + len(value)] = value
    path.write_bytes(data)
    tracemalloc.start()
    index = McapIndex(path)
    found = read(index)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert N - 4 <= len(found) < N
    assert all(found[k] == payload(k) for k in found)
    if indexed:  # when the lost ones were taken is known all the same
        assert [index.count(channel.id) for channel in index.channels] == [N // 2, N // 2]
    assert len(said) == 1
    assert f"{what}; its messages are lost" in said[0]
    assert peak < 20 * 2**20  # nowhere near what the chunk states


def test_a_damaged_index_costs_nothing(tmp_path: Path, said: list[str]):
    """One entry has half its bytes: the chunk is looked into, as one without an index."""
    path = plain(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    at = middle(data, 7)
    length = struct.unpack_from("<Q", data, at - 8)[0]
    struct.pack_into("<Q", data, at - 8, length - 8)
    del data[at + length - 8 : at + length]
    path.write_bytes(data)
    index = McapIndex(path)
    assert read(index) == {k: payload(k) for k in range(N)}
    assert [index.count(channel.id) for channel in index.channels] == [N // 2, N // 2]
    assert said == []


def test_a_damaged_definition_is_left_out_and_told(tmp_path: Path, said: list[str]):
    """Those of a chunk are whole, and used."""
    path = plain(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    for kind, _, body in records(data):
        if kind == 4:
            struct.pack_into("<I", data, body + 4, 2**31)  # length of the topic
    path.write_bytes(data)
    assert read(McapIndex(path)) == {k: payload(k) for k in range(N)}
    assert len(said) == 1
    assert "damaged records left out: 2; first the one at byte" in said[0]


def bare(path: Path, n: int) -> Path:
    """A file of n small messages in no chunk."""
    data = plain(path, use_chunking=False).read_bytes()
    first = next(at for kind, at, _ in records(data) if kind == 5)
    messages = b"".join(struct.pack("<BQHIQQ", 5, 22 + 8, 1, k, k, 0) + b"12345678" for k in range(n))
    path.write_bytes(data[:first] + messages + data[first:])
    return path


def test_a_message_in_no_chunk_costs_as_little_as_one_in_a_chunk(tmp_path: Path):
    path, n = bare(tmp_path / "a.mcap", 20_000), 20_000
    McapIndex(path)  # imports
    tracemalloc.start()
    index = McapIndex(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert index.count(1) == n + N // 2
    # 20 bytes as they come, 20 sorted, 8 for their order, and what arrays keep in reserve; as tuples they took 200.
    assert peak < 70 * n


def test_too_many_messages_are_refused_as_soon_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(message_places, "MAX_MESSAGES", 50)
    for path in (bare(tmp_path / "bare.mcap", 51), plain(tmp_path / "a.mcap")):
        with pytest.raises(InputError, match="has more than 50 messages; give a part of the recording"):
            McapIndex(path)


def test_a_chunk_that_yields_more_or_less_than_it_states_is_lost(tmp_path: Path, said: list[str]):
    for stated in (100, 2**29):
        path = plain(tmp_path / "a.mcap")
        data = bytearray(path.read_bytes())
        struct.pack_into("<Q", data, chunk_at(data) + 9 + 16, stated)
        path.write_bytes(data)
        found = read(McapIndex(path))
        assert N - 4 <= len(found) < N
    assert "yields more than the 100 bytes" in said[0]
    assert "and states 536870912" in said[1]


def test_an_unknown_compression_is_named(tmp_path: Path, said: list[str]):
    path = plain(tmp_path / "a.mcap")
    path.write_bytes(path.read_bytes().replace(b"zstd", b"best"))
    assert read(McapIndex(path)) == {}
    assert "unknown compression 'best'; known: lz4, zstd, bz2 and none" in said[0]


def test_an_index_that_lies_costs_no_more_than_its_messages(tmp_path: Path):
    path = plain(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    at = chunk_at(data)
    at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    assert data[at] == 7
    struct.pack_into("<Q", data, at + 9 + 6 + 8, 2**63 + 17)  # the first offset
    path.write_bytes(data)
    index = McapIndex(path)
    found = read(index)
    assert len(found) == N - 1
    assert [part.data for part in index.parts([channel.id for channel in index.channels], 1)].count(None) == 1


def test_what_is_no_mcap_file_is_said(tmp_path: Path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP1\r\n" + bytes(50))
    with pytest.raises(InputError, match="is not an MCAP file"):
        McapIndex(path)
    with pytest.raises(InputError, match="cannot be read"):
        McapIndex(tmp_path / "absent.mcap")


IMAGES = pictures(4)


def camera(ros: Ros, damaged: bool = False) -> Iterator[Message]:
    yield ros.info("/cam/camera_info")
    for k, image in enumerate(IMAGES):
        message = ros.image("/cam/image_raw", 10**9 + k * 10**8, image, "rgb8")
        yield message._replace(data=message.data[:200]) if damaged and k == 1 else message


@pytest.mark.parametrize("version", [1, 2])
def test_messages_of_both_versions_of_ros_are_read(version: int, tmp_path: Path):
    recording = open_recordings([write_mcap(tmp_path / "a.mcap", camera(Ros(version)), version=version)])
    found = list(recording.frames("cam", range(4)))
    np.testing.assert_array_equal([f.image for f in found if isinstance(f, Frame)], [i[..., ::-1] for i in IMAGES])


def test_a_message_that_ends_early_is_a_bad_frame(tmp_path: Path):
    recording = open_recordings([write_mcap(tmp_path / "a.mcap", camera(Ros(2), damaged=True))])
    found = list(recording.frames("cam", range(4)))
    assert [isinstance(frame, BadFrame) for frame in found] == [False, True, False, False]
    assert isinstance(found[1], BadFrame)
    assert found[1].reason == "a message of /cam/image_raw ends after 200 bytes, within a field"


def test_publishers_of_one_topic_are_one_camera(tmp_path: Path):
    """Two channels of one topic: a driver was started again during the recording."""
    path = tmp_path / "a.mcap"
    messages = list(camera(Ros(2)))
    with path.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=10_000)
        writer.start(profile="ros2")
        kinds = {kind: writer.register_schema(kind, "ros2msg", b"") for kind in {m.type for m in messages}}
        for k, message in enumerate(messages):
            channel = writer.register_channel(message.topic, "cdr", kinds[message.type], {"k": str(k // 3)})
            writer.add_message(channel, message.log_ns, message.data, message.log_ns)
        writer.finish()
    recording = open_recordings([path])
    found = list(recording.frames("cam", range(4)))
    np.testing.assert_array_equal([f.image for f in found if isinstance(f, Frame)], [i[..., ::-1] for i in IMAGES])


def test_what_is_not_ros_is_named(tmp_path: Path):
    path = tmp_path / "fox.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="")
        for name, encoding in (("foxglove.CompressedImage", "protobuf"), ("foxglove.CameraCalibration", "json")):
            schema = writer.register_schema(name, encoding, b"")
            channel = writer.register_channel(f"/{encoding}", encoding, schema)
            writer.add_message(channel, 0, b"abc", 0)
        writer.finish()
    with pytest.raises(InputError, match="holds no ROS messages") as caught:
        open_recordings([path])
    assert "/protobuf (foxglove.CompressedImage as protobuf, 1)" in str(caught.value)


@pytest.mark.parametrize("module", ["mcap", "zstandard"])
def test_a_package_that_is_missing_is_named(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = plain(tmp_path / "a.mcap", index_types=IndexType.NONE)
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=rf"needs {module}; install it with: pip install 'rigcal\[bags\]'"):
        McapIndex(path)


def test_a_cut_off_recording_is_used_and_told(tmp_path: Path, said: list[str]):
    path = write_mcap(tmp_path / "a.mcap", camera(Ros(2)), compression="NONE")
    path.write_bytes(path.read_bytes()[:26_000])
    recording = open_recordings([path])
    assert len(recording.stamps_ns("cam")) == 2
    assert [(frame.width, frame.height) for frame in recording.cameras] == [SIZE]
    assert any(line.startswith(f"{path}: is cut off or damaged: the record at byte") for line in said)


class Forgetful(ChunkedFile):
    """One whose chunk is forgotten whenever it was looked at, as another thread may do."""

    def __getattribute__(self, name: str) -> Any:
        value = super().__getattribute__(name)
        if name == "_cached" and value is not None:
            self._cached = None
        return value


def test_another_thread_may_forget_a_chunk_at_any_moment(tmp_path: Path) -> None:
    path = tmp_path / "chunks"
    path.write_bytes(b"abcd")
    chunk = Chunk(at=0, stored=4, stated=4, compression="")
    chunked = Forgetful(path, [chunk], lambda read, at, end, channel: (at, end - at))
    with path.open("rb") as file:
        assert [bytes(chunked.contents(file, 0)) for _ in range(4)] == [b"abcd"] * 4
