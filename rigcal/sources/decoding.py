"""Compressed pictures to pixels: what a camera's encoder packed, decoded only as far as asked.

Owns      the decoder's settings, which picture came out of which packet, colours, what damage spreads to.
Leaves    which packets to hand over to the readers of containers, what a packet's bits say to nal_units.

A packet's picture is known by the number that is given along as its time stamp: decoders put pictures into the order
of showing and hand the number on. What follows a damaged packet refers to it until the next key picture, so it is
called damaged too instead of being shown with smears. Not all damage shows: of H.264 packets with changed bits one in
twelve passes, of H.265 packets nine in ten, whatever is asked of the decoder; a container's checksums are needed there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from aruco.errors import MissingExtraError
from rigcal.sources.image_file import MAX_PIXELS
from rigcal.sources.nal_units import UnitReader

if TYPE_CHECKING:
    import av

# Several threads for the parts of one picture; several for pictures would leave open which packet an error belongs to.
# But the errors of the parts get lost, so it is only for a decoder that finds next to none in them anyway.
_THREADS = {"hevc": 2}
# No codec shows a picture later than this many packets after its own.
MAX_DELAY = 17
MISSING = "has no picture in the stream"


@dataclass(frozen=True, slots=True, kw_only=True)
class Encoded:
    """One packet, and what its container knows about it."""

    data: bytes
    key: bool = False  # decoding can start here
    leading: bool = False  # shown before the last key picture, so it may need what came before that
    damage: str = ""  # why it cannot be whole; empty: nothing is known


@dataclass(frozen=True, slots=True)
class Undecoded:
    """A wanted picture that could not be had; the reason completes the sentence "the picture ..."."""

    reason: str


Picture: TypeAlias = NDArray[np.uint8]  # (h, w, 3) BGR


def import_av() -> Any:
    """The package that decodes; raises MissingExtraError where it is not installed."""
    try:
        import av
    except ImportError as error:
        raise MissingExtraError("PyAV (av)", "video") from error
    return av


class PacketDecoder:
    """Decodes groups of pictures of one stream, one after the other."""

    def __init__(
        self,
        codec: str | Any,
        *,
        extradata: bytes | None = None,
        size: tuple[int, int] | None = None,
        left_px: int | None = None,
    ) -> None:
        """Make ready to decode; nothing is decoded yet.

        Args:
            codec: The name that libav knows the codec by ("h264", "hevc", ...), or the codec context of a stream of
                an open container that nothing has been decoded with.
            extradata: Parameter sets, where they are not in the packets.
            size: (width, height) that every picture must have; None: any sane one.
            left_px: Only so many columns from the left are wanted of the pictures, an even number; None: all.

        Raises:
            MissingExtraError: PyAV is not installed.
            ValueError: There is no such decoder.
        """
        self._av = import_av()
        self._context: av.VideoCodecContext = self._create(codec) if isinstance(codec, str) else codec
        if extradata is not None:
            self._context.extradata = extradata
        self._extradata = self._context.extradata
        # An error instead of a guess.
        self._set_up(self._context, {"err_detect": "crccheck+explode"})
        self._lenient: av.VideoCodecContext | None = None
        self._units = UnitReader(self._context.name, self._extradata or b"")
        self._reformatter: Any = None
        self._size, self._left_px = size, left_px
        self._cutter: _Cutter | None = None
        self.n_decoded = 0  # packets given to the decoder so far

    def decoded(
        self, packets: Iterable[bytes | Encoded], wanted: Sequence[int]
    ) -> Iterator[tuple[int, Picture | Undecoded]]:
        """The wanted pictures of packets of which the first is a key picture.

        Args:
            packets: In the order of decoding; taken only as far as the last one that is wanted.
            wanted: Numbers of packets (0: the first), in the order in which their pictures are shown.

        Yields:
            (number, picture) for each of ``wanted``, in that order; (number, Undecoded) where there is none.
        """
        for number, found in self._found(packets, wanted):
            yield number, found if isinstance(found, Undecoded) else self._picture(found)

    def _found(self, packets: Iterable[bytes | Encoded], wanted: Sequence[int]) -> Iterator[tuple[int, Any]]:
        """(number, frame or Undecoded) for each of ``wanted``."""
        run = _Run(wanted)
        context = None
        for number, packet in enumerate(islice(packets, max(wanted, default=-1) + 1)):
            encoded = packet if isinstance(packet, Encoded) else Encoded(data=packet, key=number == 0)
            unused = self._units.is_unused(encoded.data)
            if unused and not run.wants(number):
                continue
            run.begins(number, encoded, unused)
            if not encoded.damage:
                context = context or self._starting_with(encoded.data)
                self._send(context, number, encoded.data, run)
            yield from run.settled()
        if context is not None:
            self._take(context, None, run)
            context.flush_buffers()
        yield from run.rest()

    def _starting_with(self, data: bytes) -> av.VideoCodecContext:
        """The decoder for a group of pictures whose first packet is this."""
        if self._context.name != "h264" or self._units.forgets_all(data):
            return self._context
        # Orders to forget pictures from before an open group are no errors where decoding starts there.
        if self._lenient is None:
            self._lenient = self._create("h264")
            if self._extradata is not None:
                self._lenient.extradata = self._extradata
            self._set_up(self._lenient, {})
        return self._lenient

    def _create(self, codec: str) -> av.VideoCodecContext:
        return self._av.VideoCodecContext.create(codec, "r")

    @staticmethod
    def _set_up(context: av.VideoCodecContext, options: dict[str, str]) -> None:
        context.thread_count = _THREADS.get(context.name, 1)
        context.thread_type = "SLICE"
        context.options = {"max_pixels": str(MAX_PIXELS), **options}

    def _send(self, context: av.VideoCodecContext, number: int, data: bytes, run: _Run) -> None:
        # Not Packet(data): its bytes have no zeros behind them, and MPEG-4 Part 2 decoders read what lies there.
        packet = self._av.Packet(len(data))
        packet.update(data)
        packet.pts = packet.dts = number
        self.n_decoded += 1
        trouble = self._take(context, packet, run)
        if trouble:
            run.fails(number, f"is damaged ({trouble})")

    def _take(self, context: av.VideoCodecContext, packet: av.Packet | None, run: _Run) -> str:
        """Decode one packet, None: take what is still held; returns what is wrong with it."""
        try:
            frames = context.decode(packet)
        except self._av.error.FFmpegError as error:
            return error.strerror or str(error)
        for frame in frames:
            run.came(frame)
        return ""

    def _picture(self, frame: Any) -> Picture | Undecoded:
        if self._size is not None and (frame.width, frame.height) != self._size:
            return Undecoded(
                f"is {frame.width} x {frame.height} where {self._size[0]} x {self._size[1]} was promised, "
                "and a camera has one size"
            )
        if self._reformatter is None:
            self._reformatter = self._av.video.reformatter.VideoReformatter()
        try:
            if self._left_px is not None:
                self._cutter = self._cutter or _Cutter(self._av, frame, self._left_px)
                frame = self._cutter.cut(frame)
            return self._reformatter.reformat(frame, format="bgr24", threads=1).to_ndarray()
        except (self._av.error.FFmpegError, ValueError) as error:
            return Undecoded(f"has colours that cannot be converted ({error})")


class _Cutter:
    """Cuts the left columns from pictures of one size and format before their colours are converted."""

    def __init__(self, av: Any, first: Any, columns: int) -> None:
        self._graph = av.filter.Graph()
        size = {"width": first.width, "height": first.height}
        begin = self._graph.add_buffer(**size, format=first.format, time_base=Fraction(1, 1))
        crop = self._graph.add("crop", f"{columns}:{first.height}:0:0")
        begin.link_to(crop)
        crop.link_to(self._graph.add("buffersink"))
        self._graph.configure()

    def cut(self, frame: Any) -> Any:
        self._graph.push(frame)
        return self._graph.pull()


class _Run:
    """What came out of the packets so far, and which of it is sure not to rest on damage."""

    def __init__(self, wanted: Sequence[int]) -> None:
        self._open = list(reversed(wanted))
        self._wanted = frozenset(wanted)
        self._found: dict[int, Any] = {}  # number -> frame or Undecoded
        self._group = 0
        self._rests_on: dict[int, tuple[int, ...]] = {}  # number of a packet -> the groups that it may refer to
        self._harm: dict[int, int] = {}  # group -> its first damaged packet
        self._pending: dict[int, bool] = {}  # packets whose pictures have not come -> whether no other needs them

    def wants(self, number: int) -> bool:
        return number in self._wanted

    def begins(self, number: int, encoded: Encoded, unused: bool) -> None:
        """A packet is about to be decoded."""
        self._group += encoded.key
        self._rests_on[number] = (self._group, self._group - 1) if encoded.leading else (self._group,)
        self._pending[number] = unused
        if encoded.damage:
            self.fails(number, encoded.damage)

    def fails(self, number: int, reason: str) -> None:
        """A packet turned out to be damaged."""
        self._found[number] = Undecoded(reason)
        if not self._pending.get(number, False):
            group = self._rests_on[number][0]
            self._harm[group] = min(number, self._harm.get(group, number))

    def came(self, frame: Any) -> None:
        """A picture came out of the decoder."""
        number = frame.pts
        if number not in self._pending:
            return
        if frame.is_corrupt:
            self.fails(number, "is damaged")
        elif number in self._wanted:
            self._found.setdefault(number, frame)
        del self._pending[number]
        # What a container's damage or a start in an open group swallowed.
        for late in [other for other in self._pending if other < number - MAX_DELAY]:
            del self._pending[late]

    def settled(self) -> Iterator[tuple[int, Any]]:
        """What can be handed out: nothing that was decoded before it can still turn out to be damaged."""
        first = min((number for number, unused in self._pending.items() if not unused), default=None)
        while self._open and self._open[-1] in self._found and (first is None or self._open[-1] < first):
            yield self._next()

    def rest(self) -> Iterator[tuple[int, Any]]:
        while self._open:
            yield self._next()

    def _next(self) -> tuple[int, Any]:
        number = self._open.pop()
        found = self._found.pop(number, Undecoded(MISSING))
        harmed = any(self._harm.get(group, number) < number for group in self._rests_on.pop(number, ()))
        return number, Undecoded("follows a damaged picture") if harmed else found
