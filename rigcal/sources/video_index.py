"""A video file's frames without decoding them: when each is shown, and where decoding it has to start.

Owns      walking over a file's packets, time stamps, groups of pictures, what is missing of a cut file.
Leaves    reading packets again to video_reader, pictures to decoding, the clock of a camera to video_stamps.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.errors import InputError
from aruco.svo_sync import MAX_STAMP_NS
from rigcal.sources.decoding import import_av
from rigcal.sources.video_container import open_video, tell_of_first_picture
from rigcal.sources.video_ends import Ends, read_ends

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream

# A day of 120 frames a second; 20 bytes each.
MAX_PACKETS = 2**24
# Clocks of cameras on a network step back by milliseconds.
MAX_BACK_S = 0.5
_KEY, _HIDDEN, _CUT, _TIMELESS = 1, 2, 4, 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """Packets to decode together."""

    start: int  # the first, a key picture
    packets: tuple[int, ...]  # the wanted ones, in the order in which they are shown


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class VideoIndex:
    """The packets of a file's video stream in the order of decoding."""

    path: Path
    size: tuple[int, int]  # width, height
    ticks: NDArray[np.int64]  # (n,) when shown, in units of time_base; packet numbers where the file has no times
    time_base: Fraction | None  # seconds; None: the file has no times
    lengths: NDArray[np.int64]  # (n,) bytes
    keys: NDArray[np.int64]  # ascending numbers of the packets where decoding can start
    leading: NDArray[np.bool_]  # (n,) whether shown before the last key picture
    cut: NDArray[np.bool_]  # (n,) whether the container says that bytes are missing
    frames: NDArray[np.int64]  # (n frames,) packets in the order in which they are shown, hidden ones left out
    loss: str  # completes the sentence "<file> ..."; empty: it is whole

    @staticmethod
    def read(path: Path) -> VideoIndex:
        """Walk over a file.

        Raises:
            InputError: It cannot be opened as a video, has no usable stream, no frame or no usable times.
            MissingExtraError: PyAV is not installed.
        """
        try:
            ends = read_ends(path)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error}); mend its permissions.") from error
        with open_video(path, ends) as (container, stream):
            packets = _walked(path, container, stream)
            size, base = (stream.codec_context.width, stream.codec_context.height), stream.time_base
        tell_of_first_picture(path, ends)
        return packets.index(path, size, base, ends)

    @property
    def decodable(self) -> NDArray[np.bool_]:
        """(n frames,) whether a frame has a key picture before it."""
        return self.frames >= self.keys[0]

    def stamps_ns(self) -> NDArray[np.int64]:
        """(n frames,) when each is shown, by the file's own clock; raises InputError where it has none."""
        if self.time_base is None:
            raise InputError(
                f"{self.path}: a bare stream, which does not say when its frames were taken; put {self.path.stem}.csv "
                "with the columns frame and timestamp_ns beside it, or record into MKV or MP4."
            )
        num, den = self.time_base.numerator * 1_000_000_000, self.time_base.denominator
        # In Python's numbers: the products are beyond 64 bits.
        stamps = [(tick * num + den // 2) // den for tick in self.ticks[self.frames].tolist()]
        beyond = next((stamp for stamp in stamps if abs(stamp) > MAX_STAMP_NS), None)
        if beyond is not None:
            raise InputError(
                f"{self.path}: a frame at {beyond * 1e-9:g} s is beyond any clock; record the video again."
            )
        return np.array(stamps, dtype=np.int64)

    def runs(self, packets: Sequence[int]) -> Iterator[Run]:
        """What to decode for the wanted packets, given in the order in which they are shown."""
        start, last, wanted = -1, -1, list[int]()
        for packet in packets:
            begin = self.start_of(packet)
            if wanted and begin > last:
                yield Run(start=start, packets=tuple(wanted))
                wanted = []
            if not wanted:
                start, last = begin, packet
            wanted.append(packet)
            start, last = min(start, begin), max(last, packet)
        if wanted:
            yield Run(start=start, packets=tuple(wanted))

    def start_of(self, packet: int, *, earlier: int = 0) -> int:
        """Where decoding has to start for a packet's picture, or ``earlier`` key pictures before that."""
        rank = int(np.searchsorted(self.keys, packet, side="right")) - 1 - int(self.leading[packet]) - earlier
        return int(self.keys[max(rank, 0)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Packets:
    ticks: array[int]
    lengths: array[int]
    flags: array[int]
    broken: str  # why the walk ended early

    def index(self, path: Path, size: tuple[int, int], base: Fraction | None, ends: Ends) -> VideoIndex:
        n = len(self.ticks)
        flags = np.frombuffer(self.flags, dtype=np.uint8)
        # The end of a cut file: not worth a complaint of its own.
        while n and flags[n - 1] & _CUT:
            n -= 1
        flags = flags[:n]
        keys = np.flatnonzero(flags & _KEY)
        if not len(keys):
            raise InputError(f"{path}: holds no frame that decoding could start with; record it again.")
        n_timeless = int(np.count_nonzero(flags & _TIMELESS))
        if 0 < n_timeless < n:
            raise InputError(f"{path}: {n_timeless} of {n} frames do not say when they are shown; record it again.")
        ticks = np.arange(n) if n_timeless else np.array(self.ticks[:n], dtype=np.int64)
        rank = np.searchsorted(keys, np.arange(n), side="right") - 1
        shown = np.flatnonzero(flags & _HIDDEN == 0)
        if not n_timeless and base is not None:
            _refuse_restart(path, ticks[keys], base)
        until_s = None if n_timeless or base is None else float(ticks.max() * base)
        index = VideoIndex(
            path=path,
            size=size,
            ticks=ticks,
            time_base=None if n_timeless else base,
            lengths=np.array(self.lengths[:n], dtype=np.int64),
            keys=keys,
            leading=(rank >= 0) & (ticks < ticks[keys[np.maximum(rank, 0)]]),
            cut=flags & _CUT != 0,
            frames=shown[np.argsort(ticks[shown], kind="stable")],
            loss=_loss(ends.cut, self.broken, until_s, n),
        )
        _tell_of_losses(index)
        return index


def _walked(path: Path, container: InputContainer, stream: VideoStream) -> _Packets:
    av = import_av()
    ticks, lengths, flags = array("q"), array("q"), array("B")
    broken = ""
    try:
        for packet in container.demux(stream):
            if packet.size == 0:  # the end
                continue
            if packet.has_sidedata("new_extradata"):
                raise InputError(
                    f"{path}: changes its size or coding on the way, and a camera does not; cut it in two."
                )
            ticks.append(packet.pts or 0)
            lengths.append(packet.size)
            known = _KEY * packet.is_keyframe | _HIDDEN * packet.is_discard | _CUT * packet.is_corrupt
            flags.append(known | _TIMELESS * (packet.pts is None))
            if len(ticks) > MAX_PACKETS:
                raise InputError(f"{path}: has more than {MAX_PACKETS} frames; give a shorter part of it.")
    except av.error.FFmpegError as error:
        broken = error.strerror or str(error)
    if any(flag & _TIMELESS for flag in flags) and stream.codec_context.reorder_depth > 0:
        raise InputError(
            f"{path}: its pictures are stored out of order (B-frames) and without times; record into MKV or MP4."
        )
    return _Packets(ticks=ticks, lengths=lengths, flags=flags, broken=broken)


def _refuse_restart(path: Path, ticks: NDArray[np.int64], base: Fraction) -> None:
    """Complain if the clock of key pictures (n,) begins anew: the frames of two recordings must not be mixed."""
    back = np.flatnonzero(np.diff(ticks) * float(base) < -MAX_BACK_S)
    if len(back):
        before, after = (float(tick * base) for tick in ticks[back[0] : back[0] + 2].tolist())
        raise InputError(
            f"{path}: its clock jumps back from {before:.3f} s to {after:.3f} s, as if it were several recordings; "
            "split it there."
        )


def _loss(cut: str, broken: str, until_s: float | None, n_packets: int) -> str:
    if not cut and not broken:
        return ""
    moment = "" if until_s is None else f", up to {until_s:.3f} s,"
    return f"{cut or f'cannot be read to its end ({broken})'}; the {n_packets} frames before that{moment} are used"


def _tell_of_losses(index: VideoIndex) -> None:
    before = int((~index.decodable).sum())
    if before:
        logger.warning("{}: the first {} frames lack the key picture they need and are left out", index.path, before)
    if index.loss:
        logger.warning("{}: {}", index.path, index.loss)
