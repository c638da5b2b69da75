"""Clouds: what of a depth image takes part in registration, and how well it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from floor_rooms import FLOOR, FOCAL_BASELINE, ROOM, WALLS, K, cameras, depth_image, tilted
from hypothesis import given
from hypothesis import strategies as st
from icp_rooms import BOX, FURNISHED, LEVEL, TABLE, camera_data, clouds_of, cylinder_data, distances, fattened
from scipy.spatial import KDTree

from aruco.depth_bias import DepthBias
from aruco.depth_noise import CORRELATION_PX, DepthNoise, bias_prior
from aruco.errors import InputError
from aruco.floor_plane import FloorPlane, Mask
from aruco.floor_view import LEAN_PX
from aruco.icp_cloud import Cloud, cloud_of
from aruco.icp_surface import fit_surfaces
from aruco.icp_types import ICPConfig
from aruco.icp_view import measured_depth, usable_view
from aruco.pose_math import Array, Pose, exp_so3, make_pose, transform_points

FULL = ICPConfig(region="full", stride=2)
CAM = cameras()["cam0"]
UP_CAM = CAM[:3, :3].T @ [0.0, 1.0, 0.0]


def seen(depth: Array, config: ICPConfig = FULL, *, T: Pose = CAM, floor: FloorPlane | None = LEVEL) -> Cloud:
    return cloud_of("cam0", camera_data(depth), config, T_world_cam=T, floor=floor)


def degrees_between(a: Array, b: Array) -> Array:
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1.0, 1.0)))


def test_samples_lie_on_the_true_surfaces_within_their_noise():
    cloud = seen(depth_image(CAM, FURNISHED))
    off = distances(transform_points(CAM, cloud.points), FURNISHED)
    # A square of 2 x 2 pixels has a noise of 0.03 px / 2. Squares across a crease lie off it by a pixel's share.
    sigma = 0.015 / FOCAL_BASELINE * cloud.depth_m**2
    assert (off > 5 * sigma).sum() <= 5
    assert (off <= 10 * sigma).all()
    assert len(cloud) > 5000


def test_normals_face_the_camera_and_are_true():
    cloud = seen(depth_image(CAM, FURNISHED))
    world = cloud.normals @ CAM[:3, :3].T
    axis = np.eye(3)[np.argmax(np.abs(world), axis=1)]
    off = degrees_between(np.abs(world), axis)
    assert ((cloud.normals * cloud.rays).sum(axis=1) < 0).all()
    flat = cloud.normal_sigma == 0
    assert flat.mean() > 0.9
    # Planes of more than 200 squares of 0.015 px: their normals are good to a few hundredths of a degree.
    assert off[flat].max() < 0.2
    assert (off[~flat] <= np.degrees(5 * cloud.normal_sigma[~flat])).all()


def test_floor_samples_share_the_floor_normal_exactly_and_normals_of_their_own_would_not():
    depth = depth_image(CAM, FURNISHED)
    cloud = seen(depth)
    normals = cloud.normals[cloud.is_floor]
    assert len(normals) > 1000
    assert (normals == normals[0]).all()
    # Ten thousand pixels of 0.03 px: a hundredth of a degree, rounded up.
    assert degrees_between(normals[0], UP_CAM) < 0.05
    view = usable_view("cam0", camera_data(depth), 2, None)
    own = fit_surfaces(view.squares, float(K[0, 0]), view.samples.sigma)
    on_floor = own.sound & (np.abs(transform_points(CAM, view.samples.points)[:, 1]) < 0.01)
    assert degrees_between(own.normals[on_floor], UP_CAM).max() > 1.0


def test_the_floor_is_the_one_the_camera_sees_not_the_one_it_is_told():
    nudged = tilted(CAM, [1.0, -0.8], 0.03)
    cloud = seen(depth_image(CAM, FURNISHED), T=nudged)
    true = seen(depth_image(CAM, FURNISHED))
    assert cloud.is_floor.sum() == pytest.approx(true.is_floor.sum(), rel=0.02)
    assert cloud.floor is not None
    assert degrees_between(cloud.floor.normal, UP_CAM) < 0.05


def test_a_level_surface_elsewhere_is_no_floor():
    cloud = seen(depth_image(CAM, FURNISHED), floor=FloorPlane(np.array([0.0, 1.0, 0.0]), -0.4))
    assert cloud.floor is None
    assert not cloud.is_floor.any()
    assert len(cloud) > 5000


def test_a_fattened_edge_is_dropped():
    depth = fattened(depth_image(CAM, FURNISHED), 4)
    cloud = seen(depth)
    off = distances(transform_points(CAM, cloud.points), FURNISHED)
    assert (off <= 5 * 0.03 / FOCAL_BASELINE * cloud.depth_m**2).all()
    every = seen(depth, FULL).K  # the same image without masks has points far from any surface
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    rays = np.stack([(u - every[0, 2]) / every[0, 0], (v - every[1, 2]) / every[1, 1], np.ones(u.shape)], axis=-1)
    raw = transform_points(CAM, (rays * depth[..., None]).reshape(-1, 3))
    assert (distances(raw, FURNISHED) > 0.05).sum() > 100


def test_nothing_is_taken_beside_a_crease():
    cloud = seen(depth_image(CAM, FURNISHED))
    kinds = np.unique(cloud.normals[cloud.normal_sigma == 0].round(6), axis=0)
    assert len(kinds) >= 3  # floor, wall, a side of the box
    for kind in kinds:
        mine = (cloud.normals * kind).sum(axis=1) > 0.95
        other = (cloud.normals * kind).sum(axis=1) < 0.85
        near = KDTree(cloud.pixels[other]).query(cloud.pixels[mine], p=np.inf)[0]
        # 12 px at f = 700 px are 3 at 175, which is a square of 2 px and a half.
        assert near.min() >= 3.0


def test_lone_wrong_pixels_are_dropped():
    depth = depth_image(CAM, ROOM)
    rng = np.random.default_rng(0)
    v, u = rng.integers(0, depth.shape[0], 60), rng.integers(0, depth.shape[1], 60)
    # Two thirds of a pixel of disparity: too little for an edge, twenty sigma of the noise.
    depth[v, u] = 1.0 / (1.0 / depth[v, u] + 0.67 / FOCAL_BASELINE)
    cloud = seen(depth, replace(FULL, stride=1))
    wrong = np.zeros(depth.shape, dtype=bool)
    wrong[v, u] = True
    pixels = np.rint(cloud.pixels).astype(int)
    assert not wrong[pixels[:, 1], pixels[:, 0]].any()
    assert len(cloud) > 10_000


def test_a_cylinder_is_not_made_of_planes():
    T = make_pose(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 1.2, 0.0]))
    radius, distance = 0.25, 2.2
    cloud = cloud_of("cam0", cylinder_data(radius, distance), FULL, T_world_cam=T, floor=None)
    from_axis = cloud.points - [0.0, 0.0, distance]
    from_axis[:, 1] = 0.0
    on = np.linalg.norm(from_axis, axis=1) < radius + 0.05
    true = from_axis[on] / np.linalg.norm(from_axis[on], axis=1, keepdims=True)
    off = degrees_between(cloud.normals[on], true)
    assert on.sum() > 300
    assert (cloud.normal_sigma[on] > 0).all()
    # The same within a few degrees of noise, half a metre wide; one plane would be off by up to 60.
    assert np.median(off) < 3.0
    assert np.median(degrees_between(true, np.array([0.0, 0.0, -1.0]))) > 10.0


def test_surfaces_seen_from_the_side_take_no_part():
    cloud = seen(depth_image(CAM, ROOM))
    incidence = degrees_between(-cloud.normals, cloud.rays / np.linalg.norm(cloud.rays, axis=1, keepdims=True))
    assert incidence.max() <= 80.0


def upright(cloud: Cloud, T_world_cam: Pose = CAM) -> Mask:
    """Samples whose normal is within 30 degrees of level."""
    return np.abs(cloud.normals @ T_world_cam[1, :3]) <= 0.5


def test_regions_hold_the_floor_and_what_stands_on_it():
    depth = depth_image(CAM, (FLOOR, *WALLS, *BOX, *TABLE))
    floor, hybrid, full = (seen(depth, replace(FULL, region=region)) for region in ("floor", "hybrid", "full"))
    heights = {id(c): transform_points(CAM, c.points)[:, 1] for c in (floor, hybrid, full)}
    assert heights[id(floor)].max() < 0.3 + 0.02
    assert (upright(hybrid) | (heights[id(hybrid)] < 0.3 + 0.02)).all()
    assert heights[id(hybrid)].max() > 1.0
    assert (~upright(full) & (heights[id(full)] > 0.6)).any()
    assert len(floor) < len(hybrid) < len(full)
    assert floor.is_floor.sum() == hybrid.is_floor.sum() == full.is_floor.sum()


def test_without_a_floor_everything_takes_part():
    depth = depth_image(CAM, FURNISHED)
    none = seen(depth, replace(FULL, region="floor"), floor=None)
    assert len(none) == pytest.approx(len(seen(depth)), rel=0.02)
    assert not none.is_floor.any()


def test_one_sample_a_voxel_and_every_square_leads_to_one_nearby():
    config = replace(FULL, voxel_size=0.1)
    cloud = seen(depth_image(CAM, FURNISHED), config)
    voxels = np.floor(cloud.points / 0.1).astype(int)
    assert len(np.unique(voxels, axis=0)) == len(cloud)
    rows, columns = np.nonzero(cloud.grid >= 0)
    assert set(cloud.grid[rows, columns]) == set(range(len(cloud)))
    fine = seen(depth_image(CAM, FURNISHED))
    here, there = fine.grid[rows, columns], cloud.grid[rows, columns]
    both = here >= 0
    # A voxel's diagonal, and that of the fine voxels.
    apart = np.linalg.norm(fine.points[here[both]] - cloud.points[there[both]], axis=1)
    assert apart.max() < 3**0.5 * (0.1 + 0.02)


def test_thinning_takes_no_side():
    # The nearest of a voxel would lie a fair part of a sigma too near.
    cloud = seen(depth_image(CAM, ROOM), replace(FULL, voxel_size=0.1))
    off = np.abs(np.array([0.0, 1.0, 0.0]) @ CAM[:3, :3] @ cloud.rays[cloud.is_floor].T)
    heights = transform_points(CAM, cloud.points[cloud.is_floor])[:, 1]
    sigma = 0.015 / FOCAL_BASELINE * cloud.depth_m[cloud.is_floor] ** 2 * off
    z = heights / sigma
    assert abs(z.mean()) < 5 / np.sqrt(len(z))


def test_cells_are_small_and_repeat():
    depth = depth_image(CAM, FURNISHED)
    a, b = seen(depth), seen(depth)
    for name in ("pixels", "depth_m", "normals", "cell", "grid"):
        assert np.array_equal(getattr(a, name), getattr(b, name))
    assert np.array_equal(np.unique(a.cell), np.arange(a.cell.max() + 1))
    for cell in range(a.cell.max() + 1):
        assert np.ptp(a.pixels[a.cell == cell], axis=0).max() < CORRELATION_PX


def test_sigma_is_what_a_cell_shares():
    depth = depth_image(CAM, ROOM)
    pooled, single = (
        cloud_of("cam0", camera_data(depth, n_frames=n), FULL, T_world_cam=CAM, floor=LEVEL) for n in (400, 1)
    )
    noise = DepthNoise(focal_baseline=FOCAL_BASELINE)
    # Fixed noise is all that is left of 400 frames; one frame adds 0.12 px, of which a cell averages six.
    assert pooled.sigma_m == pytest.approx(noise.fixed_sigma_m(pooled.depth_m), rel=0.01)
    assert np.median(single.sigma_m / noise.fixed_sigma_m(single.depth_m)) == pytest.approx(
        np.hypot(1.0, 2.0 * 11 / 28), rel=0.01
    )


def test_noise_beyond_the_promise_makes_sigmas_larger():
    loud = 1.0 / (1.0 / depth_image(CAM, ROOM) + np.random.default_rng(1).normal(0, 0.6, (180, 320)) / FOCAL_BASELINE)
    quiet, noisy = seen(depth_image(CAM, ROOM)), seen(loud)
    # 0.6 px over 2 x 2 pixels is 0.3 px, and 0.066 px are promised of a square after twenty frames.
    ratio = (noisy.sigma_m / noisy.depth_m**2).mean() / (quiet.sigma_m / quiet.depth_m**2).mean()
    assert ratio == pytest.approx(0.3 / 0.066, rel=0.15)


@pytest.mark.parametrize(
    ("given", "wrong"),
    [
        (None, DepthBias(scale=1e-4, inverse_depth=1e-5)),
        (DepthBias(scale=0.01, inverse_depth=-2e-3), DepthBias(scale=0.0101, inverse_depth=-2.02e-3)),
        (
            DepthBias(model="offset", scale=0.01, offset_m=0.02),
            DepthBias(model="offset", scale=0.0102, offset_m=0.0201),
        ),
    ],
)
def test_slopes_are_derivatives_of_true_depth(given: DepthBias | None, wrong: DepthBias):
    depth = depth_image(CAM, ROOM)
    a, b = (
        cloud_of("cam0", camera_data(depth), FULL, T_world_cam=CAM, floor=LEVEL, bias=bias) for bias in (given, wrong)
    )
    was = DepthBias() if given is None else given
    step = np.array([wrong.scale - was.scale, wrong.inverse_depth - was.inverse_depth + wrong.offset_m - was.offset_m])
    shared = np.intersect1d(a.grid[a.grid >= 0], b.grid[b.grid >= 0])
    same = (a.grid >= 0) & (b.grid >= 0) & (a.pixels[a.grid] == b.pixels[b.grid]).all(axis=-1)
    i, j = a.grid[same], b.grid[same]
    assert len(shared) > 1000
    # Second order: the square of the step, 1e-8, times a few; and the mean over a square.
    assert b.depth_m[j] - a.depth_m[i] == pytest.approx(a.slopes[:2, i].T @ step, abs=5e-6)


def test_a_lean_turns_inverse_depth_with_the_ray():
    cloud = seen(depth_image(CAM, ROOM))
    b = np.array([0.0, 0.0, 1e-5, -2e-5])
    moved = 1.0 / (1.0 / cloud.depth_m - cloud.rays[:, :2] @ b[2:])
    assert moved - cloud.depth_m == pytest.approx(cloud.slopes.T @ b, abs=1e-7)


def test_the_given_bias_is_taken_out():
    bias = DepthBias(scale=0.01, inverse_depth=0.3 / FOCAL_BASELINE, focal_baseline=FOCAL_BASELINE)
    depth = depth_image(CAM, ROOM)
    wrong = np.vectorize(lambda z: (1 + bias.scale) / (1 / z + bias.inverse_depth))(depth)
    data = camera_data(wrong) | {"bias": bias}
    cloud = cloud_of("cam0", data, FULL, T_world_cam=CAM, floor=LEVEL)
    off = distances(transform_points(CAM, cloud.points), ROOM)
    assert (off <= 5 * 0.015 / FOCAL_BASELINE * cloud.depth_m**2).all()
    assert cloud.given_bias is bias
    # The bias of the call goes before that of the data.
    plain = cloud_of("cam0", data, FULL, T_world_cam=CAM, floor=LEVEL, bias=DepthBias())
    assert distances(transform_points(CAM, plain.points), ROOM).max() > 0.03


def test_what_is_not_known_of_the_bias_is_the_prior_or_as_measured():
    depth = depth_image(CAM, ROOM)
    free = seen(depth).bias_covariance
    assert free[:2, :2] == pytest.approx(bias_prior(FOCAL_BASELINE))
    assert np.sqrt(np.diag(free)[2:]) == pytest.approx([LEAN_PX / FOCAL_BASELINE] * 2)
    known = DepthBias(scale=1e-3, covariance=np.diag([1e-6, 1e-8]))
    cloud = cloud_of("cam0", camera_data(depth), FULL, T_world_cam=CAM, floor=LEVEL, bias=known)
    # But for the little that is never known.
    assert cloud.bias_covariance[:2, :2] == pytest.approx(np.diag([1e-6, 1e-8]), rel=0.01)


def test_a_world_with_y_down_gives_the_same_cloud():
    depth = depth_image(CAM, FURNISHED)
    turned = make_pose(exp_so3(np.array([np.pi, 0.0, 0.0])), np.zeros(3)) @ CAM
    config = replace(FULL, region="hybrid")
    up = seen(depth, config)
    down = cloud_of(
        "cam0",
        camera_data(depth),
        replace(config, up=(0.0, -1.0, 0.0)),
        T_world_cam=turned,
        floor=FloorPlane(np.array([0.0, -1.0, 0.0]), 0.0),
    )
    # Chance is the same, but a half turn is right to the last digits only.
    assert len(down) == pytest.approx(len(up), rel=0.005)
    assert down.is_floor.sum() == pytest.approx(up.is_floor.sum(), rel=0.005)
    assert upright(down, turned).mean() == pytest.approx(upright(up).mean(), abs=0.005)


def test_confidence_and_noise_leave_pixels_out():
    depth = depth_image(CAM, ROOM)
    confidence = np.zeros(depth.shape)
    confidence[:, :160] = 100.0
    right = cloud_of("cam0", camera_data(depth) | {"confidence": confidence}, FULL, T_world_cam=CAM, floor=LEVEL)
    assert right.pixels[:, 0].min() >= 160
    far = seen(np.full(depth.shape, 60.0, dtype=np.float32))
    assert len(far) == 0
    assert far.points.shape == (0, 3)
    assert (far.grid == -1).all()


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ({"K": K}, "want its depth"),
        ({"depth": np.full((180, 320), np.nan), "K": K}, "NaN everywhere"),
        ({"depth": np.full((180, 320), 2500.0), "K": K}, "millimetres"),
        ({"depth": np.ones((180, 320)), "K": np.diag([4000.0, 4000.0, 1.0])}, "centre"),
        ({"depth": np.ones((180, 320)), "K": np.eye(2)}, "camera matrix"),
    ],
)
def test_what_is_no_depth_is_refused(data: dict[str, Array], said: str):
    with pytest.raises(InputError, match=said):
        cloud_of("cam0", data, FULL, T_world_cam=CAM, floor=LEVEL)


def test_tiny_images_give_few_samples_or_none():
    for shape in ((3, 5), (16, 16), (40, 30)):
        data = {"depth": np.full(shape, 2.0), "K": np.array([[30.0, 0, 2], [0, 30, 1.5], [0, 0, 1]])}
        cloud = cloud_of("cam0", data, ICPConfig(region="full", stride=4), T_world_cam=CAM, floor=LEVEL)
        assert cloud.grid.shape == (-(-shape[0] // 4), -(-shape[1] // 4))


@given(
    scale=st.floats(-0.2, 0.2),
    second=st.floats(-0.05, 0.05),
    model=st.sampled_from(["stereo", "offset"]),
    depth=st.floats(0.2, 8.0),
)
def test_measured_depth_undoes_the_correction(scale: float, second: float, model: str, depth: float):
    if model == "offset":
        bias = DepthBias(model="offset", scale=scale, offset_m=second)
    else:
        bias = DepthBias(scale=scale, inverse_depth=second)
    assert bias.corrected(measured_depth(bias, np.array([depth]))) == pytest.approx([depth], rel=1e-9)


def test_all_cameras_of_a_room_see_its_floor():
    clouds = clouds_of(cameras())
    assert all(cloud.is_floor.sum() > 500 for cloud in clouds.values())
