"""Depth that is wrong by a known bias is put right, and the simulator means the same by it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aruco.depth_bias import DepthBias, bias_from_dict
from aruco.errors import InputError
from rigcal.sim.noise import DepthBias as SimulatedBias
from rigcal.sim.noise import DepthNoise, measure_depth

FOCAL_BASELINE = 84.0  # f = 700 px, B = 0.12 m


def test_what_the_simulator_bends_is_straightened() -> None:
    true = np.linspace(1.0, 6.0, 60, dtype=np.float32).reshape(6, 10)
    bent = measure_depth(
        true,
        np.zeros_like(true),
        DepthNoise(sigma_px=0.0, dropout=0.0),
        SimulatedBias(scale=0.003, disparity_px=0.15),
        FOCAL_BASELINE,
        np.random.default_rng(0),
    )
    bias = DepthBias(scale=0.003, inverse_depth=0.15 / FOCAL_BASELINE, focal_baseline=FOCAL_BASELINE)
    # Single precision of the simulator: a few micrometres at 6 m.
    np.testing.assert_allclose(bias.corrected(bent), true, atol=2e-5)
    # The tolerance bites: with the other sign it is centimetres off at 6 m.
    assert np.abs(DepthBias(scale=-0.003, inverse_depth=-0.15 / FOCAL_BASELINE).corrected(bent) - true).max() > 0.05


@pytest.mark.parametrize(
    "bias",
    [
        DepthBias(scale=0.01, inverse_depth=0.002),
        DepthBias(model="offset", scale=-0.02, offset_m=0.03),
    ],
)
def test_derivatives_are_those_of_finite_differences(bias: DepthBias) -> None:
    z = np.array([0.8, 2.0, 5.0])
    second = "offset_m" if bias.model == "offset" else "inverse_depth"
    h = 1e-6
    for row, name in zip(bias.derivative(z), ("scale", second)):
        values = {"model": bias.model, "scale": bias.scale, second: getattr(bias, second)}
        up, down = (DepthBias(**{**values, name: values[name] + s * h}).corrected(z) for s in (1, -1))
        np.testing.assert_allclose(row, (up - down) / (2 * h), rtol=1e-6)


def test_nothing_becomes_something() -> None:
    bias = DepthBias(inverse_depth=0.5)
    corrected = bias.corrected(np.array([np.nan, 0.0, -1.0, 3.0, 1.0]))
    # At 3 m the corrected inverse depth is below zero: beyond infinity.
    assert np.isnan(corrected[:4]).all()
    assert corrected[4] == pytest.approx(2.0)


@pytest.mark.parametrize(
    "bias",
    [
        DepthBias(scale=0.004, inverse_depth=0.0015, focal_baseline=FOCAL_BASELINE),
        DepthBias(scale=0.004, inverse_depth=0.0015),
        DepthBias(model="offset", scale=-0.001, offset_m=0.012),
    ],
)
def test_the_file_keeps_it(bias: DepthBias) -> None:
    back = bias_from_dict(bias.as_dict(), "a.json: camera c")
    z = np.linspace(0.5, 8.0, 9)
    np.testing.assert_allclose(back.corrected(z), bias.corrected(z), rtol=1e-14)


SOUND = {"scale": 0.0, "offset_m": 0.01, "sigma_scale": 0.001, "sigma_offset_m": 0.002, "correlation": 0.5}


@pytest.mark.parametrize(
    "entry",
    [
        None,
        {},
        {"scale": 0.1},
        {"scale": "x"},
        {"disparity_px": 1.0},
        {"scale": 1e9, "offset_m": 0.0},
        SOUND | {"scale": 10**400},
        SOUND | {"scale": 0.6},
        SOUND | {"scale": float("nan")},
        SOUND | {"correlation": 2},
        SOUND | {"correlation": -1.1},
        SOUND | {"sigma_scale": -0.1},
        SOUND | {"sigma_scale": -0.1, "sigma_offset_m": -0.1},
        SOUND | {"sigma_offset_m": 1e300},
        {"scale": 0.0, "disparity_px": 0.1, "focal_baseline": 1e-320},
        {"scale": 0.0, "disparity_px": 0.1, "focal_baseline": -84.0},
    ],
)
def test_other_entries_are_refused_with_a_sentence_that_says_where(entry: object) -> None:
    with pytest.raises(InputError, match=r"^a\.json: camera c: .*\. Run --refine-depth again\.$"):
        bias_from_dict(entry, "a.json: camera c")
    assert bias_from_dict(SOUND, "a.json: camera c").offset_m == 0.01


@pytest.mark.parametrize("wrong", [{"scale": float("nan")}, {"scale": 0.9}, {"focal_baseline": 0.0}])
def test_numbers_that_are_no_bias_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        DepthBias(**wrong)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize(
    "bias",
    [
        DepthBias(scale=0.004, inverse_depth=0.0015, focal_baseline=FOCAL_BASELINE),
        DepthBias(scale=0.004, inverse_depth=0.0015),
        DepthBias(model="offset", scale=-0.001, offset_m=0.012),
    ],
)
@pytest.mark.parametrize("correlation", [-0.9, 0.0, 1.0])
def test_the_file_keeps_how_well_it_is_known(bias: DepthBias, correlation: float) -> None:
    sigma = np.array([2e-3, 7e-4])
    S = np.outer(sigma, sigma) * [[1.0, correlation], [correlation, 1.0]]
    known = replace(bias, covariance=S)
    entry = known.as_dict()
    assert entry["sigma_scale"] == pytest.approx(2e-3)
    back = bias_from_dict(entry, "a.json: camera c")
    assert back.covariance is not None
    np.testing.assert_allclose(back.covariance, S, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(
    "wrong", [np.eye(3), [[1.0, 0.5], [0.4, 1.0]], [[-1.0, 0.0], [0.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]]]
)
def test_a_covariance_that_is_none_is_refused(wrong: object) -> None:
    with pytest.raises(InputError, match="depth bias"):
        DepthBias(covariance=np.array(wrong))
