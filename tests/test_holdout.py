"""Held-out frames are spread, and never cost the solve a camera or a link."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rigcal.quality.holdout import (
    MIN_SHARED_KEPT,
    MIN_VIEWS_KEPT,
    Link,
    every_nth,
    frames_to_hold_out,
    halves_hang_together,
    is_connected,
    shared_frames,
    weakest_link,
)


def test_a_fifth_is_held_out_and_spread() -> None:
    held = frames_to_hold_out(dict.fromkeys("abc", range(100)), 0.2)
    assert len(held) == 20
    assert max(np.diff(held)) <= 6
    assert min(held) < 5
    assert max(held) > 94


def test_nothing_is_held_out_where_nothing_can_be_spared() -> None:
    assert frames_to_hold_out(dict.fromkeys("ab", range(4)), 0.2) == ()
    assert frames_to_hold_out({"a": range(10), "b": range(8, 18)}, 0.2) == ()
    assert frames_to_hold_out({"a": range(10), "b": range(20, 30)}, 0.2) == ()
    assert frames_to_hold_out({"a": range(10)}, 0.2) == ()


def test_frames_that_must_stay_stay() -> None:
    held = frames_to_hold_out(dict.fromkeys("ab", range(20)), 0.5, never=range(10))
    assert len(held) == 5
    assert min(held) >= 10


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 5), share=st.floats(0.05, 0.9))
def test_what_is_left_is_enough_for_the_solve(seed: int, n: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    table = rng.uniform(size=(40, n)) < rng.uniform(0.2, 1.0)
    seen = {f"c{k}": [int(f) for f in np.flatnonzero(table[:, k])] for k in range(n)}
    held = frames_to_hold_out(seen, share)
    assert len(held) <= round(share * len(shared_frames(seen)))
    if held:
        kept = table.copy()
        kept[list(held)] = False
        counts = kept.astype(int)
        assert counts.sum(axis=0).min() >= MIN_VIEWS_KEPT
        assert is_connected(counts.T @ counts, MIN_SHARED_KEPT)


def test_of_a_target_at_rest_two_frames_stay() -> None:
    assert every_nth(range(2), 0.2) == ()
    assert len(every_nth(range(3), 0.2)) == 1
    assert len(every_nth(range(10), 0.2)) == 2
    assert len(every_nth(range(5), 0.9)) == 3


def test_the_weakest_link_is_that_of_the_strongest_tree() -> None:
    seen = {"a": range(0, 10), "b": range(0, 20), "c": range(17, 30)}
    assert weakest_link(seen) == Link("b", "c", 3)
    assert weakest_link({"a": range(3)}) is None


def test_halves_must_each_connect_all_cameras() -> None:
    seen = {"a": range(10), "b": range(5)}
    assert halves_hang_together(seen, [range(0, 10, 2), range(1, 10, 2)])
    assert not halves_hang_together(seen, [range(5), range(5, 10)])
    assert not halves_hang_together(seen, [range(10), []])


def test_cameras_that_are_kept_need_no_link() -> None:
    seen = {"a": range(10), "b": range(10), "c": range(20, 30), "d": range(20, 30)}
    assert frames_to_hold_out(seen, 0.2) == ()
    assert len(frames_to_hold_out(seen, 0.2, tied={"a", "c"})) == 4
    halves = [[*range(0, 10, 2), *range(20, 30, 2)], [*range(1, 10, 2), *range(21, 30, 2)]]
    assert not halves_hang_together(seen, halves)
    assert halves_hang_together(seen, halves, {"a", "c"})
    assert weakest_link(seen) == Link("a", "c", 0)
    assert weakest_link(seen, {"a", "c"}) == Link("c", "d", 10)
    assert weakest_link({"a": range(3), "b": range(5, 8)}, {"a", "b"}) is None
