"""Validation and verdict: a good rig is good, every fault is told by its own sentence, and nothing small fools it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from marker_pictures import make_camera
from target_views import any_pose, box, looking_at, pose_error, sight

from aruco import moved_target, resting_target
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, exp_so3, invert_transform, make_pose
from aruco.rig_estimate import RigEstimate
from aruco.view_pose import solve_view, variance_factor
from rigcal.quality.gates import Quality
from rigcal.solve.joint import JointRig, adjust_rig
from rigcal.validation import Validation, validate
from rigcal.verdict import depth_below_target, quality_of

MIDDLE = np.array([0.0, 0.3, 0.0])
CAMERAS = {
    name: looking_at(np.array([2.2 * np.sin(a), h, 2.2 * np.cos(a)]), MIDDLE)
    for name, a, h in (("a", 0.0, 0.8), ("b", 1.3, 1.0), ("c", 2.6, 0.6), ("d", 4.2, 0.9))
}
BOX = box(0.4)
NOISE_PX = 0.05


@dataclass(frozen=True, kw_only=True)
class Case:
    """A rig as it is, and what the calibration is told about it."""

    moving: bool = True
    n_frames: int = 16
    poses: Mapping[str, Pose] = field(default_factory=lambda: CAMERAS)
    true_map: Mapping[int, Array] = field(default_factory=lambda: BOX)
    told_map: Mapping[int, Array] | None = None
    true_cameras: Mapping[str, Camera] = field(default_factory=dict)  # where they differ from the told ones
    told_cameras: Mapping[str, Camera] = field(default_factory=dict)
    sees: Mapping[str, Collection[int]] = field(default_factory=dict)  # camera -> frames, otherwise all
    only: Mapping[str, Collection[int]] = field(default_factory=dict)  # camera -> markers, otherwise all
    bump: Mapping[str, tuple[int, Pose]] = field(default_factory=dict)  # from this frame on: T_world_cam @ this
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came out."""

    rig: RigEstimate
    joint: JointRig
    cameras: list[Camera]
    detections: Mapping[str, Mapping[int, Detection]]
    geometry: Mapping[int, Array]
    moving: bool
    validation: Validation

    @property
    def quality(self) -> Quality:
        return quality_of(self.validation)


def detections_of(case: Case) -> dict[str, dict[int, Detection]]:
    rng = np.random.default_rng(case.seed)
    frames = {f: make_pose(any_pose(rng)[:3, :3], MIDDLE + 0.2 * rng.standard_normal(3)) for f in range(case.n_frames)}
    if not case.moving:
        frames = dict.fromkeys(frames, make_pose(np.eye(3), MIDDLE))
    found: dict[str, dict[int, Detection]] = {}
    for name, T_world_cam in case.poses.items():
        camera = case.true_cameras.get(name, make_camera(name))
        start, bump = case.bump.get(name, (case.n_frames, np.eye(4)))
        found[name] = {}
        for f, T in frames.items():
            if f in case.sees.get(name, frames):
                T_cam_world = invert_transform(T_world_cam @ bump if f >= start else T_world_cam)
                found[name][f] = sight(camera, T_cam_world @ T, case.true_map, NOISE_PX, rng, only=case.only.get(name))
    return {name: {f: d for f, d in mine.items() if len(d)} for name, mine in found.items()}


def calibrated(case: Case) -> Outcome:
    detections = detections_of(case)
    geometry = case.told_map or case.true_map
    cameras = [case.told_cameras.get(name, make_camera(name)) for name in case.poses]
    views = [solve_view(c, f, d, geometry) for c in cameras for f, d in detections[c.name].items()]
    solved = [view for view in views if view is not None]
    scale2 = {c.name: variance_factor([v for v in solved if v.camera == c.name]) for c in cameras}
    if case.moving:
        rig = moved_target.place_cameras(solved, scale2)
    else:
        rig = resting_target.place_cameras(cameras, solved, detections, geometry, scale2)
    joint = adjust_rig(rig, cameras, detections, geometry, moving=case.moving)
    validation = validate(rig, joint, cameras, detections, geometry, moving=case.moving)
    return Outcome(
        rig=rig,
        joint=joint,
        cameras=cameras,
        detections=detections,
        geometry=geometry,
        moving=case.moving,
        validation=validation,
    )


# A rig at rest of which every camera sees three sides of the box: enough perspective to check its focal length too.
AROUND = {
    name: looking_at(MIDDLE + np.array([1.8 * np.sin(a), 1.1, 1.8 * np.cos(a)]), MIDDLE)
    for name, a in (("a", 0.75), ("b", 2.3), ("c", 3.9), ("d", 5.45))
}
AT_REST = Case(moving=False, n_frames=6, poses=AROUND, true_map=box(0.6))


def with_focal(name: str, factor: float) -> Camera:
    camera = make_camera(name)
    return replace(camera, K=camera.K * np.where(np.eye(3) * [1, 1, 0], factor, 1.0))


def with_lens(name: str, k1: float) -> Camera:
    return replace(make_camera(name), distortion=np.array([k1, 0.0, 0.0, 0.0, 0.0]))


def shifted(geometry: Mapping[int, Array], marker: int, by_m: Array) -> dict[int, Array]:
    return {m: corners + by_m if m == marker else corners for m, corners in geometry.items()}


def sized(geometry: Mapping[int, Array], factor: float) -> dict[int, Array]:
    """Markers of another size at the same places."""
    return {m: c.mean(axis=0) + factor * (c - c.mean(axis=0)) for m, c in geometry.items()}


def stretched(geometry: Mapping[int, Array], factor: float) -> dict[int, Array]:
    """Markers printed wider than high."""
    wide: dict[int, Array] = {}
    for marker, corners in geometry.items():
        x = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
        along = (corners - corners.mean(axis=0)) @ x
        wide[marker] = corners + (factor - 1) * along[:, None] * x
    return wide


def value_of(quality: Quality, name: str) -> float:
    return next(check.value for check in quality.checks if check.name == name)


def told(quality: Quality) -> str:
    return " ".join(quality.reasons)


def worst_pair_mm(outcome: Outcome, truth: Mapping[str, Pose] = CAMERAS) -> float:
    rig = {name: p.T_world_cam for name, p in outcome.joint.rig.cameras.items()}
    return max(
        pose_error(invert_transform(rig[i]) @ rig[j], invert_transform(truth[i]) @ truth[j])[1]
        for i in rig
        for j in rig
    )


# --- good rigs ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", [Case(), AT_REST], ids=["moved", "at rest"])
@pytest.mark.parametrize("seed", range(3))
def test_a_good_rig_is_good(case: Case, seed: int) -> None:
    quality = calibrated(replace(case, seed=seed)).quality
    assert quality.verdict == "good", told(quality)
    assert all(check.passed for check in quality.checks)
    scale, intrinsics = quality.reasons  # what is taken for granted is said in any case
    assert "measure the side of one printed marker" in scale
    assert "half a percent of focal length" in intrinsics


def test_held_out_frames_of_a_good_rig_lie_as_far_off_as_noise() -> None:
    outcome = calibrated(Case())
    held = outcome.validation.held_out
    assert held is not None
    assert len(held.frames) == 3
    assert held.from_others
    assert set(held.median_px) == set(CAMERAS)
    # The median of 0.05 px in two dimensions is 0.059; the other cameras' prediction adds as much at most.
    for median_px in held.median_px.values():
        assert 0.04 < median_px < 0.12


def test_the_halves_of_good_rigs_differ_as_their_covariances_promise() -> None:
    found = [s.normalised for seed in range(4) for s in calibrated(Case(seed=seed, n_frames=12)).validation.odd_even]
    assert len(found) == 24
    # Six numbers a pair, mean one; three cameras' worth of independent pairs in four rigs: 72 numbers, and 2/72 is the
    # variance of their mean: 1 +- 0.17, four sigma, and small samples add a little.
    assert 0.3 < np.mean(found) < 1.9


def test_the_same_input_gives_the_same_numbers() -> None:
    a, b = calibrated(Case(n_frames=12)), calibrated(Case(n_frames=12))
    assert a.quality.as_dict() == b.quality.as_dict()
    assert a.validation.held_out == b.validation.held_out


# --- faults, each told by its own sentence --------------------------------------------------------------------------


def test_a_wrong_focal_length_is_bad_and_named() -> None:
    outcome = calibrated(Case(true_cameras={"b": with_focal("b", 1.03)}))
    # Reprojection would pass: the other numbers see it, and the poses are far off indeed.
    assert value_of(outcome.quality, "reprojection") < 0.5
    assert worst_pair_mm(outcome) > 30
    assert outcome.quality.verdict == "bad"
    assert "focal length of camera b that is about 2" in told(outcome.quality)
    assert "too short" in told(outcome.quality)


def test_a_wrong_focal_length_of_all_cameras_is_bad_and_named() -> None:
    outcome = calibrated(Case(true_cameras={name: with_focal(name, 0.97) for name in CAMERAS}))
    assert outcome.quality.verdict == "bad"
    assert "focal length of all cameras" in told(outcome.quality)
    assert "too long" in told(outcome.quality)


def test_a_wrong_lens_is_not_good_and_named() -> None:
    quality = calibrated(Case(true_cameras={name: with_lens(name, -0.1) for name in CAMERAS})).quality
    assert quality.verdict != "good"
    assert "grow with the distance from the image centre" in told(quality)


def test_a_marker_wrong_in_the_map_is_not_good_and_named() -> None:
    quality = calibrated(Case(told_map=shifted(BOX, 24, np.array([0.0, 0.01, 0.0])))).quality
    assert quality.verdict != "good"
    assert "Markers that lie farther off than all others: 24" in told(quality)


def test_markers_of_another_size_are_bad_and_named() -> None:
    quality = calibrated(Case(told_map=sized(BOX, 1.03))).quality
    assert quality.verdict == "bad"
    assert "smaller than the marker map says" in told(quality)


def test_a_print_stretched_in_one_direction_is_not_good_and_named() -> None:
    quality = calibrated(Case(true_map=stretched(BOX, 1.02), told_map=BOX)).quality
    assert quality.verdict != "good"
    assert "percent wider than they are in the marker map" in told(quality)


@pytest.mark.parametrize("moving", [True, False], ids=["moved", "at rest"])
@pytest.mark.parametrize("shift_mm", [3, 50])
def test_a_camera_bumped_half_way_is_not_good(moving: bool, shift_mm: float) -> None:
    case = Case(n_frames=24) if moving else replace(AT_REST, n_frames=12)
    bump = make_pose(exp_so3(np.array([0.0, shift_mm / 3000, 0.0])), np.array([shift_mm / 1000, 0.0, 0.0]))
    quality = calibrated(replace(case, bump={"b": (case.n_frames // 2, bump)})).quality
    assert quality.verdict != "good"
    assert any(word in told(quality) for word in ("Camera b was moved", "whether a camera", "pose: camera b"))


def test_two_groups_that_barely_share_frames_are_not_good() -> None:
    sees = {"a": range(0, 9), "b": range(0, 9), "c": range(7, 16), "d": range(7, 16)}
    outcome = calibrated(Case(sees=sees))
    assert outcome.quality.verdict == "usable"
    assert outcome.validation.held_out is None  # nothing can be spared
    assert "The rig hangs on 2 frames that cameras" in told(outcome.quality)


@pytest.mark.parametrize("case", [Case(), AT_REST], ids=["moved", "at rest"])
def test_a_camera_with_a_single_view_is_not_good(case: Case) -> None:
    quality = calibrated(replace(case, sees={"b": [3]})).quality
    assert quality.verdict == "usable"
    assert "Camera b has only one view" in told(quality)


# --- small residuals prove nothing ----------------------------------------------------------------------------------


def test_a_rig_at_rest_that_nothing_checks_is_never_good_however_small_its_residuals() -> None:
    # Each camera sees one side; one side is 0.2 m from where the map has it, and no image can tell.
    geometry = box(0.6)
    only = {"a": [24], "b": [26], "c": [22], "d": [25]}
    case = replace(AT_REST, only=only, poses=CAMERAS, told_map=shifted(geometry, 22, np.array([0.2, 0.0, 0.0])))
    outcome = calibrated(replace(case, true_map=geometry, n_frames=20))
    assert len(outcome.joint.rig.cameras) >= 2
    assert value_of(outcome.quality, "reprojection") < 0.1
    assert outcome.quality.verdict != "good"
    assert "Nothing independent checks" in told(outcome.quality)


def test_a_focal_length_that_no_view_could_refute_keeps_a_rig_from_being_good() -> None:
    # Camera a sees the box at rest nearly face on: three percent of its focal length are 60 mm of its distance.
    case = Case(moving=False, n_frames=6, true_cameras={"a": with_focal("a", 1.03)})
    outcome = calibrated(case)
    assert worst_pair_mm(outcome) > 30
    # Lengths between cameras look right: rays turn about the very corners that they are tested on.
    assert value_of(outcome.quality, "reprojection") < 0.1
    assert value_of(outcome.quality, "length error") < 1.0
    assert outcome.quality.verdict != "good"
    assert "A focal length of camera a" in told(outcome.quality)


def test_a_map_wrong_by_one_factor_is_seen_by_nothing_and_therefore_always_mentioned() -> None:
    scaled = {marker: 1.05 * corners for marker, corners in BOX.items()}
    quality, true = calibrated(Case(told_map=scaled)).quality, calibrated(Case()).quality
    for name in ("reprojection", "held-out reprojection", "length scale error", "ray miss"):
        # The same images under the same poses, 1.05 times as large: the optimum is the same to the solver's tolerance.
        np.testing.assert_allclose(value_of(quality, name), value_of(true, name), rtol=0.02)
    assert "wrong by one factor" in told(quality)


def test_a_single_camera_is_measured_within_itself_and_never_good() -> None:
    for case in (Case(), AT_REST):
        outcome = calibrated(replace(case, poses={"a": case.poses["a"]}))
        held = outcome.validation.held_out
        assert held is not None
        assert not held.from_others
        # A quarter of the corners predicts the rest to a few times their noise.
        assert held.all_median_px < 0.5
        assert outcome.quality.verdict == "usable"
        assert "a single camera has nobody to disagree with" in told(outcome.quality)


def test_cameras_under_the_floor_are_told() -> None:
    outcome = calibrated(AT_REST)
    rig = outcome.joint.rig
    depth = depth_below_target(rig, outcome.geometry)
    assert max(depth.values()) < 0
    mirrored = depth_below_target(rig, outcome.geometry, up=(0.0, -1.0, 0.0))
    quality = quality_of(outcome.validation, below_target_m=mirrored)
    assert quality.verdict != "good"
    assert "upside down or mirrored" in told(quality)
    assert "--ground-face" in told(quality)
    by_imu = quality_of(outcome.validation, below_target_m=mirrored, up_by_imu=True)
    assert "--ground-face" not in told(by_imu)
    assert "--up-from target" in told(by_imu)
