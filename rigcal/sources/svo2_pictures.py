"""The pictures of one SVO2 camera's frames, both eyes side by side, decoded only as far as asked.

Owns      which messages are read for the frames wanted, and what is wrong with a frame that gives no picture.
Leaves    the index to svo2_frames, codecs to decoding and svo2_payload, lenses to zed_conf.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from rigcal.sources.decoding import Encoded, PacketDecoder, Undecoded
from rigcal.sources.mcap_index import DamagedError, McapIndex
from rigcal.sources.svo2_frames import FrameIndex
from rigcal.sources.svo2_payload import Coding, FrameError, jpeg_pair, payload_of

Pair: TypeAlias = NDArray[np.uint8]  # (h, 2 w, 3) BGR, both eyes, or (h, w, 3), the left one
# (index of the frame, its picture or what completes "frame <n> ...", its message)
Answer: TypeAlias = tuple[int, Pair | str, bytes]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FramePictures:
    """The coded frames of one camera."""

    mcap: McapIndex
    channel: int
    coding: Coding
    index: FrameIndex

    def read(self, indices: Sequence[int], *, both: bool) -> Iterator[Answer]:
        """The pictures of frames at ascending indices, in that order, one at a time.

        Args:
            indices: Of frames.
            both: Whether the right eye is wanted too; else it may be missing.
        """
        # One decoder for each call: who reads a camera twice at a time must not mix the two.
        left_px = None if both else self.index.size[0]
        decoder = None if self.coding == "jpeg" else PacketDecoder(self.coding, size=self._pair_size, left_px=left_px)
        for run in self.index.runs(indices):
            if self.index.begins[run[0]] < 0:
                yield run[0], self.index.faults[int(self.index.messages[run[0]])], b""
            elif decoder is None:
                yield from map(self._strips, run)
            else:
                yield from self._decoded(run, decoder)

    @property
    def _pair_size(self) -> tuple[int, int]:
        width, height = self.index.size
        return 2 * width, height

    def _strips(self, index: int) -> Answer:
        """A frame that stands for itself."""
        try:
            message = self.mcap.message(self.channel, int(self.index.messages[index]))
            picture = jpeg_pair(payload_of(message))
        except (DamagedError, FrameError) as error:
            return index, str(error), b""
        height, width = picture.shape[:2]
        fits = (width, height) == self._pair_size
        return index, picture if fits else f"holds a picture of {width} x {height}", message

    def _decoded(self, run: list[int], decoder: PacketDecoder) -> Iterator[Answer]:
        """Frames of one group, which need those before them back to the key frame."""
        begin = int(self.index.begins[run[0]])
        index_of = {int(self.index.messages[index]) - begin: index for index in run}
        messages: dict[int, bytes] = {}

        def packets() -> Iterator[Encoded]:
            for number in range(max(index_of) + 1):
                try:
                    message = self.mcap.message(self.channel, begin + number)
                    packet = Encoded(data=payload_of(message), key=number == 0)
                except (DamagedError, FrameError) as error:
                    yield Encoded(data=b"", key=number == 0, damage=str(error))
                    continue
                if number in index_of:
                    messages[number] = message
                yield packet

        for number, picture in decoder.decoded(packets(), list(index_of)):
            answer = f"holds a picture that {picture.reason}" if isinstance(picture, Undecoded) else picture
            yield index_of[number], answer, messages.pop(number, b"")
