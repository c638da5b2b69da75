"""When a video's frames were taken, where a table beside it says so.

Owns      which table is a video's, the names and units of its columns, what is wrong with it.
Leaves    the time stamps inside of videos to video_index.

    <stem>.csv, <stem>_timestamps.csv    one row a frame
    timestamps.csv                       the same for several cameras, with a column camera

The first row names the columns: one of times, whose name tells the unit (``timestamp_ns``, ``stamp_ns``,
``time_s`` ...), and ``frame``, the number of the frame counted from 0, where not every frame has a row.
"""

from __future__ import annotations

import csv
import os
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TextIO

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.svo_sync import MAX_STAMP_NS

SHARED_NAME = "timestamps.csv"
NO_STAMP = np.iinfo(np.int64).min
# A day of 120 frames a second, 25 bytes each.
MAX_FILE_BYTES = 256 * 2**20
MAX_LINE_CHARS = 4096

_UNITS_NS = {
    **dict.fromkeys(("ns", "nsec", "nanoseconds"), 1),
    **dict.fromkeys(("us", "usec", "µs", "μs", "microseconds"), 1_000),
    **dict.fromkeys(("ms", "msec", "milliseconds"), 1_000_000),
    **dict.fromkeys(("s", "sec", "secs", "seconds"), 1_000_000_000),
}
_TIME = re.compile(
    r"(?:[a-z]+[ _-])*(?:time[ _-]?stamps?|stamps?|times?|pts|t)(?: ?[(\[]([a-zµμ]+)[)\]]|[ _-]([a-zµμ]+))?"
)
_FRAME = ("frame", "frame_index", "frame_number", "frame_id", "index")
_CAMERA = ("camera", "cam", "cam_id", "camera_name", "camera_id")


def find_stamps(video: Path) -> Path | None:
    """The table of a video's time stamps, if there is one."""
    for name in (f"{video.stem}.csv", f"{video.stem}_timestamps.csv"):
        if (video.parent / name).is_file():
            return video.parent / name
    shared = video.parent / SHARED_NAME
    return shared if shared.is_file() else None


def read_stamps(table: Path, camera: str, n_frames: int, *, alone: bool, may_be_cut: bool) -> NDArray[np.int64]:
    """When each frame of a video was taken.

    Args:
        table: The CSV file.
        camera: Whose rows count, where the table has a column of cameras.
        n_frames: How many frames the video has.
        alone: Whether there is no other video that the table could be meant for.
        may_be_cut: Whether the end of the video may be missing, so that there may be more rows.

    Returns:
        (n_frames,) nanoseconds, ascending; NO_STAMP for frames without a row.

    Raises:
        InputError: The table cannot be used; the message says why and where.
    """
    try:
        if os.path.getsize(table) > MAX_FILE_BYTES:
            raise InputError(f"{table}: over {MAX_FILE_BYTES >> 20} MiB, which is not a table of time stamps.")
        with open(table, encoding="utf-8-sig", newline="") as file:
            lines = _lines(table, file)
            first = next(lines, "")
            rows = csv.reader(lines, delimiter=max(",;\t", key=first.count))
            columns = _Columns.named(table, next(csv.reader([first], delimiter=max(",;\t", key=first.count)), []))
            numbers, stamps = _read(table, rows, columns, camera)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{table}: cannot be read as a CSV table ({reason}); write it again.") from error
    if columns.camera is None and table.name == SHARED_NAME and not alone:
        raise InputError(f"{table}: is beside several videos and does not say which; add a column camera.")
    order = np.argsort(numbers, kind="stable")
    _refuse_order(table, numbers[order], stamps[order])
    return _by_frame(table, numbers[order], stamps[order], n_frames, columns.frame is not None, may_be_cut)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Columns:
    """Which column is what."""

    time: int
    unit_ns: int
    frame: int | None
    camera: int | None

    @staticmethod
    def named(table: Path, header: list[str]) -> _Columns:
        names = [name.strip().lower() for name in header]
        times = [(at, match[1] or match[2]) for at, name in enumerate(names) if (match := _TIME.fullmatch(name))]
        known = [(at, _UNITS_NS[unit]) for at, unit in times if unit in _UNITS_NS]
        if times and not known:
            raise InputError(
                f"{table}: the column {header[times[0][0]].strip()[:40]!r} does not say its unit; call it "
                "timestamp_ns, timestamp_us, timestamp_ms or timestamp_s."
            )
        if len(known) != 1:
            raise InputError(
                f"{table}: wants one column of times, named in its first row as timestamp_ns, timestamp_us, "
                f"timestamp_ms or timestamp_s, and has {len(known)}; if it is no table of time stamps, move it away."
            )
        return _Columns(
            time=known[0][0],
            unit_ns=known[0][1],
            frame=next((at for at, name in enumerate(names) if name in _FRAME), None),
            camera=next((at for at, name in enumerate(names) if name in _CAMERA), None),
        )


def _lines(table: Path, file: TextIO) -> Iterator[str]:
    """The lines of a file, each of bounded length."""
    while line := file.readline(MAX_LINE_CHARS):
        if len(line) == MAX_LINE_CHARS:
            raise InputError(
                f"{table}: has a row of over {MAX_LINE_CHARS} characters; it is not a table of time stamps."
            )
        yield line


def _read(
    table: Path, rows: Iterator[list[str]], columns: _Columns, camera: str
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(n,) numbers of frames and (n,) nanoseconds, in the order of the camera's rows."""
    numbers, stamps = array("q"), array("q")
    for n, row in enumerate(rows, 2):
        if not any(field.strip() for field in row):
            continue
        if len(row) <= max(column for column in (columns.time, columns.frame, columns.camera) if column is not None):
            raise InputError(f"{table}: row {n} has only {len(row)} columns; write the table again.")
        if columns.camera is not None and row[columns.camera].strip() != camera:
            continue
        numbers.append(len(numbers) if columns.frame is None else _number(table, n, row[columns.frame].strip()))
        stamps.append(_stamp(table, n, row[columns.time].strip(), columns.unit_ns))
    if not numbers:
        raise InputError(f"{table}: has no row for {camera}; write one for each frame.")
    return np.array(numbers, dtype=np.int64), np.array(stamps, dtype=np.int64)


def _number(table: Path, row: int, word: str) -> int:
    if not re.fullmatch("[0-9]{1,9}", word):
        raise InputError(f"{table}: row {row} has the frame {word[:40]!r}; frames are numbered 0, 1, 2, ...")
    return int(word)


def _stamp(table: Path, row: int, word: str, unit_ns: int) -> int:
    try:
        # Decimal: seconds since 1970 with nine decimals are more digits than a float has.
        value = Decimal(word) * unit_ns
    except ArithmeticError:
        value = Decimal("nan")
    if not (value.is_finite() and abs(value) <= MAX_STAMP_NS):
        raise InputError(f"{table}: row {row} has the time {word[:40]!r}, which no clock shows; mend it.")
    return int(value.to_integral_value())


def _refuse_order(table: Path, numbers: NDArray[np.int64], stamps: NDArray[np.int64]) -> None:
    """Complain of frames (n,), sorted, that come twice, or of times (n,) that do not ascend with them."""
    twice = np.flatnonzero(np.diff(numbers) == 0)
    if len(twice):
        raise InputError(f"{table}: has two rows for frame {numbers[twice[0]]}; leave one.")
    back = np.flatnonzero(np.diff(stamps) <= 0)
    if len(back):
        raise InputError(
            f"{table}: frame {numbers[back[0] + 1]} is not later than the one before ({stamps[back[0] + 1]} ns after "
            f"{stamps[back[0]]} ns); frames are in the order in which they were taken."
        )


def _by_frame(
    table: Path,
    numbers: NDArray[np.int64],
    stamps: NDArray[np.int64],
    n_frames: int,
    is_numbered: bool,
    may_be_cut: bool,
) -> NDArray[np.int64]:
    """(n_frames,) stamps of sorted rows."""
    beyond = int((numbers >= n_frames).sum())
    missing = n_frames - (len(numbers) - beyond)
    if (beyond and not may_be_cut) or (missing and not is_numbered):
        counts = f"{len(numbers)} rows" + (f" up to frame {numbers[-1]}" if is_numbered else "")
        raise InputError(
            f"{table}: has {counts}, but the video has {n_frames} frames; "
            + ("number them from 0." if is_numbered else "add a column frame that says which frame each row is of.")
        )
    if beyond or missing:
        logger.warning(
            "{}: {} frames of the video have no row and are left out; {} rows have no frame", table, missing, beyond
        )
    by_frame = np.full(n_frames, NO_STAMP, dtype=np.int64)
    by_frame[numbers[: len(numbers) - beyond]] = stamps[: len(numbers) - beyond]
    return by_frame
