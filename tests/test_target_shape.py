"""Targets whose map is only roughly right: the shape comes back, cameras as with the exact map, honest uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from joint_rigs import SimRig, box_rig, flat, pair_errors, rich_box, with_outliers
from marker_pictures import LENSES, make_camera
from scipy.stats import chi2
from target_views import box, looking_at, sight

from aruco.box_target import standard_box
from aruco.errors import CalibrationError
from aruco.marker_geometry import corrected_faces, load_marker_geometry, save_faces
from aruco.model import Detection
from aruco.pose_math import (
    Array,
    Pose,
    exp_se3,
    exp_so3,
    invert_transform,
    log_se3,
    make_pose,
    pose_distance,
    transform_points,
)
from rigcal.solve import adjust as solver
from rigcal.solve import target_shape
from rigcal.solve.adjust import Gauge, adjust
from rigcal.solve.problem import Poses, Sightings, gather, residuals
from rigcal.solve.target_shape import RefinedTarget, Shape, ShapeProblem, refine_target, rigid_fit

Geometry = Mapping[int, Array]


def rough(geometry: Geometry, rng: np.random.Generator, shift_m: float = 3e-3, turn_deg: float = 1.0) -> Geometry:
    """The map as somebody measures it with a ruler: markers off by millimetres and a degree, each in its own way."""
    wrong: dict[int, Array] = {}
    for marker, corners in geometry.items():
        axis = rng.standard_normal(3)
        R = exp_so3(np.radians(turn_deg) * axis / np.linalg.norm(axis))
        middle = corners.mean(axis=0)
        wrong[marker] = (corners - middle) @ R.T + middle + shift_m * rng.standard_normal(3)
    return wrong


def stacked(geometry: Geometry, ids: tuple[int, ...]) -> Array:
    return np.concatenate([geometry[i] for i in ids])


def shape_error_mm(found: Geometry, truth: Geometry, ids: tuple[int, ...] | None = None) -> float:
    """The farthest corner after the best rigid fit, so that only the shape counts."""
    ids = tuple(sorted(truth)) if ids is None else ids
    a, b = stacked(truth, ids), stacked(found, ids)
    return 1e3 * float(np.linalg.norm(transform_points(rigid_fit(a, b), b) - a, axis=1).max())


def with_map(rig: SimRig, geometry: Geometry) -> Sightings:
    return gather(rig.cameras, rig.detections, geometry)


def refined(
    rig: SimRig, wrong: Geometry, rng: np.random.Generator, gauge: Gauge | None = None, sigma: float = 3e-3
) -> RefinedTarget:
    return refine_target(with_map(rig, wrong), rig.start(rng, sigma), gauge or rig.gauge(), wrong)


def worst_pair_mm(poses: Poses, rig: SimRig) -> float:
    return float(pair_errors(poses.T_world_cam, rig.truth.T_world_cam)[1].max())


# --- the shape comes back -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_frame", [1, 8], ids=["resting", "moved"])
@pytest.mark.parametrize("lens_model", LENSES)
def test_exact_sightings_give_the_exact_shape_and_rig(lens_model: str, n_frame: int) -> None:
    rng = np.random.default_rng(0)
    geometry = rich_box() if n_frame == 1 else None
    rig = box_rig(rng, n_frame=n_frame, sigma_px=0.0, lens_model=lens_model, geometry=geometry)
    found = refined(rig, rough(rig.geometry, rng), rng)
    assert len(found.parts) == 1
    # Residuals of 1e-6 sigmas of 1e-3 px end the iterations: 1e-9 px at 700 px and 3 m are 1e-8 mm, with the leverage
    # of markers that only their own size places.
    assert shape_error_mm(found.geometry, rig.geometry, found.parts[0]) < 1e-4
    assert worst_pair_mm(found.poses, rig) < 1e-4


@pytest.mark.parametrize("seed", range(4))
def test_a_rough_map_becomes_exact_and_the_cameras_as_good_as_with_the_exact_map(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = box_rig(rng, n_frame=20)
    wrong = rough(rig.geometry, rng)
    start = rig.start(rng)
    found = refine_target(with_map(rig, wrong), start, rig.gauge(), wrong)
    exact = adjust(rig.sightings(), start, rig.gauge())
    # A corner of one marker in one view is known to 0.05 px, 0.2 mm at 2.5 m; some 30 views of a marker, and its
    # neighbours to refer to, make it 0.04 mm a coordinate: three of those at the worst of 24 corners, and as much
    # again for their common turn.
    assert shape_error_mm(found.geometry, rig.geometry) < 0.2
    assert found.unrefined == {}
    assert found.parts == (tuple(sorted(wrong)),)
    assert found.scale == pytest.approx(1.0, abs=0.15)
    # 30 more unknowns beside 24 + 114 take a little; both errors are draws of the same size.
    assert worst_pair_mm(found.poses, rig) < 1.5 * worst_pair_mm(exact.poses, rig) + 0.1
    grown = np.sqrt(np.diag(found.covariance) / np.diag(exact.covariance))
    assert grown.min() > 0.8
    assert grown.max() < 1.3


@pytest.mark.parametrize("seed", range(4))
def test_the_same_tolerances_are_missed_with_the_rough_map(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = box_rig(rng, n_frame=20)
    wrong = rough(rig.geometry, rng)
    start = rig.start(rng)
    plain, exact = (adjust(s, start, rig.gauge()) for s in (with_map(rig, wrong), rig.sightings()))
    assert shape_error_mm(wrong, rig.geometry) > 3.0
    assert plain.scale > 5.0
    assert worst_pair_mm(plain.poses, rig) > 5 * (1.5 * worst_pair_mm(exact.poses, rig) + 0.1)


def test_maps_that_are_very_rough_do_as_well() -> None:
    rng = np.random.default_rng(1)
    rig = box_rig(rng, n_frame=20)
    found = refined(rig, rough(rig.geometry, rng, 15e-3, 4.0), rng, sigma=1e-2)
    assert shape_error_mm(found.geometry, rig.geometry) < 0.2  # as above


def test_an_exact_map_stays_as_it_is() -> None:
    rng = np.random.default_rng(2)
    rig = box_rig(rng, n_frame=20)
    found = refined(rig, rig.geometry, rng)
    # Of six markers none goes farther than the noise: centres by three deviations (chi-square of 3: one in 400 goes
    # farther), corners twice as far as centres, because a marker of 0.45 m also turns.
    for marker, sigma in found.sigma_m.items():
        assert sigma < 1e-4
        assert found.moved_m[marker] < 6 * sigma
    assert shape_error_mm(found.geometry, rig.geometry) < 0.2  # as above


def test_every_marker_keeps_its_own_shape() -> None:
    rng = np.random.default_rng(3)
    rig = box_rig(rng)
    wrong = rough(rig.geometry, rng)
    found = refined(rig, wrong, rng)
    for marker, corners in found.geometry.items():
        moved = transform_points(rigid_fit(corners, wrong[marker]), wrong[marker])
        np.testing.assert_allclose(moved, corners, atol=1e-12)  # rounding of metres
        assert found.moved_m[marker] == pytest.approx(
            np.sqrt(((corners - wrong[marker]) ** 2).sum(axis=1).mean()), rel=1e-9
        )


@pytest.mark.parametrize("seed", range(3))
def test_a_resting_target_of_many_markers_is_refined_too(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # So many cameras that every side but the hidden ones is seen beside another.
    rig = box_rig(rng, n_cam=7, n_frame=1, sigma_px=0.02, geometry=rich_box())
    wrong = rough(rig.geometry, rng)
    start = rig.start(rng)
    found = refine_target(with_map(rig, wrong), start, rig.gauge(), wrong)
    plain = adjust(with_map(rig, wrong), start, rig.gauge())
    assert len(found.parts) == 1
    # One view of 0.02 px a corner places a marker of 0.24 m to 0.5 mm in depth; sides are linked edge by edge around
    # the box, with some leverage.
    assert shape_error_mm(found.geometry, rig.geometry, found.parts[0]) < 2.0
    assert shape_error_mm(wrong, rig.geometry, found.parts[0]) > 5.0
    assert worst_pair_mm(found.poses, rig) < worst_pair_mm(plain.poses, rig) / 2


@pytest.mark.parametrize("seed", range(3))
def test_five_percent_of_gross_corners_change_little(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rig = box_rig(rng, n_frame=20)
    wrong = rough(rig.geometry, rng)
    spoilt = rig.with_detections(with_outliers(rig.detections, 0.05, rng))
    found = refined(spoilt, wrong, rng)
    assert shape_error_mm(found.geometry, rig.geometry) < 0.25  # as above, and a little for 5 % fewer corners
    assert found.scale == pytest.approx(1.0, abs=0.2)


def test_plain_least_squares_breaks_under_five_percent_of_gross_corners(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solver, "KAPPA", 1e9)
    rng = np.random.default_rng(0)
    rig = box_rig(rng, n_frame=20)
    wrong = rough(rig.geometry, rng)
    found = refined(rig.with_detections(with_outliers(rig.detections, 0.05, rng)), wrong, rng)
    assert shape_error_mm(found.geometry, rig.geometry) > 1.0


def test_two_runs_give_the_same_bytes() -> None:
    rng = np.random.default_rng(4)
    rig = box_rig(rng, lens_model="equidistant")
    wrong = rough(rig.geometry, rng)
    a, b = (refined(rig, wrong, np.random.default_rng(5)) for _ in range(2))
    assert stacked(a.geometry, a.parts[0]).tobytes() == stacked(b.geometry, b.parts[0]).tobytes()
    assert a.poses.T_world_cam.tobytes() == b.poses.T_world_cam.tobytes()
    assert a.covariance.tobytes() == b.covariance.tobytes()
    assert a.sigma_m == b.sigma_m


# --- what the frames mean -------------------------------------------------------------------------------------------


def test_the_target_stays_where_the_map_had_it_as_nearly_as_possible() -> None:
    rng = np.random.default_rng(6)
    rig = box_rig(rng)
    wrong = rough(rig.geometry, rng)
    found = refined(rig, wrong, rng)
    # The fit is exact after every step, up to rounding of coordinates of a metre.
    np.testing.assert_allclose(
        rigid_fit(stacked(wrong, found.parts[0]), stacked(found.geometry, found.parts[0])), np.eye(4), atol=1e-12
    )


def test_a_frame_that_carries_the_world_does_not_move_by_a_bit() -> None:
    rng = np.random.default_rng(7)
    rig = box_rig(rng)
    wrong = rough(rig.geometry, rng)
    start = rig.start(rng)
    found = refine_target(with_map(rig, wrong), start, rig.gauge(), wrong)
    assert found.poses.T_world_target[0].tobytes() == start.T_world_target[0].tobytes()
    assert (found.poses.T_world_target[1:] != start.T_world_target[1:]).any(axis=(1, 2)).all()
    assert (found.poses.T_world_cam != start.T_world_cam).any(axis=(1, 2)).all()


def test_fixed_cameras_do_not_move_by_a_bit_and_the_shape_is_the_same() -> None:
    rng = np.random.default_rng(8)
    rig = box_rig(rng, n_frame=20)
    wrong = rough(rig.geometry, rng)
    start = rig.start(rng)
    by_frame, by_camera = (
        refine_target(with_map(rig, wrong), start, gauge, wrong)
        for gauge in (rig.gauge(), Gauge(flat(4, 2), flat(20, -1)))
    )
    assert by_camera.poses.T_world_cam[2].tobytes() == start.T_world_cam[2].tobytes()
    assert not by_camera.covariance[12:18].any()
    # Both stop within some hundredths of the standard deviation, which is 0.04 mm for the shape.
    assert shape_error_mm(by_frame.geometry, by_camera.geometry) < 0.01
    assert pair_errors(by_frame.poses.T_world_cam, by_camera.poses.T_world_cam)[1].max() < 0.05
    for marker, sigma in by_frame.sigma_m.items():
        assert sigma == pytest.approx(by_camera.sigma_m[marker], rel=0.02)


def test_poses_and_corrected_map_fit_the_corners() -> None:
    rng = np.random.default_rng(9)
    rig = box_rig(rng)
    found = refined(rig, rough(rig.geometry, rng), rng)
    r = residuals(with_map(rig, found.geometry), found.poses)
    # Residuals of unit variance, some absorbed by the unknowns.
    assert 0.7 < np.sqrt((r**2).mean()) < 1.1


def test_a_target_cannot_carry_two_worlds() -> None:
    rng = np.random.default_rng(10)
    rig = box_rig(rng, n_frame=4)
    both = (Gauge(flat(4, 0), flat(4, 0)), Gauge(flat(4, -1), np.arange(4) < 2))
    for gauge in both:
        with pytest.raises(ValueError, match="either fixed cameras or one fixed frame"):
            refined(rig, rig.geometry, rng, gauge)


def test_no_views_are_an_error_that_says_so() -> None:
    rng = np.random.default_rng(10)
    rig = box_rig(rng, n_frame=2)
    nothing = rig.sightings().only_views(np.zeros(rig.sightings().n_views, dtype=bool))
    with pytest.raises(CalibrationError, match="No view of the target"):
        refine_target(nothing, rig.truth, rig.gauge(), rig.geometry)


# --- what the views do not tell -------------------------------------------------------------------------------------


def seen_by(rig: SimRig, allowed: Mapping[str, tuple[int, ...]]) -> SimRig:
    """The same with each camera blind to all markers but some."""
    views = {
        name: {f: d.only(np.isin(d.ids, allowed[name])) for f, d in by_frame.items()}
        for name, by_frame in rig.detections.items()
    }
    return rig.with_detections({name: {f: d for f, d in v.items() if len(d)} for name, v in views.items()})


def two_sided(rng: np.random.Generator, n_frame: int, turn_rad: float, geometry: Geometry | None = None) -> SimRig:
    """Two cameras on both sides of a box that is shifted, and turned by up to an angle about any axis."""
    geometry = box() if geometry is None else geometry
    cameras = [make_camera(name) for name in ("front", "back")]
    places = [looking_at(np.array([0.3, 0.2, z]), np.zeros(3)) for z in (2.2, -2.2)]
    turns = [exp_so3(turn_rad * rng.uniform(-1, 1, 3)) for _ in range(n_frame)]
    targets = [make_pose(R, 0.2 * rng.standard_normal(3)) for R in turns]
    targets[0] = np.eye(4)
    seen = {
        camera.name: {f: sight(camera, invert_transform(T) @ t, geometry, 0.05, rng) for f, t in enumerate(targets)}
        for camera, T in zip(cameras, places)
    }
    return SimRig(
        cameras=tuple(cameras),
        detections=seen,
        geometry=geometry,
        truth=Poses(np.array(places), np.array(targets)),
        frames=tuple(range(n_frame)),
    )


FRONT, BACK = (24,), (22,)


def test_markers_that_no_view_shows_stay_and_are_named() -> None:
    rng = np.random.default_rng(11)
    rig = box_rig(rng)
    some = seen_by(rig, dict.fromkeys(rig.detections, (21, 22, 23, 24, 25)))
    wrong = rough(rig.geometry, rng)
    found = refined(some, wrong, rng)
    assert found.unrefined == {26: "no view of it takes part"}
    assert found.geometry[26].tobytes() == wrong[26].tobytes()
    assert list(found.geometry) == list(wrong)
    assert set(found.moved_m) == set(found.sigma_m) == set(wrong) - {26}
    assert shape_error_mm(found.geometry, rig.geometry, found.parts[0]) < 0.3  # as above, from fewer frames


@pytest.mark.parametrize("n_frame", [1, 12], ids=["resting", "shifted without a turn"])
def test_markers_that_nothing_ties_to_others_stay_and_are_named(n_frame: int) -> None:
    rng = np.random.default_rng(12)
    rig = seen_by(two_sided(rng, n_frame, 0.0), {"front": FRONT, "back": BACK})
    wrong = rough(rig.geometry, rng)
    found = refined(rig, wrong, rng)
    assert found.parts == ()
    assert {i for i, why in found.unrefined.items() if "tie it to no other marker" in why} == {22, 24}
    assert all(found.geometry[i].tobytes() == wrong[i].tobytes() for i in wrong)
    # Without a shape to estimate it is the plain adjustment.
    plain = adjust(with_map(rig, wrong), rig.start(np.random.default_rng(12)), rig.gauge())
    np.testing.assert_allclose(found.scale, plain.scale, rtol=0.05)
    assert found.sigma_m == {}


def test_a_turning_target_ties_markers_that_no_camera_sees_together() -> None:
    # Two cameras that each see one marker of a body in motion: hand and eye. Turns tell where both are on the body.
    rng = np.random.default_rng(13)
    rig = seen_by(two_sided(rng, 25, 0.7), {"front": FRONT, "back": BACK})
    wrong = rough(rig.geometry, rng)
    found = refined(rig, wrong, rng)
    assert found.parts == ((22, 24),)
    # Single markers are known to some 0.1 degrees a view, which at the box's 0.6 m is 1 mm, from 25 views.
    assert shape_error_mm(found.geometry, rig.geometry, (22, 24)) < 1.0
    assert shape_error_mm(wrong, rig.geometry, (22, 24)) > 2.0


def test_parts_that_nothing_ties_are_refined_each_where_the_map_has_it() -> None:
    rng = np.random.default_rng(14)
    front, back = (30, 31, 32, 33), (10, 11, 12, 13)
    rig = seen_by(two_sided(rng, 1, 0.0, rich_box()), {"front": front, "back": back})
    wrong = rough(rig.geometry, rng)
    found = refined(rig, wrong, rng)
    assert set(found.parts) == {front, back}
    for part in found.parts:
        # One view of each places its markers of 0.24 m to a few millimetres in depth; the fit to the map is exact
        # to second order of a last step of some micrometres.
        assert shape_error_mm(found.geometry, rig.geometry, part) < shape_error_mm(wrong, rig.geometry, part)
        np.testing.assert_allclose(rigid_fit(stacked(wrong, part), stacked(found.geometry, part)), np.eye(4), atol=1e-9)
    # Corners fit, although the two parts do not lie to each other as the map says.
    assert found.scale < 1.5
    assert adjust(with_map(rig, wrong), rig.truth, rig.gauge()).scale > 5.0


def test_single_points_are_left_alone() -> None:
    rng = np.random.default_rng(15)
    rig = box_rig(rng, n_frame=6)
    points = {10 * marker + k: c[k : k + 1] for marker, c in rig.geometry.items() for k in range(4)}

    def single(d: Detection) -> Detection:
        ids = (10 * d.ids[:, None] + np.arange(4)).ravel()
        return Detection(ids=ids, corners_px=d.corners_px.reshape(-1, 1, 2), sigma_px=d.sigma_px.reshape(-1, 1))

    detections = {name: {f: single(d) for f, d in views.items()} for name, views in rig.detections.items()}
    found = refine_target(gather(rig.cameras, detections, points), rig.start(rng), rig.gauge(), points)
    assert all("single point" in why for why in found.unrefined.values())
    assert set(found.unrefined) == set(points)
    assert all(found.geometry[i].tobytes() == points[i].tobytes() for i in points)


# --- the mathematics ------------------------------------------------------------------------------------------------


def any_problem(which: str) -> tuple[ShapeProblem, Shape]:
    """A small problem at a shape that is not the map's, with poses that are not the truth."""
    rng = np.random.default_rng(16)
    rig = box_rig(rng, n_cam=3, n_frame=4, lens_model="plumb_bob")
    wrong = rough(rig.geometry, rng)
    gauge = rig.gauge() if which == "frame" else Gauge(flat(3, 1), flat(4, -1))
    problem = target_shape._split(with_map(rig, wrong), gauge)
    problem = replace(problem, part=problem.parts(rig.truth))
    assert problem.n_parts == 1
    T_target_map = np.array([exp_se3(5e-3 * rng.standard_normal(6)) for _ in problem.ids])
    still = Shape(rig.start(rng), T_target_map)
    nothing = np.zeros((len(rig.cameras) + len(problem.ids), 6)), np.zeros((4, 6))
    return problem, problem.moved(still, *nothing)


def twisted(shape: Shape, k: int, xi: Array) -> Shape:
    """The shape after a left twist of the k-th unknown: cameras, then markers, then targets."""
    kinds = [shape.poses.T_world_cam.copy(), shape.T_target_map.copy(), shape.poses.T_world_target.copy()]
    for T in kinds:
        if 0 <= k < len(T):
            T[k] = exp_se3(xi) @ T[k]
        k -= len(T)
    return Shape(Poses(kinds[0], kinds[2]), kinds[1])


def dense(problem: ShapeProblem, shape: Shape, kappa: float, power: int = 1) -> tuple[Array, Array]:
    """J^T W J and J^T W r over cameras, markers and targets, from central differences (step as in test_problem)."""

    def at(moved: Shape) -> Array:
        return residuals(problem.placed(moved), moved.poses)

    n = len(shape.poses.T_world_cam) + len(shape.T_target_map) + len(shape.poses.T_world_target)
    columns = [
        (at(twisted(shape, k, xi)) - at(twisted(shape, k, -xi))).ravel() / 2e-5
        for k in range(n)
        for xi in 1e-5 * np.eye(6)
    ]
    J, r = np.stack(columns, axis=1), at(shape)
    w = np.repeat((1 + (r**2).sum(axis=1) / kappa**2) ** -power, 2)
    return J.T @ (w[:, None] * J), J.T @ (w * r.ravel())


def corners_of(problem: ShapeProblem, shape: Shape) -> Iterator[tuple[Array, Array]]:
    """Every marker's corners in the map and in the shape."""
    for m in range(len(problem.ids)):
        row = int(np.flatnonzero(problem.marker == m)[0])
        old = problem.rows.points[problem.rows.start[row] : problem.rows.start[row + 1]]
        yield old, transform_points(shape.T_target_map[m], old)


def best_fit_constraint(problem: ShapeProblem, shape: Shape) -> Array:
    """(6, 6 m) derivative of ``sum (q - p)`` and ``sum p x q`` over corners, from central differences."""

    def at(moved: Shape) -> Array:
        pairs = list(corners_of(problem, moved))
        return np.concatenate(
            [sum((q - p).sum(axis=0) for p, q in pairs), sum(np.cross(p, q).sum(axis=0) for p, q in pairs)]
        )

    n = len(shape.poses.T_world_cam)
    return np.stack(
        [
            (at(twisted(shape, n + m, xi)) - at(twisted(shape, n + m, -xi))) / 2e-5
            for m in range(len(problem.ids))
            for xi in 1e-5 * np.eye(6)
        ],
        axis=1,
    )


def solved_densely(problem: ShapeProblem, shape: Shape, H: Array) -> tuple[Array, Array, Array]:
    """Inverse of the constrained normal equations, zero for what is fixed; which unknowns are free; the constraint."""
    gauge, m = problem.gauge, len(problem.ids)
    free = np.repeat(np.concatenate([~gauge.fixed_cameras, np.ones(m, dtype=bool), ~gauge.fixed_frames]), 6)
    C = np.zeros((6, len(H)))
    n = 6 * len(gauge.fixed_cameras)
    C[:, n : n + 6 * m] = best_fit_constraint(problem, shape)
    C *= np.abs(H).max() / np.abs(C).max()  # for the condition of the whole
    k = int(free.sum())
    whole = np.block([[H[np.ix_(free, free)], C[:, free].T], [C[:, free], np.zeros((6, 6))]])
    inverse = np.zeros_like(H)
    inverse[np.ix_(free, free)] = np.linalg.inv(whole)[:k, :k]
    return inverse, free, C


def test_the_normal_equations_are_those_of_central_differences() -> None:
    problem, shape = any_problem("frame")
    H, g = dense(problem, shape, 20.0)
    normal = problem.normal(shape, problem.sums(shape, 20.0))
    k, f, n_cam = len(normal.H), len(normal.H_target), len(shape.poses.T_world_cam)
    mine = np.zeros_like(H)
    for i, block in enumerate((*normal.H, *normal.H_target)):
        mine[6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = block
    mine[: 6 * n_cam, 6 * n_cam : 6 * k] = normal.between
    mine[: 6 * k, 6 * k :] = normal.E.transpose(1, 0, 2).reshape(6 * k, 6 * f)
    upper = np.triu_indices(len(H))
    # As in test_problem: derivatives agree to 1e-9 of the largest; a wrong sign or frame is of order one.
    assert np.abs(mine - H)[upper].max() < 1e-7 * np.abs(H).max()
    assert np.abs(np.concatenate([normal.g, normal.g_target.ravel()]) - g).max() < 1e-7 * np.abs(g).max()
    # Every kind of block takes part in that.
    assert min(np.abs(b).max() for b in (normal.between, normal.E[:, 6 * n_cam :], normal.H[n_cam:])) > 1e-2 * H.max()


@pytest.mark.parametrize("damping", [0.0, 1e-3])
@pytest.mark.parametrize("which", ["frame", "camera"])
def test_a_step_is_the_dense_one_under_the_constraint_of_the_best_fit(which: str, damping: float) -> None:
    problem, shape = any_problem(which)
    H, g = dense(problem, shape, 20.0)
    H += damping * np.diag(np.diag(H))
    inverse, _, C = solved_densely(problem, shape, H)
    want = -inverse @ g
    step = np.concatenate([s.ravel() for s in problem.step(shape, problem.sums(shape, 20.0), damping)])
    # Derivatives agree to 1e-9; the condition of such a rig, and of markers seen once or twice, multiplies that.
    np.testing.assert_allclose(step, want, atol=1e-4 * np.abs(want).max())
    assert np.abs(C @ step).max() < 1e-6 * np.abs(C).max() * np.abs(step).max()


@pytest.mark.parametrize("which", ["frame", "camera"])
def test_the_covariance_is_the_dense_one(which: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(target_shape, "repetition", lambda *_, **__: 1.0)
    problem, shape = any_problem(which)
    H, _ = dense(problem, shape, 20.0, power=2)
    inverse, _, _ = solved_densely(problem, shape, H)
    n = len(inverse) - 6 * len(problem.rows.frames)
    variance = solver.residual_variance(problem.sums(shape, 20.0).squares, problem.dof, 20.0)
    want = variance * inverse[:n, :n]
    found = problem.covariance(shape, 20.0)
    np.testing.assert_allclose(found, want, atol=1e-4 * np.abs(want).max())  # as for the step
    assert (found == found.T).all()


def test_moving_the_target_frame_changes_no_residual() -> None:
    problem, shape = any_problem("frame")
    rng = np.random.default_rng(17)
    T = exp_se3(0.1 * rng.standard_normal(6))
    away = Shape(
        Poses(shape.poses.T_world_cam, shape.poses.T_world_target @ invert_transform(T)), T @ shape.T_target_map
    )
    before, after = (residuals(problem.placed(s), s.poses) for s in (shape, away))
    np.testing.assert_allclose(after, before, atol=1e-8)  # rounding of 1000 px in sigmas of 0.05 px


def test_residuals_beyond_the_unknowns_are_counted() -> None:
    problem, _ = any_problem("frame")
    n_corner = len(problem.rows.points)
    # Three cameras, three of four frames, and five of six markers: the sixth only says where the target's frame is.
    assert problem.dof == 2 * n_corner - 6 * (3 + 3 + 5)


# --- what it knows about itself -------------------------------------------------------------------------------------

REPETITIONS = 40


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Repeated:
    """Many refinements under new noise and new wrong maps, each beside the truth in the frame of its own map."""

    errors: Array  # (k, 6 (c + m)) cameras, then markers: T_true = Exp(xi) @ T_estimate
    covariances: Array  # (k, 6 (c + m), 6 (c + m))
    centre_m: Array  # (k, m) distances of the markers' centres from the truth
    sigma_m: Array  # (k, m)
    plain: Array  # (k,) normalised squared errors of the cameras, adjusted with the rough map

    def normalised(self, mine: slice, rank: int) -> Array:
        """Squared errors over their covariance of that rank, (k,)."""
        values, axes = np.linalg.eigh(self.covariances[:, mine, mine])
        along = np.einsum("kji,kj->ki", axes, self.errors[:, mine])
        return (along**2 / values)[:, -rank:].sum(axis=1)


def twist(T_true: Pose, T: Pose) -> Array:
    return log_se3(T_true @ invert_transform(T))


@cache
def repeated() -> Repeated:
    errors, covariances, centres, sigmas, plain = [], [], [], [], []
    for seed in range(REPETITIONS):
        rng = np.random.default_rng(3000 + seed)
        rig = box_rig(rng, n_cam=3, n_frame=12)
        wrong = rough(rig.geometry, rng)
        found = refined(rig, wrong, rng, sigma=1e-3)
        # The world is the target's frame in the first frame, and that is where the true shape fits the map best.
        ids = found.parts[0]
        assert ids == tuple(sorted(wrong))
        T_map_target = rigid_fit(stacked(wrong, ids), stacked(rig.geometry, ids))
        truth = {i: transform_points(T_map_target, rig.geometry[i]) for i in ids}
        T_world_cam = T_map_target @ rig.truth.T_world_cam
        cameras = np.array([twist(a, b) for a, b in zip(T_world_cam, found.poses.T_world_cam)])
        markers = np.array([log_se3(rigid_fit(truth[i], found.geometry[i])) for i in ids])
        errors.append(np.concatenate([cameras, markers]).ravel())
        covariances.append(full_covariance(rig, wrong, found))
        centres.append([np.linalg.norm((truth[i] - found.geometry[i]).mean(axis=0)) for i in ids])
        sigmas.append([found.sigma_m[i] for i in ids])
        rough_fit = adjust(with_map(rig, wrong), rig.start(rng, 1e-3), rig.gauge())
        off = np.concatenate([twist(a, b) for a, b in zip(T_world_cam, rough_fit.poses.T_world_cam)])
        plain.append(off @ np.linalg.solve(found.covariance, off))
    return Repeated(
        errors=np.array(errors),
        covariances=np.array(covariances),
        centre_m=np.array(centres),
        sigma_m=np.array(sigmas),
        plain=np.array(plain),
    )


def full_covariance(rig: SimRig, wrong: Geometry, found: RefinedTarget) -> Array:
    """That of cameras and markers, of which the result shows the cameras' part."""
    problem = target_shape._split(with_map(rig, wrong), rig.gauge())
    problem = replace(problem, part=np.zeros(len(problem.ids), dtype=np.int64))
    shape = Shape(found.poses, np.array([rigid_fit(found.geometry[i], wrong[i]) for i in found.parts[0]]))
    covariance = problem.covariance(shape, solver.KAPPA * found.scale)
    n = 6 * len(rig.cameras)
    # The same numbers after a detour over corners, whose rounding a weight feels at 1e-9.
    np.testing.assert_allclose(covariance[:n, :n], found.covariance, rtol=1e-6, atol=1e-6 * found.covariance.max())
    return covariance


def assert_spread_as_promised(normalised: Array, dimensions: int) -> None:
    """The mean normalised squared error lies in the central 99.9 % interval of chi-square, widened by 10 %.

    The sum over k independent repetitions is chi-square of k * dimensions. The variance itself comes from some 500
    residuals, corners of a frame are asked whether they repeat each other, which never makes it smaller, and maps that
    are off by a degree bend the model a little: together below 10 %.
    """
    n = len(normalised) * dimensions
    low, high = chi2.interval(0.999, n) / np.array(n)
    mean = float(normalised.sum()) / n
    assert low * 0.9 < mean < high * 1.1, f"{mean:.3f} is not in {low:.3f} .. {high:.3f}, 10 %"


def test_cameras_have_the_spread_that_the_covariance_promises() -> None:
    many = repeated()
    assert_spread_as_promised(many.normalised(slice(0, 18), 18), 18)
    for camera in range(3):
        assert_spread_as_promised(many.normalised(slice(6 * camera, 6 * camera + 6), 6), 6)


def test_markers_have_the_spread_that_the_covariance_promises() -> None:
    many = repeated()
    # Of six markers' poses, five are unknown: the rest is the frame of the map.
    assert_spread_as_promised(many.normalised(slice(18, 54), 30), 30)
    assert_spread_as_promised(many.normalised(slice(0, 54), 48), 48)


def test_the_centres_of_markers_have_their_standard_deviations() -> None:
    many = repeated()
    ratio = (many.centre_m**2).sum() / (many.sigma_m**2).sum()
    # The five independent centres of a repetition have at least one dimension each.
    low, high = chi2.interval(0.999, 5 * REPETITIONS) / np.array(5 * REPETITIONS)
    assert 0.9 * low < ratio < 1.1 * high


def test_the_interval_can_be_missed() -> None:
    many = repeated()
    for wrong in (0.5, 2.0):
        with pytest.raises(AssertionError):
            assert_spread_as_promised(many.normalised(slice(0, 54), 48) / wrong, 48)
    with pytest.raises(AssertionError):
        assert_spread_as_promised(many.plain, 18)


# --- writing it down ------------------------------------------------------------------------------------------------


def test_a_corrected_map_can_be_written_and_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(18)
    rig = box_rig(rng)
    found = refined(rig, rough(rig.geometry, rng), rng)
    faces = corrected_faces(standard_box(), found.geometry)
    assert [(face.name, face.ids) for face in faces] == [(face.name, face.ids) for face in standard_box()]
    save_faces(tmp_path / "corrected.parquet", faces)
    read = load_marker_geometry(tmp_path / "corrected.parquet")
    assert set(read) == set(found.geometry)
    assert all(read[i].tobytes() == found.geometry[i].tobytes() for i in read)


def test_a_rigid_fit_finds_the_motion_and_never_a_mirror() -> None:
    rng = np.random.default_rng(19)
    points = rng.standard_normal((12, 3))
    T = exp_se3(rng.standard_normal(6))
    angle, distance = pose_distance(rigid_fit(transform_points(T, points), points), T)
    assert max(angle, distance) < 1e-12  # rounding
    mirrored = points * [1.0, 1.0, -1.0]
    assert np.linalg.det(rigid_fit(mirrored, points)[:3, :3]) == pytest.approx(1.0)
