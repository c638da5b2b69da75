"""Who sees the target together with whom, and what to record next."""

from __future__ import annotations

from rigcal.solve.graph import graph_health


def test_a_chain_is_as_strong_as_its_weakest_link() -> None:
    health = graph_health({"a": range(10), "b": range(20), "c": range(17, 40)})
    assert health.shared == {("a", "b"): 10, ("b", "c"): 3}
    assert health.parts == (("a", "b", "c"),)
    assert health.weakest is not None
    assert (health.weakest.i, health.weakest.j, health.weakest.frames) == ("b", "c", 3)
    assert "b and c" in health.suggestion


def test_a_second_way_round_makes_a_thin_link_harmless() -> None:
    # a-c share one frame only, but both share ten with b: nothing hangs on it.
    health = graph_health({"a": range(11), "b": [*range(10), *range(20, 30)], "c": [10, *range(20, 30)]})
    assert health.shared["a", "c"] == 1
    assert health.weakest is not None
    assert health.weakest.frames == 10
    assert health.suggestion == ""


def test_parts_are_named_and_a_bridge_is_suggested() -> None:
    health = graph_health({"a": [0, 1], "b": [1, 2], "d": [5], "e": [5], "x": []})
    assert health.parts == (("a", "b"), ("d", "e"), ("x",))
    assert "put the target where a and d" in health.suggestion
    assert health.as_dict()["parts"] == [["a", "b"], ["d", "e"], ["x"]]


def test_one_camera_has_no_link() -> None:
    health = graph_health({"a": range(3)})
    assert health.weakest is None
    assert health.suggestion == ""
    assert health.as_dict()["weakest_link"] is None
