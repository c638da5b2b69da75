"""A target that is moved: frames vote for the relative poses of cameras, links chain to a rig, gaps are named."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.stats import chi2
from target_views import any_pose, box, looking_at, pose_error, square, tilted, views_of

from aruco.camera_link import agreement, link_cameras
from aruco.moved_target import place_cameras
from aruco.pose_averaging import average_poses
from aruco.pose_math import Pose, exp_se3, invert_transform, log_se3, make_pose
from aruco.rig_estimate import RigEstimate
from aruco.view_pose import View

MIDDLE = np.array([0.0, 0.3, 0.0])
CAMERAS = {
    name: looking_at(np.array([2.2 * np.sin(a), h, 2.2 * np.cos(a)]), MIDDLE)
    for name, a, h in (("a", 0.0, 0.8), ("b", 1.3, 1.0), ("c", 2.6, 0.6), ("d", 4.2, 0.9))
}
BOX = box(0.3)


def moves(rng: np.random.Generator, n: int) -> Mapping[int, Pose]:
    return {f: make_pose(any_pose(rng)[:3, :3], MIDDLE + 0.15 * rng.standard_normal(3)) for f in range(n)}


def trust(views: list[View]) -> dict[str, float]:
    return {view.camera: 1.0 for view in views}


def by_frame(views: list[View], camera: str) -> dict[int, View]:
    return {view.frame: view for view in views if view.camera == camera}


def worst_pair(rig: Mapping[str, Pose], truth: Mapping[str, Pose] = CAMERAS) -> tuple[float, float]:
    """Degrees and millimetres of the worst relative pose of two cameras: free of the choice of the world."""
    errors = [
        pose_error(invert_transform(rig[i]) @ rig[j], invert_transform(truth[i]) @ truth[j])
        for i in rig
        for j in rig
        if i < j
    ]
    return max(e[0] for e in errors), max(e[1] for e in errors)


def poses(rig: RigEstimate) -> dict[str, Pose]:
    return {name: placement.T_world_cam for name, placement in rig.cameras.items()}


# --- the rig --------------------------------------------------------------------------------------------------------


def test_exact_views_give_the_exact_rig_in_the_world_of_the_first_frame() -> None:
    rng = np.random.default_rng(0)
    frames = moves(rng, 6)
    views = views_of(CAMERAS, frames, BOX, 0.0, rng)
    rig = place_cameras(views, trust(views))
    assert not rig.lost
    for name, T_world_cam in CAMERAS.items():
        # See test_view_pose for single views; the chain has at most three links.
        assert pose_error(rig.cameras[name].T_world_cam, invert_transform(frames[0]) @ T_world_cam)[1] < 1e-2
        assert rig.cameras[name].spread_m < 1e-4
        assert rig.cameras[name].frames == tuple(range(6))
    for frame, T in frames.items():
        assert pose_error(rig.T_world_target[frame], invert_transform(frames[0]) @ T)[1] < 1e-2
    np.testing.assert_allclose(rig.T_world_target[0], np.eye(4), atol=1e-12)


def test_noise_of_a_good_fit_gives_millimetres() -> None:
    rng = np.random.default_rng(1)
    views = views_of(CAMERAS, moves(rng, 12), BOX, 0.05, rng)
    turn_deg, shift_mm = worst_pair(poses(place_cameras(views, trust(views))))
    # One view turns by 0.04 degrees, 1.6 mm at 2.2 m; the worst of six pairs from 12 frames: 1.5 mm. Times four.
    assert turn_deg < 0.15
    assert shift_mm < 6.0


# A box of 8 cm whose most frontal marker alone is seen: 19 px at 0.15 px. Nearly every view has two poses.
FACE_ON_DEG, FACE_ON_MM = 2.0, 80.0


def naive_rig(views: list[View]) -> dict[str, Pose]:
    """Each view's best solution, averaged robustly, with the first camera as the world."""
    first = by_frame(views, "a")
    rig: dict[str, Pose] = {"a": np.eye(4)}
    for name in ("b", "c", "d"):
        other = by_frame(views, name)
        shared = sorted(first.keys() & other.keys())
        rig[name] = average_poses(
            [first[f].best.T_cam_target @ invert_transform(other[f].best.T_cam_target) for f in shared]
        ).T
    return rig


def test_ambiguous_views_find_the_rig_where_their_best_solutions_do_not() -> None:
    naive_misses = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        views = views_of(CAMERAS, moves(rng, 12), box(0.08), 0.15, rng, most=1)
        assert np.mean([view.is_ambiguous(1.0) for view in views]) > 0.8
        rig = place_cameras(views, trust(views))
        assert not rig.lost
        turn_deg, shift_mm = worst_pair(poses(rig))
        # A view tells the tilt to 4 degrees; 12 frames and two views a link to 1 degree, at 2.2 m 40 mm; twice that.
        assert turn_deg < FACE_ON_DEG
        assert shift_mm < FACE_ON_MM
        turn_deg, shift_mm = worst_pair(naive_rig(views))
        naive_misses += turn_deg > FACE_ON_DEG or shift_mm > FACE_ON_MM
    assert naive_misses >= 4


def test_cameras_that_share_no_frame_are_chained() -> None:
    rng = np.random.default_rng(2)
    sees = {"a": range(0, 6), "b": range(3, 12), "c": range(9, 18), "d": range(15, 20)}
    views = views_of(CAMERAS, moves(rng, 20), BOX, 0.05, rng, sees=sees)
    rig = place_cameras(views, trust(views))
    assert not rig.lost
    turn_deg, shift_mm = worst_pair(poses(rig))
    # Three links of three frames, each 2 mm and 0.05 degrees, the ends 4 m apart: 5 mm; four sigma.
    assert turn_deg < 0.4
    assert shift_mm < 20.0
    np.testing.assert_allclose(rig.T_world_target[3], np.eye(4), atol=1e-12)  # the first frame that two cameras see
    assert 0 in rig.T_world_target  # a view without rivals places the target alone


def test_parts_without_a_shared_frame_are_named() -> None:
    rng = np.random.default_rng(3)
    sees = {"a": range(0, 6), "b": range(0, 6), "c": range(2, 6), "d": range(6, 9)}
    views = views_of(CAMERAS, moves(rng, 9), BOX, 0.05, rng, sees=sees)
    rig = place_cameras(views, trust(views))
    assert sorted(rig.cameras) == ["a", "b", "c"]
    assert list(rig.lost) == ["d"]
    assert "no frame" in rig.lost["d"]
    assert max(rig.T_world_target) < 6


def test_of_two_pairs_the_first_by_name_is_kept() -> None:
    rng = np.random.default_rng(4)
    sees = {"a": range(0, 4), "b": range(4, 8), "c": range(4, 8), "d": range(0, 4)}
    views = views_of(CAMERAS, moves(rng, 8), BOX, 0.05, rng, sees=sees)
    rig = place_cameras(views, trust(views))
    assert sorted(rig.cameras) == ["a", "d"]
    assert "connected only with c" in rig.lost["b"]
    assert "connected only with b" in rig.lost["c"]


def test_the_strongest_links_make_the_tree() -> None:
    # a and c share many frames with b, but only one with each other, and see it badly there.
    rng = np.random.default_rng(5)
    frames = moves(rng, 12)
    good = views_of(CAMERAS, frames, BOX, 0.02, rng, sees={"a": range(6), "b": range(12), "c": range(6, 12), "d": []})
    bad = views_of(CAMERAS, {99: frames[0]}, BOX, 2.0, rng, sees={"a": [99], "b": [], "c": [99], "d": []})
    rig = place_cameras(good + bad, trust(good))
    assert worst_pair(poses(rig))[1] < 6.0
    direct = link_cameras(by_frame(bad, "a"), by_frame(bad, "c"), trust(good))
    if direct is not None:
        assert pose_error(direct.average.T, invert_transform(CAMERAS["a"]) @ CAMERAS["c"])[1] > 6.0


def test_one_camera_alone_stands_in_the_world_of_its_first_frame() -> None:
    rng = np.random.default_rng(6)
    frames = moves(rng, 4)
    views = views_of({"a": CAMERAS["a"]}, frames, BOX, 0.0, rng)
    rig = place_cameras(views, trust(views))
    assert list(rig.cameras) == ["a"]
    assert not rig.lost
    assert pose_error(rig.cameras["a"].T_world_cam, invert_transform(frames[0]) @ CAMERAS["a"])[1] < 1e-2


def test_cameras_that_never_meet_are_all_lost() -> None:
    rng = np.random.default_rng(7)
    views = views_of(CAMERAS, moves(rng, 4), BOX, 0.05, rng, sees={"a": [0], "b": [1], "c": [2], "d": [3]})
    rig = place_cameras(views, trust(views))
    assert not rig.cameras
    assert sorted(rig.lost) == ["a", "b", "c", "d"]
    assert not rig.T_world_target


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_views_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    views = views_of(CAMERAS, moves(rng, 8), box(0.12), 0.1, rng, most=1)
    shuffled = [views[k] for k in rng.permutation(len(views))]
    a, b = place_cameras(views, trust(views)), place_cameras(shuffled, trust(shuffled))
    assert list(a.cameras) == list(b.cameras)
    assert list(a.T_world_target) == list(b.T_world_target)
    for name in a.cameras:
        # Only the order of sums differs.
        np.testing.assert_allclose(a.cameras[name].T_world_cam, b.cameras[name].T_world_cam, atol=1e-9)
        assert sorted(a.cameras[name].frames) == sorted(b.cameras[name].frames)


def test_the_same_views_give_the_same_bytes() -> None:
    rng = np.random.default_rng(8)
    views = views_of(CAMERAS, moves(rng, 8), box(0.12), 0.1, rng, most=1)
    a, b = (poses(place_cameras(list(views), trust(views))) for _ in range(2))
    assert all(a[name].tobytes() == b[name].tobytes() for name in a)


def test_one_swapped_frame_is_left_out() -> None:
    # The target moved between the cameras' shutters: their views of this frame do not belong together.
    rng = np.random.default_rng(9)
    frames = moves(rng, 10)
    views = views_of({n: CAMERAS[n] for n in "abc"}, frames, BOX, 0.05, rng)
    late = views_of({"d": CAMERAS["d"]}, {**frames, 4: frames[5]}, BOX, 0.05, rng)
    rig = place_cameras(views + late, trust(views + late))
    assert worst_pair(poses(rig))[1] < 6.0
    assert 4 not in rig.cameras["d"].frames
    assert 4 in rig.cameras["a"].frames


# --- links ----------------------------------------------------------------------------------------------------------


def test_a_link_knows_its_covariance() -> None:
    rng, repeats = np.random.default_rng(10), 60
    frames = moves(rng, 4)
    pair = {name: CAMERAS[name] for name in ("a", "b")}
    T_a_b = invert_transform(CAMERAS["a"]) @ CAMERAS["b"]
    squared = []
    for _ in range(repeats):
        views = views_of(pair, frames, BOX, 0.2, rng)
        link = link_cameras(by_frame(views, "a"), by_frame(views, "b"), {"a": 1.0, "b": 1.0})
        assert link is not None
        assert (link.i, link.j) == ("a", "b")
        assert len(link.frames) >= 2  # the average may call a poor frame an outlier
        xi = log_se3(T_a_b @ invert_transform(link.average.T))
        squared.append(xi @ link.average.information @ xi)
    low, high = chi2.ppf([0.0005, 0.9995], 6 * repeats) / repeats
    assert low < np.mean(squared) < high
    # Corners whose variance is four times what they promise know a quarter as much.
    views = views_of(pair, frames, BOX, 0.2, np.random.default_rng(11))
    honest, doubted = (
        link_cameras(by_frame(views, "a"), by_frame(views, "b"), {"a": scale2, "b": scale2}) for scale2 in (1.0, 4.0)
    )
    assert honest is not None
    assert doubted is not None
    assert doubted.strength == pytest.approx(honest.strength / 4, rel=1e-6)


def test_no_shared_frame_gives_no_link() -> None:
    views = views_of(CAMERAS, moves(np.random.default_rng(12), 2), BOX, 0.05, np.random.default_rng(12))
    a, b = by_frame(views, "a"), by_frame(views, "b")
    assert link_cameras({0: a[0]}, {1: b[1]}, trust(views)) is None
    assert link_cameras({}, b, trust(views)) is None


def test_one_ambiguous_frame_gives_no_link_and_several_do() -> None:
    rng = np.random.default_rng(13)
    card = square(0.1)
    pair = {"a": np.eye(4), "b": make_pose(np.eye(3), np.array([0.3, 0.0, 0.0]))}
    frames = {f: tilted(rng.uniform(6, 15), rng.uniform(0, 6), rng.uniform(0, 6), 2.0) for f in range(15)}
    views = views_of(pair, frames, card, 0.15, rng)
    a, b = by_frame(views, "a"), by_frame(views, "b")
    doubtful = [f for f in frames if a[f].is_ambiguous(0.5) or b[f].is_ambiguous(0.5)]
    assert doubtful
    for f in doubtful:
        assert link_cameras({f: a[f]}, {f: b[f]}, trust(views)) is None
    link = link_cameras(a, b, trust(views))
    assert link is not None
    # The tilt of each view is known to 2.5 degrees: over 15 frames and two views 0.9 degrees; three sigma.
    assert pose_error(link.average.T, pair["b"])[0] < 2.5


def test_agreement_has_its_limits_where_they_are_stated() -> None:
    T = any_pose(np.random.default_rng(14))
    reach = np.array([2.0])
    for turn_deg, shift_m, agree in ((4.9, 0.0, True), (5.1, 0.0, False), (0.0, 0.159, True), (0.0, 0.161, False)):
        other = make_pose(T[:3, :3], T[:3, 3] + [0.0, shift_m, 0.0])
        other[:3, :3] = exp_se3(np.array([0.0, np.radians(turn_deg), 0.0, 0.0, 0.0, 0.0]))[:3, :3] @ T[:3, :3]
        assert agreement(other[None], T[None], reach)[0, 0] == agree
