"""Kept cameras that no longer stand where their file has them are found; those that do raise no alarm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from joint_rigs import SimRig
from kept_rigs import at_rest, contradictions, displaced, earlier_file, noisy, off_m, recorded, seen_by, standing
from loguru import logger

from aruco.errors import CalibrationError
from aruco.model import Calibration
from aruco.pose_math import exp_se3, transform_points
from rigcal.finishing import finish
from rigcal.formats.native import document
from rigcal.kept_check import KeptCheck, compare_kept
from rigcal.pipeline import calibrate_seen
from rigcal.placing import place_cameras

TWO, THREE = ("c0", "c1"), ("c0", "c1", "c2")
# What a ring of boxes 2.4 m away, seen twelve times, leaves: 0.2 mm typically, and the file errs as much.
GOOD_M = 0.6e-3


@pytest.fixture
def told() -> Iterator[list[str]]:
    """What is logged, line by line."""
    lines: list[str] = []
    sink = logger.add(lambda message: lines.append(str(message)), level="INFO", format="{level} {message}")
    yield lines
    logger.remove(sink)


def reasons(calibration: Calibration) -> str:
    return " ".join(calibration.notes["quality"]["reasons"])


def check_value(calibration: Calibration, name: str) -> float:
    (value,) = (c["value"] for c in calibration.notes["quality"]["checks"] if c["name"] == name)
    return value


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("knows", [True, False])
def test_cameras_that_nobody_moved_raise_no_alarm(seed: int, knows: bool) -> None:
    rig = standing(seed)
    kept = earlier_file(rig, THREE, seed)
    kept = kept if knows else replace(kept, covariance={})
    for evidence in (seen_by(recorded(rig, seed), moving_target=True), seen_by(at_rest(rig, seed))):
        check = compare_kept(evidence, kept)
        assert sorted(check.compared) == list(THREE)
        assert not check.contradictions


def test_harmless_differences_are_no_contradiction() -> None:
    # Half a millimetre is far more than the covariances promise, but two good calibrations may differ by it.
    rig = standing(0)
    kept = displaced(earlier_file(rig, THREE, 0), "c1", 0.5e-3)
    assert not compare_kept(seen_by(recorded(rig, 0), moving_target=True), kept).contradictions


@pytest.mark.parametrize("shift_m", [3e-3, 10e-3, 0.3])
@pytest.mark.parametrize("moving", [True, False])
def test_of_three_the_displaced_one_is_named_and_bends_nothing(shift_m: float, moving: bool) -> None:
    rig = standing(1)
    kept = displaced(earlier_file(rig, THREE, 1), "c1", shift_m)
    evidence = seen_by(recorded(rig, 1), moving_target=True) if moving else seen_by(at_rest(rig, 1))
    found = calibrate_seen(evidence, kept=kept)
    assert contradictions(found) == [("c1",)]
    # 1.5 mm: a resting box lets a camera 2.4 m away be known to about half a millimetre.
    assert check_value(found, "kept cameras displaced") == pytest.approx(1e3 * shift_m, abs=1.5)
    assert found.notes["quality"]["verdict"] in (("bad",) if shift_m > 0.02 else ("usable", "bad"))
    assert "Camera c1 is displaced: the other cameras of old.json put it" in reasons(found)
    assert off_m(found, kept, rig, "c3", "c0") < GOOD_M
    # It stays where it was, in the file, and is not counted among the cameras that were used.
    assert "c1" not in found.T_world_cam
    assert document(found)["c1"] == kept.entries["c1"]
    assert "put it" in found.idle["c1"]


def test_held_to_all_three_the_new_camera_is_off_by_as_much() -> None:
    rig = standing(1)
    kept = displaced(earlier_file(rig, THREE, 1), "c1", 3e-3)
    evidence = seen_by(recorded(rig, 1), moving_target=True)
    bent = finish(place_cameras(evidence, kept)[0], evidence, kept)
    assert off_m(bent, kept, rig, "c3", "c0") > 1e-3
    assert bent.notes["quality"]["verdict"] == "good"


@pytest.mark.parametrize(("shift_m", "verdicts"), [(3e-3, {"usable"}), (9e-3, {"usable", "bad"}), (0.05, {"bad"})])
@pytest.mark.parametrize("moving", [True, False])
def test_of_two_that_contradict_each_other_neither_is_blamed(shift_m: float, verdicts: set[str], moving: bool) -> None:
    rig = standing(2)
    kept = displaced(earlier_file(rig, TWO, 2), "c1", shift_m)
    evidence = seen_by(recorded(rig, 2), moving_target=True) if moving else seen_by(at_rest(rig, 2))
    found = calibrate_seen(evidence, kept=kept)
    assert contradictions(found) == [TWO]
    assert found.notes["quality"]["verdict"] in verdicts
    assert "Cameras c0 and c1 of old.json contradict each other by" in reasons(found)
    assert "find out which" in reasons(found)
    # The adjustment lets go of either, by chance: that is no reason to accuse it.
    assert "views do not fit" not in reasons(found)
    assert all(why.startswith("cameras c0 and c1 of old.json contradict") for why in found.idle.values())


def test_a_third_that_knows_little_decides_nothing() -> None:
    rig = standing(2)
    kept = displaced(earlier_file(rig, THREE, 2), "c1", 3e-3)
    once, rng = recorded(rig, 2), np.random.default_rng(2)
    blurred = {
        f: replace(noisy(d, rng, 2.0), sigma_px=np.full_like(d.sigma_px, 2.0))
        for f, d in list(once.detections["c2"].items())[:4]
    }
    check = compare_kept(seen_by(once.with_detections({**once.detections, "c2": blurred}), moving_target=True), kept)
    assert sorted(check.compared) == list(THREE)
    assert [c.cameras for c in check.contradictions] == [TWO]


def test_two_that_leave_nothing_to_adjust_are_not_blamed_either() -> None:
    rig = standing(35)
    kept = displaced(earlier_file(rig, TWO, 35), "c1", 0.05)
    with pytest.raises(CalibrationError, match=r"^Cameras c0 and c1 of old\.json contradict each other by 50\.5 mm"):
        calibrate_seen(seen_by(at_rest(rig, 35)), kept=kept)


def test_a_rough_map_does_not_hide_a_displaced_camera() -> None:
    rig, rng = standing(3), np.random.default_rng(3)
    kept = earlier_file(rig, THREE, 3)
    again = recorded(rig, 3)
    off = {m: exp_se3(np.r_[5e-3 * rng.standard_normal(3), 2e-3 * rng.standard_normal(3)]) for m in rig.geometry}
    rough = replace(again, geometry={m: transform_points(off[m], corners) for m, corners in rig.geometry.items()})
    evidence = seen_by(rough, moving_target=True, refine_target=True)
    assert not compare_kept(evidence, kept).contradictions
    (found,) = compare_kept(evidence, displaced(kept, "c1", 5e-3)).contradictions
    assert found.cameras == ("c1",)


def test_parts_are_compared_by_themselves() -> None:
    rig = standing(4)
    kept = displaced(earlier_file(rig, ("c0", "c1", "c2", "c3"), 4), "c3", 0.02)
    once = recorded(rig, 4, 16)
    halves = {"c0": range(8), "c1": range(8), "c2": range(8, 16), "c3": range(8, 16)}
    seen = {name: {f: d for f, d in once.detections[name].items() if f in halves[name]} for name in halves}
    check = compare_kept(seen_by(once.with_detections(seen), moving_target=True), kept)
    assert sorted(check.compared) == ["c0", "c1", "c2", "c3"]
    (found,) = check.contradictions
    assert found.cameras == ("c2", "c3")


def test_a_single_kept_camera_has_nothing_to_contradict() -> None:
    rig = standing(5)
    kept = earlier_file(rig, TWO, 5).only({"c0"})
    assert compare_kept(seen_by(recorded(rig, 5), moving_target=True), kept) == KeptCheck()


# --- what becomes of kept cameras that took no part -----------------------------------------------------------------


def spoilt(rig: SimRig, *names: str) -> SimRig:
    """Corners of some cameras that fit no pose, the same in every frame: somebody else's intrinsics, as it were."""
    views = {
        name: {f: noisy(d, np.random.default_rng(9), 8.0) for f, d in rig.detections[name].items()} for name in names
    }
    return rig.with_detections({**rig.detections, **views})


@pytest.mark.parametrize("joint", [True, False])
def test_a_rig_whose_kept_cameras_do_not_all_fit_stays_in_their_world(joint: bool, told: list[str]) -> None:
    rig = standing(6, n_cam=6)
    names = ("c4", "c3", "c2", "c1", "c0")
    kept = earlier_file(rig, names, 6)
    kept = replace(kept, entries={**kept.entries, "far": {"pose": "p"}})
    found = calibrate_seen(seen_by(spoilt(at_rest(rig, 6), "c0", "c1", "c2"), joint=joint), kept=kept)
    content = document(found)
    assert content["_meta"]["world"] == {"up": [0, 1, 0], "origin": "floor"}
    assert {name: content[name]["pose"] for name in kept.entries} == {n: e["pose"] for n, e in kept.entries.items()}
    assert not found.lost
    # Recorded, and the views do not fit: neither silent nor taken for a camera that was not there.
    assert sorted(found.idle) == ["c0", "c1", "c2"]
    assert found.stale == {"c0", "c1", "c2"}
    assert not found.is_whole
    assert content["_meta"]["took_no_part"] == dict(found.idle)
    # In one order, whatever the hash seed.
    lines = [line.split()[2] for line in told if "took no part" in line]
    assert lines == ["c0", "c1", "c2"]


def test_without_one_kept_camera_that_fits_there_is_no_world() -> None:
    rig = standing(7, n_cam=3)
    evidence = seen_by(spoilt(at_rest(rig, 7), "c0"), joint=False)
    with pytest.raises(CalibrationError, match=r"No camera of old\.json fits where that puts it") as caught:
        calibrate_seen(evidence, kept=earlier_file(rig, TWO, 7).only({"c0"}))
    assert "camera c0: the corners lie" in str(caught.value)


def test_a_kept_camera_that_does_not_see_the_target_is_no_failure() -> None:
    rig = standing(8)
    once = recorded(rig, 8)
    kept = earlier_file(rig, THREE, 8)
    evidence = seen_by(once.with_detections({**once.detections, "c1": {}}), moving_target=True)
    found = calibrate_seen(evidence, kept=kept)
    assert "never sees the target" in found.idle["c1"]
    assert not found.lost
    assert found.is_whole
    assert found.stale == frozenset()


def test_kept_cameras_hang_together_without_a_frame(told: list[str]) -> None:
    rig = standing(4)
    once = recorded(rig, 4, 16)
    halves = {"c0": range(8), "c1": range(8), "c2": range(8, 16), "c3": range(8, 16)}
    seen = {name: {f: d for f, d in once.detections[name].items() if f in halves[name]} for name in halves}
    kept = earlier_file(rig, ("c0", "c2"), 4)
    found = calibrate_seen(seen_by(once.with_detections(seen), moving_target=True), kept=kept)
    assert found.notes["connections"]["parts"] == [["c0", "c1", "c2", "c3"]]
    assert found.notes["connections"]["suggestion"] == ""
    assert not [line for line in told if "never see the target together" in line]
    # Nor does the verdict ask for frames that tie what is tied.
    assert check_value(found, "frames of the weakest link") >= 5
    assert check_value(found, "cameras checked independently") == 100
    assert max(off_m(found, kept, rig, "c1", "c0"), off_m(found, kept, rig, "c3", "c0")) < 2 * GOOD_M


def test_what_a_file_says_of_kept_cameras_is_kept() -> None:
    rig = standing(10)
    kept = earlier_file(rig, THREE, 10)
    entries = {n: {**e, "owner": "lab", "frames": 99, "least_known": "yaw"} for n, e in kept.entries.items()}
    entries["far"] = {"pose": "p", "owner": "attic"}
    covariance = {**kept.meta["covariance"], "far": [0.0] * 36}
    bias = {"c0": {"scale": 1.01}, "far": {"scale": 0.99}}
    kept = replace(kept, entries=entries, meta={"covariance": covariance, "depth_bias": bias})
    content = document(calibrate_seen(seen_by(recorded(rig, 10), moving_target=True), kept=kept))
    assert content["c0"]["owner"] == "lab"
    assert content["c0"]["frames"] == 12
    assert content["c0"]["kept"] is True
    assert content["c0"]["least_known"] == "yaw"
    assert content["far"] == entries["far"]
    assert content["_meta"]["depth_bias"] == bias
    assert {n: content["_meta"]["covariance"][n] for n in covariance} == covariance
    assert set(content["_meta"]["covariance"]) == {"c0", "c1", "c2", "c3", "far"}
