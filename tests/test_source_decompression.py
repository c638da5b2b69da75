"""Compressed blocks: what they may cost, and what becomes of damaged ones."""

from __future__ import annotations

import bz2
import tracemalloc

import lz4.frame
import numpy as np
import pytest
import zstandard

from rigcal.sources.decompression import DamagedError, decompressed, decompressed_head

# Half noise, half zeros: more than one piece, and smaller when compressed.
DATA = np.random.default_rng(1).bytes(1_500_000) + bytes(1_500_000)
BLOCKS = {
    "none": DATA,
    "zstd": zstandard.ZstdCompressor().compress(DATA),
    "lz4": lz4.frame.compress(DATA),
    "bz2": bz2.compress(DATA),
}


@pytest.mark.parametrize("compression", BLOCKS)
def test_blocks_give_back_what_was_compressed(compression: str):
    assert decompressed(BLOCKS[compression], compression, len(DATA)) == DATA
    for stated in (len(DATA) - 1, len(DATA) + 1):
        with pytest.raises(DamagedError, match="states"):
            decompressed(BLOCKS[compression], compression, stated)
    if compression != "none":
        assert decompressed_head(BLOCKS[compression], compression, 2_000_000) == DATA[:2_000_000]
        assert decompressed_head(BLOCKS[compression], compression, 10**7) == DATA


def test_a_block_costs_what_it_holds_and_not_what_it_states():
    nothing = zstandard.ZstdCompressor().compress(b"")
    tracemalloc.start()
    with pytest.raises(DamagedError, match="yields 0 bytes and states 1073741824"):
        decompressed(nothing, "zstd", 2**30)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * 2**20  # the decompressor's own window and a piece


def test_a_block_that_yields_more_than_it_states_is_given_up():
    bomb = zstandard.ZstdCompressor().compress(bytes(200 * 2**20))
    tracemalloc.start()
    with pytest.raises(DamagedError, match="yields more than the 3000000 bytes"):
        decompressed(bomb, "zstd", 3_000_000)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 30 * 2**20  # nowhere near the 200 MiB that it would yield
