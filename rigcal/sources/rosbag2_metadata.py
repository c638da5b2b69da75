"""metadata.yaml, which rosbag2 writes beside the files of a bag.

Owns      its keys, and how much of it is believed.
Leaves    which files are one recording to ros_bag, what is lost of one to rosbag2_sqlite.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import yaml

from aruco.errors import InputError

METADATA = "metadata.yaml"
# A line for each of some thousand files, and some lines for each of some hundred topics.
MAX_METADATA_BYTES = 4 * 2**20


@dataclass(frozen=True, slots=True, kw_only=True)
class StatedTopic:
    """A topic as metadata.yaml has it."""

    name: str
    type: str
    count: int  # messages in all files


@dataclass(frozen=True, slots=True, kw_only=True)
class Metadata:
    """What metadata.yaml says."""

    files: tuple[str, ...] = ()
    compression_mode: str = ""  # "", "file" or "message"
    compression_format: str = ""
    count_of_file: Mapping[str, int] = field(default_factory=dict)  # name of a file -> its messages, where it is said
    topics: tuple[StatedTopic, ...] = ()


def read_metadata(folder: Path) -> Metadata:
    """What a folder's metadata.yaml says; nothing where there is none, or it is another program's.

    Raises:
        InputError: It is no YAML file, or absurdly large.
        OSError: It cannot be read.
    """
    file = folder / METADATA
    if not file.is_file():
        return Metadata()
    if file.stat().st_size > MAX_METADATA_BYTES:
        raise InputError(f"{file}: over {MAX_METADATA_BYTES >> 20} MiB, which is not a rosbag2 description.")
    try:
        # The base loader makes texts, lists and maps only.
        content = yaml.load(file.read_text(encoding="utf-8-sig"), Loader=yaml.BaseLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{file}: not a readable YAML file ({reason}); restore it or run ros2 bag reindex.") from error
    bag = _map(content, "rosbag2_bagfile_information")
    files = tuple(name for name in _list(bag, "relative_file_paths") if isinstance(name, str) and PurePath(name).name)
    counts = {PurePath(str(one.get("path"))).name: _count(one) for one in _maps(bag, "files")}
    if len(files) == 1:  # older versions give only the sum
        counts.setdefault(PurePath(files[0]).name, _count(bag))
    return Metadata(
        files=files,
        compression_mode=str(bag.get("compression_mode", "")).lower().replace("none", ""),
        compression_format=str(bag.get("compression_format", "")).lower(),
        count_of_file={name: count for name, count in counts.items() if count is not None},
        topics=tuple(_topics(bag)),
    )


def _topics(bag: Mapping[str, Any]) -> Iterator[StatedTopic]:
    for one in _maps(bag, "topics_with_message_count"):
        about, count = _map(one, "topic_metadata"), _count(one)
        if count is not None:
            yield StatedTopic(name=str(about.get("name", "")), type=str(about.get("type", "")), count=count)


def _count(content: Mapping[str, Any]) -> int | None:
    text = str(content.get("message_count", ""))
    return int(text) if text.isascii() and text.isdigit() and len(text) < 19 else None


def _map(content: Any, key: str) -> Mapping[str, Any]:
    value = content.get(key) if isinstance(content, dict) else None
    return value if isinstance(value, dict) else {}


def _maps(content: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    return [value for value in _list(content, key) if isinstance(value, dict)]


def _list(content: Mapping[str, Any], key: str) -> list[Any]:
    value = content.get(key)
    return value if isinstance(value, list) else []
