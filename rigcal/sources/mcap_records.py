"""How the records of an MCAP file are told apart (mcap.dev/spec).

Owns      the file's first bytes, kinds of records, and the head that each record has.
Leaves    what follows a head to those who read (mcap_walk, mcap_index) and write (mcap_growing).
"""

from __future__ import annotations

import struct
from enum import IntEnum

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length of what follows


class Opcode(IntEnum):
    """Kinds of records, those that are read or written here."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    STATISTICS = 0x0B
    METADATA = 0x0C
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F
