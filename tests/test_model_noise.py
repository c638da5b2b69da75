"""Corners that miss by more than their sigmas promise: by the lens model, the print, the clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from joint_rigs import SimRig, board_rig, box_rig, pair_errors
from scipy.stats import chi2

from aruco.model import Detection
from aruco.pose_math import Array, adjoint, invert_transform, log_se3
from rigcal.solve import adjust as solver
from rigcal.solve import corner_errors
from rigcal.solve.adjust import adjust
from rigcal.solve.joint import JointRig, adjust_rig
from rigcal.solve.problem import gather


def disturbed(rig: SimRig, noise_px: float, rng: np.random.Generator) -> SimRig:
    """Every corner off by ``noise_px`` a coordinate, whatever its sigma says; sigmas spread over a factor of ten."""

    def spoilt(d: Detection) -> Detection:
        sigma = d.sigma_px * 10 ** rng.uniform(-0.5, 0.5, d.sigma_px.shape)
        off = noise_px * rng.standard_normal(d.corners_px.shape)
        return replace(d, corners_px=d.corners_px + off, sigma_px=sigma)

    return rig.with_detections({n: {f: spoilt(d) for f, d in mine.items()} for n, mine in rig.detections.items()})


def late(rig: SimRig, shift_px: float, rng: np.random.Generator) -> SimRig:
    """Every view shifted as a whole, as when its camera's clock jitters while the target is moved."""

    def shifted(d: Detection) -> Detection:
        return replace(d, corners_px=d.corners_px + shift_px * rng.standard_normal(2))

    return rig.with_detections({n: {f: shifted(d) for f, d in mine.items()} for n, mine in rig.detections.items()})


def adjusted(rig: SimRig, rng: np.random.Generator) -> JointRig:
    estimate = rig.estimate(rig.start(rng, 1e-3))
    return adjust_rig(estimate, rig.cameras, rig.detections, rig.geometry, moving=True)


@pytest.mark.parametrize("noise_px", [0.2, 0.6])
def test_model_noise_is_found(noise_px: float) -> None:
    rng = np.random.default_rng(1)
    joint = adjusted(disturbed(board_rig(rng, sigma_px=0.03), noise_px, rng), rng)
    # A robust deviation from about 8000 coordinates is good to 2 %; the corners' own sigmas blur it a little.
    assert joint.corners.noise_px == pytest.approx(noise_px, rel=0.06)
    assert joint.scale == pytest.approx(1.0, abs=0.06)
    assert joint.corners.beyond_promise > 4


def test_there_is_none_where_sigmas_are_right() -> None:
    rng = np.random.default_rng(2)
    joint = adjusted(board_rig(rng), rng)
    assert joint.corners.noise_px == 0.0
    assert joint.corners.beyond_promise == joint.scale


def errors_mm(rounds: int, monkeypatch: pytest.MonkeyPatch) -> float:
    monkeypatch.setattr(corner_errors, "NOISE_ROUNDS", rounds)
    found: list[float] = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        rig = disturbed(box_rig(rng, sigma_px=0.03), 0.4, rng)
        joint = adjusted(rig, rng)
        T = np.array([joint.rig.cameras[camera.name].T_world_cam for camera in rig.cameras])
        found += list(pair_errors(T, rig.truth.T_world_cam)[1])
    return float(np.sqrt(np.mean(np.square(found))))


def test_poses_are_better_when_corners_are_not_weighed_by_a_promise_they_break(monkeypatch: pytest.MonkeyPatch) -> None:
    # Sigmas spread over a factor of ten make weights of a hundred to one: a few corners decide everything.
    assert errors_mm(2, monkeypatch) < 0.75 * errors_mm(0, monkeypatch)


def test_noise_is_added_in_quadrature_and_none_changes_nothing() -> None:
    rig = board_rig(np.random.default_rng(3), n_frame=2)
    sigma_px = gather(rig.cameras, rig.detections, rig.geometry, 0.3).sigma_px
    np.testing.assert_allclose(sigma_px, np.hypot(0.1, 0.3))
    assert (gather(rig.cameras, rig.detections, rig.geometry).sigma_px == 0.1).all()


# --- corners that err together --------------------------------------------------------------------------------------


def normalised(shift_px: float, repetitions: int, *, forget: bool = False) -> Array:
    """Squared errors of all cameras over what the covariance promises, a camera's six coordinates at a time."""
    found: list[float] = []
    for seed in range(repetitions):
        rng = np.random.default_rng(100 + seed)
        rig = late(board_rig(rng, n_frame=20), shift_px, rng)
        with pytest.MonkeyPatch.context() as patch:
            if forget:
                patch.setattr(solver, "repetition", lambda *_, **__: 1.0)
            result = adjust(rig.sightings(), rig.start(rng, 1e-3), rig.gauge())
        first = result.poses.T_world_cam[0], rig.truth.T_world_cam[0]
        blocks = result.covariance.reshape(4, 6, 4, 6)
        for k in range(1, 4):  # relative to the first camera: the world is a single frame's target, and shifted too
            T, T_true = (
                invert_transform(a) @ b[k] for a, b in zip(first, (result.poses.T_world_cam, rig.truth.T_world_cam))
            )
            xi = log_se3(T_true @ invert_transform(T))
            C = blocks[k, :, k] + blocks[0, :, 0] - blocks[0, :, k] - blocks[k, :, 0]
            A = adjoint(invert_transform(first[0]))
            found.append(float(xi @ np.linalg.solve(A @ C @ A.T, xi)))
    return np.array(found)


def test_views_that_are_off_as_a_whole_widen_the_covariance() -> None:
    mean = normalised(0.5, 20).mean() / 6
    # Chi-square over 60 sixfold errors that share three cameras: 1 +- 0.25; the factor is one number for a shift
    # that does not spread over all directions as independent corners do: half as much again.
    assert 0.5 < mean < 1.6
    assert normalised(0.5, 20, forget=True).mean() / 6 > 3


@pytest.mark.parametrize(("n_cam", "n_frame"), [(2, 25), (3, 10)])
def test_few_cameras_are_widened_too_when_a_frame_carries_the_world(n_cam: int, n_frame: int) -> None:
    found: list[float] = []
    for seed in range(12):
        rng = np.random.default_rng(300 + seed)
        rig = late(box_rig(rng, n_cam=n_cam, n_frame=n_frame), 0.4, rng)
        result = adjust(rig.sightings(), rig.start(rng, 1e-3), rig.gauge())
        T, T_true = (invert_transform(P[0]) @ P[1] for P in (result.poses.T_world_cam, rig.truth.T_world_cam))
        blocks = result.covariance.reshape(n_cam, 6, n_cam, 6)
        C = blocks[0, :, 0] + blocks[1, :, 1] - blocks[0, :, 1] - blocks[1, :, 0]
        A = adjoint(invert_transform(result.poses.T_world_cam[0]))
        xi = log_se3(T_true @ invert_transform(T))
        found.append(float(xi @ np.linalg.solve(A @ C @ A.T, xi)) / 6)
    # One for independent corners; without the factor tens. A scalar does not follow every direction.
    assert 0.3 < np.median(found) < 3.0


def test_independent_corners_are_left_alone() -> None:
    k = 25
    mean = normalised(0.0, k).mean() / 6
    low, high = chi2.interval(0.999, 6 * k) / np.array(6 * k)
    assert low / 1.1 < mean < high * 1.1
