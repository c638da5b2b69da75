"""SVO2 files made to the description that the reader follows, and the conf files of their cameras.

There is no real file to test with. What is written here follows published descriptions: MCAP, not compressed, by
"libmcap stereolabs"; a JSON header with 128 bytes in base64; frames with two sizes before and 56 bytes after the
Annex-B stream; sensor samples of 360 bytes in JSON.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from aruco.model import Camera

SIZE = (672, 376)
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 33_333_333
BASELINE_M = 0.12
# Of an invented camera with the distortion and the misalignment of a real ZED.
LEFT = {"fx": 351.2, "fy": 350.6, "cx": 341.3, "cy": 191.7, "k1": -0.174, "k2": 0.026, "p1": 4e-4, "p2": -3e-4, "k3": 0}
RIGHT = {"fx": 349.9, "fy": 349.5, "cx": 331.8, "cy": 186.2, "k1": -0.176, "k2": 0.027, "p1": 2e-4, "p2": 5e-4, "k3": 0}
STEREO = {"Baseline": 120, "TY": 0.2, "TZ": -0.3, "CV_VGA": 0.0068, "RX_VGA": 0.0061, "RZ_VGA": -0.0019}

FOOTER = struct.Struct("<III iii Q I ii I i 4x")


@dataclass(frozen=True, kw_only=True)
class Clip:
    """What one camera recorded."""

    pairs: Sequence[np.ndarray]  # (h, 2 w, 3) BGR, both eyes
    stamps_ns: Sequence[int] = ()  # one a pair; empty: even
    codec: str = "h264"  # "hevc", "jpeg"
    key_every: int = 5
    accelerations: Sequence[Sequence[float]] = field(default_factory=tuple)  # m/s^2, of sensors
    # (number of the frame, its message) -> what is written instead; None: nothing
    change: Callable[[int, bytes], bytes | None] = lambda number, message: message

    def stamps(self) -> list[int]:
        return list(self.stamps_ns) or [START_NS + PERIOD_NS * k for k in range(len(self.pairs))]


def conf_text(left: Mapping[str, float] = LEFT, right: Mapping[str, float] = RIGHT, *, section: str = "VGA") -> str:
    """A conf file in the older form."""
    stereo = {key.replace("VGA", section): value for key, value in STEREO.items()}
    parts = {f"LEFT_CAM_{section}": left, f"RIGHT_CAM_{section}": right, "STEREO": stereo}
    return "\n".join(f"[{name}]\n" + "".join(f"{k}={v}\n" for k, v in values.items()) for name, values in parts.items())


def eyes() -> tuple[Camera, Camera]:
    """The two eyes of ``conf_text``'s camera as they are recorded."""

    def eye(name: str, v: Mapping[str, float]) -> Camera:
        K = np.array([[v["fx"], 0, v["cx"]], [0, v["fy"], v["cy"]], [0, 0, 1]])
        distortion = np.array([v[key] for key in ("k1", "k2", "p1", "p2", "k3")])
        return Camera(name=name, width=SIZE[0], height=SIZE[1], K=K, distortion=distortion)

    return eye("left", LEFT), eye("right", RIGHT)


def T_right_left() -> np.ndarray:
    """How ``conf_text``'s eyes stand to each other, by the formula of the description."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([STEREO["RX_VGA"], STEREO["CV_VGA"], STEREO["RZ_VGA"]]))[0]
    T[:3, 3] = np.array([-STEREO["Baseline"], STEREO["TY"], STEREO["TZ"]]) / 1000
    return T


def R_rect_left() -> np.ndarray:
    """(3, 3) from the axes of ``conf_text``'s left eye into those of the rectified pair."""
    left, right = eyes()
    T = T_right_left()
    given = (left.K, left.distortion, right.K, right.distortion, SIZE, T[:3, :3], T[:3, 3:])
    return np.asarray(cv2.stereoRectify(*given, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)[0])


def write_svo2(
    path: Path,
    clips: Mapping[str, Clip],
    *,
    header: Mapping[str, Any] | None = None,
    chunk_size: int = 64 * 1024,
    compression: CompressionType = CompressionType.NONE,
    topic: str = "Camera_SN{serial}",
) -> None:
    """Write cameras, named by serial number, into one file."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_size, compression=compression)
        writer.start(profile="", library="libmcap stereolabs")
        serial, clip = next(iter(clips.items()))
        first = clip.stamps()[0]
        _add_json(writer, "svo_header", "sl_type", _header(serial, clip, header or {}), first)
        for stamp, channel, data in sorted(_messages(writer, clips, topic), key=lambda message: message[0]):
            writer.add_message(channel_id=channel, log_time=stamp, publish_time=stamp, data=data)
        _add_json(writer, "svo_footer", "sl_type", {"frames": []}, first)
        writer.finish()


def _messages(writer: Writer, clips: Mapping[str, Clip], topic: str) -> Iterator[tuple[int, int, bytes]]:
    for serial, clip in clips.items():
        name = topic.format(serial=serial)
        schema = writer.register_schema(f"{name}/side_by_side", "zed_sdk_encoded", b"")
        channel = writer.register_channel(f"{name}/side_by_side", "zed_sdk_encoded", schema)
        for number, (stamp, message) in enumerate(zip(clip.stamps(), frame_messages(clip), strict=True)):
            changed = clip.change(number, message)
            if changed is not None:
                yield stamp, channel, changed
        if len(clip.accelerations):
            schema = writer.register_schema("sensors", "jsonschema", b"{}")
            channel = writer.register_channel(f"{name}/sensors", "json", schema)
            for k, acceleration in enumerate(clip.accelerations):
                stamp = START_NS + 2_500_000 * k
                yield stamp, channel, json.dumps(_sensors(stamp, acceleration)).encode()


def frame_messages(clip: Clip) -> list[bytes]:
    """The messages of a clip's frames."""
    payloads = [jpeg_payload(pair) for pair in clip.pairs] if clip.codec == "jpeg" else encoded(clip)
    height, width = clip.pairs[0].shape[:2]
    messages = []
    for number, (stamp, payload) in enumerate(zip(clip.stamps(), payloads, strict=True)):
        last_key = number - number % clip.key_every
        kind = 3 if number == last_key else 0
        constants = (0x5C002C00, 1, 2, -1)
        footer = FOOTER.pack(width, height, *constants, stamp, len(payload), kind, last_key, number, 7 + last_key)
        messages.append(struct.pack("<II", len(payload) + 4 + len(footer), len(payload)) + payload + footer)
    return messages


def encoded(clip: Clip) -> list[bytes]:
    """Annex-B packets, one a picture, a key picture every ``key_every``."""
    name = {"h264": "libx264", "hevc": "libx265"}[clip.codec]
    context = av.CodecContext.create(name, "w")
    assert isinstance(context, av.VideoCodecContext)
    context.height, context.width = clip.pairs[0].shape[:2]
    context.pix_fmt, context.time_base, context.framerate = "yuv420p", Fraction(1, 30), Fraction(30)
    params = (
        f"keyint={clip.key_every}:min-keyint={clip.key_every}:scenecut=0:bframes=0:repeat-headers=1:sliced-threads=0"
    )
    options = {"preset": "ultrafast", "crf": "8", "tune": "zerolatency"}
    quiet = ":log-level=none" if clip.codec == "hevc" else ""
    context.options = {**options, f"{name[3:]}-params": params + quiet}
    packets = []
    for k, pair in enumerate([*clip.pairs, None]):
        frame = None
        if pair is not None:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pair), format="bgr24").reformat(format="yuv420p")
            frame.pts = k
        packets += [bytes(packet) for packet in context.encode(frame)]
    return packets


def jpeg_payload(pair: np.ndarray) -> bytes:
    """Four grey strips that hold the bytes of YUYV pixels."""
    yuyv = cv2.cvtColor(pair, cv2.COLOR_BGR2YUV_YUYV)
    rows = yuyv.reshape(yuyv.shape[0], -1)
    strips = [
        cv2.imencode(".jpg", strip, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes() for strip in np.array_split(rows, 4)
    ]
    return struct.pack("<4Q", *map(len, strips)) + b"".join(strips)


def _header(serial: str, clip: Clip, more: Mapping[str, Any]) -> dict[str, Any]:
    height, width = clip.pairs[0].shape[:2]
    binary = struct.pack("<IIII", width // 2, height, int(serial), 30).ljust(128, b"\0")
    known = {"ZED_SDK_version": "5.1.2", "version": "2.0.5", "IMU_frequency": 400.0}
    return {**known, "header": base64.b64encode(binary).decode(), **more}


def _sensors(stamp_ns: int, acceleration: Sequence[float]) -> dict[str, str]:
    data = bytearray(360)
    struct.pack_into("<Q", data, 0x10, stamp_ns)
    struct.pack_into("<4f", data, 0x3C, 0, 0, 0, 1)
    struct.pack_into("<3f", data, 0x58, 0.1, -0.1, 0.05)
    struct.pack_into("<3f", data, 0x64, *acceleration)
    return {"__title__": "sensors", "data": base64.b64encode(bytes(data)).decode()}


def _add_json(writer: Writer, topic: str, name: str, content: Mapping[str, Any], stamp: int) -> None:
    schema = writer.register_schema(name, "jsonschema", b"{}")
    channel = writer.register_channel(topic, "json", schema)
    writer.add_message(channel_id=channel, log_time=stamp, publish_time=stamp, data=json.dumps(content).encode())
