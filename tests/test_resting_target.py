"""A target that rests: frames decide together what none decides alone, and a camera in doubt is named."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2
from target_views import CAMERA, any_pose, box, looking_at, pose_error, sight, square, tilted, views_of

from aruco.errors import CalibrationError
from aruco.pose_math import Pose, invert_transform, log_se3, make_pose
from aruco.resting_target import information_of_inverse, place_cameras
from aruco.view_pose import RULED_OUT_CHI2, Candidate, View, solve_view

BOX = box()
RING = {
    f"c{k}": looking_at(np.array([2.5 * np.sin(a), 1.0, 2.5 * np.cos(a)]), np.zeros(3))
    for k, a in enumerate((0.3, 1.9, 3.4, 5.0))
}
AT_REST = {frame: np.eye(4) for frame in range(3)}


def trust(*names: str) -> dict[str, float]:
    return dict.fromkeys(names, 1.0)


def two_sided_view(frame: int, excess: float, T_best: Pose, T_rival: Pose) -> View:
    """A view by hand, whose rival fits worse by ``excess``."""
    best, rival = (
        Candidate(T_cam_target=T, chi2=cost, rms_px=0.1, information=1e6 * np.eye(6))
        for T, cost in ((T_best, 2.0), (T_rival, 2.0 + excess))
    )
    return View(camera="a", frame=frame, ids=(0,), candidates=(best, rival))


MIRRORED = tilted(20.0, 0.0, 0.3, 2.0), tilted(-20.0, 0.0, 0.3, 2.0)


def test_exact_views_give_the_exact_rig() -> None:
    rig = place_cameras(views_of(RING, AT_REST, BOX, 0.0, np.random.default_rng(0)), trust(*RING))
    assert not rig.lost
    for name, T_world_cam in RING.items():
        # See test_view_pose for single views; the average adds nothing.
        assert pose_error(rig.cameras[name].T_world_cam, T_world_cam)[1] < 1e-3
        assert rig.cameras[name].spread_m < 1e-6
        assert rig.cameras[name].frames == (0, 1, 2)
    assert all(np.array_equal(T, np.eye(4)) for T in rig.T_world_target.values())
    assert list(rig.T_world_target) == [0, 1, 2]


def test_noise_of_a_good_fit_gives_millimetres() -> None:
    rig = place_cameras(views_of(RING, AT_REST, BOX, 0.05, np.random.default_rng(1)), trust(*RING))
    for name, T_world_cam in RING.items():
        turn_deg, shift_mm = pose_error(rig.cameras[name].T_world_cam, T_world_cam)
        # Two faces at 0.05 px and 3.6 mm a pixel, three frames: 0.02 degrees, 0.7 mm; four sigma.
        assert turn_deg < 0.08
        assert shift_mm < 3.0


def test_frames_decide_together_what_single_views_cannot() -> None:
    small, cleared, misled = square(0.1), 0, 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T = tilted(15.0, rng.uniform(0, 6), 1.0, 2.0)
        truth = {"a": invert_transform(T)}
        views = views_of(truth, {frame: np.eye(4) for frame in range(40)}, small, 0.1, rng)
        assert sum(view.is_ambiguous(1.0) for view in views) > 20
        rig = place_cameras(views, trust("a"))
        # 35 px at 0.1 px tell the tilt to 1.5 degrees in one view, 40 views to 0.25; four sigma.
        assert pose_error(rig.cameras["a"].T_world_cam, truth["a"])[0] < 1.0
        cleared += rig.cameras["a"].n_ambiguous
        misled += sum(pose_error(view.best.T_cam_target, T)[0] > 8.0 for view in views)
    assert cleared > 80
    # The tolerance bites: some views, taken alone, choose the other pose.
    assert misled > 0


def test_a_camera_in_doubt_is_lost_with_a_reason() -> None:
    doubtful = [two_sided_view(frame, 0.5, *MIRRORED) for frame in range(5)]
    rig = place_cameras(doubtful, trust("a"))
    assert not rig.cameras
    assert "two poses" in rig.lost["a"]
    assert not rig.T_world_target


def test_small_preferences_add_up() -> None:
    preference = 0.3 * RULED_OUT_CHI2
    views = [two_sided_view(frame, preference, *MIRRORED) for frame in range(5)]
    assert all(view.is_ambiguous(1.0) for view in views)
    rig = place_cameras(views, trust("a"))
    np.testing.assert_allclose(rig.cameras["a"].T_world_cam, invert_transform(MIRRORED[0]), atol=1e-12)
    assert rig.cameras["a"].n_ambiguous == 5
    # Opposite preferences do not, and corners that are worse than promised do not either.
    mixed = views[:3] + [two_sided_view(frame, preference, *MIRRORED[::-1]) for frame in (3, 4)]
    assert "a" in place_cameras(mixed, trust("a")).lost
    assert "a" in place_cameras(views, {"a": 5.0}).lost


def test_one_sure_view_decides_for_the_others() -> None:
    sure = two_sided_view(9, 50 * RULED_OUT_CHI2, *MIRRORED)
    doubtful = [two_sided_view(frame, 0.5, *MIRRORED[::-1]) for frame in range(3)]
    rig = place_cameras([*doubtful, sure], trust("a"))
    np.testing.assert_allclose(rig.cameras["a"].T_world_cam, invert_transform(MIRRORED[0]), atol=1e-9)
    assert rig.cameras["a"].frames == (0, 1, 2, 9)


def test_a_target_that_was_moved_is_told() -> None:
    rng = np.random.default_rng(3)
    moved = {frame: any_pose(rng, shift_m=0.2) for frame in range(8)}
    views = views_of(RING, moved, BOX, 0.05, rng)
    with pytest.raises(CalibrationError, match="--moving-target"):
        place_cameras(views, trust(*RING))


def test_a_few_frames_in_which_it_moved_are_left_out() -> None:
    rng = np.random.default_rng(4)
    frames = {frame: np.eye(4) for frame in range(8)} | {3: make_pose(np.eye(3), np.array([0.0, 0.1, 0.3]))}
    rig = place_cameras(views_of(RING, frames, BOX, 0.05, rng), trust(*RING))
    for name, T_world_cam in RING.items():
        assert pose_error(rig.cameras[name].T_world_cam, T_world_cam)[1] < 3.0
        assert 3 not in rig.cameras[name].frames
        assert (len(rig.cameras[name].frames), rig.cameras[name].n_views) == (7, 8)


def test_information_of_the_inverse_predicts_its_scatter() -> None:
    rng, repeats = np.random.default_rng(5), 200
    T_world_cam = RING["c0"]
    squared = []
    for _ in range(repeats):
        view = solve_view(CAMERA, 0, sight(CAMERA, invert_transform(T_world_cam), BOX, 0.2, rng, most=2), BOX)
        assert view is not None
        xi = log_se3(T_world_cam @ view.best.T_cam_target)
        squared.append(xi @ information_of_inverse(view.best) @ xi)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * repeats) / repeats
    assert low < np.mean(squared) < high


def test_the_order_of_views_does_not_matter() -> None:
    views = views_of(RING, AT_REST, BOX, 0.05, np.random.default_rng(6))
    shuffled = [views[k] for k in np.random.default_rng(7).permutation(len(views))]
    a, b = place_cameras(views, trust(*RING)), place_cameras(shuffled, trust(*RING))
    assert list(a.cameras) == list(b.cameras) == sorted(RING)
    for name in RING:
        np.testing.assert_allclose(a.cameras[name].T_world_cam, b.cameras[name].T_world_cam, atol=1e-10)
        assert sorted(a.cameras[name].frames) == sorted(b.cameras[name].frames)


def test_a_turned_rig_is_the_same_rig() -> None:
    rig = place_cameras(views_of(RING, AT_REST, BOX, 0.05, np.random.default_rng(8)), trust(*RING))
    R = any_pose(np.random.default_rng(9))[:3, :3]
    turned = rig.turned(R)
    names = sorted(RING)
    for frame, T in rig.T_world_target.items():
        for name in names:
            before = invert_transform(rig.cameras[name].T_world_cam) @ T
            after = invert_transform(turned.cameras[name].T_world_cam) @ turned.T_world_target[frame]
            np.testing.assert_allclose(after, before, atol=1e-12)
        np.testing.assert_allclose(turned.T_world_target[frame][:3, :3], R @ T[:3, :3], atol=1e-12)
