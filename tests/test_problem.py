"""The adjustment's arrays: gathering, residuals, and every derivative beside central differences."""

from __future__ import annotations

import numpy as np
import pytest
from joint_rigs import SimRig, board_rig, box_rig
from marker_pictures import LENSES

from aruco.model import Detection
from aruco.pose_math import Array, exp_se3
from rigcal.solve import problem
from rigcal.solve.problem import Poses, gather, residuals, view_sums

STEP = 1e-5  # radians and metres


def moved(poses: Poses, *, camera: int = -1, frame: int = -1, xi: Array) -> Poses:
    """The poses after a left twist of one camera or target."""
    cameras, targets = poses.T_world_cam.copy(), poses.T_world_target.copy()
    if camera >= 0:
        cameras[camera] = exp_se3(xi) @ cameras[camera]
    if frame >= 0:
        targets[frame] = exp_se3(xi) @ targets[frame]
    return Poses(cameras, targets)


def shaken(seed: int, lens_model: str) -> tuple[SimRig, Poses]:
    rng = np.random.default_rng(seed)
    rig = box_rig(rng, n_cam=3, n_frame=3, sigma_px=0.05, lens_model=lens_model)
    return rig, rig.start(rng)


@pytest.mark.parametrize("which", ["camera", "frame"])
@pytest.mark.parametrize("lens_model", LENSES)
def test_the_normal_equations_of_views_are_those_of_central_differences(lens_model: str, which: str) -> None:
    rig, poses = shaken(1, lens_model)
    sightings = rig.sightings()
    sums = view_sums(sightings, poses, np.inf)
    r = residuals(sightings, poses)
    sign = {"camera": -1.0, "frame": 1.0}[which]
    owner = {"camera": sightings.view_camera, "frame": sightings.view_frame}[which]
    for k in np.unique(owner):
        columns = []
        for xi in STEP * np.eye(6):
            ahead, back = (residuals(sightings, moved(poses, xi=x, **{which: int(k)})) for x in (xi, -xi))
            columns.append((ahead - back) / (2 * STEP))
        J = np.stack(columns, axis=2)  # (n, 2, 6)
        for view in np.flatnonzero(owner == k):
            mine = sightings.corner_view == view
            H = np.einsum("nki,nkj->ij", J[mine], J[mine])
            g = np.einsum("nki,nk->i", J[mine], r[mine])
            # Truncation: STEP^2 times a third derivative of some ten times the first, 1e-9; rounding: 1e-16 of a pixel
            # coordinate of 1000 over STEP and a slope of 1000, 1e-11. A wrong sign or term is of order one.
            assert np.abs(sums.W[view] - H).max() < 1e-7 * np.abs(H).max()
            assert np.abs(sign * sums.g[view] - g).max() < 1e-7 * np.abs(J[mine]).max() * np.abs(r[mine]).sum()


@pytest.mark.parametrize("kappa", [2.0, 50.0])
def test_the_gradient_is_that_of_the_robust_loss(kappa: float) -> None:
    rig, poses = shaken(2, "plumb_bob")
    sightings = rig.sightings()

    def cost(frame: int, xi: Array) -> float:
        squares = view_sums(sightings, moved(poses, frame=frame, xi=xi), kappa).squares
        return float(kappa**2 * np.log1p(squares / kappa**2).sum() / 2)

    sums = view_sums(sightings, poses, kappa)
    for frame in range(3):
        g = sums.g[sightings.view_frame == frame].sum(axis=0)
        numeric = [(cost(frame, xi) - cost(frame, -xi)) / (2e-7) for xi in 1e-7 * np.eye(6)]
        # The loss bends within kappa standard deviations, 1e-4 rad: a step of 1e-7 leaves 1e-6 of the slope, and
        # rounding of a cost of 1e4 at 1e-12 over 1e-7 leaves 1e-5 where slopes are 1e4 and more.
        np.testing.assert_allclose(numeric, g, rtol=1e-4, atol=1e-4 * np.abs(g).max())


def test_the_squared_weight_is_the_mean_slope_of_the_influence() -> None:
    # psi(r) = r / (1 + r.r / k^2); over all directions of r the mean of its derivative along itself is w^2 exactly.
    kappa, length = 2.0, 3.1
    angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    r = length * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def psi_x(r: Array) -> Array:
        return r[:, 0] / (1 + (r**2).sum(axis=1) / kappa**2)

    ahead = np.array([1e-6, 0.0])
    slope = (psi_x(r + ahead) - psi_x(r - ahead)) / 2e-6
    assert slope.mean() == pytest.approx((1 + length**2 / kappa**2) ** -2, rel=1e-8)


def test_power_two_squares_the_weights() -> None:
    rng = np.random.default_rng(3)
    rig = board_rig(rng, n_frame=2)
    one_corner = {
        name: {f: d.only(np.arange(len(d)) == 0) for f, d in views.items()} for name, views in rig.detections.items()
    }
    sightings = gather(rig.cameras, one_corner, rig.geometry)
    poses = rig.start(rng)
    plain, once, twice = (view_sums(sightings, poses, k, n) for k, n in ((np.inf, 1), (3.0, 1), (3.0, 2)))
    w = 1 / (1 + plain.squares / 9.0)
    np.testing.assert_allclose(once.W, w[:, None, None] * plain.W, rtol=1e-12)
    np.testing.assert_allclose(twice.W, w[:, None, None] ** 2 * plain.W, rtol=1e-12)


@pytest.mark.parametrize("lens_model", LENSES)
def test_exact_sightings_have_no_residuals(lens_model: str) -> None:
    rig = box_rig(np.random.default_rng(4), sigma_px=0.0, lens_model=lens_model)
    # In sigmas of 1e-3 px; coordinates of 1000 px are rounded at 1e-13.
    assert np.abs(residuals(rig.sightings(), rig.truth)).max() < 1e-8


def test_corners_behind_the_camera_are_nan_and_others_are_not_touched() -> None:
    rig = box_rig(np.random.default_rng(5))
    sightings = rig.sightings()
    turned = rig.truth.T_world_cam.copy()
    turned[1] = turned[1] @ np.diag([-1.0, 1.0, -1.0, 1.0])
    r = residuals(sightings, Poses(turned, rig.truth.T_world_target))
    behind = sightings.view_camera[sightings.corner_view] == 1
    assert np.isnan(r[behind]).all()
    assert np.isfinite(r[~behind]).all()


@pytest.mark.parametrize("chunk", [1, 9, 40])
def test_the_size_of_pieces_changes_nothing(chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rig, poses = shaken(6, "plumb_bob")
    sightings = rig.sightings()
    whole, r = view_sums(sightings, poses, 3.0), residuals(sightings, poses)
    monkeypatch.setattr(problem, "CHUNK_CORNERS", chunk)
    pieces = view_sums(sightings, poses, 3.0)
    # The same products; only the order of some sums may differ.
    np.testing.assert_allclose(pieces.W, whole.W, rtol=1e-12)
    np.testing.assert_allclose(pieces.g, whole.g, rtol=1e-9)
    np.testing.assert_allclose(residuals(sightings, poses), r, rtol=1e-12, atol=1e-12)


# --- gathering ------------------------------------------------------------------------------------------------------


def test_gathered_corners_stand_by_camera_and_view() -> None:
    rig = box_rig(np.random.default_rng(7))
    sightings = rig.sightings()
    assert (np.diff(sightings.view_camera) >= 0).all()
    assert sightings.n_views == sum(map(len, rig.detections.values()))
    assert sightings.start[-1] == len(sightings.points) == len(sightings.marker)
    view = 5
    camera, frame = rig.cameras[sightings.view_camera[view]].name, sightings.frames[sightings.view_frame[view]]
    detection = rig.detections[camera][frame]
    mine = sightings.corner_view == view
    np.testing.assert_array_equal(sightings.pixels[mine], detection.corners_px.reshape(-1, 2))
    np.testing.assert_array_equal(sightings.points[mine], np.concatenate([rig.geometry[int(i)] for i in detection.ids]))
    np.testing.assert_array_equal(sightings.marker[mine], np.repeat(detection.ids, 4))


def test_the_order_of_dictionaries_does_not_matter() -> None:
    rig = box_rig(np.random.default_rng(8))
    shuffled = {name: dict(reversed(views.items())) for name, views in reversed(rig.detections.items())}
    a, b = rig.sightings(), gather(rig.cameras, shuffled, rig.geometry)
    assert a.frames == b.frames
    for field in ("view_camera", "view_frame", "start", "points", "pixels", "sigma_px", "marker"):
        assert getattr(a, field).tobytes() == getattr(b, field).tobytes()


def test_unknown_markers_and_views_of_nothing_else_are_left_out() -> None:
    rig = box_rig(np.random.default_rng(9))
    some = rig.detections["c0"][2]
    stranger = Detection(ids=some.ids + 500, corners_px=some.corners_px, sigma_px=some.sigma_px)
    sightings = gather(rig.cameras, {**rig.detections, "c0": {2: stranger}}, rig.geometry)
    assert 0 not in sightings.view_camera
    known = {k: v for k, v in rig.geometry.items() if k != 24}
    assert 24 not in gather(rig.cameras, rig.detections, known).marker


def test_nothing_gathers_to_nothing() -> None:
    rig = box_rig(np.random.default_rng(10))
    sightings = gather(rig.cameras, {}, rig.geometry)
    empty = Poses(rig.truth.T_world_cam, np.empty((0, 4, 4)))
    assert sightings.n_views == 0
    assert residuals(sightings, empty).shape == (0, 2)
    assert view_sums(sightings, empty, 1.0).W.shape == (0, 6, 6)


def test_only_views_keeps_the_numbers_of_cameras_and_frames() -> None:
    rig, poses = shaken(11, "pinhole")
    sightings = rig.sightings()
    keep = sightings.view_frame != 1
    some = sightings.only_views(keep)
    assert some.frames == sightings.frames
    np.testing.assert_array_equal(residuals(some, poses), residuals(sightings, poses)[keep[sightings.corner_view]])
