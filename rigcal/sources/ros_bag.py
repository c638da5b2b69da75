"""ROS bags: ROS 1 files (.bag) and rosbag2 folders (SQLite or MCAP files), also split ones.

Owns      recognising them, and which files are one recording.
Leaves    metadata.yaml to rosbag2_metadata, the containers to rosbag1_index, rosbag2_sqlite and mcap_file, what
          messages mean to ros_opening.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

from loguru import logger

from aruco.errors import InputError
from aruco.model import Recording
from rigcal.sources.mcap_records import MAGIC as MCAP_MAGIC
from rigcal.sources.message_store import ChannelStore, MessageStore, SplitStore, Topic, ZstdMessages, plain_type
from rigcal.sources.options import SourceOptions
from rigcal.sources.rosbag1_index import MAGIC, Rosbag1Index
from rigcal.sources.rosbag2_metadata import METADATA, read_metadata
from rigcal.sources.rosbag2_sqlite import SIGNATURE, SqliteStore
from rigcal.sources.unknown import unknown_file

if TYPE_CHECKING:
    from rigcal.sources.mcap_file import McapStore

# Messages that wait to be written when a file is full come into the next.
OVERLAP_NS = 1_000_000_000
# Files of a split bag: <name>_0.db3, <name>_1.db3, ...
_SPLIT = re.compile(r"(.*)_(\d{1,9})\.(db3|mcap|bag)")


def recognises(path: Path, head: bytes) -> bool:
    """Whether a file is a bag, or a folder holds one bag."""
    if head:
        # Any version: what is too old is named when it is opened. Of SQLite files those with rosbag2's table.
        return head.startswith(b"#ROSBAG V") or (head.startswith(SIGNATURE) and b"TABLE topics" in head)
    try:
        return path.is_dir() and bool(read_metadata(path).files or _files(path))
    except (OSError, InputError):
        # What is wrong with a metadata.yaml is said when it is opened.
        return (path / METADATA).is_file()


def opened(path: Path, options: SourceOptions) -> Recording:
    """The recording in a bag or a folder.

    Raises:
        InputError: It cannot be used.
        MissingExtraError: A package that its compression needs is not installed.
    """
    from rigcal.sources.ros_opening import ros_recording

    try:
        return ros_recording(_store(path), options)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); mend its permissions.") from error


class BagStore(ChannelStore):
    """The messages of a ROS 1 bag by topic; implements MessageStore."""

    def __init__(self, path: Path) -> None:
        """Index the bag; raises InputError."""
        self.path = path
        index = Rosbag1Index(path)
        if index.loss is not None:
            logger.warning("{}: {}", path, index.loss)
        types: dict[str, str] = {}  # of a topic's first publisher; others of that type are it, too
        ids: dict[str, list[int]] = {}
        for connection in index.connections:
            if types.setdefault(connection.topic, connection.type) == connection.type:
                ids.setdefault(connection.topic, []).append(connection.id)
        super().__init__(index, ids)
        self.topics: dict[str, Topic] = {
            name: Topic(name=name, type=plain_type(kind), encoding="ros1", count=self.count(name))
            for name, kind in types.items()
        }


def _store(path: Path) -> MessageStore:
    if not path.is_dir():
        return _file_store(path)
    metadata = read_metadata(path)
    files = _files(path)
    if not files:
        raise InputError(f"{path}: no bag there; a rosbag2 folder has {METADATA} and .db3 or .mcap files.")
    if metadata.compression_mode == "file" or any(name.suffix == ".zstd" for name in files):
        names = ", ".join(name.name for name in files)
        raise InputError(
            f"{path}: its files are compressed whole ({names}); undo that with zstd -d, or convert the bag with "
            "ros2 bag convert to compression_mode none."
        )
    if metadata.compression_mode == "message" and metadata.compression_format != "zstd":
        raise InputError(f"{path}: its messages are compressed as {metadata.compression_format}, only zstd is read.")
    stores = [_file_store(name) for name in files]
    whole = SplitStore(path, stores) if len(stores) > 1 else stores[0]
    return ZstdMessages(whole) if metadata.compression_mode == "message" else whole


def _file_store(path: Path) -> BagStore | SqliteStore | McapStore:
    with path.open("rb") as stream:
        head = stream.read(64)
    if head.startswith(MAGIC):
        return BagStore(path)
    if head.startswith(SIGNATURE):
        return SqliteStore(path)
    if head and MAGIC.startswith(head):
        raise InputError(f"{path}: is cut off after {len(head)} bytes; copy it again.")
    if head.startswith(b"#ROSBAG V"):
        version = head.split(b"\n")[0][len(b"#ROSBAG V") :].decode("ascii", "replace")
        raise InputError(f"{path}: is a bag of version {version}, only 2.0 is read; convert it with rosbag fix.")
    if not head.startswith(MCAP_MAGIC):
        raise unknown_file(path, head)
    from rigcal.sources.mcap_file import McapStore

    return McapStore(path)


def _files(path: Path) -> list[Path]:
    """The files of the one bag in a folder, in order; none where there is no bag or several.

    An interrupted recorder has written no metadata.yaml; then the files are known by their numbered names.
    """
    metadata = read_metadata(path)
    if metadata.files:
        # Only names: a bag's files lie beside its metadata, whatever the paths say.
        found = [path / PurePath(name).name for name in metadata.files]
        there = [name for name in found if name.is_file()]
        if len(there) < len(found):
            missing = ", ".join(name.name for name in found if name not in there)
            logger.warning("{}: {} of its files are missing: {}", path, len(found) - len(there), missing)
        return there
    numbered: dict[tuple[str, str], list[tuple[int, Path]]] = {}
    for child in path.iterdir():
        match = _SPLIT.fullmatch(child.name)
        if match is not None and child.is_file():
            numbered.setdefault((match[1], match[3]), []).append((int(match[2]), child))
    # One file alone is a recording without its folder.
    if len(numbered) != 1 or len(next(iter(numbered.values()))) < 2:
        return []
    files = [child for _, child in sorted(next(iter(numbered.values())))]
    return files if _are_split(files) else []


def _are_split(files: Sequence[Path]) -> bool:
    """Whether files are one after the other. RealSense's are one a camera, whatever they are called."""
    from rigcal.sources.realsense_topics import is_realsense

    stores = [_file_store(path) for path in files]
    if any(is_realsense(store.topics) for store in stores):
        return False
    spans = [span for store in stores if (span := store.span_ns()) is not None]
    overlap_ns = min([OVERLAP_NS, *((end - start) // 2 for start, end in spans)])
    return all(later[0] >= earlier[1] - overlap_ns for earlier, later in pairwise(spans))
