"""Pooled depth is the resting scene: better than a single image, without what moves, and never a mean of two things."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from aruco.depth_pool import DepthFrame, check_depth, pool_depth, spread_indices
from aruco.errors import InputError
from rigcal.sim.noise import DepthBias, DepthNoise, measure_depth

FOCAL_BASELINE = 84.0  # f = 700 px, B = 0.12 m
NOISE_PX = 0.12
WALL_M = 3.0
ONE_PX_M = WALL_M**2 / FOCAL_BASELINE  # what a pixel of disparity is at the wall: 107 mm
SIZE = (60, 80)
HERE = (slice(20, 40), slice(30, 50))  # where something stands
ELSEWHERE = (slice(45, 60), slice(0, 80))


def _wall(k: int, *, dropout: float = 0.02) -> np.ndarray:
    """The wall in image k; noise drawn anew in each image only."""
    noise = DepthNoise(sigma_px=NOISE_PX, dropout=dropout)
    wall = np.full(SIZE, WALL_M, dtype=np.float32)
    return measure_depth(wall, np.zeros_like(wall), noise, DepthBias(), FOCAL_BASELINE, np.random.default_rng(k))


def _recording(n: int, seen: float = 0.0, *, thing_m: float = 1.5, dropout: float = 0.02) -> list[DepthFrame]:
    """So many images, with a thing in front of the wall in the first part of them."""
    images = [_wall(k, dropout=dropout) for k in range(n)]
    for image in images[: round(seen * n)]:
        image[HERE] += np.float32(thing_m - WALL_M)
    return [(1000 * k, image, None) for k, image in enumerate(images)]


def test_pooled_depth_is_as_good_as_a_mean() -> None:
    pooled = pool_depth(_recording(50))
    error_px = (pooled.depth - WALL_M) / ONE_PX_M
    # 50 images of 0.12 px are worth 0.017 px; a median would reach 0.021, a single image 0.12.
    assert np.sqrt(np.mean(error_px**2)) < 0.0185
    assert np.sqrt(np.nanmean(((_wall(0) - WALL_M) / ONE_PX_M) ** 2)) > 0.1
    assert np.median(pooled.spread) / ONE_PX_M == pytest.approx(NOISE_PX, rel=0.1)
    # Two percent have no depth in each image.
    assert pooled.count.mean() == pytest.approx(49, abs=0.5)
    assert (pooled.n_frames, pooled.n_seen, pooled.undecided) == (50, 50, 0.0)
    assert pooled.depth.dtype == np.float32
    assert pooled.count.dtype == np.uint16


@pytest.mark.parametrize("seen", [0.1, 0.25, 0.4])
@pytest.mark.parametrize("thing_m", [1.5, 2.5])
def test_what_stands_for_less_than_half_the_time_is_left_out(seen: float, thing_m: float) -> None:
    frames = _recording(50, seen, thing_m=thing_m)
    error_px = (pool_depth(frames).depth[HERE] - WALL_M) / ONE_PX_M
    # What the wall's own images are worth: 0.12 px over the root of 30 to 45, on average over correlated pixels.
    assert np.isfinite(error_px).all()
    assert abs(error_px.mean()) < 0.015
    # The tolerance bites: a thing that stays for a while pulls even the median to its side, and the mean to nowhere.
    images = np.stack([image for _, image, _ in frames])[:, *HERE]
    assert seen < 0.2 or abs((np.nanmedian(images, axis=0) - WALL_M).mean()) / ONE_PX_M > 0.02
    assert abs((np.nanmean(images, axis=0) - WALL_M).mean()) / ONE_PX_M > 0.1


@pytest.mark.parametrize("n", [2, 6, 20, 50])
def test_two_things_that_share_a_pixel_leave_none(n: int) -> None:
    pooled = pool_depth(_recording(n, 0.5, dropout=0.0))
    assert np.isnan(pooled.depth[HERE]).all()
    assert not pooled.count[HERE].any()
    assert np.isfinite(pooled.depth[ELSEWHERE]).mean() > 0.99
    # 400 of 4800 pixels.
    assert pooled.undecided == pytest.approx(1 / 12, rel=0.1)


def test_what_shows_only_while_something_stands_there_is_not_the_scene() -> None:
    frames = _recording(50, 0.3)
    for _, image, _ in frames[15:]:
        image[HERE] = np.nan  # a wall without texture has no depth
    assert np.isnan(pool_depth(frames).depth[HERE]).all()


def test_a_pixel_much_noisier_than_others_is_kept_with_its_spread() -> None:
    frames = _recording(50)
    rng = np.random.default_rng(5)
    for _, image, _ in frames:
        image[HERE] = 1.0 / (1.0 / WALL_M + rng.normal(0.0, 8 * NOISE_PX / FOCAL_BASELINE, image[HERE].shape))
    pooled = pool_depth(frames)
    assert np.isfinite(pooled.depth[HERE]).mean() > 0.99
    # Values of 0.96 px; what a band takes away of their tails is some percent.
    assert np.median(pooled.spread[HERE]) / ONE_PX_M == pytest.approx(8 * NOISE_PX, rel=0.2)


def test_images_without_noise_are_given_back() -> None:
    wall = np.full(SIZE, 2.345, dtype=np.float32)
    pooled = pool_depth([(k, wall, None) for k in range(5)])
    # Rounded to an eighth of a millimetre.
    np.testing.assert_allclose(pooled.depth, wall, atol=6.2e-5)
    assert not pooled.spread.any()


def test_one_image_is_its_own_pool() -> None:
    pooled = pool_depth(_recording(1))
    np.testing.assert_allclose(pooled.depth, _wall(0), atol=6.2e-5)
    assert np.isnan(pooled.spread).all()
    assert pooled.count.max() == 1


def test_long_recordings_are_held_in_part_and_evenly() -> None:
    n = 1000

    def stream() -> Iterator[DepthFrame]:
        for k in range(n):
            image = _wall(k % 50)
            # It stands for the first third: whoever holds the beginning only takes it for the scene.
            if k < n / 3:
                image[HERE] = 1.5
            yield 1000 * k, image, None

    tracemalloc.start()
    pooled = pool_depth(stream(), max_frames=32)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (pooled.n_frames, pooled.n_seen) == (32, n)
    assert abs(pooled.depth[HERE].mean() - WALL_M) < 0.02 * ONE_PX_M
    # The images alone are 19 MB; 32 of them, and sorting those, are 4.
    assert peak < 6e6
    beginning = pool_depth([f for f, _ in zip(stream(), range(32))])
    assert abs(beginning.depth[HERE].mean() - WALL_M) > 1.0


def test_how_many_are_held_does_not_depend_on_a_power_of_two() -> None:
    for n in (31, 33, 65, 90):
        pooled = pool_depth(_recording(n, dropout=0.0), max_frames=32)
        assert 16 <= pooled.n_frames <= 32


def test_frames_worth_reading_are_evenly_spread() -> None:
    assert spread_indices(3, 5) == [0, 1, 2]
    assert spread_indices(101, 5) == [0, 25, 50, 75, 100]
    assert spread_indices(0) == []


def test_the_best_images_are_those_that_show_the_scene() -> None:
    frames = _recording(20, 0.4)
    frames[15][1][30:] = np.nan
    pooled = pool_depth(frames, n_kept=11)
    # The first 8 show a thing, one is half empty.
    assert list(pooled.frames) == [1000 * k for k in range(8, 20) if k != 15]
    for stamp, kept in pooled.frames.items():
        np.testing.assert_array_equal(kept.depth, frames[stamp // 1000][1])
        # Two percent without depth, and what lies beyond 3.5 sigma.
        assert 0.96 < kept.score < 1.0


def test_confidence_is_pooled_and_heeded() -> None:
    frames = [(stamp, image, np.full(SIZE, k, dtype=np.uint8)) for k, (stamp, image, _) in enumerate(_recording(11))]
    for _, image, confidence in frames[:8]:
        confidence[HERE] = 100
        image[HERE] = 1.5
    pooled = pool_depth(frames)
    assert pooled.confidence is not None
    assert np.median(pooled.confidence[ELSEWHERE]) == 5
    # Eight of eleven are not trusted by the camera itself: too few are left, and the thing is not taken for the scene.
    assert np.isnan(pooled.depth[HERE]).all()
    assert (pooled.confidence[HERE] == 100).all()
    assert pool_depth(_recording(3)).confidence is None


def test_input_is_not_changed_and_empty_images_are_passed_over() -> None:
    zero = np.zeros(SIZE, dtype=np.float32)
    frames = [(0, zero, None), *[(1 + k, image, None) for k, (_, image, _) in enumerate(_recording(4))]]
    before = [image.copy() for _, image, _ in frames]
    pooled = pool_depth(frames)
    assert (pooled.n_frames, pooled.n_seen) == (4, 5)
    for (_, image, _), old in zip(frames, before):
        np.testing.assert_array_equal(image, old)


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        ([], "none of 0"),
        ([(0, np.zeros(SIZE), None)], "none of 1"),
        ([(0, np.ones(SIZE), None), (1, np.ones((3, 4)), None)], "one resolution"),
        ([(0, np.full(SIZE, 2500.0), None)], "millimetres"),
        ([(0, np.ones(SIZE), np.zeros((3, 4), dtype=np.uint8))], "confidence"),
        ([(0, np.ones(SIZE), np.zeros(SIZE))], "confidence"),
    ],
)
def test_recordings_that_cannot_be_pooled_are_refused(frames: list[DepthFrame], says: str) -> None:
    with pytest.raises(InputError, match=says) as caught:
        pool_depth(frames, where="camera left")
    assert str(caught.value).startswith("camera left")


@pytest.mark.parametrize(
    ("depth", "says"),
    [
        (np.ones((2, 3, 4)), "an image"),
        (np.ones((0, 4)), "an image"),
        (np.array([["a", "b"]]), "an image"),
        (np.zeros((4, 5)), "zero everywhere"),
        (np.full((4, 5), np.nan), "NaN everywhere"),
        (np.full((4, 5), np.inf), "infinite everywhere"),
        (np.array([[0.0, np.nan], [np.inf, 0.0]]), "no finite positive"),
        (np.array([[1.0, -1.0]]), "negative"),
        (np.full((4, 5), 1500, dtype=np.uint16), "millimetres.*depth_scale"),
        (np.array([[0.0, 0.0, 0.0, 2000.0]]), "millimetres"),
    ],
)
def test_what_is_no_depth_image_is_refused_in_one_sentence(depth: np.ndarray, says: str) -> None:
    with pytest.raises(InputError, match=f"file, camera left: .*{says}"):
        check_depth(depth, "file, camera left")


def test_holes_become_nan() -> None:
    depth = np.array([[1.0, 0.0, np.nan], [np.inf, -np.inf, 3.0]])
    np.testing.assert_array_equal(check_depth(depth, "x"), [[1.0, np.nan, np.nan], [np.nan, np.nan, 3.0]])
    # Some far points do not make metres millimetres.
    far = np.array([[3.0, 4.0, 500.0]], dtype=np.float32)
    assert check_depth(far, "x") is far
    assert check_depth(np.array([[2, 3]], dtype=np.uint16), "x").dtype == np.float32
