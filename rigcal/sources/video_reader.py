"""Packets of a video file, read again where they are needed.

Owns      getting to a packet: going on from where the file is being read, seeking, or beginning anew.
Leaves    which packets are needed to video_index, decoding them to decoding.

A container finds a place by time, and not always the right one (transport streams have no index at all). So a packet
is recognised by its time and length, and where seeking does not lead there the file is read from its beginning.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import ExitStack
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np

from rigcal.sources.decoding import Encoded, PacketDecoder, Picture, Undecoded, import_av
from rigcal.sources.video_container import open_video
from rigcal.sources.video_index import Run, VideoIndex

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.stream import VideoStream

# Reading over so many packets is as fast as seeking.
_NEAR = 16
# Key pictures to go back by, one after the other, where seeking leads too far.
_STEPS_BACK = (0, 1, 4)
# So many packets after a seek that are in no index: it led nowhere.
_MAX_STRANGERS = 1000


class VideoReader:
    """A file's packets, and the pictures of wanted ones; a context manager that keeps the file open."""

    def __init__(self, index: VideoIndex) -> None:
        self._index = index
        # For recognising packets by their times.
        self._by_tick = np.argsort(index.ticks, kind="stable")
        self._sorted_ticks = index.ticks[self._by_tick]
        self._is_key = np.zeros(len(index.ticks), dtype=np.bool_)
        self._is_key[index.keys] = True
        self._av = import_av()
        self._open = ExitStack()
        self._next = 0  # number of the packet that the file gives next
        self._held: Packet[VideoStream] | None = None  # that packet, where it has been read already
        self._container: InputContainer
        self._stream: VideoStream
        self._source: Iterator[Packet[VideoStream]]
        self.decoder: PacketDecoder

    def __enter__(self) -> VideoReader:
        """Open the file at its beginning."""
        self._rewind()
        self.decoder = PacketDecoder(self._stream.codec_context, size=self._index.size)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self._open.close()

    def pictures(self, run: Run, digests: dict[int, str]) -> Iterator[tuple[int, Picture | Undecoded]]:
        """The wanted pictures of a run, as (packet, picture) in the order in which they are shown.

        Args:
            run: What to decode.
            digests: Gets the SHA-256 of each wanted packet's bytes, hexadecimal.
        """
        wanted = [packet - run.start for packet in run.packets]
        for number, picture in self.decoder.decoded(self._packets(run, digests), wanted):
            yield number + run.start, picture

    def _packets(self, run: Run, digests: dict[int, str]) -> Iterator[Encoded]:
        wanted = frozenset(run.packets)
        self._go_to(run.start)
        while (packet := self._read()) is not None:
            number, data = self._next - 1, bytes(packet)
            if number in wanted:
                digests[number] = hashlib.sha256(data).hexdigest()
            yield Encoded(
                data=data,
                key=bool(self._is_key[number]),
                leading=bool(self._index.leading[number]),
                damage="is not wholly in the file" if self._index.cut[number] else "",
            )

    def _go_to(self, number: int) -> None:
        """Make a packet, a key picture, the next one."""
        if not 0 <= number - self._next <= _NEAR and not self._sought(number):
            self._rewind()
        while self._next < number and self._read() is not None:
            pass

    def _sought(self, number: int) -> bool:
        """Whether seeking led to a packet or a little before it."""
        if self._index.time_base is None:
            return False
        keys = self._index.keys
        rank = int(np.searchsorted(keys, number))
        for back in _STEPS_BACK:
            tick = int(self._index.ticks[keys[max(rank - back, 0)]])
            try:
                self._container.seek(tick, stream=self._stream)
            except self._av.error.FFmpegError:
                return False
            self._source = self._container.demux(self._stream)
            if self._recognised() and self._next <= number:
                return True
        return False

    def _recognised(self) -> bool:
        """Read until a packet is one that the index knows; it is the next one then."""
        self._held, self._next = None, len(self._index.ticks)
        for _ in range(_MAX_STRANGERS):
            packet = self._from_file()
            if packet is None:
                return False
            number = self._number_of(packet)
            if number is not None:
                self._held, self._next = packet, number
                return True
        return False

    def _number_of(self, packet: Packet[VideoStream]) -> int | None:
        if packet.pts is None:
            return None
        first, end = np.searchsorted(self._sorted_ticks, [packet.pts, packet.pts + 1]).tolist()
        same = (int(number) for number in self._by_tick[first:end] if self._index.lengths[number] == packet.size)
        return next(same, None)

    def _read(self) -> Packet[VideoStream] | None:
        """The next packet; None at the end of what the index knows."""
        if self._next >= len(self._index.ticks):
            return None
        packet, self._held = self._held or self._from_file(), None
        self._next += 1
        return packet

    def _from_file(self) -> Packet[VideoStream] | None:
        try:
            return next((packet for packet in self._source if packet.size), None)
        except self._av.error.FFmpegError:  # the end of what can be read; the index has told of it
            return None

    def _rewind(self) -> None:
        self._open.close()
        self._container, self._stream = self._open.enter_context(open_video(self._index.path))
        self._source = self._container.demux(self._stream)
        self._held, self._next = None, 0
