"""What is no recording: what it looks like, and what to give instead.

Owns      recognising files that people mistake for recordings, and the sentences about them.
Leaves    recognising recordings to their readers.
"""

from __future__ import annotations

from pathlib import Path

from aruco.errors import InputError

KNOWN = "RGB-D folders, ZED SVO and SVO2, ROS bags (.bag, rosbag2 folders, .mcap) and videos"
# A file that is named so and holds something else is worth a word.
RECORDING_SUFFIXES = (
    ".svo",
    ".svo2",
    ".mcap",
    ".bag",
    ".db3",
    ".mp4",
    ".mkv",
    ".avi",
    ".mov",
    ".webm",
    ".h264",
    ".h265",
)

# First bytes -> what it is, and what to do with it.
_LOOKS = (
    (
        b"\x89PNG",
        "looks like a PNG image; give the recording's folder, <recording>/<camera>/image/",
    ),
    (b"\xff\xd8\xff", "looks like a JPEG image; give the recording's folder, <recording>/<camera>/image/"),
    (b"\x89HDF\r\n\x1a\n", "looks like an HDF5 file; a depth store goes to refine-ground-plane --input-depth"),
    (b"PAR1", "looks like a Parquet file; a marker map goes to --markers"),
    (b"PK\x03\x04", "looks like a ZIP archive; unpack it first"),
    (b"\x1f\x8b", "looks like a gzip archive; unpack it first"),
    (b"\x28\xb5\x2f\xfd", "looks like a Zstandard archive; unpack it first"),
    (b"\x04\x22\x4d\x18", "looks like an LZ4 archive; unpack it first"),
    (b"\xfd7zXZ", "looks like an XZ archive; unpack it first"),
    (b"7z\xbc\xaf", "looks like a 7-Zip archive; unpack it first"),
    (
        b"SQLite format 3\0",
        "looks like a SQLite file; of a rosbag2 recording give the folder with its metadata.yaml",
    ),
    (b"GIF8", "looks like a GIF animation; give the video or the images that it was made of"),
    (b"%PDF", "looks like a PDF document; give a recording"),
    (b"\x7fELF", "looks like a program; give a recording"),
)


def unknown_file(path: Path, head: bytes) -> InputError:
    """What to say about a file that no reader knows, from its first bytes."""
    return InputError(f"{path}: {what_it_is(path, head)}. Known recordings: {KNOWN}.")


def empty_folder(path: Path) -> InputError:
    """What to say about a folder without recordings."""
    return InputError(
        f"{path}: no recording there; an RGB-D folder has <camera>/camera_info.yaml and <camera>/image/<stamp_ns>.png "
        f"or .jpg. Known recordings: {KNOWN}."
    )


def unfinished(path: Path) -> InputError:
    """What to say about the folder of an interrupted conversion."""
    whole = path.with_suffix("")
    return InputError(
        f"{path}: is an unfinished conversion; run the rigcal convert that wrote {whole.name} again, which goes on "
        "where it stopped."
    )


def what_it_is(path: Path, head: bytes) -> str:
    """What a file looks like that no reader knows, and what to do with it, to complete the sentence "<file>: ..."."""
    if not head:
        return "is empty (0 bytes); copy the recording again"
    if not any(head):
        return f"begins with {len(head)} zero bytes, as a file does that was not copied to its end; copy it again"
    for signature, look in _LOOKS:
        if head.startswith(signature):
            return look
    if is_text(head):
        return _text_look(path)
    suffix = path.suffix.lower()
    named = f" although it is named {suffix}" if suffix else ""
    return f"does not begin like any recording that is known here{named}; it may be damaged, copy it again"


def is_text(head: bytes) -> bool:
    """Whether first bytes are text, which no recording begins with for long."""
    try:
        head[:-4].decode("utf-8")  # a character may be cut at the end
    except UnicodeDecodeError:
        return False
    return b"\0" not in head


def _text_look(path: Path) -> str:
    if path.name == "metadata.yaml":
        return "describes a rosbag2 recording; give its folder"
    if path.name == "camera_info.yaml":
        return "describes a camera of an RGB-D folder; give the folder above the camera's"
    if path.suffix.lower() in (".yaml", ".yml", ".toml", ".json"):
        return "is a text file; the intrinsics of videos go to --intrinsics, and the recording itself is wanted here"
    if path.suffix.lower() == ".conf":
        return "is a text file; a ZED calibration goes to --zed-conf, and the recording itself is wanted here"
    named = f" although it is named {path.suffix}" if path.suffix.lower() in RECORDING_SUFFIXES else ""
    return f"is a text file, not a recording{named}"
