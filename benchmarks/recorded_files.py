"""Recordings as other programs make them: video files, MCAP files of JPEG images, SVO2 files of ZED cameras.

Owns      writing such files for benchmarks.
Leaves    reading them to what is measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.model import Camera
from rigcal.sources.camera_info import dump_camera_info
from rigcal.sources.svo2_payload import FOOTER, HEAD, KEY_FRAME

H264, H265 = "libx264", "libx265"
_CONF_SECTION = {720: "HD", 1080: "FHD"}  # by the height of the images [px]
_PARAMETERS = {H264: "x264-params", H265: "x265-params"}
Image = NDArray[np.uint8]


def filmed_images(n: int, size: tuple[int, int], seed: int = 0) -> list[Image]:
    """Images (h, w, 3) of a textured plane that moves before a camera with noise."""
    width, height = size
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height // 16 + 8, width // 16 + 8, 3), dtype=np.uint8)
    plane = cv2.resize(coarse, None, fx=16, fy=16, interpolation=cv2.INTER_CUBIC)
    noise = rng.normal(0.0, 2.0, (height, width, 3)).astype(np.float32)
    images = []
    for k in range(n):
        shift = np.array([[1.0, 0.0, -0.7 * (k % 60)], [0.0, 1.0, -0.4 * (k % 60)]])
        view = cv2.warpAffine(plane, shift, (width, height), flags=cv2.INTER_LINEAR)
        rolled = np.roll(noise, int(rng.integers(0, height)), axis=0)
        images.append(np.clip(view + rolled, 0, 255).astype(np.uint8))
    return images


def write_video(
    path: Path,
    images: Iterable[Image],
    *,
    codec: str = H264,
    key_every: int = 30,
    crf: int = 20,
    stamps_ms: Sequence[int] | None = None,
    pixels: str = "yuv420p",
) -> None:
    """A video file with the encoder's usual B pictures; 30 frames a second where no stamps are given."""
    import av

    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=30)
        assert isinstance(stream, av.VideoStream)
        base = Fraction(1, 30) if stamps_ms is None else Fraction(1, 1000)
        for k, image in enumerate(images):
            if k == 0:
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = pixels
                stream.codec_context.time_base = base
                keys = f"keyint={key_every}:min-keyint={key_every}:scenecut=0:open-gop=0:log-level=none"
                # PyAV asks for slices, other programs do not.
                keys += ":sliced-threads=0" if codec == H264 else ""
                stream.options = {_PARAMETERS[codec]: keys, "crf": str(crf), "preset": "veryfast"}
            frame = av.VideoFrame.from_ndarray(image, "bgr24").reformat(format=pixels)
            frame.pts = k if stamps_ms is None else stamps_ms[k]
            frame.time_base = base
            out.mux(stream.encode(frame))
        out.mux(stream.encode())


def write_repeated(path: Path, source: Path, times: int) -> int:
    """A long video: the packets of a short one, which begins with a key picture, again and again.

    Returns:
        How many packets it has.
    """
    import av

    with av.open(str(source)) as short, av.open(str(path), "w") as out:
        inner = short.streams.video[0]
        stream = out.add_stream_from_template(inner)
        packets = [(bytes(p), p.pts, p.dts, p.duration, p.is_keyframe) for p in short.demux(inner) if p.size]
        length = sum(duration or 0 for _, _, _, duration, _ in packets)
        for k in range(times):
            for data, pts, dts, duration, key in packets:
                packet = av.Packet(data)
                packet.stream = stream
                packet.time_base = inner.time_base or Fraction(1, 30)
                packet.pts, packet.dts, packet.duration = (pts or 0) + k * length, (dts or 0) + k * length, duration
                packet.is_keyframe = key
                out.mux(packet)
    return times * len(packets)


def write_svo2(folder: Path, serial: str, images: Sequence[Image], *, codec: str, times: int) -> Path:
    """An SVO2 file of pairs (h, 2 w, 3) again and again, and the camera's factory calibration beside it."""
    from mcap.writer import CompressionType, Writer

    path, topic = folder / f"{serial}.svo2", f"Camera_SN{serial}/side_by_side"
    height, width = images[0].shape[:2]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(library="libmcap stereolabs")
        schema = writer.register_schema(topic, "zed_sdk_encoded", b"")
        channel = writer.register_channel(topic, "zed_sdk_encoded", schema)
        packets = list(_hardware_encoded(images, codec)) * times
        for k, data in enumerate(packets):
            number_of_key = k - k % len(images)
            kind = KEY_FRAME if k == number_of_key else 0
            stamp = 10**18 + k * 33_333_333
            footer = FOOTER.pack(width, height, 0, 0, 0, 0, stamp, len(data), kind, number_of_key, k, 0)
            message = HEAD.pack(len(data) + len(footer) + 4, len(data)) + data + footer
            writer.add_message(channel, stamp, message, stamp, k)
        writer.finish()
    focal, centre = 0.55 * width / 2, (width / 4, height / 2)
    lens = f"fx={focal}\nfy={focal}\ncx={centre[0]}\ncy={centre[1]}\nk1=-0.17\nk2=0.03\np1=0\np2=0\nk3=0\n"
    eyes = "".join(f"[{side}_CAM_{_CONF_SECTION[height]}]\n{lens}" for side in ("LEFT", "RIGHT"))
    angles = "".join(f"{angle}_{_CONF_SECTION[height]}=0.002\n" for angle in ("RX", "CV", "RZ"))
    (folder / f"SN{serial}.conf").write_text(f"{eyes}[STEREO]\nBaseline=120\nTY=0\nTZ=0\n{angles}", encoding="utf-8")
    return path


def _hardware_encoded(images: Sequence[Image], codec: str) -> Iterator[bytes]:
    """Packets as graphics cards encode a camera: no B pictures, and nothing in a picture that could be done at once."""
    import av

    context = av.CodecContext.create(codec, "w")
    assert isinstance(context, av.VideoCodecContext)
    context.height, context.width = images[0].shape[:2]
    context.pix_fmt, context.time_base, context.framerate = "yuv420p", Fraction(1, 30), Fraction(30)
    settings = "keyint=infinite:scenecut=0:bframes=0:repeat-headers=1:log-level=none"
    settings += ":sliced-threads=0" if codec == H264 else ":wpp=0"
    context.options = {"preset": "ultrafast", "crf": "20", "tune": "zerolatency", _PARAMETERS[codec]: settings}
    for k, image in enumerate(images):
        frame = av.VideoFrame.from_ndarray(image, "bgr24").reformat(format="yuv420p")
        frame.pts = k
        yield from map(bytes, context.encode(frame))
    yield from map(bytes, context.encode())


def write_intrinsics(path: Path, name: str, size: tuple[int, int]) -> Camera:
    """A camera_info file beside a video, of a camera without distortion."""
    width, height = size
    K = np.array([[0.8 * width, 0.0, width / 2], [0.0, 0.8 * width, height / 2], [0.0, 0.0, 1.0]])
    camera = Camera(name=name, width=width, height=height, K=K)
    path.write_text(dump_camera_info(camera), encoding="utf-8")
    return camera


def write_jpeg_mcap(path: Path, camera: Camera, jpegs: Sequence[bytes], period_ns: int) -> None:
    """An MCAP file as ROS 2 drivers record it: JPEG images, which chunks need not compress again."""
    from mcap.writer import CompressionType, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    kinds = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo")
    size = {"width": camera.width, "height": camera.height}
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        channels = [
            writer.register_channel(
                f"/{camera.name}/{topic}",
                "cdr",
                writer.register_schema(kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode()),
            )
            for topic, kind in zip(("image_raw/compressed", "camera_info"), kinds)
        ]
        for k, data in enumerate(jpegs):
            stamp = k * period_ns
            time = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
            header = types["std_msgs/msg/Header"](time, camera.name)
            image = types[kinds[0]](header, "jpeg", np.frombuffer(data, dtype=np.uint8))
            info = types[kinds[1]](
                header=header,
                **size,
                distortion_model=camera.distortion_model,
                d=camera.distortion,
                k=camera.K.ravel(),
                r=np.eye(3).ravel(),
                p=np.hstack([camera.K, np.zeros((3, 1))]).ravel(),
                binning_x=0,
                binning_y=0,
                roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
            )
            for channel, kind, message in zip(channels, kinds, (image, info)):
                writer.add_message(channel, stamp, bytes(store.serialize_cdr(message, kind)), stamp, k)
        writer.finish()
