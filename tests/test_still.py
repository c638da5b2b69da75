"""Resting stretches of a target that is carried from place to place, seen by cameras that are not synchronised."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from target_views import CAMERA, any_pose, box, looking_at, sight

from aruco.model import Detection
from aruco.pose_math import Pose, exp_se3, invert_transform, log_se3
from aruco.still import Stretch, merge_stretches, still_stretches

BOX = box()
CAMERAS = {
    f"c{k}": looking_at(np.array([2.5 * np.sin(a), 1.0, 2.5 * np.cos(a)]), np.zeros(3))
    for k, a in enumerate((0.3, 2, 4))
}
MS = 1_000_000
REST_MS, CARRY_MS = 1500, 1000


def place_at(places: list[Pose], t_ms: float) -> Pose:
    """Rests at each place, then is carried to the next at constant speed."""
    k, within = divmod(t_ms, REST_MS + CARRY_MS)
    here, there = places[int(k)], places[min(int(k) + 1, len(places) - 1)]
    share = max(0.0, within - REST_MS) / CARRY_MS
    return exp_se3(share * log_se3(there @ invert_transform(here))) @ here


@pytest.fixture(scope="module")
def tracks() -> dict[str, list[tuple[int, Detection]]]:
    rng = np.random.default_rng(0)
    places = [any_pose(rng, 0.5, 0.15) for _ in range(4)]
    end = 4 * (REST_MS + CARRY_MS) - CARRY_MS
    made: dict[str, list[tuple[int, Detection]]] = {}
    for phase, (name, T_world_cam) in zip((0.0, 11.0, 23.0), CAMERAS.items()):
        made[name] = []
        for t in np.arange(phase, end, 33.3):
            seen = sight(CAMERA, invert_transform(T_world_cam) @ place_at(places, t), BOX, 0.05, rng)
            made[name].append((int(t * MS), seen))
    return made


def test_every_rest_is_found_and_nothing_else(tracks: dict[str, list[tuple[int, Detection]]]) -> None:
    stretches = still_stretches(tracks)
    assert len(stretches) == 4
    for k, stretch in enumerate(stretches):
        start = k * (REST_MS + CARRY_MS)
        # The ends are known to a frame, and the slack of the clocks is cut off: no rest is entered too early.
        assert start * MS <= stretch.first_ns <= (start + 150) * MS
        assert (start + REST_MS - 150) * MS <= stretch.last_ns <= (start + REST_MS) * MS


def test_merged_corners_lie_where_the_target_rested(tracks: dict[str, list[tuple[int, Detection]]]) -> None:
    merged = merge_stretches(tracks, still_stretches(tracks))
    for name, by_stretch in merged.items():
        assert sorted(by_stretch) == [0, 1, 2, 3]
        middle = next(d for t, d in tracks[name] if t > REST_MS / 2 * MS)
        first = by_stretch[0]
        _, i, j = np.intersect1d(first.ids, middle.ids, return_indices=True)
        # One frame scatters by 0.05 px, forty frames by less: five sigma.
        assert np.abs(first.corners_px[i] - middle.corners_px[j]).max() < 0.25
        assert first.sigma_px.max() < 0.03


def test_single_frames_of_cameras_on_their_own_clocks_would_not_do(
    tracks: dict[str, list[tuple[int, Detection]]],
) -> None:
    # While the target is carried, a third of a frame's time moves corners by pixels.
    a = [d for t, d in tracks["c0"] if REST_MS * MS < t < (REST_MS + CARRY_MS) * MS]
    steps = [np.abs(x.corners_px[0] - y.corners_px[0]).max() for x, y in itertools.pairwise(a) if x.ids[0] == y.ids[0]]
    assert np.median(steps) > 1.0


def test_a_target_that_never_rests_has_no_stretch() -> None:
    rng = np.random.default_rng(1)
    T_cam_world = invert_transform(CAMERAS["c0"])
    start, speed = any_pose(rng, 0.3, 0.1), 0.3 * rng.standard_normal(6)
    track = [
        (k * 33 * MS, sight(CAMERA, T_cam_world @ exp_se3(speed * k / 30) @ start, BOX, 0.05, rng)) for k in range(60)
    ]
    assert still_stretches({"c0": track}) == []


def test_gaps_and_short_glimpses_are_no_rest() -> None:
    rng = np.random.default_rng(2)
    seen = [sight(CAMERA, invert_transform(CAMERAS["c0"]), BOX, 0.05, rng) for _ in range(4)]
    far_apart = [(k * 5000 * MS, d) for k, d in enumerate(seen)]
    assert still_stretches({"c0": far_apart}) == []
    short = [(k * 33 * MS, d) for k, d in enumerate(seen)]
    assert still_stretches({"c0": short}) == []
    assert merge_stretches({"c0": short[:2]}, [Stretch(0, 10**9)]) == {"c0": {}}
