"""Masks take away what stereo gets wrong beside edges and on grazing surfaces, and leave the rest."""

from __future__ import annotations

import numpy as np
import pytest

from aruco.depth_mask import mask_edges, mask_grazing
from rigcal.sim.noise import DepthBias, DepthNoise, grow_edges, measure_depth

K = np.array([[700.0, 0.0, 320.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
BASELINE_M = 0.12
FOCAL_BASELINE = 700.0 * BASELINE_M
SIZE = (360, 640)


def _plane(normal: list[float], offset_m: float) -> np.ndarray:
    """Depth (h, w) of the plane normal . X = offset."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(SIZE)], axis=-1)
    with np.errstate(divide="ignore"):
        depth = offset_m / (rays @ (np.array(normal) / np.linalg.norm(normal)))
    return np.where(depth > 0, depth, np.nan).astype(np.float32)


def _floor(height_m: float = 1.2, down_deg: float = 25.0) -> np.ndarray:
    """A floor seen by a camera so high that looks so far down."""
    tilt = np.deg2rad(down_deg)
    return _plane([0.0, np.cos(tilt), np.sin(tilt)], height_m)


def _measured(exact: np.ndarray, seed: int = 0) -> np.ndarray:
    noise = DepthNoise()
    grown = grow_edges(exact, noise, FOCAL_BASELINE)
    return measure_depth(grown, np.zeros_like(grown), noise, DepthBias(), FOCAL_BASELINE, np.random.default_rng(seed))


def test_depth_that_covers_its_surroundings_is_masked() -> None:
    exact = _floor()
    exact[100:220, 250:400] = 1.4
    measured = _measured(exact)
    keep = ~mask_edges(measured, focal_baseline=FOCAL_BASELINE) & np.isfinite(measured)
    error_px = np.abs(FOCAL_BASELINE / measured - FOCAL_BASELINE / exact)
    # Noise of 0.12 px reaches 0.6 px in a quarter of a million pixels; what the box covers is off by 5 to 40 px.
    assert error_px[keep].max() < 1.0
    assert np.nanmax(error_px) > 5.0
    # A frame of 15 px around the box is 8000 of the 230000 pixels, holes are 2 percent.
    assert keep.mean() > 0.92


def test_a_floor_alone_has_no_edges() -> None:
    measured = _measured(_floor(down_deg=20.0))
    assert mask_edges(measured, focal_baseline=FOCAL_BASELINE)[np.isfinite(measured)].mean() < 0.001
    # Neither has a table top close to the camera, on which disparity changes by 0.24 or 0.4 px from row to row.
    for height_m in (0.5, 0.3):
        assert not mask_edges(_floor(height_m, 40.0), focal_baseline=FOCAL_BASELINE).any()


def test_a_hole_between_two_surfaces_does_not_hide_the_edge() -> None:
    depth = np.full(SIZE, 3.0, dtype=np.float32)
    depth[:, 300:] = 1.5
    depth[:, 270:300] = np.nan  # what one eye only sees has no depth
    masked = mask_edges(depth, focal_baseline=FOCAL_BASELINE)
    assert masked[:, 263:270].all()
    assert masked[:, 300:307].all()
    assert not masked[:, :262].any()
    assert not masked[:, 308:].any()
    # A hole within one surface is no edge.
    floor = _floor(down_deg=60.0)
    floor[100:140, 200:260] = np.nan
    assert not mask_edges(floor, focal_baseline=FOCAL_BASELINE).any()


def test_smeared_edges_are_edges() -> None:
    depth = np.full(SIZE, 3.0, dtype=np.float32)
    depth[:, 300:] = 2.5
    depth[:, 295:300] = np.linspace(3.0, 2.5, 7, dtype=np.float32)[1:-1]  # 5.6 px in six steps
    assert mask_edges(depth, focal_baseline=FOCAL_BASELINE)[:, 293:302].all()


@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 70.0, 77.0, 83.0, 86.0])
def test_surfaces_seen_from_the_side_are_masked(angle_deg: float) -> None:
    angle = np.deg2rad(angle_deg)
    exact = _plane([np.sin(angle), 0.0, np.cos(angle)], 2.0 * np.cos(angle))
    middle = mask_grazing(_measured(exact), K)[:, 300:341]  # rays within 2 degrees of the axis
    # In a single noisy image the slope of the window is known to a degree or two.
    assert middle.mean() > 0.95 if angle_deg > 80 else middle.mean() < 0.05


def test_specks_have_no_direction() -> None:
    depth = np.full(SIZE, np.nan, dtype=np.float32)
    depth[100:104, 100:104] = 2.0
    depth[200:300, 200:400] = 2.0
    masked = mask_grazing(depth, K)
    assert masked[100:104, 100:104].all()
    assert not masked[200:300, 200:400].any()
    assert not masked[np.isnan(depth)].any()


def test_masks_of_tiny_and_empty_images_are_masks() -> None:
    for size in ((1, 1), (3, 2), (5, 40)):
        for value in (1.0, np.nan):
            depth = np.full(size, value, dtype=np.float32)
            assert mask_edges(depth).shape == size
            assert mask_grazing(depth, np.eye(3)).shape == size
