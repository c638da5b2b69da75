"""Patterns of residuals: derivatives are those of the projection, and each fault is found with its size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from marker_pictures import LENSES, make_camera
from target_views import any_pose, box, looking_at, sight

from aruco import lens
from aruco.model import Camera
from aruco.pose_math import Array, exp_se3, invert_transform, make_pose, transform_points
from rigcal.quality import patterns
from rigcal.quality.patterns import Corners, Kind, search_patterns
from rigcal.solve.adjust import Gauge, adjust
from rigcal.solve.problem import Poses, gather

MIDDLE = np.array([0.0, 0.3, 0.0])
POSES = {
    name: looking_at(np.array([2.2 * np.sin(a), h, 2.2 * np.cos(a)]), MIDDLE)
    for name, a, h in (("a", 0.0, 0.8), ("b", 1.3, 1.0), ("c", 2.6, 0.6))
}
BOX = box(0.4)


def solved(true: Mapping[str, Camera], geometry: Mapping[int, Array] = BOX, *, n_frames: int = 10) -> Corners:
    """The corners of a moved box, and the optimum of cameras that are taken for the usual ones and a usual box."""
    rng = np.random.default_rng(0)
    frames = [make_pose(any_pose(rng)[:3, :3], MIDDLE + 0.2 * rng.standard_normal(3)) for _ in range(n_frames)]
    seen = {
        n: {
            f: sight(true.get(n, make_camera(n)), invert_transform(P) @ T, geometry, 0.05, rng)
            for f, T in enumerate(frames)
        }
        for n, P in POSES.items()
    }
    cameras = [make_camera(name) for name in POSES]
    s = gather(cameras, seen, BOX)
    gauge = Gauge(np.arange(3) == 0, np.zeros(n_frames, dtype=bool))
    optimum = adjust(s, Poses(np.array(list(POSES.values())), np.array(frames)), gauge)
    return Corners(
        cameras=cameras,
        T_world_cam=optimum.poses.T_world_cam,
        T_world_target=optimum.poses.T_world_target,
        moving=True,
        camera=s.view_camera[s.corner_view],
        frame=s.view_frame[s.corner_view],
        marker=s.marker,
        points=s.points,
        pixels=s.pixels,
        sigma_px=s.sigma_px,
        scale=optimum.scale,
    )


def changed(kind: Kind, amount: float, name: str = "b") -> Camera:
    camera = make_camera(name)
    K, distortion = camera.K.copy(), camera.distortion.copy()
    if kind == "focal":
        K[[0, 1], [0, 1]] *= 1 + amount
    elif kind == "aspect":
        K[0, 0] *= 1 + amount / 2
        K[1, 1] *= 1 - amount / 2
    elif kind == "lens":
        distortion[0] = amount
    else:
        K[0 if kind == "centre_x" else 1, 2] += amount
    return replace(camera, K=K, distortion=distortion)


@pytest.mark.parametrize("lens_model", LENSES)
def test_derivatives_are_those_of_the_projection(lens_model: str) -> None:
    camera = make_camera("cam", lens_model)
    p = np.random.default_rng(1).uniform([-0.5, -0.4, 1.8], [0.5, 0.4, 2.5], (20, 3))
    by_point, _ = patterns._pixel_derivatives(camera, p)
    step = 1e-6
    for k in range(3):
        plus, minus = (lens.project(camera, p + s * step * np.eye(3)[k]) for s in (1, -1))
        # Central differences: 1e-6 m leave 1e-6 of 350 px/m in rounding.
        np.testing.assert_allclose(by_point[:, :, k], (plus - minus) / (2 * step), atol=1e-3)


@pytest.mark.parametrize("kind", patterns.OF_CAMERA)
def test_derivatives_by_faults_are_those_of_changed_cameras(kind: Kind) -> None:
    p = np.random.default_rng(2).uniform([-0.5, -0.4, 1.8], [0.5, 0.4, 2.5], (20, 3))
    _, faults = patterns._pixel_derivatives(make_camera("b"), p)
    plus, minus = (lens.project(changed(kind, s * 1e-5), p) for s in (1, -1))
    np.testing.assert_allclose(faults[:, :, patterns.OF_CAMERA.index(kind)], (plus - minus) / 2e-5, atol=1e-4)


def test_derivatives_by_the_target_are_those_of_a_moved_target() -> None:
    rng = np.random.default_rng(3)
    camera, T_world_target, T_cam_world = (
        make_camera(),
        any_pose(rng, 0.3, 0.1),
        make_pose(np.eye(3), np.array([0, 0, 2])),
    )
    points = rng.uniform(-0.2, 0.2, (20, 3))
    D, _ = patterns._pixel_derivatives(camera, transform_points(T_cam_world @ T_world_target, points))
    twist = patterns._twist(T_world_target, points, D @ T_cam_world[:3, :3])
    for k in range(6):
        plus, minus = (
            lens.project(
                camera, transform_points(T_cam_world @ exp_se3(s * 1e-6 * np.eye(6)[k]) @ T_world_target, points)
            )
            for s in (1, -1)
        )
        np.testing.assert_allclose(twist[:, :, k], (plus - minus) / 2e-6, atol=1e-3)


def test_noise_shows_no_pattern() -> None:
    assert search_patterns(solved({})).clearest is None


@pytest.mark.parametrize(("kind", "amount"), [("focal", 0.015), ("aspect", -0.015), ("lens", 0.06), ("centre_x", 25.0)])
def test_a_fault_of_one_camera_is_found_with_its_size(kind: Kind, amount: float) -> None:
    found = search_patterns(solved({"b": changed(kind, amount)})).clearest
    assert found is not None
    assert (found.kind, found.camera) == (kind, "b")
    # One linear step under a robust loss: a tenth, and four of its sigmas.
    assert abs(found.value - amount) < 0.1 * abs(amount) + 4 * found.sigma


def test_prints_of_another_shape_or_size_are_found_with_their_size() -> None:
    wide: dict[int, Array] = {}
    for marker, c in BOX.items():
        x = (c[1] - c[0]) / np.linalg.norm(c[1] - c[0])
        wide[marker] = c + 0.01 * ((c - c.mean(axis=0)) @ x)[:, None] * x
    found = search_patterns(solved({}, wide)).clearest
    assert found is not None
    assert found.kind == "print_stretch"
    np.testing.assert_allclose(found.value, 0.01, rtol=0.15)
    found = search_patterns(
        solved({}, {m: c.mean(axis=0) + 1.02 * (c - c.mean(axis=0)) for m, c in BOX.items()})
    ).clearest
    assert found is not None
    assert found.kind == "print_size"
    np.testing.assert_allclose(found.value, 0.02, rtol=0.15)


def test_what_goes_unnoticed_is_larger_where_there_is_less_to_see() -> None:
    many, few = search_patterns(solved({})).focal_noticed, search_patterns(solved({}, n_frames=3)).focal_noticed
    assert set(many) == set(POSES)
    assert max(few.values()) > max(many.values())
