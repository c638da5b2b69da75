"""Which frames an SVO2 camera has, when, and from where each can be decoded.

Owns      the index of a stream, made of the footers alone, and what damage does to the frames after it.
Leaves    the bytes of messages to svo2_payload, reading and decoding them to svo2.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from rigcal.sources.mcap_index import McapIndex
from rigcal.sources.svo2_payload import FOOTER, Footer, FrameError, footer_of

# In the descriptions the frames are numbered; where fewer than this go up by one, the numbers mean something else.
_NUMBERED = 0.9

# A frame's footer, or why it has none: what completes "frame <n> ...".
Row: TypeAlias = Footer | str
LOST = "is lost with its part of the file"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameIndex:
    """One camera's frames by time."""

    size: tuple[int, int]  # of one eye's image [px]
    stamps_ns: NDArray[np.int64]  # (n,) strictly ascending
    messages: NDArray[np.int64]  # (n,) which message each is, in the file's order
    begins: NDArray[np.int64]  # (n,) message that decoding must begin at; -1: cannot be decoded
    faults: Mapping[int, str]  # of messages that cannot be used: what completes "frame <n> ..."

    def runs(self, indices: Sequence[int]) -> Iterator[list[int]]:
        """Ascending indices in parts that are decoded in one go, each from one key frame on, in the file's order."""
        run: list[int] = []
        for index in indices:
            begin, message = self.begins[index], self.messages[index]
            if run and (begin < 0 or begin != self.begins[run[-1]] or message <= self.messages[run[-1]]):
                yield run
                run = []
            run.append(int(index))
        if run:
            yield run


def footers(mcap: McapIndex, channels: Sequence[int]) -> dict[int, list[Row]]:
    """What the frames of several channels say of themselves, in the file's order; one pass, nothing else is read."""
    rows: dict[int, list[Row]] = {channel: [] for channel in channels}
    for part in mcap.parts(channels, FOOTER.size, start=-FOOTER.size):
        try:
            row = LOST if part.data is None else footer_of(part.data, part.total)
        except FrameError as error:
            row = str(error)
        rows[part.channel].append(row)
    return {channel: _of_one_size(found) for channel, found in rows.items()}


def frame_index(path: Path, rows: Sequence[Row], log_times_ns: NDArray[np.int64], *, alone: bool) -> FrameIndex:
    """The index of one camera's frames.

    Args:
        path: For the log.
        rows: From ``footers``; at least one of them sound.
        log_times_ns: (n,) when each message was logged, for frames without a footer.
        alone: Every frame stands for itself; otherwise those between key frames need the ones before them.
    """
    begins, faults = _alone(rows) if alone else _begins(path, rows)
    stamps = _stamps(rows, log_times_ns)
    # By time; of frames with one stamp the usable one, of these the first.
    order = np.lexsort((np.arange(len(rows)), begins < 0, stamps))
    keep = order[np.diff(stamps[order], prepend=np.int64(-1)) > 0]
    if len(keep) < len(rows):
        logger.debug("{}: {} frames are left out, others have the same stamps", path, len(rows) - len(keep))
    return FrameIndex(
        size=next(row.size for row in rows if isinstance(row, Footer)),
        stamps_ns=_frozen(stamps[keep]),
        messages=keep,
        begins=begins[keep],
        faults=faults,
    )


def _of_one_size(rows: list[Row]) -> list[Row]:
    """The rows, where those of another size than most are faults."""
    sizes = [row.size for row in rows if isinstance(row, Footer)]
    if len(set(sizes)) < 2:
        return rows
    usual = max(sorted(set(sizes)), key=sizes.count)
    return [
        f"says that it is {row.size[0]} x {row.size[1]}, the others {usual[0]} x {usual[1]}"
        if isinstance(row, Footer) and row.size != usual
        else row
        for row in rows
    ]


def _frozen(array: NDArray[np.int64]) -> NDArray[np.int64]:
    array.setflags(write=False)
    return array


def _stamps(rows: Sequence[Row], log_times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """(n,) stamps from the footers; where a footer is damaged, from when the message was logged."""
    sound = np.array([isinstance(row, Footer) for row in rows], dtype=bool)
    stamps = np.array([row.stamp_ns if isinstance(row, Footer) else 0 for row in rows], dtype=np.int64)
    # The two are equal in the files described; should one be on another clock, their difference is the same for all.
    offsets = np.sort(stamps[sound] - log_times_ns[sound])
    offset = offsets[len(offsets) // 2] if len(offsets) else np.int64(0)
    return np.where(sound, stamps, np.maximum(log_times_ns + offset, 0))


def _alone(rows: Sequence[Row]) -> tuple[NDArray[np.int64], dict[int, str]]:
    begins = np.array([at if isinstance(row, Footer) else -1 for at, row in enumerate(rows)], dtype=np.int64)
    return begins, {at: row for at, row in enumerate(rows) if isinstance(row, str)}


def _begins(path: Path, rows: Sequence[Row]) -> tuple[NDArray[np.int64], dict[int, str]]:
    """(n,) message that decoding of each message must begin at, -1 for none, and the reasons for these.

    A picture is made from the one before it, so one that is missing or damaged spoils all up to the next key frame.
    """
    begins = np.full(len(rows), -1, dtype=np.int64)
    faults: dict[int, str] = {}
    if rows and not any(isinstance(row, Footer) and row.is_key for row in rows):
        logger.warning("{}: no key frame is marked as one; decoding begins at the first frame", path)
        key, broken = 0, ""
    else:
        key, broken = -1, "comes before the first key frame"
    numbered = _are_numbered(rows)
    last: Footer | None = None
    for message, row in enumerate(rows):
        if isinstance(row, str):
            faults[message], broken, last = row, f"needs frame {message}, which cannot be read", None
            continue
        if row.is_key:
            key, broken = message, ""
        elif last is not None and not broken and _is_gap(last, row, numbered):
            broken = "needs frames that are missing before it"
        if broken:
            faults[message] = broken
        else:
            begins[message] = key
        last = row
    return begins, faults


def _is_gap(before: Footer, row: Footer, numbered: bool) -> bool:
    """Whether frames are missing between two that follow one another in the file, the second of them no key frame."""
    if numbered and row.number != before.number + 1:
        return True
    return not before.is_key and row.last_key != before.last_key


def _are_numbered(rows: Sequence[Row]) -> bool:
    numbers = np.array([row.number for row in rows if isinstance(row, Footer)], dtype=np.int64)
    return len(numbers) > 1 and float(np.mean(np.diff(numbers) == 1)) >= _NUMBERED
