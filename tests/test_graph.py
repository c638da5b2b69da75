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


def test_cameras_that_are_kept_hang_together_without_a_frame() -> None:
    frames = {"a": range(4), "b": range(4), "x": range(10, 30), "y": range(10, 30), "z": range(10, 30)}
    assert graph_health(frames).parts[0] == ("x", "y", "z")
    health = graph_health({**frames, "c": range(5, 8), "d": [30]}, tied={"a", "c", "elsewhere"})
    # The part of the kept cameras carries the world, however small.
    assert health.parts == (("a", "b", "c"), ("x", "y", "z"), ("d",))
    assert health.weakest is not None
    assert (health.weakest.i, health.weakest.j, health.weakest.frames) == ("a", "b", 4)
    tied = graph_health({"a": range(8), "b": range(8), "c": range(20, 28), "d": range(20, 28)}, tied={"a", "c"})
    assert tied.parts == (("a", "b", "c", "d"),)
    assert tied.suggestion == ""
    assert (
        graph_health({"a": range(4), "b": range(5, 9)}, tied={"a", "b"}).summary
        == "2 cameras that are kept see the target"
    )
