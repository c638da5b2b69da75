"""A scene at rest: noise is averaged out, what disturbs is left out, and the sigma stays honest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from aruco.corner_fit import SIGMA_FLOOR_PX
from aruco.merged_detection import frames_at_rest, merge_detections
from aruco.model import Detection
from aruco.pose_math import Array

SQUARE = np.array([[0.0, 0.0], [60.0, 0.0], [60.0, 60.0], [0.0, 60.0]])
PLACES = SQUARE + np.array([[[100.0, 100.0]], [[300.0, 120.0]], [[500.0, 90.0]]])


def detection(corners: Array, sigma_px: float = 0.1, ids: Sequence[int] = (3, 5, 9)) -> Detection:
    return Detection(
        ids=np.array(ids, dtype=np.int64), corners_px=corners, sigma_px=np.full(corners.shape[:2], sigma_px)
    )


def noisy(rng: np.random.Generator, n: int, noise_px: float = 0.1, sigma_px: float = 0.1) -> list[Detection]:
    return [detection(PLACES + noise_px * rng.standard_normal(PLACES.shape), sigma_px) for _ in range(n)]


# --- merging --------------------------------------------------------------------------------------------------------


def test_noise_falls_with_the_root_of_the_number_of_frames_and_the_sigma_says_so() -> None:
    z = []
    for seed in range(60):
        merged = merge_detections(noisy(np.random.default_rng(seed), 25))
        z.append((merged.corners_px - PLACES) / merged.sigma_px[..., None])
    # The sigma also holds a floor that does not average out and that this noise does not have: 0.02 beside 0.01 px.
    expected = 0.02 / np.hypot(0.02, SIGMA_FLOOR_PX)
    # 1440 numbers: the standard deviation is known to 2 %, the sigma of each marker to some percent.
    assert np.std(z) == pytest.approx(expected, rel=0.08)


def test_the_sigma_never_falls_below_what_repeats_in_every_frame() -> None:
    merged = merge_detections([detection(PLACES, 0.1)] * 10_000)
    assert (merged.sigma_px >= SIGMA_FLOOR_PX).all()
    assert merged.sigma_px.max() < 1.1 * SIGMA_FLOOR_PX


def test_scatter_beyond_the_promise_is_believed() -> None:
    merged = merge_detections(noisy(np.random.default_rng(0), 16, noise_px=0.4, sigma_px=0.05))
    # 0.4 / sqrt(16), known to some percent from 128 numbers a marker.
    np.testing.assert_allclose(merged.sigma_px, 0.1, rtol=0.25)


def test_frames_in_which_somebody_walked_through_are_left_out() -> None:
    rng = np.random.default_rng(1)
    seen = noisy(rng, 20)
    for k in (2, 7, 8):
        corners = seen[k].corners_px.copy()
        corners[1, 2] += [6.0, -4.0]
        seen[k] = detection(corners)
    merged = merge_detections(seen)
    # 0.1 / sqrt(17), twelve numbers: the largest is below four times that.
    assert np.abs(merged.corners_px - PLACES).max() < 0.1
    # The tolerance bites: the plain mean is off by 3 / 20 of the disturbance.
    assert np.abs(np.mean([d.corners_px for d in seen], axis=0) - PLACES).max() > 0.5


def test_one_frame_is_itself() -> None:
    merged = merge_detections([detection(PLACES, 0.07)])
    np.testing.assert_array_equal(merged.corners_px, PLACES)
    np.testing.assert_allclose(merged.sigma_px, 0.07, rtol=1e-12)


@pytest.mark.parametrize("n", [2, 4, 10])
def test_frames_that_contradict_each_other_half_and_half_are_averaged_and_not_believed(n: int) -> None:
    other = PLACES.copy()
    other[0, 1] += [10.0, 0.0]
    merged = merge_detections([detection(PLACES), detection(other)] * (n // 2))
    assert np.isfinite(merged.corners_px).all()
    np.testing.assert_allclose(merged.corners_px[0, 1], PLACES[0, 1] + [5.0, 0.0])
    # The whole marker is in doubt; the others are not touched.
    assert merged.sigma_px[0].min() > 0.2
    assert merged.sigma_px[1].max() < 0.11


def test_markers_seen_in_fewer_than_half_of_the_frames_are_left_out() -> None:
    seen = [detection(PLACES, ids=(1, 2, 3)) if k < 4 else detection(PLACES[:2], ids=(1, 2)) for k in range(10)]
    assert merge_detections(seen).ids.tolist() == [1, 2]
    assert merge_detections(seen[:7]).ids.tolist() == [1, 2, 3]


def test_ids_come_out_ascending_whatever_came_first() -> None:
    merged = merge_detections([detection(PLACES[:1], ids=(9,)), detection(PLACES[1:2], ids=(2,))])
    assert merged.ids.tolist() == [2, 9]


@pytest.mark.parametrize("seen", [[], [detection(np.empty((0, 4, 2)), ids=())]])
def test_nothing_merges_to_nothing(seen: list[Detection]) -> None:
    assert len(merge_detections(seen)) == 0


def test_single_points_of_a_board_merge_too() -> None:
    points = PLACES.reshape(-1, 1, 2)
    ids = range(len(points))
    merged = merge_detections([detection(points, ids=ids)] * 5)
    np.testing.assert_allclose(merged.corners_px, points)


# --- rest -----------------------------------------------------------------------------------------------------------


def test_frames_in_which_the_target_was_moved_do_not_rest() -> None:
    rng = np.random.default_rng(2)
    seen = dict(enumerate(noisy(rng, 12)))
    for frame in (0, 5, 11):
        seen[frame] = detection(PLACES + 25.0)
    assert frames_at_rest(seen) == [1, 2, 3, 4, 6, 7, 8, 9, 10]


def test_one_disturbed_marker_of_three_does_not_make_a_frame_move() -> None:
    seen = dict(enumerate(noisy(np.random.default_rng(3), 8)))
    corners = PLACES.copy()
    corners[2] += 30.0
    seen[4] = detection(corners)
    assert frames_at_rest(seen) == list(range(8))


def test_a_target_that_never_stays_rests_nowhere_or_nearly() -> None:
    seen = {k: detection(PLACES + 20.0 * k) for k in range(9)}
    assert frames_at_rest(seen) == [4]  # its own median


def test_frames_without_a_marker_do_not_rest() -> None:
    seen = dict(enumerate(noisy(np.random.default_rng(4), 4)))
    seen[9] = detection(np.empty((0, 4, 2)), ids=())
    assert frames_at_rest(seen) == [0, 1, 2, 3]
    assert frames_at_rest({}) == []
