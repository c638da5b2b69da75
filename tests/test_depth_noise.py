"""The noise model says what simulated stereo does, over depth, over time and over neighbours."""

from __future__ import annotations

import numpy as np
import pytest

from aruco.depth_noise import (
    CORRELATION_PX,
    PRIOR_DISPARITY_PX,
    TEMPORAL_CORRELATION_PX,
    DepthNoise,
    bias_prior,
    independent_count,
)
from aruco.errors import InputError
from rigcal.sim.noise import DepthBias, fixed_error, measure_depth
from rigcal.sim.noise import DepthNoise as SimulatedNoise

FOCAL_BASELINE = 84.0  # f = 700 px, B = 0.12 m
MODEL = DepthNoise(focal_baseline=FOCAL_BASELINE)


def _walls(depth_m: float, n: int, size: tuple[int, int] = (400, 400)) -> np.ndarray:
    """So many depth images (n, h, w) of a wall, without holes and bias."""
    noise = SimulatedNoise(dropout=0.0)
    fixed = fixed_error(size, noise, np.random.default_rng(0))
    wall = np.full(size, depth_m, dtype=np.float32)
    return np.stack(
        [measure_depth(wall, fixed, noise, DepthBias(), FOCAL_BASELINE, np.random.default_rng(1 + k)) for k in range(n)]
    )


@pytest.mark.parametrize("depth_m", [1.0, 3.0, 5.0])
def test_a_pixel_scatters_as_the_model_says(depth_m: float) -> None:
    images = _walls(depth_m, 16)
    # About 200 (fixed part) independent patches of one wall: sigma to 5 percent, so 10 percent are two of it.
    assert images[0].std() == pytest.approx(float(MODEL.sigma_m(depth_m)), rel=0.1)
    assert images.mean(axis=0).std() == pytest.approx(float(MODEL.averaged_sigma_m(depth_m, 16)), rel=0.1)
    # The tolerance bites: an average of 16 is not four times as good as one, since part of the error never changes.
    assert images.mean(axis=0).std() > 1.5 * float(MODEL.sigma_m(depth_m)) / 4


def test_averaging_for_ever_leaves_the_fixed_part() -> None:
    depth_m = np.array([1.0, 4.0])
    np.testing.assert_allclose(MODEL.averaged_sigma_m(depth_m, 1e12), MODEL.fixed_sigma_m(depth_m), rtol=1e-6)


def test_neighbours_share_errors() -> None:
    side, n = 140, 40
    noise = SimulatedNoise()
    rng = np.random.default_rng(0)
    means = {
        name: np.std([fixed.mean() for fixed in fields])
        for name, fields in {
            "fixed": [fixed_error((side, side), noise, rng) for _ in range(n)],
            "white": [rng.standard_normal((side, side)) * noise.fixed_sigma_px for _ in range(n)],
        }.items()
    }
    expected = noise.fixed_sigma_px / np.sqrt(independent_count(side**2))
    # The deviation of 40 means is known to 11 percent; the square's edges let it be somewhat smaller.
    assert means["fixed"] == pytest.approx(expected, rel=0.3)
    # Taking pixels for independent would promise 28 times too much.
    assert means["white"] < 0.1 * expected


def test_every_second_pixel_knows_as_much_as_all() -> None:
    assert independent_count(10_000) == pytest.approx(independent_count(2_500, stride=2))
    assert independent_count(3) == 1.0
    # Far apart, every pixel counts for itself, and never for more.
    assert independent_count(50, stride=100) == 50.0
    assert TEMPORAL_CORRELATION_PX < CORRELATION_PX


def test_without_baseline_a_usual_camera_is_meant() -> None:
    # The first Kinect's noise is 0.0012 + 0.0019 (z - 0.4)^2, about 14 mm at 3 m; any stand-in is within twice that.
    assert 0.007 < float(DepthNoise().sigma_m(3.0)) < 0.028
    assert np.isnan(DepthNoise().sigma_m(np.nan))


def test_the_prior_is_in_the_units_of_its_model() -> None:
    stereo = bias_prior(FOCAL_BASELINE)
    assert np.sqrt(stereo[1, 1]) * FOCAL_BASELINE == pytest.approx(PRIOR_DISPARITY_PX)
    assert bias_prior(2 * FOCAL_BASELINE)[1, 1] == pytest.approx(stereo[1, 1] / 4)
    assert np.sqrt(bias_prior(model="offset")[1, 1]) == pytest.approx(0.0055)
    assert bias_prior()[1, 1] > stereo[1, 1]


@pytest.mark.parametrize("numbers", [{"focal_baseline": 0.0}, {"focal_baseline": np.nan}, {"sigma_px": -1.0}])
def test_impossible_noise_is_refused(numbers: dict[str, float]) -> None:
    with pytest.raises(InputError, match="depth noise"):
        DepthNoise(**numbers)
