"""Triangulation and lengths: exact where corners are, honest with noise, and wrong scales and cameras show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from marker_pictures import make_camera
from target_views import any_pose, box, looking_at, sight

from aruco import lens
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, exp_se3, invert_transform, make_pose, transform_points
from rigcal.quality.lengths import Lengths, measure_lengths, triangulate, widest_angle

MIDDLE = np.array([0.0, 0.3, 0.0])
POSES = {
    name: looking_at(np.array([2.2 * np.sin(a), h, 2.2 * np.cos(a)]), MIDDLE)
    for name, a, h in (("a", 0.0, 0.8), ("b", 0.6, 1.0), ("c", 1.2, 0.6))
}
BOX = box(0.4)


def seen(
    cameras: list[Camera], sigma_px: float, *, n_frames: int = 8, poses: Mapping[str, Pose] = POSES
) -> dict[str, dict[int, Detection]]:
    rng = np.random.default_rng(0)
    frames = [make_pose(any_pose(rng)[:3, :3], MIDDLE + 0.1 * rng.standard_normal(3)) for _ in range(n_frames)]
    return {
        c.name: {f: sight(c, invert_transform(poses[c.name]) @ T, BOX, sigma_px, rng) for f, T in enumerate(frames)}
        for c in cameras
    }


def measured(
    sigma_px: float,
    *,
    lens_model: str = "pinhole",
    geometry: Mapping[int, Array] = BOX,
    poses: Mapping[str, Pose] = POSES,
) -> Lengths:
    cameras = [make_camera(name, lens_model) for name in POSES]
    lengths = measure_lengths(cameras, poses, seen(cameras, sigma_px), geometry)
    assert lengths is not None
    return lengths


@pytest.mark.parametrize("lens_model", ["pinhole", "plumb_bob", "rational_polynomial", "equidistant"])
def test_exact_corners_give_exact_lengths_through_any_lens(lens_model: str) -> None:
    lengths = measured(0.0, lens_model=lens_model)
    # The inverse of a lens is exact to 1e-12.
    assert lengths.rms_m < 1e-9
    assert abs(lengths.scale_error) < 1e-9
    assert lengths.miss_px < 1e-6
    assert lengths.cameras == ("a", "b", "c")
    assert lengths.n > 6 * lengths.n_corners / 4


def test_noise_gives_its_own_size() -> None:
    lengths = measured(0.1)
    # 0.1 px is 0.3 mm at 2.2 m; across 0.6 rad the depth of a corner is known three times worse, and a length has two.
    assert 0.0002 < lengths.rms_m < 0.002
    assert abs(lengths.scale_error) < 0.001
    # Two cameras have four coordinates for three unknowns: a quarter of the variance of both is left, 0.07 px a corner.
    assert 0.03 < lengths.miss_px < 0.15


def test_a_map_with_larger_markers_at_the_same_places_shows() -> None:
    larger = {m: c.mean(axis=0) + 1.02 * (c - c.mean(axis=0)) for m, c in BOX.items()}
    lengths = measured(0.02, geometry=larger)
    np.testing.assert_allclose(lengths.markers_scale_error, 1 / 1.02 - 1, atol=5e-4)
    # Distances between the middles of markers are right, so distances between them are less wrong.
    assert abs(lengths.between_scale_error) < abs(lengths.markers_scale_error)


def test_cameras_too_near_each_other_come_out_as_a_scale() -> None:
    nearer = {name: make_pose(T[:3, :3], 0.99 * T[:3, 3]) for name, T in POSES.items()}
    # Everything shrinks about the origin, the cameras' distances and what they measure.
    np.testing.assert_allclose(measured(0.02, poses=nearer).scale_error, -0.01, atol=1e-3)


def test_a_camera_that_looks_elsewhere_shows_as_rays_that_miss() -> None:
    turned = dict(POSES)
    turned["b"] = POSES["b"] @ exp_se3(np.array([0.005, 0.0, 0.0, 0.0, 0.0, 0.0]))
    # 5 mrad are 3.5 px; the three cameras share the blame.
    assert measured(0.02, poses=turned).miss_px > 0.5
    assert measured(0.02).miss_px < 0.05


def test_rays_that_hardly_cross_are_left_out() -> None:
    beside = {name: make_pose(POSES["a"][:3, :3], POSES["a"][:3, 3] + [0.05 * k, 0, 0]) for k, name in enumerate("abc")}
    cameras = [make_camera(name) for name in beside]
    # 0.1 m at 2.2 m is 2.6 degrees.
    assert measure_lengths(cameras, beside, seen(cameras, 0.0, poses=beside), BOX) is None


def test_one_camera_or_nothing_seen_gives_no_lengths() -> None:
    camera = make_camera("a")
    assert measure_lengths([camera], POSES, seen([camera], 0.0), BOX) is None
    assert measure_lengths([camera], POSES, {}, BOX) is None


def test_triangulation_is_better_than_the_nearest_point_of_rays() -> None:
    rng = np.random.default_rng(1)
    # One camera stands ten times as far off, so its rays miss by more metres for the same pixels.
    T = np.array([POSES["a"], POSES["b"], looking_at(np.array([20.0, 4.0, 3.0]), MIDDLE)])
    X = MIDDLE + 0.2 * rng.standard_normal((400, 3))
    camera = replace(make_camera(), distortion=np.zeros(5))
    pixels = np.stack([lens.project(camera, transform_points(invert_transform(P), X)) for P in T], axis=1)
    pixels += 0.2 * rng.standard_normal(pixels.shape)
    rays = np.stack([lens.undistort(camera, pixels[:, c]) for c in range(3)], axis=1)
    weight = np.full(rays.shape[:2], camera.K[0, 0] / 0.2)
    error = np.linalg.norm(triangulate(rays, weight, T) - X, axis=1)
    # 0.2 px at 2.2 m is 0.6 mm.
    assert np.median(error) < 0.002
    d = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
    d = np.einsum("cij,ncj->nci", T[:, :3, :3], d)
    d /= np.linalg.norm(d, axis=2, keepdims=True)
    across = np.eye(3) - d[..., :, None] * d[..., None, :]
    linear = np.linalg.solve(across.sum(axis=1), np.einsum("ncij,cj->ni", across, T[:, :3, 3])[:, :, None])[:, :, 0]
    assert np.median(np.linalg.norm(linear - X, axis=1)) > 1.2 * np.median(error)


def test_points_without_two_rays_stay_unknown() -> None:
    T = np.array([POSES["a"], POSES["b"]])
    rays = np.array([[[0.0, 0.0], [np.nan, np.nan]]])
    assert np.isnan(triangulate(rays, np.array([[1.0, 0.0]]), T)).all()
    assert widest_angle(rays, T)[0] == 0.0
