"""Which moves of cameras are kept: true ones, and none that wrong depth, a slide or chance asks for."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from floor_rooms import FLOOR, Wall, cameras, depth_image
from icp_rooms import BOXES, LEVEL, camera_data, covariance

from aruco import icp_gates
from aruco import icp_words as words
from aruco.icp_cloud import Cloud, cloud_of
from aruco.icp_gates import JOINT_SIGMAS, Verdict, judge, set_aside
from aruco.icp_heldout import N_FOLDS, Comparison, HeldOut, held_out, patches
from aruco.icp_match import overlapping_pairs
from aruco.icp_normal import Normal, solved
from aruco.icp_objections import CHI2_999, Case, prior_sigmas, surprise, to_all_depths, worst_objection
from aruco.icp_solve import Prior, Registration, register
from aruco.icp_types import ICPConfig
from aruco.pose_math import Array, Pose, exp_so3, invert_transform, make_pose, pose_distance

RIG = cameras()
FULL = ICPConfig(region="full", stride=2)
GOOD, ROUGH = (0.03, 2.0), (0.3, 8.0)  # degrees and mm about and along each axis
Spoil = Callable[[Array], Array]


def at_other(T: Pose, turn_deg: Sequence[float] | Array, shift_m: Sequence[float] | Array) -> Pose:
    """A pose turned about its centre and shifted, in world axes."""
    return make_pose(exp_so3(np.radians(turn_deg)) @ T[:3, :3], T[:3, 3] + np.asarray(shift_m))


def poses_off(size: tuple[float, float], seed: int) -> dict[str, Pose]:
    rng = np.random.default_rng(seed)
    return {name: at_other(T, rng.normal(0, size[0], 3), rng.normal(0, 1e-3 * size[1], 3)) for name, T in RIG.items()}


@cache
def seen(walls: tuple[Wall, ...] = BOXES) -> dict[str, Cloud]:
    return {name: cloud_with(name, walls) for name in RIG}


def cloud_with(name: str, walls: Sequence[Wall] = BOXES, spoil: Spoil = lambda depth: depth) -> Cloud:
    depth = spoil(depth_image(RIG[name], walls, seed=int(name[-1])))
    return cloud_of(name, camera_data(depth), FULL, T_world_cam=RIG[name], floor=LEVEL)


def judged(
    clouds: Mapping[str, Cloud],
    start: Mapping[str, Pose],
    size: tuple[float, float] | None,
    config: ICPConfig = FULL,
    *,
    unknown: Collection[str] = (),
) -> tuple[Registration, Verdict]:
    """A registration without gates, and what is left of it; of some cameras nobody has said how well they are known."""
    priors = {
        name: Prior(T_world_cam=T, covariance=None if size is None or name in unknown else covariance(T, *size))
        for name, T in start.items()
    }
    pairs = overlapping_pairs(clouds, start, config)

    def again(silent: Collection[str]) -> Registration:
        some, meeting = set_aside(clouds, pairs, silent)
        return register(some, start, priors, meeting, config, floor=LEVEL, reference="cam0")

    first = again(())
    return first, judge(first, clouds, start, priors, config, floor=LEVEL, register=again)


def errors_mm(T_world_cam: Mapping[str, Pose]) -> dict[str, float]:
    """Of every camera's place as the reference sees it."""
    relative = {name: invert_transform(T_world_cam["cam0"]) @ T for name, T in T_world_cam.items()}
    truth = {name: invert_transform(RIG["cam0"]) @ T for name, T in RIG.items()}
    return {name: 1e3 * pose_distance(relative[name], truth[name])[1] for name in RIG}


def mean_mm(T_world_cam: Mapping[str, Pose]) -> float:
    return float(np.mean([e for name, e in errors_mm(T_world_cam).items() if name != "cam0"]))


@pytest.fixture(scope="module")
def rough() -> tuple[dict[str, Pose], Registration, Verdict]:
    start = poses_off(ROUGH, 1)
    return start, *judged(seen(), start, ROUGH)


@pytest.fixture(scope="module")
def shares(rough: tuple[dict[str, Pose], Registration, Verdict]) -> HeldOut:
    return held_out(rough[1], seed=0)


# ------------------------------------------------------------------------------------------------------- what is kept


def test_moves_that_are_right_are_kept(rough: tuple[dict[str, Pose], Registration, Verdict]):
    start, _, verdict = rough
    assert all(verdict.moves[name].accepted for name in ("cam1", "cam2", "cam3"))
    assert verdict.left_out == ()
    # Boxes of 0.7 m in small images tell tilt and height, and a part of yaw, x and z.
    assert mean_mm(verdict.registration.T_world_cam) < 0.8 * mean_mm(start)
    for name in ("cam1", "cam2", "cam3"):
        move = verdict.moves[name]
        assert move.held_out_after_mm < move.held_out_before_mm
        assert move.gain_sigmas >= JOINT_SIGMAS
        assert move.prior_sigmas < np.sqrt(CHI2_999[6])
        assert "standard errors" in move.reason


def test_the_reference_stays_and_says_so(rough: tuple[dict[str, Pose], Registration, Verdict]):
    start, _, verdict = rough
    np.testing.assert_array_equal(verdict.registration.T_world_cam["cam0"], start["cam0"])
    assert not verdict.moves["cam0"].accepted
    assert "reference" in verdict.moves["cam0"].reason


def drawn(seed: int) -> dict[str, Cloud]:
    """The same scene with other noise."""
    return {
        name: cloud_of(name, camera_data(depth_image(T, BOXES, seed=10 * seed + k)), FULL, T_world_cam=T, floor=LEVEL)
        for k, (name, T) in enumerate(RIG.items())
    }


@pytest.mark.parametrize("seed", range(3))
def test_poses_that_are_right_are_left_alone(seed: int):
    _, verdict = judged(drawn(seed), RIG, GOOD)
    # Where the start is the truth every move is chance, and further from it than no move.
    assert not any(move.accepted for move in verdict.moves.values())
    for name, T in RIG.items():
        np.testing.assert_array_equal(verdict.registration.T_world_cam[name], T)
        assert verdict.moves[name].refusal == ("unproved" if name != "cam0" else "")


def test_good_poses_that_could_be_better_are_moved():
    before, after, accepted = 0.0, 0.0, 0
    for seed in range(3):
        start = poses_off(GOOD, 100 + seed)
        _, verdict = judged(drawn(seed), start, GOOD)
        before, after = before + mean_mm(start), after + mean_mm(verdict.registration.T_world_cam)
        accepted += sum(move.accepted for move in verdict.moves.values())
    # Not each move is worth enough to be proved, and clouds do not know all of what poses are off: two thirds of the
    # moves and a tenth of the errors at least.
    assert accepted >= 6
    assert after < 0.9 * before


def test_nothing_slides_over_a_bare_floor():
    start = poses_off(GOOD, 2)
    _, verdict = judged(seen((FLOOR,)), start, GOOD)
    for name, T in verdict.registration.T_world_cam.items():
        off = T[:3, 3] - start[name][:3, 3]
        assert np.hypot(off[0], off[2]) < 1e-3
        turn = T[:3, :3] @ start[name][:3, :3].T
        assert abs(np.degrees(np.arctan2(turn[0, 2], turn[2, 2]))) < 0.02


def test_others_follow_a_reference_that_is_not_level():
    # It does not move, so the floor of all tilts as it does: by 0.6 degrees, of which nobody else is to blame.
    start = {**RIG, "cam0": at_other(RIG["cam0"], (0.5, 0.0, 0.4), (0.0, 0.005, 0.0))}
    _, verdict = judged(seen(), start, (0.4, 8.0))
    assert verdict.left_out == ()
    assert all(verdict.moves[name].accepted for name in ("cam1", "cam2", "cam3"))
    # A turn by 0.6 degrees is 25 to 45 mm of each camera seen from the reference.
    assert mean_mm(verdict.registration.T_world_cam) < 0.5 * mean_mm(start)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Doubtful:
    """What was held out of a registration, where it speaks against one camera's move and for all others."""

    registration: Registration

    def compared(self, cameras: Collection[str]) -> Comparison:
        sigmas = -3.0 if {*cameras} == {"cam2"} else 5.0
        return Comparison(gain=sigmas, share=0.5 + sigmas, sigma=1.0)

    def median_mm(self, camera: str, cameras: Collection[str] = ()) -> float:
        return float(len(cameras))


def test_a_camera_that_held_out_distances_speak_against_stays_while_others_move(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("aruco.icp_gates.held_out", lambda registration, seed: Doubtful(registration=registration))
    start = poses_off(ROUGH, 1)
    _, verdict = judged(seen(), start, ROUGH)
    np.testing.assert_array_equal(verdict.registration.T_world_cam["cam2"], start["cam2"])
    assert "grow, by 3.0 standard errors" in verdict.moves["cam2"].reason
    assert verdict.moves["cam2"].gain_sigmas == -3.0
    assert verdict.moves["cam1"].accepted
    assert verdict.moves["cam1"].gain_sigmas == 5.0
    # It is not set aside: its cloud remains a witness.
    assert verdict.left_out == ()
    assert any("cam2" in pair for pair in verdict.registration.pairs)


# --------------------------------------------------------------------------------------------------------- wrong depth


def scaled(factor: float) -> Spoil:
    return lambda depth: factor * depth


def curved(depth: Array) -> Array:
    """3 % more half an image's width beside the middle: a lens that was not taken out."""
    height, width = depth.shape
    v, u = np.mgrid[0:height, 0:width]
    return depth * (1 + 0.03 * ((u - width / 2) ** 2 + (v - height / 2) ** 2) / (width / 2) ** 2)


@pytest.mark.parametrize("spoil", [scaled(1.05), scaled(0.96)], ids=["5 % long", "4 % short"])
def test_a_camera_whose_depth_is_wrong_keeps_its_pose_and_takes_nobody_along(spoil: Spoil):
    start = poses_off(GOOD, 2)
    _, verdict = judged({**seen(), "cam2": cloud_with("cam2", spoil=spoil)}, start, GOOD)
    np.testing.assert_array_equal(verdict.registration.T_world_cam["cam2"], start["cam2"])
    assert verdict.left_out == ("cam2",)
    assert verdict.moves["cam2"].refusal == "depth"
    # Nobody is worse off than without that cloud, to the prior's own size of chance.
    assert mean_mm(verdict.registration.T_world_cam) < mean_mm(start) + 0.5


def test_a_lens_that_was_not_taken_out_does_no_harm():
    start = poses_off(GOOD, 2)
    _, verdict = judged({**seen(), "cam2": cloud_with("cam2", spoil=curved)}, start, GOOD)
    # No error of depth that is believed is curved; what looks like one may pass, but not take a pose away.
    assert mean_mm(verdict.registration.T_world_cam) < mean_mm(start) + 0.5


def test_a_reference_whose_depth_is_wrong_moves_nobody():
    start = poses_off(GOOD, 2)
    _, verdict = judged({**seen(), "cam0": cloud_with("cam0", spoil=scaled(1.05))}, start, GOOD)
    assert verdict.left_out == ("cam0",)
    for name, T in start.items():
        np.testing.assert_array_equal(verdict.registration.T_world_cam[name], T)
    assert verdict.moves["cam0"].refusal == "depth"
    assert "the clouds of cam0 being set aside" in verdict.moves["cam1"].reason


def test_a_bias_that_a_camera_may_have_is_no_reason_to_refuse_it():
    start = poses_off(ROUGH, 1)
    _, verdict = judged({**seen(), "cam2": cloud_with("cam2", spoil=scaled(1.004))}, start, ROUGH)
    assert verdict.left_out == ()
    assert mean_mm(verdict.registration.T_world_cam) < 0.8 * mean_mm(start)


@pytest.mark.parametrize(
    ("bumped", "turn_deg", "shift_m"),
    [
        ("cam0", (0.7, 0.0, 0.7), (0.0, 0.03, 0.0)),
        ("cam1", (0.0, 1.0, 0.0), (0.03, 0.0, -0.03)),
        ("cam3", (0.0, 1.0, 0.0), (0.03, 0.0, -0.03)),
    ],
)
def test_one_wrong_pose_among_well_known_ones_is_named_alone(
    bumped: str, turn_deg: tuple[float, float, float], shift_m: tuple[float, float, float]
):
    # Poses known to a millimetre pull at each other as much as at the one that is wrong: all are off by many sigma.
    start = poses_off(GOOD, 2)
    start[bumped] = at_other(start[bumped], turn_deg, shift_m)
    registration, verdict = judged(seen(), start, GOOD)
    priors = {name: Prior(T_world_cam=T, covariance=covariance(T, *GOOD)) for name, T in start.items()}
    case = Case(clouds=seen(), start=start, priors=priors, config=FULL, floor=LEVEL)
    limit = np.sqrt(CHI2_999[6])
    assert sum(prior_sigmas(case, registration, name) > limit for name in start) > 1
    against = {name: move for name, move in verdict.moves.items() if move.refusal == "prior"}
    assert [*against] == [bumped]
    assert against[bumped].rotation_deg > 0.2  # of the reference, which does not move, that is what clouds wish


def test_depth_errors_that_each_camera_may_have_are_not_believed_of_all(
    rough: tuple[dict[str, Pose], Registration, Verdict],
):
    start, registration, _ = rough
    priors = {name: Prior(T_world_cam=T) for name, T in start.items()}
    case = Case(clouds=seen(), start=start, priors=priors, config=FULL, floor=LEVEL)

    def wrong_by(sigmas: float) -> Registration:
        bias = {n: np.array([0.0, sigmas * np.sqrt(c.bias_covariance[1, 1]), 0.0, 0.0]) for n, c in seen().items()}
        # Said for sure, of cameras as they usually are.
        scales = replace(registration.scales, bias=1.0, lean=1.0)
        return replace(registration, bias=bias, scales=scales, joint=np.zeros_like(registration.joint))

    objection = worst_objection(case, wrong_by(3.5), ["cam1", "cam2", "cam3"])
    assert objection is not None
    assert objection.kind == "depth"
    assert "all cameras together" in objection.reason
    alone = worst_objection(case, wrong_by(4.5), ["cam1", "cam2", "cam3"])
    assert alone is not None
    assert "all cameras together" not in alone.reason
    # Three of a hundred such errors are larger than 2.2 sigma, and so may those of four cameras be now and then.
    assert not list(to_all_depths(case, wrong_by(2.2), ["cam0", "cam1", "cam2", "cam3"]))


# ------------------------------------------------------------------------------------------------- bounds and priors


def test_a_move_beyond_the_prior_is_refused_and_one_without_a_prior_is_not():
    start = poses_off(GOOD, 2)
    start["cam2"] = at_other(start["cam2"], (1.0, 0.0, 0.4), (0.02, 0.02, -0.02))
    _, verdict = judged(seen(), start, GOOD)
    np.testing.assert_array_equal(verdict.registration.T_world_cam["cam2"], start["cam2"])
    assert "sigma of what that is known to" in verdict.moves["cam2"].reason
    assert verdict.moves["cam2"].prior_sigmas > np.sqrt(CHI2_999[6])
    _, free = judged(seen(), start, None)
    assert free.moves["cam2"].accepted
    assert np.isnan(free.moves["cam2"].prior_sigmas)
    assert errors_mm(free.registration.T_world_cam)["cam2"] < 0.9 * errors_mm(start)["cam2"]


def test_a_move_beyond_the_bounds_is_refused():
    start = poses_off(ROUGH, 1)
    _, verdict = judged(seen(), start, ROUGH, replace(FULL, max_translation_m=0.003))
    assert not any(move.accepted and move.translation_mm > 3 for move in verdict.moves.values())
    assert any(move.refusal == "too_far" for move in verdict.moves.values())


def test_a_prior_forbids_a_move_against_a_reference_of_which_nobody_has_said_how_well_it_is_known():
    start = poses_off(GOOD, 2)
    start["cam2"] = at_other(start["cam2"], (1.0, 0.0, 0.4), (0.02, 0.02, -0.02))
    _, verdict = judged(seen(), start, GOOD, unknown=("cam0",))
    assert verdict.moves["cam2"].refusal == "prior"
    assert verdict.moves["cam2"].prior_sigmas > np.sqrt(CHI2_999[6])
    # What nobody has said of a camera itself forbids nothing.
    _, free = judged(seen(), start, GOOD, unknown=("cam2",))
    assert np.isnan(free.moves["cam2"].prior_sigmas)


def turned(degrees: Mapping[str, float]) -> dict[str, Pose]:
    """Cameras turned in place about the vertical."""
    return {name: at_other(T, (0.0, degrees.get(name, 0.0), 0.0), np.zeros(3)) for name, T in RIG.items()}


def blamed(registration: Registration, after: Mapping[str, Pose], moving: Sequence[str]) -> str | None:
    """Who went too far."""
    priors = {name: Prior(T_world_cam=T) for name, T in RIG.items()}
    case = Case(clouds=seen(), start=RIG, priors=priors, config=FULL, floor=None)
    objection = worst_objection(case, replace(registration, T_world_cam={**after}), moving)
    assert objection is None or objection.kind == "too_far"
    return None if objection is None else objection.camera


def test_who_went_too_far_is_the_one_without_which_the_others_agree(
    rough: tuple[dict[str, Pose], Registration, Verdict],
):
    _, registration, _ = rough
    two, three, four = ["cam1"], ["cam1", "cam2"], ["cam1", "cam2", "cam3"]
    # Beyond what others do in common, in the mean of which cam2 has a part, cam0 goes farther than cam2 itself.
    assert blamed(registration, turned({"cam2": 6.0}), three) == "cam2"
    assert blamed(registration, turned({"cam2": 6.0}), four) == "cam2"
    assert blamed(registration, turned({"cam1": 6.0, "cam2": -7.0}), four) == "cam2"
    # Where all others swing about the reference, it is the one that was turned.
    seen_from_cam0 = {name: invert_transform(turned({"cam0": 6.0})["cam0"]) @ T for name, T in RIG.items()}
    swung = {name: RIG["cam0"] @ T for name, T in seen_from_cam0.items()} | {"cam0": RIG["cam0"]}
    assert blamed(registration, swung, four) == "cam0"
    # Of two cameras nobody knows; the reference cannot be moved.
    assert blamed(registration, turned({"cam1": 6.0}), two) == "cam1"
    assert blamed(registration, turned({"cam0": 6.0}), two) == "cam1"
    # Within its bounds a turn in place is nobody's fault, however far from the others' middle a camera stands.
    assert blamed(registration, turned({"cam2": 4.0}), three) is None


def test_a_camera_that_was_turned_is_refused_and_the_others_are_registered():
    clouds = {name: cloud for name, cloud in seen().items() if name != "cam3"}
    start = {name: RIG[name] for name in clouds}
    start["cam2"] = at_other(start["cam2"], (0.0, 6.0, 0.0), (0.0, 0.0, 0.0))
    _, verdict = judged(clouds, start, None, replace(FULL, max_iterations=[15, 8, 5]))
    assert verdict.left_out == ("cam2",)
    assert verdict.moves["cam2"].refusal == "too_far"
    assert verdict.moves["cam1"].refusal in ("", "unproved")


def test_the_prior_is_asked_about_what_clouds_wish_not_about_what_they_were_granted():
    prior = np.diag([1.0, 4.0])
    # Clouds as sure as the prior get half of their wish, which is (6, 0): 4.2 sigma of what it may be by chance.
    assert surprise(np.array([3.0, 0.0]), prior, 0.5 * prior) == pytest.approx(36 / 2)
    assert surprise(np.array([3.0, 0.0]), prior, prior) == pytest.approx(9)
    # What clouds say nothing of does not move; rounding there is no surprise.
    assert surprise(np.array([3.0, 1e-9]), prior, np.diag([1.0, 0.0])) == pytest.approx(9)


def test_wishes_by_chance_surprise_as_chi_square_does():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    prior = A @ A.T
    noise = np.diag(rng.uniform(0.1, 2.0, 6))
    gain = prior @ np.linalg.inv(prior + noise)
    truth = rng.multivariate_normal(np.zeros(6), prior, 4000)
    wish = (truth + rng.multivariate_normal(np.zeros(6), noise, 4000)) @ gain.T
    chi2 = np.array([surprise(x, prior, gain @ prior) for x in wish])
    # Six degrees of freedom less what hardly told directions lose; 4000 draws know a mean of 6 to 0.06.
    assert 5.0 < chi2.mean() < 6.2
    assert (chi2 > CHI2_999[6]).mean() < 0.003


# ------------------------------------------------------------------------------------------------------- held-out part


def test_what_is_held_out_is_held_out_of_all_pairs(shares: HeldOut):
    rows = shares.registration.rows
    assert set(shares.fold) == set(range(N_FOLDS))
    for patch in np.unique(shares.patch)[:20]:
        assert len(set(shares.fold[shares.patch == patch])) == 1
    # A patch of floor in the middle of the room is seen by several pairs.
    pairs = rows.a[~rows.is_floor] * 10 + rows.b[~rows.is_floor]
    patch = shares.patch[~rows.is_floor]
    assert max(len(set(pairs[patch == k])) for k in np.unique(patch)) >= 3
    sizes = np.bincount(shares.fold)
    assert sizes.min() > 0.6 * sizes.max()


def test_patches_are_places(shares: HeldOut):
    rows = shares.registration.rows
    floor = rows.is_floor
    p_cross_n, n = rows.by_a[floor, :3], rows.by_a[floor, 3:6]
    place = np.cross(n, p_cross_n)
    for patch in np.unique(patches(rows)[floor])[:20]:
        extent = np.ptp(place[shares.patch[floor] == patch], axis=0)
        assert extent.max() <= 0.61  # a patch's side, and the tilt of the floor


def test_a_solution_does_not_know_what_was_held_out(shares: HeldOut):
    gaps = shares.gaps()
    rows = shares.registration.rows
    # Fitted gaps are smaller than predicted ones, in squares of their sigma.
    assert np.sum(gaps**2 / rows.variance) > np.sum(rows.gap_m**2 / rows.variance)


def test_held_out_distances_ask_for_moves_that_are_right(shares: HeldOut):
    everybody = shares.compared(["cam1", "cam2", "cam3"])
    assert everybody.sigmas > JOINT_SIGMAS
    # All of the way, as far as it is known.
    assert abs(everybody.share - 1.0) < 3.0 * everybody.sigma
    assert shares.compared([]).sigmas == 0


@pytest.mark.parametrize("kept", [(), ("cam2",), ("cam1", "cam3")])
def test_predictions_with_cameras_kept_are_those_of_equations_in_which_they_are_not_free(
    shares: HeldOut, kept: tuple[str, ...]
):
    reg = shares.registration
    M, free, x0 = np.eye(reg.layout.size), ~reg.frozen, np.zeros(reg.layout.size)
    for name in kept:
        # It moves as the reference does.
        M[reg.layout.pose(name), reg.layout.pose(reg.reference)] = np.eye(6)
        free[reg.layout.pose(name)] = False
        x0[reg.layout.pose(name)] = reg.back[name]
    M = M[:, free]
    naive = []
    for normal in shares.without:
        beside = Normal(H=normal.H, g=normal.g + normal.H @ x0, chi2=0.0)
        naive.append(reg.rows.gaps(x0 + solved(beside, M), reg.layout))
    expected = np.stack(naive)[shares.fold, np.arange(len(shares.fold))]
    # Rounding, of gaps of millimetres.
    np.testing.assert_allclose(shares.gaps(kept), expected, rtol=0, atol=1e-12)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Row:
    """What was held out of cameras in a row, of which some groups fail."""

    registration: Registration
    failing: Collection[tuple[str, ...]]  # whose moves together are not proved
    asked: list[tuple[str, ...]]

    def compared(self, cameras: Collection[str]) -> Comparison:
        self.asked.append(tuple(sorted(cameras)))
        gain = -9.0 if self.asked[-1] in self.failing else 9.0
        return Comparison(gain=gain, share=gain, sigma=1.0)

    def median_mm(self, camera: str, cameras: Collection[str] = ()) -> float:
        return 1.0


def refused(failing: Collection[tuple[str, ...]], n: int = 20) -> tuple[set[str], list[tuple[str, ...]]]:
    """Cameras of a row that are refused, and about whose moves together was asked."""
    names = [f"c{k:02d}" for k in range(n)]
    registration: Any = SimpleNamespace(
        pairs=dict.fromkeys(pairwise(names)),
        T_world_cam=dict.fromkeys(names, np.eye(4)),
        reference=names[0],
        unobservable={},
    )
    priors = {name: Prior(T_world_cam=np.eye(4)) for name in names}
    case = Case(clouds={}, start=registration.T_world_cam, priors=priors, config=FULL, floor=None)
    held: Any = Row(registration=registration, failing=failing, asked=[])
    trial = icp_gates._Trial(case=case, held=held, alone=frozenset())
    return {*trial.unproved(names[1:])}, held.asked


def test_a_refusal_is_no_reason_to_ask_about_cameras_far_away_until_all_are_asked_at_the_end():
    # One fails by itself; each next one once the one before it is gone.
    gone, asked = refused([("c05",), ("c06", "c07"), ("c07", "c08"), ("c08", "c09")])
    assert gone == {"c05", "c06", "c07", "c08"}
    # Twice about each camera, at the start and at the end, and about few between; two comparisons each, and a third
    # for what is told of each refusal.
    assert len(asked) < 2 * (2 * 19 + 3 * 4)
    # Nobody passes without having been asked beside all that are left in the end.
    gone, asked = refused([("c05",)])
    assert gone == {"c05"}
    assert sum(len(names) == 1 for names in asked) >= 2 * 18


def test_moves_that_are_not_proved_together_are_not_asked_about_in_ever_smaller_groups():
    """Of three such cameras, and then of two, one was left whose move chance had proved by itself."""
    gone, _ = refused([("c01", "c02"), ("c01", "c02", "c03"), ("c02", "c03")], n=4)
    assert gone == {"c01", "c02", "c03"}


def test_clouds_set_aside_have_no_say():
    clouds, pairs = set_aside(seen(), {("cam0", "cam1"): 1.0, ("cam1", "cam2"): 2.0}, ("cam2",))
    assert pairs == {("cam0", "cam1"): 1.0}
    assert not clouds["cam2"].is_floor.any()
    assert clouds["cam1"] is seen()["cam1"]


def test_the_verdict_is_the_same_each_time(rough: tuple[dict[str, Pose], Registration, Verdict]):
    start, _, verdict = rough
    _, again = judged(seen(), start, ROUGH)
    assert {k: m.reason for k, m in again.moves.items()} == {k: m.reason for k, m in verdict.moves.items()}
    for name, T in verdict.registration.T_world_cam.items():
        np.testing.assert_array_equal(again.registration.T_world_cam[name], T)


def test_sentences_say_whose_moves_proved_together():
    alone = words.not_proved(0.1, 0.002, 1.4, 0, JOINT_SIGMAS)
    assert alone.endswith("by its move alone held-out distances shrink by 1.4 standard errors, want 2.")
    assert "that of 2 cameras that overlap it together" in words.gained(0.1, 0.002, (9.0, 6.0), 5.0, 2, float("nan"))
    assert words.untold(()) == "-"
    assert words.untold(("yaw", "height")) == "yaw, height"
    assert words.untold(("yaw", "height", "turn about x", "turn about z", "shift along x", "shift along z")) == "all"
