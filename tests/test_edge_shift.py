"""Edges that tone curves shift: found with the poses, and taken out where they can be told from other errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from joint_rigs import SimRig, board_rig, box_rig, pair_errors, rich_box
from scipy.stats import chi2

from aruco.model import Detection
from aruco.pose_math import Array, invert_transform, log_se3
from rigcal.solve.adjust import adjust
from rigcal.solve.edge_shift import EdgeShift, find_shift, outward_moves, outwards
from rigcal.solve.joint import JointRig, adjust_rig

SHIFTS_PX = (-0.30, -0.28, -0.33, -0.31)


def seen_shifted(rig: SimRig, shifts_px: tuple[float, ...] = SHIFTS_PX, noise_px: float = 0.0, seed: int = 0) -> SimRig:
    """The edges of every camera's markers moved outwards, and corners off by more noise than they promise."""
    rng = np.random.default_rng(seed)

    def moved(d: Detection, shift_px: float) -> Detection:
        off = shift_px * outward_moves(d.corners_px) + noise_px * rng.standard_normal(d.corners_px.shape)
        return replace(d, corners_px=d.corners_px + off)

    seen = {
        camera.name: {f: moved(d, px) for f, d in rig.detections[camera.name].items()}
        for camera, px in zip(rig.cameras, shifts_px)
    }
    return rig.with_detections(seen)


def adjusted(rig: SimRig, *, moving: bool = True) -> JointRig:
    estimate = rig.estimate(rig.start(np.random.default_rng(7), 1e-3))
    return adjust_rig(estimate, rig.cameras, rig.detections, rig.geometry, moving=moving)


def poses(joint: JointRig, rig: SimRig) -> Array:
    return np.array([joint.rig.cameras[camera.name].T_world_cam for camera in rig.cameras])


@pytest.mark.parametrize("mirrored", [False, True])
def test_corners_move_as_the_crossings_of_moved_edges_do(mirrored: bool) -> None:
    quad = np.array([[10.0, 12.0], [60.0, 20.0], [55.0, 70.0], [5.0, 50.0]])
    quad = quad[::-1] if mirrored else quad
    middle = quad.mean(axis=0)
    lines = []
    for a, b in zip(quad, np.roll(quad, -1, axis=0)):
        n = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
        n = n if n @ (a - middle) > 0 else -n
        lines.append((n, n @ a + 0.5))
    crossings = [np.linalg.solve([lines[k - 1][0], lines[k][0]], [lines[k - 1][1], lines[k][1]]) for k in range(4)]
    np.testing.assert_allclose(quad + 0.5 * outward_moves(quad[None])[0], crossings, atol=1e-9)


def test_single_points_do_not_move() -> None:
    assert not outwards(board_rig(np.random.default_rng(1), n_frame=2).sightings()).any()


@pytest.mark.parametrize("moving", [True, False])
def test_shifts_are_found_and_taken_out(moving: bool) -> None:
    rng = np.random.default_rng(2)
    rig = box_rig(rng) if moving else box_rig(rng, n_frame=1, geometry=rich_box())
    bent = seen_shifted(rig)
    joint = adjusted(bent, moving=moving)
    assert joint.corners.noise_px == 0.0
    # Corners of 0.05 px; a view has a dozen and more: 0.005 px moved, three times that from one view a camera.
    np.testing.assert_allclose(list(joint.corners.shift_px.values()), SHIFTS_PX, atol=0.02 if moving else 0.06)
    _, error_mm = pair_errors(poses(joint, bent), bent.truth.T_world_cam)
    _, as_without = pair_errors(poses(adjusted(rig, moving=moving), rig), rig.truth.T_world_cam)
    # One unknown more a camera costs a little.
    assert error_mm.max() < 2.5 * as_without.max() + 0.1
    # The tolerance bites: poses alone cannot explain it.
    plain = adjust(bent.sightings(), bent.start(rng, 1e-3), bent.gauge())
    assert pair_errors(plain.poses.T_world_cam, bent.truth.T_world_cam)[1].max() > 3 * error_mm.max()


def test_without_a_shift_nothing_is_taken_out() -> None:
    joint = adjusted(box_rig(np.random.default_rng(3)))
    assert not joint.corners.shift_px
    assert not joint.corners.doubtful_shift_px


def test_a_shift_below_other_errors_is_left_alone_but_counted() -> None:
    rig = box_rig(np.random.default_rng(4), n_frame=30)
    small = (-0.1, -0.1, -0.1, -0.1)
    joint = adjusted(seen_shifted(rig, small, noise_px=0.4))
    assert not joint.corners.shift_px
    np.testing.assert_allclose(list(joint.corners.doubtful_shift_px.values()), small, atol=0.05)
    unshifted = adjusted(seen_shifted(rig, (0.0,) * 4, noise_px=0.4))
    # What it would do to the poses is in their covariance.
    assert np.trace(joint.covariance["c1"]) > 1.5 * np.trace(unshifted.covariance["c1"])


def test_more_than_an_edge_can_be_shifted_is_another_fault() -> None:
    joint = adjusted(seen_shifted(box_rig(np.random.default_rng(5)), (-1.5,) * 4))
    assert not joint.corners.shift_px
    assert joint.corners.beyond_promise > 5


def test_boards_of_single_points_have_no_shift() -> None:
    joint = adjusted(board_rig(np.random.default_rng(6), n_frame=6))
    assert not joint.corners.shift_px
    assert not joint.corners.doubtful_shift_px


def found_many(n: int) -> tuple[Array, Array, list[EdgeShift]]:
    """Errors of the second camera relative to the first over many repetitions, their covariance, the shifts."""
    normalised, shifts = [], []
    for seed in range(n):
        rng = np.random.default_rng(50 + seed)
        bent = seen_shifted(box_rig(rng, n_cam=3, n_frame=8), SHIFTS_PX[:3])
        plain = adjust(bent.sightings(), bent.start(rng, 1e-3), bent.gauge())
        shifts.append(find_shift(bent.sightings(), plain, bent.gauge()))
        joint = adjusted(bent)
        for k, camera in enumerate(bent.cameras):
            T = joint.rig.cameras[camera.name].T_world_cam
            xi = log_se3(bent.truth.T_world_cam[k] @ invert_transform(T))
            normalised.append(xi @ np.linalg.solve(joint.covariance[camera.name], xi))
    errors = np.array([s.shift_px - np.array(SHIFTS_PX[:3]) for s in shifts])
    return np.array(normalised), errors, shifts


def test_shifts_and_poses_have_the_spread_that_is_promised() -> None:
    n = 30
    normalised, errors, shifts = found_many(n)
    chi = [e @ np.linalg.solve(s.covariance_px2, e) for e, s in zip(errors, shifts)]
    low, high = chi2.interval(0.999, 3 * n) / np.array(3 * n)
    # 15 %: the variance comes from some hundred residuals; the prior pulls by a hundredth of a pixel.
    assert low / 1.15 < np.mean(chi) / 3 < high * 1.15
    # Three cameras of one world share its errors: as many independent values as repetitions.
    low, high = chi2.interval(0.999, 6 * n) / np.array(6 * n)
    assert low / 1.15 < normalised.mean() / 6 < high * 1.15
