"""Clouds brought together: what moves, what stays, and what is said of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from floor_rooms import BASELINE_M, FLOOR, Wall, cameras, depth_image, zoomed
from icp_rooms import BOXES, LEVEL, covariance

from aruco.depth_bias import DepthBias
from aruco.depth_noise import bias_prior
from aruco.floor_plane import FloorPlane
from aruco.icp_cloud import Cloud, cloud_of
from aruco.icp_equations import LEAST_SCALE, State, floor_parameters, floor_rows, joined, pair_rows, residual_scale
from aruco.icp_match import Matches, match, overlapping_pairs
from aruco.icp_normal import summed
from aruco.icp_placing import placed
from aruco.icp_prior import ASPECTS, default_of
from aruco.icp_rows import Layout, Rows
from aruco.icp_smooth import smoothed
from aruco.icp_solve import Prior, Registration, register
from aruco.icp_types import ICPConfig
from aruco.icp_view import LEAST_BIAS
from aruco.pose_math import Array, Pose, adjoint, exp_se3, exp_so3, invert_transform, log_so3, make_pose, pose_distance

RIG = cameras()
ZOOM = 2  # 640 x 360: cells of 28 px are a few centimetres
FULL = ICPConfig(region="full", stride=4)
NAMES = tuple(RIG)
GOOD, ROUGH = (0.03, 2.0), (0.3, 8.0)  # degrees and mm about and along each axis


def off(size: tuple[float, float], seed: int) -> dict[str, Pose]:
    rng = np.random.default_rng(seed)
    return {
        name: make_pose(
            exp_so3(np.radians(rng.normal(0, size[0], 3))) @ T[:3, :3], T[:3, 3] + rng.normal(0, 1e-3 * size[1], 3)
        )
        for name, T in RIG.items()
    }


def data_of(name: str, walls: Sequence[Wall], disparity_px: float = 0.0) -> dict[str, Any]:
    depth = depth_image(RIG[name], walls, seed=NAMES.index(name), disparity_px=disparity_px, zoom=ZOOM)
    return {"depth": depth, "K": zoomed(ZOOM), "baseline": BASELINE_M / ZOOM, "n_frames": 20}


@cache
def seen(walls: tuple[Wall, ...] = BOXES, disparity_px: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)) -> dict[str, Cloud]:
    return {
        name: cloud_of(name, data_of(name, walls, disparity_px[k]), FULL, T_world_cam=T, floor=LEVEL)
        for k, (name, T) in enumerate(RIG.items())
    }


def registered(
    clouds: Mapping[str, Cloud],
    start: Mapping[str, Pose],
    size: tuple[float, float] | None,
    *,
    config: ICPConfig = FULL,
) -> Registration:
    priors = {
        name: Prior(T_world_cam=start[name], covariance=None if size is None else covariance(start[name], *size))
        for name in clouds
    }
    pairs = overlapping_pairs(clouds, start, config)
    return register(clouds, start, priors, pairs, config, floor=LEVEL, reference="cam0")


def errors_mm(T_world_cam: Mapping[str, Pose]) -> dict[str, float]:
    """Of every camera's place as the reference sees it."""
    out = {}
    for name in set(T_world_cam) - {"cam0"}:
        T, T_true = (invert_transform(poses["cam0"]) @ poses[name] for poses in (T_world_cam, RIG))
        out[name] = 1e3 * pose_distance(T, T_true)[1]
    return out


def mean_mm(T_world_cam: Mapping[str, Pose]) -> float:
    return float(np.mean(list(errors_mm(T_world_cam).values())))


@pytest.fixture(scope="module")
def rough() -> Registration:
    return registered(seen(), off(ROUGH, 1), ROUGH)


# ------------------------------------------------------------------------------------------------------ where it ends


@pytest.mark.parametrize("method", ["point_to_plane", "gicp"])
def test_clouds_of_a_furnished_room_correct_rough_poses(method: str):
    config = replace(FULL, method=method)
    start = off(ROUGH, 1)
    found = registered(seen(), start, ROUGH, config=config)
    assert found.settled
    promised = np.mean([found.pair_sigma_mm("cam0", name) for name in NAMES[1:]])
    # Noise is promised 0.06 px that neighbours share, so a part of the given poses stays that the data could mend.
    assert mean_mm(found.T_world_cam) < promised < 0.6 * mean_mm(start)


def test_good_poses_stay_good():
    start = off(GOOD, 2)
    found = registered(seen(), start, GOOD)
    assert mean_mm(found.T_world_cam) < mean_mm(start)


def test_the_reference_and_cameras_that_stay_are_where_they_were_to_the_last_bit(rough: Registration):
    start = off(ROUGH, 1)
    found = placed(rough, ["cam2"])
    for name in ("cam0", "cam2"):
        np.testing.assert_array_equal(found.T_world_cam[name], start[name])
    for name in ("cam1", "cam3"):
        assert not np.array_equal(found.T_world_cam[name], start[name])


def test_the_same_clouds_give_the_same_bytes(rough: Registration):
    again = registered(seen(), off(ROUGH, 1), ROUGH)
    for name, T in rough.T_world_cam.items():
        assert T.tobytes() == again.T_world_cam[name].tobytes()
    assert rough.joint.tobytes() == again.joint.tobytes()


def test_a_world_that_points_down_gives_the_same_rig(rough: Registration):
    flip = make_pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    config = replace(FULL, up=(0.0, -1.0, 0.0))
    start = {name: flip @ T for name, T in off(ROUGH, 1).items()}
    Ad = adjoint(flip)
    priors = {
        name: Prior(T_world_cam=T, covariance=Ad @ covariance(flip @ T, *ROUGH) @ Ad.T) for name, T in start.items()
    }
    floor = FloorPlane(np.array([0.0, -1.0, 0.0]), 0.0)
    pairs = overlapping_pairs(seen(), start, config)
    found = register(seen(), start, priors, pairs, config, floor=floor, reference="cam0")
    for name, T in rough.T_world_cam.items():
        # Sums in another order, and a stop at a tenth of a sigma.
        np.testing.assert_allclose(flip @ found.T_world_cam[name], T, atol=1e-6)


def test_a_camera_without_overlap_is_kept():
    start = off(ROUGH, 1)
    pairs = [pair for pair in overlapping_pairs(seen(), start, FULL) if "cam3" not in pair]
    priors = {name: Prior(T_world_cam=T, covariance=covariance(T, *ROUGH)) for name, T in start.items()}
    found = register(seen(), start, priors, pairs, FULL, floor=LEVEL, reference="cam0")
    assert found.unlinked == ("cam3",)
    np.testing.assert_array_equal(found.T_world_cam["cam3"], start["cam3"])


def test_a_place_to_begin_at_of_a_camera_that_takes_no_part_is_none():
    """Cameras that were found may be of another part of the rig, or have no cloud."""
    start = off(GOOD, 1)
    priors = {name: Prior(T_world_cam=T, covariance=covariance(T, *GOOD)) for name, T in start.items()}
    pairs, config = overlapping_pairs(seen(), start, FULL), replace(FULL, max_iterations=[1, 1, 1])
    found, plain = (
        register(seen(), start, priors, pairs, config, floor=LEVEL, reference="cam0", begin=begin)
        for begin in ({"elsewhere": start["cam1"]}, None)
    )
    assert found.T_world_cam.keys() == start.keys()
    for name, T in plain.T_world_cam.items():
        np.testing.assert_array_equal(found.T_world_cam[name], T)


def test_without_floor_or_pairs_poses_stay():
    start = off(ROUGH, 1)
    priors = {name: Prior(T_world_cam=T) for name, T in start.items()}
    found = register(seen(), start, priors, [], FULL, floor=None, reference="cam0")
    assert set(found.unlinked) == set(RIG) - {"cam0"}
    assert found.floor is None
    for name, T in start.items():
        np.testing.assert_array_equal(found.T_world_cam[name], T)


# -------------------------------------------------------------------------------------------------------- bare floors


@pytest.mark.parametrize("size", [GOOD, ROUGH, None])
def test_nothing_slides_over_a_bare_floor_and_it_is_said(size: tuple[float, float] | None):
    # Levelled poses: tilt and height are right, yaw, x and z are not.
    rng = np.random.default_rng(4)
    turn_deg, shift_mm = size or ROUGH
    start = {
        name: make_pose(
            exp_so3(np.radians([0.0, rng.normal(0, turn_deg), 0.0])) @ T[:3, :3],
            T[:3, 3] + 1e-3 * shift_mm * rng.normal(size=3) * [1, 0, 1],
        )
        for name, T in RIG.items()
    }
    found = registered(seen((FLOOR,)), start, size)
    assert found.pairs
    for name, T in found.T_world_cam.items():
        shift = T[:3, 3] - start[name][:3, 3]
        # The limits of the issue.
        assert np.hypot(shift[0], shift[2]) < 1e-3
        assert abs(np.degrees(log_so3(T[:3, :3] @ start[name][:3, :3].T)[1])) < 0.02
    for words in (*(found.unobservable[name] for name in ("cam1", "cam2", "cam3")), *unobserved_pairs(found)):
        assert {"yaw", "shift along x", "shift along z"} <= set(words)


def unobserved_pairs(found: Registration) -> list[tuple[str, ...]]:
    return [pair.unobservable for pair in found.pairs.values()]


def test_a_bare_floor_says_nothing_of_depth_errors_either():
    """A plane that a depth error moves a turn and a rise move back: only priors may tell them apart."""
    found = registered(seen((FLOOR,)), off(ROUGH, 1), ROUGH)
    for name, bias in found.bias.items():
        sigma = np.sqrt(np.diag(seen()[name].bias_covariance))
        # Taken a centimetre apart, derivatives by both told them to 1 sigma, and noise made that 8.
        assert (np.abs(bias) < 0.5 * sigma).all()


def test_information_of_a_bare_floor_knows_tilt_and_height_alone():
    found = registered(seen((FLOOR,)), RIG, ROUGH)
    for (_, target), pair in found.pairs.items():
        back = adjoint(invert_transform(RIG[target]))
        # In the world's axes, about the world's origin, on the floor: yaw, x and z leave the floor as it is.
        information = back.T @ pair.information @ back
        assert np.diag(information)[[1, 3, 5]].max() < 1e-6 * information[4, 4]


# -------------------------------------------------------------------------------------------------------- depth errors


def test_depth_errors_are_estimated_with_the_poses():
    px = (0.0, 0.25, 0.0, -0.2)
    start = off(GOOD, 2)
    found = registered(seen(BOXES, px), start, GOOD)
    for k, name in enumerate(RIG):
        # 1 / z_true = 1 / z - d / (f B), with f B = 84 px m.
        error = found.bias[name][1] - px[k] / 84.0
        assert abs(error) < 3.0 * np.sqrt(found.bias_covariance[name][1, 1])
    # They are told from none.
    assert found.bias["cam1"][1] > 2.0 * np.sqrt(found.bias_covariance["cam1"][1, 1])
    assert mean_mm(found.T_world_cam) < mean_mm(start)
    believed = {n: replace(c, bias_covariance=1e-8 * c.bias_covariance) for n, c in seen(BOXES, px).items()}
    plain = registered(believed, start, GOOD)
    # They are allowed for where they are not asked for, too.
    silent = registered(seen(BOXES, px), start, GOOD, config=replace(FULL, depth_bias=False))
    np.testing.assert_array_equal(silent.T_world_cam["cam2"], found.T_world_cam["cam2"])
    assert mean_mm(plain.T_world_cam) > mean_mm(found.T_world_cam)


@pytest.mark.parametrize("known", [np.zeros((2, 2)), np.array([[1e-6, 1e-8], [1e-8, 1e-10]])])
def test_a_depth_error_that_is_known_for_certain_may_be_registered_with(known: Array):
    """Files may say so: sigmas of zero, or a correlation of one."""
    start, bias = off(GOOD, 2), DepthBias(covariance=known, focal_baseline=84.0)
    sure = cloud_of("cam1", {**data_of("cam1", BOXES), "bias": bias}, FULL, T_world_cam=RIG["cam1"], floor=LEVEL)
    found = registered({**seen(), "cam1": sure}, start, GOOD)
    assert mean_mm(found.T_world_cam) < mean_mm(start)
    # Known to a part of what is usual still: no farther from what was said than that.
    along = np.linalg.inv(known + LEAST_BIAS**2 * bias_prior(84.0))
    assert found.bias["cam1"][:2] @ along @ found.bias["cam1"][:2] < 9.0
    for S in (found.covariance["cam1"], found.bias_covariance["cam1"]):
        assert np.linalg.eigvalsh(S).min() > 0


def test_evidence_tells_rigs_with_depth_errors_from_those_without():
    px = (0.3, -0.25, 0.2, -0.3)
    assert registered(seen(), RIG, GOOD).scales.bias < 0.6 < registered(seen(BOXES, px), RIG, GOOD).scales.bias


def test_evidence_tells_rough_poses_from_good_ones():
    good, rough = (registered(seen(), off(size, 3), None).scales.default for size in (GOOD, ROUGH))
    # The default is 0.3 degrees and 6 mm.
    for aspect in ASPECTS:
        name = default_of(aspect, "cam1")
        assert good[name] < 0.5 < 0.7 < rough[name] < 2.5


def off_in_plan(seed: int) -> dict[str, Pose]:
    """Level and at the right height, as levelling leaves poses, but turned and shifted over the floor."""
    rng = np.random.default_rng(seed)
    return {
        name: make_pose(
            exp_so3(np.radians([0.0, rng.normal(0, 0.6), 0.0])) @ T[:3, :3],
            T[:3, 3] + 0.012 * rng.normal(size=3) * [1, 0, 1],
        )
        for name, T in RIG.items()
    }


def in_promised(found: Registration) -> list[float]:
    """Errors of places beside the reference, in what is promised."""
    return [error / found.pair_sigma_mm("cam0", name) for name, error in errors_mm(found.T_world_cam).items()]


def test_floors_that_agree_do_not_vouch_for_yaw_and_place(monkeypatch: pytest.MonkeyPatch):
    def surprise() -> float:
        found = [registered(seen(), off_in_plan(seed), None) for seed in (5, 6, 7)]
        return float(np.sqrt(np.mean(np.square([in_promised(f) for f in found]))))

    # One if all is exact; a size that three numbers a camera tell is known to half itself.
    assert surprise() < 2.0
    # One size for all six: tilt and height, which are right, make the rest look good.
    for module in ("icp_prior", "icp_evidence"):
        monkeypatch.setattr(f"aruco.{module}.ASPECTS", {"all": tuple(range(6))})
    assert surprise() > 2.5


def test_depth_better_than_promised_counts_for_more_but_not_for_ever(rough: Registration):
    # White noise of 0.03 px, a tenth of which is left in a cell, where 0.06 px that all of it shares is promised.
    assert rough.scale == LEAST_SCALE
    few = rough.rows.only(np.arange(3))
    # Of three gaps chance may make as little.
    assert residual_scale(few, 0.2 * np.sqrt(few.variance)) > LEAST_SCALE
    assert residual_scale(rough.rows, 3.0 * 0.6745 * np.sqrt(rough.rows.variance)) == pytest.approx(3.0)


def test_noise_in_slopes_would_shrink_clouds():
    """Scale and height by one camera's floor, with derivatives at noisy samples and at the surface they lie on."""
    rng = np.random.default_rng(0)
    cloud = seen((FLOOR,))["cam0"]
    z = 1.0 / (1.0 / smoothed(cloud)[1] + rng.normal(0.0, 0.06 / 84.0, len(cloud)))
    noisy = replace(
        cloud,
        depth_m=z,
        slopes=np.stack([-z, z**2, *(z**2 * cloud.rays[:, :2].T)]),
        sigma_m=0.06 / 84.0 * z**2,
        cell=np.arange(len(z)),  # every sample has an error of its own
    )
    layout, state = Layout(("cam0",)), standing({"cam0": RIG["cam0"]})
    prior = np.diag(
        np.append(np.full(6, 1e2**2), [3e-3**-2, 1.8e-3**-2, 0.6e-3**-2, 0.6e-3**-2, 1e4**2, 1e4**2, 1e4**2])
    )
    surprises = []
    for taken, depth in ((noisy, z), smoothed(noisy)):
        rows, n_cells = joined(
            [floor_rows(state, {"cam0": taken}, {"cam0": depth}, layout, "cam0")], {"cam0": taken}, layout
        )
        normal = summed(rows, layout, n_cells)
        P = np.linalg.inv(normal.H + prior)
        x = -P @ normal.g
        at = layout.bias("cam0")
        surprises.append(float(x[at] @ np.linalg.solve(P[at, at], x[at])))
    # The truth is that nothing is wrong: chi-square of 4 at most, for known noise is no error of depth.
    assert surprises[1] < 4.0
    assert surprises[0] > 20.0


# ---------------------------------------------------------------------------------------------------------- equations


def standing(T_world_cam: Mapping[str, Pose]) -> State:
    up = np.array([0.0, 1.0, 0.0])
    return State(
        T_world_cam=dict(T_world_cam),
        bias={name: np.zeros(4) for name in T_world_cam},
        floor=floor_parameters(LEVEL, up),
        up=up,
    )


Two = tuple[dict[str, Cloud], dict[str, Array], Layout, tuple[Matches, Matches]]


@pytest.fixture(scope="module")
def two() -> Two:
    about = {name: smoothed(seen()[name]) for name in ("cam0", "cam1")}
    clouds = {name: cloud for name, (cloud, _) in about.items()}
    surfaces = {name: depth for name, (_, depth) in about.items()}
    T = invert_transform(RIG["cam1"]) @ RIG["cam0"]
    there = match(clouds["cam0"], clouds["cam1"], T, 0.05)
    back = match(clouds["cam1"], clouds["cam0"], invert_transform(T), 0.05)
    return clouds, surfaces, Layout(("cam0", "cam1")), (there, back)


@pytest.mark.parametrize("both_normals", [False, True])
def test_gaps_follow_every_unknown_as_their_derivatives_say(two: Two, both_normals: bool):
    clouds, _, layout, (there, back) = two
    # Levers are taken on the surface; here everything is, so that differences of gaps are the derivative itself.
    surfaces = {name: cloud.depth_m for name, cloud in clouds.items()}

    def rows(state: State) -> Rows:
        # Normals follow depth errors too; how that changes gaps has no mean.
        now = {
            name: replace(cloud, depth_m=cloud.depth_m + state.bias[name] @ cloud.slopes)
            for name, cloud in clouds.items()
        }
        pair = pair_rows(state, now, surfaces, layout, there, back, both_normals=both_normals)
        floors = [floor_rows(state, now, surfaces, layout, name) for name in layout.cameras]
        return joined([pair, *floors], clouds, layout)[0]

    state = standing({name: RIG[name] for name in layout.cameras})
    here = rows(state)
    for k in range(layout.size):
        x = np.zeros(layout.size)
        x[k] = 1e-6
        measured = (rows(state.moved(x, layout)).gap_m - here.gap_m) / 1e-6
        told = (here.gaps(x, layout) - here.gap_m) / 1e-6
        # Second order, 1e-6 times metres; slopes of the floor turn its normal by their square only. Depth errors of
        # both cameras are told where the source's sample lies, up to a few cm beside the target's.
        is_error = any(layout.bias(name).start <= k < layout.bias(name).stop for name in layout.cameras)
        exact = 2e-5
        if both_normals:
            # Normals that are not the same turn otherwise than their mean: tenths of a radian of millimetres, where a
            # lever to one of both samples is wrong by half a correspondence, 0.07.
            exact = 1e-3
        np.testing.assert_allclose(measured, told, atol=0.02 * np.abs(told).max() if is_error else exact)


def test_what_both_directions_see_counts_once(two: Two):
    clouds, surfaces, layout, (there, back) = two
    state = standing({name: RIG[name] for name in layout.cameras})
    none = np.zeros(0, dtype=np.intp)
    at = layout.pose("cam1")

    def information(there: Matches, back: Matches) -> Array:
        rows = pair_rows(state, clouds, surfaces, layout, there, back, both_normals=False)
        rows, n_cells = joined([rows], clouds, layout)
        return summed(rows, layout, n_cells).H[at, at]

    one = information(there, replace(back, i=none, j=none, gap_m=np.zeros(0)))
    both = information(there, back)
    twice = information(
        replace(there, i=np.tile(there.i, 2), j=np.tile(there.j, 2), gap_m=np.tile(there.gap_m, 2)), back
    )
    # The other direction reaches some cells more; nothing is worth two.
    assert 1.0 <= np.trace(both) / np.trace(one) < 1.4
    assert np.trace(twice) / np.trace(both) < 1.05


def test_moving_back_leads_to_the_start(rough: Registration):
    start = off(ROUGH, 1)
    for name in ("cam1", "cam2", "cam3"):
        kept = exp_se3(rough.back[name]) @ invert_transform(rough.T_out_own) @ rough.T_world_cam[name]
        reference = invert_transform(rough.T_out_own) @ rough.T_world_cam["cam0"]
        expected = invert_transform(start["cam0"]) @ start[name]
        np.testing.assert_allclose(invert_transform(reference) @ kept, expected, atol=1e-9)


def test_covariances_are_symmetric_and_positive(rough: Registration):
    for S in (
        *rough.covariance.values(),
        *rough.bias_covariance.values(),
        rough.joint[~rough.frozen][:, ~rough.frozen],
    ):
        np.testing.assert_allclose(S, S.T, atol=1e-15)
        assert np.linalg.eigvalsh(S).min() > 0
    # The reference is known as it was given.
    np.testing.assert_allclose(
        rough.covariance["cam0"], covariance(off(ROUGH, 1)["cam0"], *ROUGH), rtol=0.01, atol=1e-7
    )
    assert rough.pair_sigma_mm("cam1", "cam2") == pytest.approx(rough.pair_sigma_mm("cam2", "cam1"), rel=0.3)


def test_cameras_that_stay_are_known_as_they_were_told_to_be():
    start = off(ROUGH, 1)
    levelled = {name: covariance(T, 0.1, 5.0) for name, T in start.items()}
    priors = {name: Prior(T_world_cam=T, covariance=covariance(T, *ROUGH)) for name, T in start.items()}
    pairs = overlapping_pairs(seen(), start, FULL)
    found, plain = (
        placed(
            register(seen(), start, priors, pairs, FULL, floor=LEVEL, reference="cam0", start_covariances=told),
            ["cam3"],
        )
        for told in (levelled, None)
    )
    for name in ("cam0", "cam3"):
        np.testing.assert_allclose(found.covariance[name], levelled[name], rtol=1e-6, atol=1e-12)
    for name in ("cam1", "cam2"):
        assert np.linalg.eigvalsh(found.covariance[name]).min() > 0
        # Others are moved to where those stand, and are as well known as that.
        assert np.trace(found.covariance[name]) < 0.7 * np.trace(plain.covariance[name])
        # And follow those that stay by other shares.
        assert not np.array_equal(found.T_world_cam[name], plain.T_world_cam[name])
