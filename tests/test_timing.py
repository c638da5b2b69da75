"""Frames taken apart: jitter and late clocks are found with their sizes, and no other fault is taken for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from joint_rigs import MIDDLE, board, exchanged, ring
from joint_rigs import SimRig as Rig
from marker_pictures import make_camera
from target_views import any_pose, box, looking_at, sight

from aruco import lens
from aruco.model import Camera, Detection
from aruco.pose_math import Pose, exp_so3, invert_transform, make_pose, transform_points
from rigcal.quality import moving_views
from rigcal.quality import timing as timing_module
from rigcal.quality.moving_views import Seen
from rigcal.quality.timing import Timing, find_timing
from rigcal.solve.adjust import Gauge
from rigcal.solve.joint import adjust_rig
from rigcal.solve.judge import adjust_judging
from rigcal.solve.problem import Poses
from rigcal.validation import Validation, validate
from rigcal.verdict import quality_of

NAMES = ("c0", "c1", "c2", "c3")
NOISE_PX = 0.07
BOARD = board(5, 4, 0.13)
# Half a turn about z: images have y down, the world has it up.
UPRIGHT = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Case:
    """A recording of a target in motion."""

    kind: str = "board"
    seed: int = 0
    hz: float = 10.0
    n_frames: int = 30
    speed: float = 0.35  # m/s and, nearly, rad/s
    jitter_s: float = 0.0  # standard deviation
    lag_s: float = 0.0  # of camera c1
    true_cameras: Mapping[str, Camera] = field(default_factory=dict)
    bump: Pose = field(default_factory=lambda: np.eye(4))  # of camera c2, after two fifths
    swaps: int = 0
    rests: bool = False  # between moves of no time
    n_cameras: int = 4


def trajectory(case: Case, rng: np.random.Generator) -> Callable[[float], Pose]:
    """Time [s] -> T_world_target: two sines of 2 to 7 s in every direction, as a hand moves."""
    w, phase = 2 * np.pi * rng.uniform(0.15, 0.45, (2, 6)), rng.uniform(0, 2 * np.pi, (2, 6))
    amplitude = rng.uniform(0.5, 1.0, (2, 6))
    rate = np.sqrt(((amplitude * w) ** 2 / 2).sum(axis=0))
    size = case.speed * np.repeat([2.7, 1.0], 3) / np.sqrt(3)
    start = UPRIGHT if case.kind == "board" else any_pose(rng)[:3, :3]

    def at(t: float) -> Pose:
        x = (amplitude * np.sin(w * t + phase)).sum(axis=0) / rate * size
        return make_pose(exp_so3(x[:3]) @ start, MIDDLE + x[3:])

    return at


def sighted(camera: Camera, T_cam_target: Pose, case: Case, rng: np.random.Generator) -> Detection:
    if case.kind == "box":
        return sight(camera, T_cam_target, box(0.6), NOISE_PX, rng)
    pixels = lens.project(camera, transform_points(T_cam_target, np.concatenate(list(BOARD.values()))))
    inside = ((pixels > 5) & (pixels < [camera.width - 6, camera.height - 6])).all(axis=1)
    noisy = (pixels + NOISE_PX * rng.standard_normal(pixels.shape))[inside]
    return Detection(ids=np.flatnonzero(inside), corners_px=noisy[:, None], sigma_px=np.full((len(noisy), 1), NOISE_PX))


def recorded(case: Case) -> Rig:
    rng = np.random.default_rng(case.seed)
    at = trajectory(case, rng)
    if case.kind == "box":
        places = ring(4, 2.4, rng)
    else:
        across = enumerate((-1.0, -0.35, 0.35, 1.0))
        places = [looking_at(np.array([x, 0.6 + 0.2 * (-1) ** k, -2.0]), MIDDLE) for k, x in across]
    names = NAMES[: case.n_cameras]
    seen: dict[str, dict[int, Detection]] = {name: {} for name in names}
    for name, T in zip(names, places):
        for f in range(case.n_frames):
            # Uniform, so that the largest is 1.7 times the standard deviation.
            t = f / case.hz + np.sqrt(3) * case.jitter_s * rng.uniform(-1, 1) + case.lag_s * (name == "c1")
            target = at(2 * np.floor(t / 2) if case.rests else t)
            moved = T @ case.bump if name == "c2" and f >= 2 * case.n_frames // 5 else T
            camera = case.true_cameras.get(name, make_camera(name))
            if len(found := sighted(camera, invert_transform(moved) @ target, case, rng)):
                seen[name][f] = found
    truth = Poses(np.array(places[: len(names)]), np.array([at(f / case.hz) for f in range(case.n_frames)]))
    rig = Rig(
        cameras=tuple(make_camera(name) for name in names),
        detections=seen,
        geometry=BOARD if case.kind == "board" else box(0.6),
        truth=truth,
        frames=tuple(range(case.n_frames)),
    )
    for _ in range(case.swaps):
        first = int(rng.integers(2, case.n_frames - 3))
        if {first, first + 1} <= rig.detections["c3"].keys():
            rig = exchanged(rig, "c3", first, first + 1)
    return rig


def adjusted(case: Case) -> Seen:
    """All views, also rejected ones, under the adjusted poses."""
    rig = recorded(case)
    sightings = rig.sightings()
    gauge = Gauge(np.arange(case.n_cameras) == 0, np.zeros(len(sightings.frames), dtype=bool))
    start = Poses(rig.truth.T_world_cam, rig.truth.T_world_target[list(sightings.frames)])
    poses = adjust_judging(sightings, start, gauge).adjustment.poses
    return Seen(
        cameras=rig.cameras,
        T_world_cam=poses.T_world_cam,
        T_world_target=poses.T_world_target,
        times=np.array(sightings.frames, dtype=np.float64),
        camera=sightings.view_camera[sightings.corner_view],
        frame=sightings.view_frame[sightings.corner_view],
        marker=sightings.marker,
        points=sightings.points,
        pixels=sightings.pixels,
        period_s=1 / case.hz,
    )


def sure(case: Case) -> Timing:
    timing = find_timing(adjusted(case))
    assert timing is not None
    return timing


def with_focal(name: str, factor: float) -> Camera:
    camera = make_camera(name)
    return replace(camera, K=camera.K * np.where(np.eye(3) * [1, 1, 0], factor, 1.0))


def with_lens(name: str, k1: float) -> Camera:
    return replace(make_camera(name), distortion=np.array([k1, 0.0, 0.0, 0.0, 0.0]))


def bumped_by(shift_mm: float) -> Pose:
    return make_pose(exp_so3(np.array([0.0, shift_mm / 3000, 0.0])), np.array([shift_mm / 1000, 0.0, 0.0]))


# --- what is there is found -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "jitter_ms", "hz"),
    [("board", 10, 10), ("box", 20, 10), ("board", 40, 10), ("box", 20, 30), ("board", 40, 30)],
)
def test_jitter_is_found_with_its_size(kind: str, jitter_ms: float, hz: float) -> None:
    case = Case(kind=kind, hz=hz, jitter_s=jitter_ms / 1000, n_frames=30 if hz < 20 else 50, seed=1)
    timing = sure(case)
    assert timing.is_clear
    # A hundred differences know a standard deviation to 7 percent; jitter itself makes velocities from neighbours
    # wrong, the more the longer it is against them.
    assert timing.jitter == pytest.approx(jitter_ms / 1000 * hz, rel=0.25)
    assert not timing.clocks
    assert "apart from those of the others while the target moved: move it more slowly" in timing.sentence


@pytest.mark.parametrize("kind", ["board", "box"])
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("lag_ms", [-40, 15])
def test_a_late_clock_is_found_with_its_size(kind: str, seed: int, lag_ms: float) -> None:
    timing = sure(Case(kind=kind, seed=seed, lag_s=lag_ms / 1000))
    assert timing.is_clear
    assert set(timing.clocks) == {"c1"}
    # The adjustment gives in to the lag here and there, and the target does not move evenly: 3 ms.
    assert timing.offset["c1"] == pytest.approx(lag_ms / 100, abs=0.03)
    assert timing.jitter < 0.03
    way = "later" if lag_ms > 0 else "earlier"
    told = f"camera c1 about {100 * abs(timing.offset['c1']):.0f} ms {way} than by the others"
    assert told in timing.sentence


def test_a_clock_and_jitter_are_told_apart() -> None:
    timing = sure(Case(lag_s=0.04, jitter_s=0.01, seed=2))
    assert timing.is_clear
    assert set(timing.clocks) == {"c1"}
    assert timing.offset["c1"] == pytest.approx(0.4, abs=0.05)
    assert timing.jitter == pytest.approx(0.1, rel=0.3)
    assert "single frames scatter by" in timing.sentence


def test_without_times_shares_of_frame_periods_are_told() -> None:
    timing = replace(sure(Case(lag_s=0.04)), period_s=0.0)
    assert "about 0.40 frame periods later" in timing.sentence or "about 0.41 frame periods later" in timing.sentence


def test_of_two_cameras_residuals_alone_show_too_little() -> None:
    case = Case(kind="box", lag_s=0.02, n_frames=40, n_cameras=2)
    timing = sure(case)
    assert timing.is_clear
    assert timing.clocks == {"c1": pytest.approx(0.2, abs=0.02)}
    # The naive way: residuals over velocities, under targets and cameras that have followed the views.
    seen = adjusted(case)
    naive = [
        np.median(
            [-float(v.velocity @ v.r / (v.velocity @ v.velocity)) for _, v in moving_views._views_of(seen, c, 1, 1)]
        )
        for c in (0, 1)
    ]
    assert naive[1] - naive[0] < 0.8 * 0.2


# --- what is something else is not taken for it ---------------------------------------------------------------------

NULLS: dict[str, Case] = {
    "nothing": Case(),
    "resting": Case(rests=True, jitter_s=0.02),
    "focal length": Case(true_cameras={"c1": with_focal("c1", 1.03)}),
    "all focal lengths": Case(true_cameras={name: with_focal(name, 0.97) for name in NAMES}),
    "lens": Case(true_cameras={name: with_lens(name, -0.1) for name in NAMES}),
    "bumped a little": Case(bump=bumped_by(3)),
    "bumped": Case(bump=bumped_by(15)),
    "bumped a lot": Case(bump=bumped_by(50)),
    "exchanged": Case(swaps=2),
    "exchanged often": Case(swaps=5),
}


@pytest.mark.parametrize("fault", NULLS)
def test_other_faults_are_not_told_as_time(fault: str) -> None:
    # Forty rigs, four of each fault. None comes near: of 400 more the worst reached a quarter of what is needed.
    for seed in range(4):
        timing = sure(replace(NULLS[fault], kind=("board", "box")[seed % 2], seed=seed))
        assert not timing.is_clear
        assert timing.times_better < 0.5 * timing.needed


def test_the_control_of_turned_velocities_alone_would_blame_time_for_bumped_cameras(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(timing_module, "_moved", lambda frames, n_cam: np.inf)
    # A board that goes to and fro in the direction of the bump.
    case = replace(NULLS["bumped"], seed=9)
    assert sure(case).is_clear
    monkeypatch.undo()
    assert not sure(case).is_clear


def test_places_far_apart_say_nothing_about_time() -> None:
    # Ten times as fast: two frames lie half a turn of the motion apart.
    timing = find_timing(adjusted(Case(speed=1.0, hz=0.5, jitter_s=0.02)))
    assert timing is None or not timing.is_clear


# --- the verdict ----------------------------------------------------------------------------------------------------


def judged(case: Case) -> tuple[Validation, str]:
    rig = recorded(case)
    start = rig.estimate(rig.truth)
    joint = adjust_rig(start, rig.cameras, rig.detections, rig.geometry, moving=True)
    times_s = {f: f / case.hz for f in rig.frames}
    found = validate(start, joint, rig.cameras, rig.detections, rig.geometry, moving=True, times_s=times_s)
    return found, " ".join(quality_of(found).reasons)


def test_a_late_clock_is_told_first_even_of_a_camera_that_was_lost_for_it() -> None:
    found, told = judged(Case(lag_s=0.04))
    assert "c1" in found.adjusted.rig.lost
    assert found.timing is not None
    assert set(found.timing.clocks) == {"c1"}
    assert told.startswith("Frames that count as simultaneous were taken by camera c1 about 4")


def test_jitter_is_told_first_and_blames_no_camera() -> None:
    _, told = judged(Case(jitter_s=0.02, seed=1))
    assert told.startswith("Frames of camera c")
    assert "was moved during the recording" not in told
    assert "The residuals" not in told


def test_a_bumped_camera_is_still_told_as_such() -> None:
    _, told = judged(Case(bump=bumped_by(15), seed=1))
    assert "count as simultaneous" not in told
    assert "apart from those of the others" not in told
    assert "c2" in told
