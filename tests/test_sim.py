"""The simulator tells the truth: its pictures agree with the projection, its noise with its parameters."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from aruco import lens
from aruco.board import CharucoBoard, board_geometry, parse_board
from aruco.errors import InputError
from aruco.marker_geometry import SHIPPED_MAPS, load_faces
from aruco.model import Camera
from aruco.pose_math import Array, exp_so3, invert_transform, make_pose, transform_points
from rigcal.sim import RIGS, Simulation, simulate, simulate_rig
from rigcal.sim.noise import (
    DepthBias,
    DepthNoise,
    ImageNoise,
    expose,
    fixed_error,
    grow_edges,
    measure_depth,
    sense,
)
from rigcal.sim.placement import look_at, resting_pose, seen_markers
from rigcal.sim.render import render_depth, render_image
from rigcal.sim.room import floor_panel
from rigcal.sim.scene import (
    BLACK_ALBEDO,
    FLAT_LIGHT,
    WHITE_ALBEDO,
    Panel,
    Print,
    Scene,
    Target,
    board_panel,
    box_panels,
    marker_cells,
    marker_dictionary,
    target_panels,
)

BENT = {
    "none": ("plumb_bob", []),
    "plumb_bob": ("plumb_bob", [-0.25, 0.08, 1e-3, -8e-4, 0.0]),
    "rational_polynomial": ("rational_polynomial", [0.3, 0.1, 1e-3, 0.0, 0.01, 0.5, 0.1, 0.02]),
    "equidistant": ("equidistant", [0.02, -0.01, 0.003, 0.0]),
}
QUIET = DepthNoise(sigma_px=0.0, fixed_sigma_px=0.0, grown_px=0, dropout=0.0)
FB = 84.0  # f = 700 px, B = 0.12 m


def camera(kind: str = "none") -> Camera:
    model, distortion = BENT[kind]
    K = np.array([[200.0, 0.0, 158.3], [0.0, 205.0, 121.6], [0.0, 0.0, 1.0]])
    return Camera(
        name="a",
        width=320,
        height=240,
        K=K,
        distortion_model=model,  # pyright: ignore[reportArgumentType]
        distortion=np.array(distortion),
    )


def square_ahead(side_m: float = 1.1) -> Array:
    """Corners (4, 3) of a tilted square that fills much of the view of a camera at the origin."""
    half = side_m / 2
    corners = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    return corners @ exp_so3(np.array([0.35, -0.3, 0.2])).T + [0.1, -0.05, 1.5]


def area_and_centre(view: Camera, corners: Array, per_side: int = 400) -> tuple[float, Array]:
    """Area and centroid of a projected polygon by the shoelace formula, its sides cut into short pieces."""
    share = np.linspace(0, 1, per_side, endpoint=False)[:, None]
    outline = np.concatenate([a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])
    p = lens.project(view, outline)
    q = np.roll(p, -1, axis=0)
    cross = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]
    return float(cross.sum() / 2), ((p + q) * cross[:, None]).sum(axis=0) / (3 * cross.sum())


def bright_area_and_centre(image: Array) -> tuple[float, Array]:
    v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    total = float(image.sum())
    return total, np.array([(image * u).sum(), (image * v).sum()]) / total


def bright_square(corners: Array) -> Scene:
    return Scene(panels=(Panel(vertices=corners, albedo=1.0),), light=FLAT_LIGHT, background=0.0)


@pytest.fixture(scope="module")
def box() -> Simulation:
    return simulate("box-static", seed=0)


# --- geometry of the pictures ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", BENT)
def test_a_bright_square_covers_the_area_that_projection_says(kind: str) -> None:
    view, corners = camera(kind), square_ahead()
    area, centre = area_and_centre(view, corners)
    image = render_image(bright_square(corners), view, np.eye(4)).astype(np.float64)
    got_area, got_centre = bright_area_and_centre(image)
    # 55 rays leave an error of 0.011 px^2 (standard deviation) in each of the ~750 pixels that the outline crosses,
    # which add up by chance to 0.3 px^2, that is 5e-4 px along the outline; and 1e-3 px in the centre. Three sigma:
    assert got_area == pytest.approx(area, abs=0.9)
    assert np.abs(got_centre - centre).max() < 3e-3


def test_one_ray_a_pixel_misses_the_area() -> None:
    corners = square_ahead()
    area, _ = area_and_centre(camera(), corners)
    coarse = (render_depth(bright_square(corners), camera(), np.eye(4)) > 0).sum()
    assert abs(coarse - area) > 0.9


@pytest.mark.parametrize("kind", ["plumb_bob", "equidistant"])
def test_a_distorted_picture_bends_straight_edges(kind: str) -> None:
    corners = square_ahead()
    area, _ = area_and_centre(camera(kind), corners)
    straight, _ = area_and_centre(camera(kind), corners, per_side=1)
    assert abs(straight - area) > 100  # against the 0.9 px^2 allowed above


@pytest.mark.parametrize("offset_px", [0.0, 0.013, 0.25, 0.4999, 0.77])
def test_an_upright_edge_stands_where_projection_says_to_the_thousandth(offset_px: float) -> None:
    # The hardest case for sampling: an edge along the columns of pixels.
    view = camera()
    edge_m = (100.0 + offset_px - view.K[0, 2]) / view.K[0, 0]
    corners = np.array([[-2.0, -2.0, 1.0], [edge_m, -2.0, 1.0], [edge_m, 2.0, 1.0], [-2.0, 2.0, 1.0]])
    image = render_image(bright_square(corners), view, np.eye(4)).astype(np.float64)
    # Pixel 0 begins at -0.5, so the sum of a row is the edge's place plus a half.
    places = image.sum(axis=1) - 0.5
    assert abs(places.mean() - 100.0 - offset_px) < 1e-3
    assert np.abs(places - 100.0 - offset_px).max() < 1.5 / 55  # one or two rays of a single pixel


def test_a_cell_of_a_print_lies_where_its_corners_project() -> None:
    corners = square_ahead(0.8)
    white = np.zeros((8, 8), dtype=bool)
    white[2, 5] = True  # row 2, column 5: not its own mirror image in any way
    panel = Panel(vertices=square_ahead(1.1), albedo=BLACK_ALBEDO, prints=(Print(corners=corners, white=white),))
    image = render_image(Scene(panels=(panel,), light=FLAT_LIGHT, background=BLACK_ALBEDO), camera(), np.eye(4))
    right, down = (corners[1] - corners[0]) / 8, (corners[3] - corners[0]) / 8
    first = corners[0] + 5 * right + 2 * down
    cell = np.array([first, first + right, first + right + down, first + down])
    area, centre = area_and_centre(camera(), cell)
    # The margin is white too: look at the cell's surroundings only.
    u, v = np.rint(centre).astype(int)
    window = (image[v - 14 : v + 15, u - 14 : u + 15].astype(np.float64) - BLACK_ALBEDO) / (WHITE_ALBEDO - BLACK_ALBEDO)
    got_area, got_centre = bright_area_and_centre(window)
    assert got_area == pytest.approx(area, abs=0.28)  # three sigma of 0.011 px^2 in each of ~70 pixels
    error_px = got_centre + np.array([u - 14, v - 14]) - centre
    assert np.abs(error_px).max() < 8e-3  # three sigma: 0.011 px^2 at ~6 px in ~40 crossed pixels, of 160 px^2


def test_a_print_is_seen_from_its_printed_side_only() -> None:
    cells = marker_cells(marker_dictionary("DICT_APRILTAG_36h11"), 3)
    panel = Panel(vertices=square_ahead(1.1), albedo=0.5, prints=(Print(corners=square_ahead(0.8), white=cells),))
    scene = Scene(panels=(panel,), light=FLAT_LIGHT)
    assert render_image(scene, camera(), np.eye(4)).min() == pytest.approx(min(BLACK_ALBEDO, scene.background))
    behind = look_at(np.array([0.1, -0.05, 3.5]), np.array([0.1, -0.05, 1.5]))
    assert set(np.unique(render_image(scene, camera(), behind)[100:140, 130:180])) == {np.float32(0.5)}


def test_depth_is_exact_and_empty_where_nothing_is() -> None:
    view, T_world_cam = camera(), look_at(np.array([0.5, 1.4, 2.0]), np.array([0.0, 0.6, -1.0]))
    depth_m = render_depth(Scene(panels=(floor_panel(),)), view, T_world_cam).astype(np.float64)
    v, u = np.mgrid[0:240, 0:320]
    rays = np.stack([(u - view.K[0, 2]) / view.K[0, 0], (v - view.K[1, 2]) / view.K[1, 1], np.ones((240, 320))], -1)
    points = transform_points(T_world_cam, rays * depth_m[..., None])
    seen = np.isfinite(depth_m)
    assert seen.any()
    assert not seen.all()
    assert np.abs(points[seen][:, 1]).max() < 2e-6  # the rounding of 6 m to float32, twice over
    # No point of the floor is missed: the horizon of the floor is the only boundary.
    assert (np.diff(seen.astype(int), axis=0) >= 0).all()


def test_depth_of_a_distorted_camera_is_rectified() -> None:
    scene = bright_square(square_ahead())
    bent, plain = (render_depth(scene, camera(kind), np.eye(4)) for kind in ("plumb_bob", "none"))
    np.testing.assert_array_equal(bent, plain)


def test_pixels_beyond_the_lens_show_the_background() -> None:
    view = Camera(name="a", width=320, height=240, K=camera().K, distortion=np.array([-0.4, 0.0, 0.0, 0.0, 0.0]))
    wall = Panel(
        vertices=np.array([[-99.0, -99, 1], [99, -99, 1], [99, 99, 1], [-99, 99, 1]]), albedo=0.8, contrast=0.1
    )
    image = render_image(Scene(panels=(wall,), background=0.3), view, np.eye(4))
    grid = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 2)
    lost = np.isnan(lens.undistort(view, grid)[:, 0]).reshape(240, 320)
    assert 0 < lost.mean() < 0.5
    inside = cv2.erode(lost.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1).astype(bool)
    assert (image[inside] == np.float32(0.3)).all()
    assert image[120, 160] > 0.5


def test_a_nearer_body_hides_a_farther_one() -> None:
    near = box_panels((0.4, 0.4, 0.4), make_pose(np.eye(3), np.array([0.0, 0.0, 1.2])), 1.0)
    scene = Scene(
        panels=(Panel(vertices=square_ahead(3.0) + np.array([0, 0, 2.0]), albedo=0.0), *near), light=FLAT_LIGHT
    )
    depth_m = render_depth(scene, camera(), np.eye(4))
    assert depth_m[120, 158] == pytest.approx(1.0, abs=1e-6)
    assert render_image(scene, camera(), np.eye(4))[120, 158] == 1.0


# --- the target -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1])
def test_every_visible_marker_is_detected_where_it_projects(seed: int) -> None:
    simulation = simulate("box-static", seed=seed, depth=False)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(marker_dictionary(simulation.dictionary), parameters)
    for view in simulation.recording.cameras:
        T_world_cam, T_world_target = simulation.T_world_cam[view.name], simulation.T_world_target[0]
        (frame,) = simulation.recording.frames(view.name, [0])
        corners, ids, _ = detector.detectMarkers(frame.image)
        found = {int(marker): quad[0] for marker, quad in zip(ids.ravel(), corners)}
        expected = seen_markers(view, T_world_cam, simulation.target, T_world_target)
        assert expected
        assert set(expected) <= set(found)
        for marker, pixels in expected.items():
            # OpenCV's own refinement is biased by up to 0.4 px here; a wrong corner order would be a marker's side.
            assert np.abs(found[marker] - pixels).max() < 0.5, (view.name, marker)
        # A marker on a side turned away is hidden by the body.
        toward = {
            marker
            for face in simulation.faces
            for marker, quad in zip(face.ids, transform_points(T_world_target, face.corners))
            if np.cross(quad[1] - quad[0], quad[3] - quad[0]) @ (quad[0] - T_world_cam[:3, 3]) > 0
        }
        assert set(found) <= toward


def test_prints_on_hidden_sides_change_nothing() -> None:
    faces = load_faces(SHIPPED_MAPS / "standard_box_markers.parquet")
    T_world_target = make_pose(np.eye(3), np.array([0.0, 0.3, 0.0]))
    T_world_cam = look_at(np.array([0.8, 1.2, 2.0]), np.array([0.0, 0.3, 0.0]))  # sees front, right and top

    def picture(*names: str) -> Array:
        chosen = tuple(face for face in faces if face.name in names)
        target = Target(faces=chosen, dictionary="DICT_APRILTAG_36h11")
        return render_image(Scene(panels=tuple(target_panels(target, T_world_target))), camera(), T_world_cam)

    everything = picture("front", "back", "left", "right", "top", "bottom")
    np.testing.assert_array_equal(everything, picture("front", "right", "top"))
    assert np.abs(everything - picture("front", "right")).max() > 0.3


@pytest.mark.parametrize(("file", "closed"), [("standard_box_markers.parquet", True), ("object_points.parquet", False)])
def test_a_target_rests_on_the_face_that_was_asked_for(file: str, closed: bool) -> None:
    faces = tuple(load_faces(SHIPPED_MAPS / file))
    target = Target(faces=faces, dictionary="DICT_APRILTAG_36h11", closed=closed)
    for face in faces:
        T_world_target = resting_pose(target, face.name, 0.7)
        heights = transform_points(T_world_target, face.corners)[..., 1]
        # An open target's panels are 2 mm thick.
        assert heights == pytest.approx(np.full_like(heights, 0.0 if closed else 0.002), abs=1e-9)
        lowest = min(panel.vertices[:, 1].min() for panel in target_panels(target, T_world_target))
        assert lowest > -1e-9
    with pytest.raises(InputError, match=r"lid: .*known: .*front"):
        resting_pose(target, "lid", 0.0)


def test_the_open_corner_has_three_sides_and_the_box_six() -> None:
    dictionary = "DICT_APRILTAG_36h11"
    corner = Target(
        faces=tuple(load_faces(SHIPPED_MAPS / "object_points.parquet")), dictionary=dictionary, closed=False
    )
    box = Target(faces=tuple(load_faces(SHIPPED_MAPS / "standard_box_markers.parquet")), dictionary=dictionary)
    assert [len(panel.prints) for panel in target_panels(corner, np.eye(4))] == [4, 4, 4]
    assert [len(panel.prints) for panel in target_panels(box, np.eye(4))] == [1] * 6


# --- noise ----------------------------------------------------------------------------------------------------------


def test_image_noise_is_about_two_levels_at_mid_grey() -> None:
    rng = np.random.default_rng(3)
    level = np.full((200, 200), 128.0, dtype=np.float32)
    image = sense(level, ImageNoise(), rng).astype(np.float64)
    # Read 1.2 and shot 2.2 * sqrt(128 / 255) make 1.97; rounding adds 1 / 12 to the variance: 1.99. The standard
    # deviation of 40000 samples is known to 0.4 %.
    assert image.std() == pytest.approx(1.99, rel=0.015)
    assert image.mean() == pytest.approx(128.0, abs=0.04)


def test_blur_keeps_an_edge_in_its_place() -> None:
    step = np.zeros((9, 60), dtype=np.float32)
    step[:, 30:] = 0.5
    levels = expose(step, ImageNoise(falloff=0.0, exposure=1.0))[4]
    assert np.abs(levels + levels[::-1] - 127.5).max() < 1e-3
    assert 5 < levels[29] < 60  # it is a ramp, not a step


@pytest.mark.parametrize("z_m", [1.5, 3.0, 5.0])
def test_depth_noise_follows_the_square_of_depth(z_m: float) -> None:
    noise = DepthNoise(fixed_sigma_px=0.0, dropout=0.0)
    flat, zero = np.full((120, 160), z_m, dtype=np.float32), np.zeros((120, 160), dtype=np.float32)
    frames = [
        measure_depth(flat, zero, noise, DepthBias(), FB, np.random.default_rng([1, frame])) for frame in range(40)
    ]
    expected = z_m**2 * noise.sigma_px / FB
    # Errors are shared within ~100 px^2, so 40 frames hold some 7000 independent ones: 1 % each, 3 % is safe.
    assert np.std(frames) == pytest.approx(expected, rel=0.03)
    assert np.std(frames) != pytest.approx(z_m * noise.sigma_px / FB, rel=0.03)
    # Neighbours share most of their error, distant pixels nothing: exp(-d^2 / 4 sigma^2).
    errors = np.array(frames, dtype=np.float64) - z_m
    assert np.corrcoef(errors[:, :, :-1].ravel(), errors[:, :, 1:].ravel())[0, 1] == pytest.approx(0.973, abs=0.01)
    assert abs(np.corrcoef(errors[:, :, :-40].ravel(), errors[:, :, 40:].ravel())[0, 1]) < 0.05


def test_averaging_over_time_leaves_the_fixed_error() -> None:
    noise = DepthNoise(dropout=0.0)
    flat = np.full((240, 320), 2.0, dtype=np.float32)
    fixed = fixed_error((240, 320), noise, np.random.default_rng(0))
    frames = [measure_depth(flat, fixed, noise, DepthBias(), FB, np.random.default_rng([2, k])) for k in range(60)]
    left = 1.0 / np.mean(1.0 / np.array(frames, dtype=np.float64), axis=0) - 2.0
    # About 240 * 320 / (4 pi 8^2) = 95 independent patches: 7 % on a standard deviation.
    assert left.std() == pytest.approx(4.0 * noise.fixed_sigma_px / FB, rel=0.25)
    one = np.asarray(frames[0], dtype=np.float64) - 2.0
    assert left.std() < 0.6 * one.std()


def test_the_bias_formula_is_recovered_from_depth() -> None:
    bias = DepthBias(scale=0.004, disparity_px=-0.2)
    true_m = np.linspace(1.0, 6.0, 500, dtype=np.float32).reshape(20, 25)
    measured = measure_depth(true_m, np.zeros_like(true_m), QUIET, bias, FB, np.random.default_rng(0))
    # 1 / z_true = (1 + s) / z_measured - d / (f B) is linear in s and d.
    inverse = 1.0 / measured.astype(np.float64).ravel()
    A = np.stack([inverse, np.full_like(inverse, -1.0 / FB)], axis=1)
    s, d = np.linalg.lstsq(A, 1.0 / true_m.astype(np.float64).ravel() - inverse, rcond=None)[0]
    assert s == pytest.approx(0.004, abs=1e-6)  # the rounding of float32
    assert d == pytest.approx(-0.2, abs=1e-4)
    # Scale alone does not explain it.
    scale = np.mean(measured / true_m) - 1
    assert np.abs(measured / (1 + scale) - true_m).max() > 0.02


def test_nearer_surfaces_grow_and_slopes_do_not() -> None:
    depth_m = np.full((60, 100), 4.0, dtype=np.float32)
    depth_m[:, 50:] = 2.0
    depth_m[:10, :20] = np.nan
    grown = grow_edges(depth_m, DepthNoise(grown_px=4), FB)
    assert (grown[30] == 2.0).nonzero()[0][0] == 46
    assert np.isnan(grown[0, 0])
    # A floor seen from 1.5 m: its disparity changes by 0.08 px from row to row.
    floor = np.broadcast_to((1.5 * 700 / np.arange(160, 360))[:, None], (200, 50)).astype(np.float32)
    np.testing.assert_array_equal(grow_edges(floor, DepthNoise(grown_px=4), FB), floor)


def test_two_percent_of_depth_is_missing() -> None:
    flat = np.full((241, 321), 2.0, dtype=np.float32)
    depth_m = measure_depth(flat, np.zeros_like(flat), DepthNoise(), DepthBias(), FB, np.random.default_rng(5))
    assert depth_m.shape == flat.shape
    assert np.isnan(depth_m).mean() == pytest.approx(0.02, abs=0.002)


# --- recordings -----------------------------------------------------------------------------------------------------

SMALL = replace(RIGS["demo"], width=160, height=120, focal_px=95.0, n_cameras=2, n_frames=3)


def frame_bytes(simulation: Simulation, name: str, index: int) -> tuple[bytes, bytes]:
    (frame,) = simulation.recording.frames(name, [index], depth=True)
    assert frame.depth_m is not None
    return frame.image.tobytes(), frame.depth_m.tobytes()


@pytest.mark.parametrize("moving", [False, True])
def test_a_frame_is_the_same_alone_and_in_sequence(moving: bool) -> None:
    rig = replace(SMALL, moving=moving, distance_m=(2.2, 2.6))
    first, second = simulate_rig(rig, seed=4), simulate_rig(rig, seed=4)
    for view in first.recording.cameras:
        sequence = list(first.recording.frames(view.name, range(3), depth=True))
        assert frame_bytes(second, view.name, 2) == (
            sequence[2].image.tobytes(),
            None if sequence[2].depth_m is None else sequence[2].depth_m.tobytes(),
        )
        assert len({frame.digest for frame in sequence}) == 3
        assert len({frame.depth_m.tobytes() for frame in sequence if frame.depth_m is not None}) == 3


def test_different_seeds_make_different_recordings() -> None:
    a, b = simulate_rig(SMALL, seed=4), simulate_rig(SMALL, seed=5)
    assert frame_bytes(a, "41000001", 0)[0] != frame_bytes(b, "41000001", 0)[0]
    assert not np.allclose(a.T_world_cam["41000001"], b.T_world_cam["41000001"])
    assert a.depth_bias != b.depth_bias


def test_options_leave_the_places_alone() -> None:
    plain = simulate("box-static", seed=7)
    bent = simulate("box-static", seed=7, distortion=True, depth=False, n_frames=9)
    assert all(view.has_distortion and view.baseline_m is None for view in bent.recording.cameras)
    for name, T_world_cam in plain.T_world_cam.items():
        np.testing.assert_array_equal(T_world_cam, bent.T_world_cam[name])
    unbiased = simulate("box-static", seed=7, depth_bias=False)
    assert set(unbiased.depth_bias.values()) == {DepthBias()}


def test_stamps_are_a_regular_clock_with_a_small_skew(box: Simulation) -> None:
    names = [view.name for view in box.recording.cameras]
    assert names == sorted(names) == ["41000001", "41000002", "41000003", "41000004"]
    stamps = np.array([box.recording.stamps_ns(name) for name in names])
    assert stamps.dtype == np.int64
    assert (np.diff(stamps, axis=1) == 33_333_333).all()
    assert np.ptp(stamps, axis=0).max() < 3_000_000
    assert len(np.unique(stamps[:, 0])) == 4


def test_without_depth_no_depth_is_made() -> None:
    simulation = simulate_rig(replace(SMALL, depth=False))
    (frame,) = simulation.recording.frames("41000001", [0], depth=True)
    assert frame.depth_m is None
    (frame,) = simulate_rig(SMALL).recording.frames("41000001", [0])
    assert frame.depth_m is None


@pytest.mark.parametrize("name", RIGS)
def test_every_rig_stands_as_it_says(name: str) -> None:
    for seed in range(3):
        simulation = simulate(name, seed=seed)
        rig = simulation.rig
        assert len(simulation.T_world_target) == rig.n_frames
        seen_by: dict[str, int] = {}
        for view in simulation.recording.cameras:
            T_world_cam = simulation.T_world_cam[view.name]
            assert rig.camera_height_m[0] <= T_world_cam[1, 3] <= rig.camera_height_m[1]
            assert T_world_cam[1, 1] < -0.5  # upright: the image's y axis points down
            sights = [seen_markers(view, T_world_cam, simulation.target, T) for T in set_of(simulation.T_world_target)]
            seen_by[view.name] = sum(map(bool, sights))
        assert min(seen_by.values()) >= (rig.n_frames // rig.n_cameras if rig.moving else 1)
        for T_world_target in simulation.T_world_target:
            corners = [transform_points(T_world_target, face.corners) for face in simulation.faces]
            assert min(quads[..., 1].min() for quads in corners) > -1e-9


def set_of(poses: tuple[Array, ...]) -> list[Array]:
    return [np.frombuffer(data).reshape(4, 4) for data in {T.tobytes(): None for T in poses}]


def test_depth_of_a_rig_agrees_with_its_truth(box: Simulation) -> None:
    exact = simulate_rig(replace(box.rig, depth_noise=QUIET, bias_scale=0.0, bias_disparity_px=0.0))
    view = exact.recording.cameras[0]
    T_world_cam = exact.T_world_cam[view.name]
    (frame,) = exact.recording.frames(view.name, [0], depth=True)
    assert frame.depth_m is not None
    T_cam_target = invert_transform(T_world_cam) @ exact.T_world_target[0]
    seen = seen_markers(view, T_world_cam, exact.target, exact.T_world_target[0])
    for face in exact.faces:
        for marker, corners in zip(face.ids, face.corners):
            if marker in seen:
                u, v = np.rint(lens.project(view, transform_points(T_cam_target, corners)).mean(axis=0)).astype(int)
                ray = np.linalg.solve(view.K, [u, v, 1.0])
                c = transform_points(T_cam_target, corners)
                normal = np.cross(c[1] - c[0], c[3] - c[0])
                assert frame.depth_m[v, u] == pytest.approx(normal @ c[0] / (normal @ ray), abs=1e-6)


def test_the_truth_document_keeps_every_bit(box: Simulation) -> None:
    document = json.loads(json.dumps(box.truth_document()))
    meta = document.pop("_meta")
    assert meta["format"] == "rigcal.extrinsics"
    assert meta["world"] == {"up": [0, 1, 0], "origin": "floor"}
    assert list(document) == [view.name for view in box.recording.cameras]
    for name, entry in document.items():
        pose = np.array(entry["pose"].split(), dtype=np.float64).reshape(4, 4)
        np.testing.assert_array_equal(pose, box.T_world_cam[name])
        assert meta["truth"]["depth_bias"][name]["scale"] == box.depth_bias[name].scale
    assert len(meta["truth"]["T_world_target"]) == 3


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (lambda: simulate("boxes"), "boxes: no such rig; known: box-static, "),
        (lambda: simulate("demo", seed=-1), "seed -1 is negative"),
        (lambda: simulate("demo", n_frames=0), "at least one camera and one frame"),
        (lambda: simulate("demo", resting_face="lid"), "lid: .*known: .*front"),
        (lambda: simulate("demo").recording.stamps_ns("left"), "left: no such camera; known: 41000001, "),
        (lambda: next(simulate("demo").recording.frames("41000001", [3])), "frames 0 to 2, not 3"),
        (lambda: simulate_rig(replace(SMALL, dictionary="DICT_4X4")), "DICT_4X4: .*known: .*DICT_4X4_50"),
        (lambda: marker_cells(marker_dictionary("DICT_4X4_50"), 50), "marker 50 .* 0 to 49"),
    ],
)
def test_wrong_wishes_are_refused_with_what_is_known(attempt: object, message: str) -> None:
    assert callable(attempt)
    with pytest.raises(InputError, match=message):
        attempt()


def test_importing_the_simulator_does_not_load_open3d() -> None:
    code = "import sys, rigcal.sim; sys.exit('open3d' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_large_picture_full_of_edges_can_be_rendered() -> None:
    # More pixels near edges than OpenCV takes rows of an image at once.
    view = Camera(name="a", width=40, height=1200, K=np.array([[20.0, 0, 20.3], [0, 20.0, 600.0], [0, 0, 1.0]]))
    stripes = [
        Panel(vertices=np.array([[x, -99.0, 1.0], [x + 0.1, -99, 1], [x + 0.1, 99, 1], [x, 99, 1]]), albedo=1.0)
        for x in np.arange(-2, 2, 0.2)
    ]
    carpet = Panel(vertices=np.array([[-99.0, -99.0, 2.0], [99, -99, 2], [99, 99, 2], [-99, 99, 2]]), albedo=1e-6)
    scene = Scene(panels=(*stripes, replace(carpet, contrast=0.1)), light=FLAT_LIGHT)
    # Two pixels of four are striped.
    assert render_image(scene, view, np.eye(4)).mean() == pytest.approx(0.5, abs=1e-3)


# --- boards ---------------------------------------------------------------------------------------------------------


def test_a_board_is_held_up_to_cameras_on_an_arc() -> None:
    simulation = simulate("board-moved", seed=2)
    rig, board = simulation.rig, simulation.target.board
    assert isinstance(board, CharucoBoard)
    assert (rig.n_cameras, rig.n_frames, rig.width, rig.height) == (4, 25, 1280, 720)
    assert simulation.truth_document()["_meta"]["truth"]["board"] == "charuco:7x5:0.1:0.075:DICT_4X4_50"
    shared = 0
    for T_world_target in simulation.T_world_target:
        sights = [
            len(seen_markers(view, simulation.T_world_cam[view.name], simulation.target, T_world_target))
            for view in simulation.recording.cameras
        ]
        shared += sum(n >= 9 for n in sights) >= 2
    assert shared == rig.n_frames
    bent = simulate("board-moved", seed=2, distortion=True)
    assert all(view.has_distortion for view in bent.recording.cameras)
    np.testing.assert_array_equal(bent.T_world_target, simulation.T_world_target)


def test_a_rendered_board_shows_opencvs_corners_where_projection_says() -> None:
    simulation = simulate("board-moved", seed=2)
    board = simulation.target.board
    assert isinstance(board, CharucoBoard)
    view = max(
        simulation.recording.cameras,
        key=lambda c: len(
            seen_markers(c, simulation.T_world_cam[c.name], simulation.target, simulation.T_world_target[0])
        ),
    )
    (frame,) = simulation.recording.frames(view.name, [0])
    size, dictionary = (board.columns, board.rows), marker_dictionary(board.dictionary)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary))
    corners, ids, _, _ = detector.detectBoard(frame.image)
    assert len(ids) >= 12
    T_cam_target = invert_transform(simulation.T_world_cam[view.name]) @ simulation.T_world_target[0]
    points = np.concatenate([board_geometry(board)[int(k)] for k in np.ravel(ids)])
    error = np.asarray(corners).reshape(-1, 2) - lens.project(view, transform_points(T_cam_target, points))
    # OpenCV's own corners err by 0.05 px in the median; another frame, order or handedness would be squares off.
    assert np.median(np.linalg.norm(error, axis=1)) < 0.15


def test_a_board_whose_cells_do_not_divide_its_squares_looks_the_same() -> None:
    one_print = parse_board("charuco:3x3:0.1:0.075:DICT_4X4_50")
    layers = parse_board("charuco:3x3:0.1:0.0750001:DICT_4X4_50")
    T_world_board = make_pose(np.eye(3), np.array([-0.15, -0.15, 0.4]))
    panels = [board_panel(board, T_world_board) for board in (one_print, layers)]
    assert [len(panel.prints) for panel in panels] == [1, 1 + 4]
    a, b = (render_image(Scene(panels=(panel,), light=FLAT_LIGHT), camera(), np.eye(4)) for panel in panels)
    # 55 rays leave 0.01 of contrast in a pixel on an edge, and the edges differ by 1e-5 px.
    assert np.abs(a - b).max() < 0.06
    assert np.abs(a - b).mean() < 1e-3


def test_tags_of_a_grid_stand_upright_between_black_squares() -> None:
    grid = parse_board("aprilgrid:2x2:0.1:0.3")
    # Kalibr's frame has y up and z towards the viewer; the camera's y points down.
    T_world_board = make_pose(np.diag([1.0, -1.0, -1.0]), np.array([-0.115, 0.115, 0.3]))
    view = camera()
    image = render_image(Scene(panels=(board_panel(grid, T_world_board),), light=FLAT_LIGHT), view, np.eye(4))
    cell = 0.01

    def at(x: float, y: float) -> float:
        u, v = np.rint(lens.project(view, transform_points(T_world_board, np.array([[x, y, 0.0]])))[0]).astype(int)
        return float(image[v, u])

    # The first row of the first tag of 36h11 as its authors publish it, 110101, below a border of two cells.
    row = [at((2.5 + k) * cell, 0.1 - 2.5 * cell) for k in range(6)]
    np.testing.assert_allclose(row, np.where([1, 1, 0, 1, 0, 1], WHITE_ALBEDO, BLACK_ALBEDO), atol=1e-6)
    assert at(0.115, 0.115) == pytest.approx(BLACK_ALBEDO)
    assert at(0.115, 0.05) == pytest.approx(WHITE_ALBEDO)
