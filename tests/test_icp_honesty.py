"""Registration knows what it does not know: errors over many rigs against what it promises."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from floor_rooms import BASELINE_M, FOCAL_BASELINE, cameras, depth_image, zoomed
from icp_rooms import BOXES, LEVEL, covariance

from aruco.depth_noise import CORRELATION_PX, PRIOR_DISPARITY_PX, PRIOR_SCALE, DepthNoise
from aruco.icp_cloud import Cloud, cloud_of
from aruco.icp_match import overlapping_pairs
from aruco.icp_normal import scaled_inverse, summed
from aruco.icp_placing import placed
from aruco.icp_solve import Prior, Registration, register
from aruco.icp_types import ICPConfig
from aruco.pose_math import Array, Pose, adjoint, exp_so3, invert_transform, log_se3, make_pose

RIG = cameras(3)
NAMES = tuple(RIG)
ZOOM = 2
CONFIG = ICPConfig(region="full")
TURN_DEG, SHIFT_M = 0.3, 0.008
COUNT = 8


@cache
def exact(name: str) -> Array:
    """Depth with noise of 0.03 px that no neighbours share: a tenth of a cell's error when it is averaged."""
    return depth_image(RIG[name], BOXES, zoom=ZOOM)


def measured(name: str, rng: np.random.Generator) -> Array:
    """Depth as the noise model and the prior of bias have it."""
    depth, noise = exact(name), DepthNoise(focal_baseline=FOCAL_BASELINE)
    # White noise smoothed over s correlates over 4 pi s^2 pixels.
    smooth_px = CORRELATION_PX / np.sqrt(4 * np.pi)
    field = cv2.GaussianBlur(rng.standard_normal(depth.shape), (0, 0), smooth_px) * 2 * np.sqrt(np.pi) * smooth_px
    error_px = noise.fixed_sigma_px * field + rng.normal(0.0, PRIOR_DISPARITY_PX)
    return 1.0 / ((1.0 / depth + error_px / FOCAL_BASELINE) / (1.0 + rng.normal(0.0, PRIOR_SCALE)))


def start(rng: np.random.Generator) -> dict[str, Pose]:
    return {
        name: make_pose(
            exp_so3(np.radians(rng.normal(0, TURN_DEG, 3))) @ T[:3, :3], T[:3, 3] + rng.normal(0, SHIFT_M, 3)
        )
        for name, T in RIG.items()
    }


def registered(seed: int) -> Registration:
    rng = np.random.default_rng(seed)
    given = start(rng)
    clouds: dict[str, Cloud] = {}
    for name in NAMES:
        data = {"depth": measured(name, rng), "K": zoomed(ZOOM), "baseline": BASELINE_M / ZOOM, "n_frames": 100}
        clouds[name] = cloud_of(name, data, CONFIG, T_world_cam=given[name], floor=LEVEL)
    priors = {
        name: Prior(T_world_cam=T, covariance=covariance(T, TURN_DEG, 1e3 * SHIFT_M)) for name, T in given.items()
    }
    pairs = overlapping_pairs(clouds, given, CONFIG)
    return register(clouds, given, priors, pairs, CONFIG, floor=LEVEL, reference=NAMES[0])


@pytest.fixture(scope="module")
def trials() -> list[Registration]:
    return [registered(seed) for seed in range(COUNT)]


def error_and_jacobian(found: Registration) -> tuple[Array, Array]:
    """Errors (12,) of both other cameras beside the reference, and how they follow the joint unknowns."""
    truth: Mapping[str, Pose] = {
        name: found.T_world_cam[NAMES[0]] @ invert_transform(RIG[NAMES[0]]) @ T for name, T in RIG.items()
    }
    errors, rows = [], []
    for name in NAMES[1:]:
        errors.append(log_se3(truth[name] @ invert_transform(found.T_world_cam[name])))
        J = np.zeros((6, found.layout.size))
        J[:, found.layout.pose(name)], J[:, found.layout.pose(NAMES[0])] = np.eye(6), -np.eye(6)
        rows.append(adjoint(found.T_out_own) @ J)
    return np.concatenate(errors), np.vstack(rows)


def surprise(found: Registration, joint: Array) -> float:
    """Chi-square of the errors by each degree of freedom."""
    e, J = error_and_jacobian(found)
    return float(e @ np.linalg.solve(J @ joint @ J.T, e)) / len(e)


def test_errors_are_as_large_as_promised(trials: list[Registration]):
    values = [surprise(found, found.joint) for found in trials]
    # 96 degrees of freedom: the mean of an exact model is 1 +- 0.14. Noise within cells is told roughly, on the safe
    # side, and depth errors and noise are shared by all pairs.
    assert 0.5 < np.mean(values) < 1.4
    assert max(values) < 3.0


def test_noise_as_promised_is_taken_as_promised(trials: list[Registration]):
    assert {found.scale for found in trials} == {1.0}


def test_samples_counted_as_independent_promise_too_much(trials: list[Registration]):
    """The same rows, every sample with an error of its own: what a plain point-to-plane information matrix says."""
    values = []
    for found in trials[:4]:
        rows = found.rows
        alone = replace(
            rows, own=rows.variance / rows.n_points, shared_a=0.0 * rows.shared_a, shared_b=0.0 * rows.shared_b
        )
        free = ~found.frozen
        H = summed(alone, found.layout, int(rows.cell_a.max()) + 1).H + found.prior.H
        joint = np.zeros_like(H)
        joint[np.ix_(free, free)] = scaled_inverse(H[np.ix_(free, free)])
        values.append(surprise(found, joint))
    assert np.mean(values) > 3.0


def test_pairs_promise_what_they_keep(trials: list[Registration]):
    squares, promised = [], []
    for found in trials:
        for k, a in enumerate(NAMES):
            for b in NAMES[k + 1 :]:
                T, T_true = (invert_transform(poses[a]) @ poses[b] for poses in (found.T_world_cam, RIG))
                squares.append(1e6 * float(np.sum((T[:3, 3] - T_true[:3, 3]) ** 2)))
                promised.append(found.pair_sigma_mm(a, b) ** 2)
    # 24 pairs, not independent: the root is known to about a fifth.
    assert 0.6 < np.sqrt(np.mean(squares) / np.mean(promised)) < 1.3


def test_biases_are_as_wrong_as_promised_and_less_than_beforehand(trials: list[Registration]):
    for found in trials[:2]:
        for name in NAMES:
            sigma = np.sqrt(np.diag(found.bias_covariance[name])[:2])
            assert (sigma < 1.5 * np.array([PRIOR_SCALE, PRIOR_DISPARITY_PX / FOCAL_BASELINE])).all()


def test_cameras_beside_one_that_stays_are_as_wrong_as_promised(trials: list[Registration]):
    """A camera that stays where it is wrong takes the others along in part."""
    told = []
    for found in trials:
        beside = placed(found, NAMES[2:])
        e = log_se3(RIG[NAMES[1]] @ invert_transform(beside.T_world_cam[NAMES[1]]))
        told.append(float(e @ np.linalg.solve(beside.covariance[NAMES[1]], e)) / 6)
    # 48 degrees of freedom: 1 +- 0.2 if all is exact.
    assert 0.5 < np.mean(told) < 1.5
