"""Pictures out of packets: the right ones, not more than needed, none with smears, in the right colours."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from video_writer import H264, H265, MJPEG, moving_images, number_of, write_video

from aruco.errors import MissingExtraError
from rigcal.sources.decoding import MISSING, Encoded, PacketDecoder, Undecoded, import_av
from rigcal.sources.nal_units import UnitReader

av = import_av()


class Stream:
    """The packets of a file, and which number each picture bears."""

    def __init__(self, path: Path) -> None:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            self.codec = stream.codec_context.name
            self.extradata = stream.codec_context.extradata
            packets = [packet for packet in container.demux(stream) if packet.size]
            self.data = [bytes(packet) for packet in packets]
            shown = sorted(packet.pts for packet in packets)
            self.number = [shown.index(packet.pts) for packet in packets]
            self.keys = [i for i, packet in enumerate(packets) if packet.is_keyframe]

    @property
    def in_order(self) -> list[int]:
        return sorted(range(len(self.data)), key=self.number.__getitem__)

    def encoded(self) -> list[Encoded]:
        return [Encoded(data=data, key=i in self.keys) for i, data in enumerate(self.data)]

    def decoder(self) -> PacketDecoder:
        return PacketDecoder(self.codec, extradata=self.extradata)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("videos")
    images = moving_images(24)
    write_video(folder / "h264.mp4", images, b_frames=3, key_every=24)
    write_video(folder / "hevc.mp4", images, codec=H265, b_frames=3, key_every=24)
    write_video(folder / "hevc.ts", images, codec=H265, b_frames=3, key_every=24)  # start codes instead of lengths
    write_video(folder / "h264.ts", images, b_frames=3, key_every=24)
    write_video(folder / "mjpeg.avi", images, codec=MJPEG, pixels="yuvj420p")
    return folder


NAMES = ("h264.mp4", "hevc.mp4", "h264.ts", "hevc.ts", "mjpeg.avi")


def numbers(stream: Stream, decoder: PacketDecoder, wanted: list[int]) -> list[int | str]:
    """What is seen in the wanted pictures, which must come in that order."""
    found = list(decoder.decoded(stream.data, wanted))
    assert [packet for packet, _ in found] == wanted
    return [picture.reason if isinstance(picture, Undecoded) else number_of(picture) for _, picture in found]


@pytest.mark.parametrize("name", NAMES)
def test_every_packet_gives_its_own_picture(folder: Path, name: str) -> None:
    stream = Stream(folder / name)
    assert numbers(stream, stream.decoder(), stream.in_order) == list(range(24))
    # Taking packets and pictures in the order in which they come would be wrong wherever there are B-frames.
    assert (stream.number == list(range(24))) == (name == "mjpeg.avi")


@pytest.mark.parametrize("name", NAMES)
def test_single_pictures_are_the_same_as_among_all_and_a_decoder_can_start_again(folder: Path, name: str) -> None:
    stream = Stream(folder / name)
    everything = dict(stream.decoder().decoded(stream.data, stream.in_order))
    decoder = stream.decoder()
    for wanted in ([17], [3], [23], [0], sorted((5, 6, 20), key=stream.number.__getitem__)):
        for packet, picture in decoder.decoded(stream.data, wanted):
            np.testing.assert_array_equal(picture, everything[packet])


@pytest.mark.parametrize("name", NAMES[:4])
def test_nothing_is_decoded_that_the_wanted_picture_does_not_need(folder: Path, name: str) -> None:
    stream = Stream(folder / name)
    wanted = stream.number.index(16)  # a P-frame: of each four before it only two are ever referred to
    decoder = stream.decoder()
    assert numbers(stream, decoder, [wanted]) == [16]
    assert wanted == 13  # 1 + 4 * 3: the encoder wrote groups of four, the last of them first
    assert decoder.n_decoded == 1 + 3 * 2 + 1


def test_only_as_many_packets_are_taken_as_are_needed(folder: Path) -> None:
    stream = Stream(folder / "h264.mp4")
    taken = []

    def packets() -> object:
        for i, data in enumerate(stream.data):
            taken.append(i)
            yield data

    list(stream.decoder().decoded(packets(), [4]))  # type: ignore[arg-type]
    assert taken == [0, 1, 2, 3, 4]
    assert list(stream.decoder().decoded(stream.data, [])) == []


def test_of_several_layers_no_picture_is_left_out() -> None:
    # A slice of type TRAIL_N, after parameter sets with one and with two temporal layers.
    for layers, unused in ((1, True), (2, False)):
        sps = b"\x00\x00\x01\x42\x01" + bytes([(layers - 1) << 1])
        assert UnitReader("hevc", b"").is_unused(sps + b"\x00\x00\x01\x00\x01\xaf") is unused
    assert not UnitReader("hevc", b"").is_unused(b"\x00\x00\x01\x00\x01\xaf")  # nothing is known about layers
    assert not UnitReader("vp9", b"").is_unused(b"\x00\x00\x01\x00\x01\xaf")
    assert not UnitReader("h264", b"").is_unused(b"")


@pytest.mark.parametrize("name", ["h264.mp4", "hevc.mp4"])
def test_a_cut_packet_harms_what_follows_until_the_next_key_picture(tmp_path: Path, name: str) -> None:
    write_video(tmp_path / name, moving_images(40), codec=H264 if "264" in name else H265, b_frames=2, key_every=20)
    stream = Stream(tmp_path / name)
    whole = dict(stream.decoder().decoded(stream.encoded(), stream.in_order))
    damaged = stream.number.index(6)  # a P-frame
    packets = stream.encoded()
    packets[damaged] = Encoded(data=stream.data[damaged][: len(stream.data[damaged]) // 2])
    found = dict(stream.decoder().decoded(packets, stream.in_order))
    for packet, picture in found.items():
        if isinstance(picture, Undecoded):
            assert damaged <= packet < stream.keys[1]
            assert "damaged" in picture.reason
        else:
            np.testing.assert_array_equal(picture, whole[packet])  # no smears
    assert all(isinstance(found[packet], Undecoded) for packet in range(damaged, stream.keys[1]))


def test_damage_to_a_picture_that_no_other_needs_stays_there(folder: Path) -> None:
    stream = Stream(folder / "h264.mp4")
    damaged = stream.number.index(1)
    packets = stream.encoded()
    packets[damaged] = Encoded(data=packets[damaged].data, damage="was not received")
    found = dict(stream.decoder().decoded(packets, stream.in_order))
    assert found.pop(damaged) == Undecoded("was not received")
    assert not any(isinstance(picture, Undecoded) for picture in found.values())


def test_a_lost_packet_is_noticed_within_a_group_of_h264(folder: Path) -> None:
    stream = Stream(folder / "h264.mp4")
    lost = stream.number.index(8)
    packets = stream.encoded()
    del packets[lost]
    found = dict(stream.decoder().decoded(packets, range(len(packets))))
    assert all(isinstance(found[packet], Undecoded) for packet in range(lost + 3, len(packets)))


@pytest.mark.parametrize("codec", [H264, H265])
def test_an_open_group_can_be_started_at_without_what_was_before(tmp_path: Path, codec: str) -> None:
    write_video(tmp_path / "open.mp4", moving_images(40), codec=codec, b_frames=3, open_gop=True)
    stream = Stream(tmp_path / "open.mp4")
    start = stream.keys[1]
    leading = [i for i in range(start, stream.keys[2]) if stream.number[i] < stream.number[start]]
    assert leading  # else the group is not open
    group = stream.encoded()[start : stream.keys[2]]
    wanted = sorted(range(len(group)), key=lambda i: stream.number[start + i])
    for packet, picture in stream.decoder().decoded(group, wanted):
        if start + packet in leading:
            assert picture == Undecoded(MISSING)
        else:
            assert isinstance(picture, np.ndarray)
            assert number_of(picture) == stream.number[start + packet]


def test_rubbish_gives_reasons() -> None:
    rng = np.random.default_rng(0)
    for codec in ("h264", "hevc", "mjpeg"):
        packets = [rng.bytes(400) for _ in range(5)] + [b""]
        for _, picture in PacketDecoder(codec).decoded(packets, range(8)):
            assert isinstance(picture, Undecoded)


def test_another_size_than_promised_is_refused(folder: Path) -> None:
    stream = Stream(folder / "h264.mp4")
    decoder = PacketDecoder(stream.codec, extradata=stream.extradata, size=(320, 240))
    (_, picture), *_ = decoder.decoded(stream.data, [0])
    assert isinstance(picture, Undecoded)
    assert "is 160 x 120 where 320 x 240" in picture.reason


def test_a_picture_of_absurd_size_is_refused_before_there_is_memory_for_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rigcal.sources.decoding.MAX_PIXELS", 160 * 120 - 1)
    stream = Stream(folder / "h264.ts")
    (_, picture), *_ = stream.decoder().decoded(stream.data, [0])
    assert isinstance(picture, Undecoded)


def bgr_of(Y: int, U: int, V: int, kr: float, kb: float, *, full: bool) -> np.ndarray:
    """ITU-T H.273, 8.3: from 8-bit luma and chroma to B, G, R of 0..255."""
    y = Y / 255 if full else (Y - 16) / 219
    u, v = ((c - 128) / (255 if full else 224) for c in (U, V))
    r, b = y + 2 * (1 - kr) * v, y + 2 * (1 - kb) * u
    return np.clip(255 * np.array([b, (y - kr * r - kb * b) / (1 - kr - kb), r]), 0, 255)


COLOURS = {  # matrix, range -> kr, kb of ITU-T H.273, table 4
    (1, 1): (0.2126, 0.0722),
    (1, 2): (0.2126, 0.0722),
    (6, 1): (0.299, 0.114),
    (6, 2): (0.299, 0.114),
    (5, 2): (0.299, 0.114),
}


@pytest.mark.parametrize("codec", [H264, H265])
@pytest.mark.parametrize("colour", list(COLOURS))
def test_colours_are_as_tagged(tmp_path: Path, codec: str, colour: tuple[int, int]) -> None:
    Y, U, V = 120, 100, 170
    planes = np.concatenate([np.full(64 * 48, Y), np.full(32 * 24, U), np.full(32 * 24, V)]).astype(np.uint8)
    write_video(tmp_path / "patch.mp4", [planes.reshape(72, 64)], codec=codec, colour=colour)
    stream = Stream(tmp_path / "patch.mp4")
    ((_, picture),) = stream.decoder().decoded(stream.data, [0])
    assert isinstance(picture, np.ndarray)
    assert picture.shape == (48, 64, 3)
    want = bgr_of(Y, U, V, *COLOURS[colour], full=colour[1] == 2)
    # 2.5: coding changes a level by up to 1 (which weighs up to 1.2), and libav rounds its coefficients.
    np.testing.assert_allclose(picture[24, 32], want, atol=2.5)
    # Taken with the other range or matrix the same tolerance is missed.
    other = bgr_of(Y, U, V, *COLOURS[colour], full=colour[1] != 2)
    assert np.abs(picture[24, 32] - other).max() > 2.5
    swapped = bgr_of(Y, U, V, *COLOURS[(6, 1) if colour[0] == 1 else (1, 1)], full=colour[1] == 2)
    assert np.abs(picture[24, 32] - swapped).max() > 2.5


def test_ten_bits_become_eight(tmp_path: Path) -> None:
    images = moving_images(4)
    write_video(tmp_path / "ten.mkv", images, codec=H265, pixels="yuv420p10le")
    stream = Stream(tmp_path / "ten.mkv")
    pictures = dict(stream.decoder().decoded(stream.data, range(4)))
    assert all(isinstance(picture, np.ndarray) and picture.dtype == np.uint8 for picture in pictures.values())
    assert [number_of(picture) for picture in pictures.values() if isinstance(picture, np.ndarray)] == [0, 1, 2, 3]


def test_libav_says_nothing(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name in NAMES:
        stream = Stream(folder / name)
        list(stream.decoder().decoded([data[: len(data) // 2] for data in stream.data], range(24)))
    assert capfd.readouterr() == ("", "")


def test_without_the_package_a_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"rigcal\[video\]"):
        PacketDecoder("h264")


def test_the_package_is_imported_late() -> None:
    code = "import sys; import rigcal.sources.video; sys.exit('av' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(("name", "code"), [("a.mp4", "mp4v"), ("a.avi", "XVID")])
def test_mpeg4_pictures_all_come_and_are_the_same_each_time(tmp_path: Path, name: str, code: str) -> None:
    """Its decoder reads beyond a packet's end: without zeros there, a fifth and more came out as damaged."""
    writer = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter.fourcc(*code), 30.0, (160, 120))
    rng = np.random.default_rng(3)
    for image in rng.integers(0, 256, (40, 12, 16, 3)).astype(np.uint8):
        writer.write(cv2.resize(image, (160, 120), interpolation=cv2.INTER_CUBIC))
    writer.release()
    stream = Stream(tmp_path / name)
    reads = [[picture for _, picture in stream.decoder().decoded(stream.encoded(), range(40))] for _ in range(2)]
    assert not [picture for read in reads for picture in read if isinstance(picture, Undecoded)]
    np.testing.assert_array_equal(np.array(reads[0]), np.array(reads[1]))


def test_damage_is_told_in_pictures_of_several_slices_too(tmp_path: Path) -> None:
    """With threads for the slices libav says nothing of what goes wrong in them."""
    images = moving_images(12, (320, 240))
    noise = np.random.default_rng(0).integers(-30, 31, images[0].shape)
    noisy = [np.clip(image + noise, 0, 255).astype(np.uint8) for image in images]
    write_video(tmp_path / "v.mkv", noisy, options={"x264-params": "slices=4:keyint=12:bframes=0"}, key_every=12)
    stream = Stream(tmp_path / "v.mkv")
    whole = dict(stream.decoder().decoded(stream.encoded(), stream.in_order))
    packets = stream.encoded()
    rng, spoilt = np.random.default_rng(1), bytearray(stream.data[2])
    for at in rng.integers(len(spoilt) // 4, len(spoilt), 40):
        spoilt[at] ^= 1 << int(rng.integers(8))
    packets[2] = Encoded(data=bytes(spoilt))
    found = dict(stream.decoder().decoded(packets, stream.in_order))
    for packet, picture in found.items():
        assert isinstance(picture, Undecoded) == (packet >= 2)
        if not isinstance(picture, Undecoded):
            np.testing.assert_array_equal(picture, whole[packet])
