"""Which compressed pictures no other picture needs, read off the first bytes of an H.264 or H.265 packet.

Owns      the few bits of the units' headers that tell (ITU-T H.264, 7.4.1; H.265, 7.4.2.2).
Leaves    decoding to decoding.

Where a wanted picture lies in the middle of a group, those that nothing refers to need not be decoded on the way:
half of them with the usual settings of encoders.
"""

from __future__ import annotations

from collections.abc import Iterator

_START = b"\x00\x00\x01"
# Parameter sets and messages come before the first slice; so many units are no picture.
_MAX_UNITS = 64


class UnitReader:
    """Tells whether other pictures refer to a packet's."""

    def __init__(self, codec: str, extradata: bytes) -> None:
        """Look at a stream's parameters.

        Args:
            codec: As libav calls it; of others than "h264" and "hevc" every picture counts as needed.
            extradata: What the container says about the stream; may be empty.
        """
        # ISO/IEC 14496-15: units follow their lengths if the container has a configuration record, else start codes.
        self._length_bytes = 0
        self._known = codec in ("h264", "hevc")
        self._is_hevc = codec == "hevc"
        at = 21 if self._is_hevc else 4
        if extradata[:1] == b"\x01" and len(extradata) > at:
            self._length_bytes = (extradata[at] & 3) + 1
        self._one_layer = not self._is_hevc
        if self._is_hevc and self._length_bytes:
            self._one_layer = (extradata[21] >> 3) & 7 == 1  # numTemporalLayers
        elif self._is_hevc:
            self._look_for_layers(extradata)

    def is_unused(self, data: bytes) -> bool:
        """Whether surely no other picture refers to a packet's picture."""
        if not self._known:
            return False
        if self._is_hevc and not self._one_layer and not self._length_bytes:
            self._look_for_layers(data)
        header = self._first_slice(data)
        if header is None:
            return False
        if not self._is_hevc:
            return (header >> 5) & 3 == 0  # nal_ref_idc
        # With several temporal layers, what its own layer does not refer to can still be needed by a higher one.
        return self._one_layer and (kind := (header >> 1) & 63) < 16 and kind % 2 == 0  # ..._N

    def forgets_all(self, data: bytes) -> bool:
        """Whether an H.264 packet's picture makes the decoder forget all before it: nothing after refers to that."""
        header = self._first_slice(data)
        return header is not None and header & 31 == 5  # instantaneous decoding refresh

    def _first_slice(self, data: bytes) -> int | None:
        return next((unit for unit in self._headers(data) if self._is_slice(unit)), None)

    def _is_slice(self, header: int) -> bool:
        return (header >> 1) & 63 < 32 if self._is_hevc else 1 <= header & 31 <= 5

    def _headers(self, data: bytes) -> Iterator[int]:
        """The first byte of each unit."""
        at, n = 0, 0
        while n < _MAX_UNITS:
            if self._length_bytes:
                start = at + self._length_bytes
                at = start + int.from_bytes(data[at:start], "big")
            else:
                start = data.find(_START, at) + len(_START)
                at = start if start >= len(_START) else len(data)
            if start >= len(data) or at >= len(data) + (self._length_bytes > 0):
                return
            yield data[start]
            n += 1

    def _look_for_layers(self, data: bytes) -> None:
        at = data.find(_START + b"\x42\x01")  # a sequence parameter set
        if 0 <= at < len(data) - 5:
            self._one_layer = (data[at + 5] >> 1) & 7 == 0  # sps_max_sub_layers_minus1
