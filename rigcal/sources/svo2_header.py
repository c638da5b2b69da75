"""What an SVO2 file says of itself: its version, its cameras, whether it can be read at all.

Owns      the topics, the JSON header, and the sentences about files that are encrypted or of another version.
Leaves    the container to mcap_index, frames to svo2_frames, the accelerometer to svo2_sensors.

The layout is known from descriptions of other people's files, not from its maker; see docs/recordings.md.
"""

from __future__ import annotations

import base64
import json
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from loguru import logger

from aruco.errors import InputError
from rigcal.sources.mcap_index import DamagedError, McapChannel, McapIndex

HEADER_TOPIC = "svo_header"
KNOWN_MAJOR_VERSION = "2"
FRAMES, SENSORS = "side_by_side", ("integrated_sensors", "sensors")
# Width and height of one eye [px], serial number, frames per second.
_HEADER = struct.Struct("<IIII")
# The files of today have 1 to 4 kB.
_MAX_HEADER_BYTES = 2**20
_TOPIC = re.compile(r"Camera_SN([0-9]{1,12})/([a-z_]+)")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraTopics:
    """Where one camera's messages are."""

    serial: str
    frames: int  # channel
    sensors: int | None  # channel of accelerometer messages, the ones that belong to frames rather than all


def camera_topics(mcap: McapIndex) -> tuple[CameraTopics, ...]:
    """The cameras of a file, sorted by serial number.

    Raises:
        InputError: There is none, its version is unknown, it is encrypted, or a topic is named like no camera's.
    """
    _check_header(mcap)
    found: dict[str, dict[str, int]] = {}
    for channel in mcap.channels:
        match = _TOPIC.fullmatch(channel.topic)
        if match is None:
            _check_foreign_topic(mcap.path, channel)
            continue
        if "encrypt" in f"{channel.encoding} {channel.schema_encoding} {channel.schema_name}".lower():
            raise encrypted(mcap.path)
        kinds = found.setdefault(match[1], {})
        if match[2] in kinds and mcap.count(channel.id) and mcap.count(kinds[match[2]]):
            raise InputError(f"{mcap.path}: has two streams {channel.topic}; export the recording again.")
        if match[2] not in kinds or mcap.count(channel.id):
            kinds[match[2]] = channel.id
    cameras = [
        CameraTopics(
            serial=serial,
            frames=kinds[FRAMES],
            sensors=next((kinds[kind] for kind in SENSORS if kind in kinds and mcap.count(kinds[kind])), None),
        )
        for serial, kinds in sorted(found.items())
        if FRAMES in kinds
    ]
    if not cameras:
        raise InputError(f"{mcap.path}: an SVO2 file without a camera's {FRAMES} stream; record it again.")
    return tuple(cameras)


def encrypted(path: Path) -> InputError:
    """The sentence about an encrypted file."""
    return InputError(
        f"{path}: is encrypted (the ZED SDK can do that from version 5.3 on) and cannot be read here; open it on a "
        "computer with the ZED SDK and its key, or record without encryption."
    )


def unreadable_coding(path: Path, serial: str) -> InputError:
    """The sentence about frames that are neither H.264, H.265 nor JPEG, as far as can be seen."""
    return InputError(
        f"{path}: the frames of camera {serial} are neither H.264, H.265 nor JPEG: they are encrypted (the ZED SDK can "
        "do that from version 5.3 on) or of a newer version of the format; open the file on a computer with the ZED "
        "SDK, or record with H264 or H265 compression and without encryption."
    )


def _check_foreign_topic(path: Path, channel: McapChannel) -> None:
    if channel.topic.endswith(f"/{FRAMES}"):
        raise InputError(
            f"{path}: a stream is called {channel.topic[:80]!r} and not Camera_SN<serial>/{FRAMES}; record or export "
            "the file again."
        )


def _check_header(mcap: McapIndex) -> None:
    if any("encrypt" in name.lower() for name in mcap.metadata):
        raise encrypted(mcap.path)
    header = _header(mcap)
    for key, value in header.items():
        marked = "encrypt" in key or "cipher" in key
        if marked and str(value).strip().lower() not in ("", "0", "false", "none", "null"):
            raise encrypted(mcap.path)
    version = str(header.get("version", ""))[:20]
    if version and version.split(".")[0] != KNOWN_MAJOR_VERSION:
        raise InputError(
            f"{mcap.path}: is SVO of version {version!r}, and only {KNOWN_MAJOR_VERSION}.x is known here; open it on a "
            "computer with the ZED SDK."
        )
    logger.debug(
        "{}: SVO {} by ZED SDK {} ({}): {}",
        mcap.path,
        version or "of unknown version",
        header.get("zed_sdk_version", "unknown"),
        mcap.library,
        _binary(header),
    )


def _header(mcap: McapIndex) -> Mapping[str, Any]:
    """The JSON header with its keys in small letters; empty where there is none that can be read."""
    channel = next((channel for channel in mcap.channels if channel.topic == HEADER_TOPIC), None)
    if channel is None or not mcap.count(channel.id):
        logger.warning("{}: has no {}; its version is not known", mcap.path, HEADER_TOPIC)
        return {}
    try:
        text = mcap.message(channel.id, 0)
        header = json.loads(text) if len(text) <= _MAX_HEADER_BYTES else None
    except (DamagedError, ValueError, RecursionError) as error:
        logger.warning("{}: its {} cannot be read ({})", mcap.path, HEADER_TOPIC, str(error)[:100])
        return {}
    if not isinstance(header, dict):
        logger.warning("{}: its {} holds no keys; its version is not known", mcap.path, HEADER_TOPIC)
        return {}
    return {str(key).lower(): value for key, value in header.items()}


def _binary(header: Mapping[str, Any]) -> str:
    """The header's numbers in words. The frames say their own size, so nothing depends on them."""
    try:
        width, height, serial, fps = _HEADER.unpack_from(base64.b64decode(str(header.get("header", "")), validate=True))
    except (ValueError, struct.error):
        return "no header in base64"
    return f"{width} x {height}, camera {serial}, {fps} frames per second"
