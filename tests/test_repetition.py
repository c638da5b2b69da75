"""Frames that repeat a place are no new knowledge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from joint_rigs import SimRig, board_rig, box_rig, flat

from aruco.pose_math import exp_se3
from rigcal.solve import adjust as solver
from rigcal.solve import repetition as counting
from rigcal.solve.adjust import KAPPA, Adjustment, Gauge, adjust, degrees_of_freedom, residual_variance
from rigcal.solve.problem import Poses, gather
from rigcal.solve.repetition import SAME_PLACE_M, places


def test_a_place_lasts_until_the_target_has_moved() -> None:
    shifts = [0.0, 0.3, 0.9, 1.5, 1.6, 40.0, 40.1, 0.0]  # in SAME_PLACE_M
    T = np.array([exp_se3(np.array([0, 0, 0, SAME_PLACE_M * s, 0, 0])) for s in shifts])
    assert places(T).tolist() == [0, 0, 0, 1, 1, 2, 2, 0]
    turned = np.array([exp_se3(np.array([0, angle, 0, 0, 0, 0])) for angle in (0.0, 0.02, 0.06)])
    assert places(turned).tolist() == [0, 0, 1]
    assert places(np.empty((0, 4, 4))).tolist() == []


def repeated(times: int) -> Adjustment:
    """A board in ten places, seen ``times`` times in each with the same corner errors."""
    rig = board_rig(np.random.default_rng(5), n_frame=10)
    seen = {
        name: {f * times + k: d for f, d in mine.items() for k in range(times)} for name, mine in rig.detections.items()
    }
    start = Poses(rig.truth.T_world_cam, np.repeat(rig.truth.T_world_target, times, axis=0))
    gauge = Gauge(np.arange(4) == 0, np.zeros(10 * times, dtype=bool))
    return adjust(gather(rig.cameras, seen, rig.geometry), start, gauge)


def test_the_same_errors_again_do_not_make_it_surer() -> None:
    # Twelve times the corners promise a twelfth of the variance; what is known is what one frame a place knows.
    ratio = np.trace(repeated(12).covariance) / np.trace(repeated(1).covariance)
    assert ratio == pytest.approx(1.0, abs=0.35)


def test_without_places_it_would_be_twelve_times_too_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solver, "places", lambda T: np.arange(len(T)))
    assert np.trace(repeated(12).covariance) < 0.3 * np.trace(repeated(1).covariance)


# --- what carries the world has no witness --------------------------------------------------------------------------


def factor(rig: SimRig, found: Adjustment, gauge: Gauge) -> float:
    """How much larger the variance is than the residuals alone say."""
    dof = degrees_of_freedom(rig.sightings(), gauge)
    return found.variance / residual_variance((found.residuals**2).sum(axis=1), dof, KAPPA * found.scale)


@pytest.mark.parametrize("n_frame", [1, 8], ids=["resting", "moved"])
def test_a_single_camera_has_nothing_to_repeat(n_frame: int) -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        rig = box_rig(rng, n_cam=1, n_frame=n_frame)
        found = adjust(rig.sightings(), rig.start(rng), rig.gauge())
        # Not a ratio of two rounding errors, which would be anything from 1 to 1e10.
        assert factor(rig, found, rig.gauge()) == pytest.approx(1.0, abs=1e-12)


def test_the_last_camera_that_views_are_left_of_has_nothing_to_repeat() -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        rig = box_rig(rng, n_cam=2, n_frame=4)
        rig = rig.with_detections({"c0": rig.detections["c0"]})
        gauge = Gauge(flat(2, 1), flat(4, 0))
        found = adjust(rig.sightings(), rig.start(rng), gauge)
        assert factor(rig, found, gauge) == pytest.approx(1.0, abs=1e-12)


def factors(n_cam: int) -> list[float]:
    """Of views that err as a whole, with the world carried by the first frame, by the second, and by a camera."""
    n_frame = 40
    rng = np.random.default_rng(3)
    rig = box_rig(rng, n_cam=n_cam, n_frame=n_frame)
    shaken = {
        name: {f: replace(d, corners_px=d.corners_px + 0.2 * rng.standard_normal(2)) for f, d in views.items()}
        for name, views in rig.detections.items()
    }
    rig = rig.with_detections(shaken)
    gauges = [Gauge(flat(n_cam, -1), flat(n_frame, f)) for f in (0, 1)]
    gauges.append(Gauge(flat(n_cam, 0), flat(n_frame, -1)))
    return [factor(rig, adjust(rig.sightings(), rig.truth, gauge), gauge) for gauge in gauges]


@pytest.mark.parametrize("n_cam", [2, 4])
@pytest.mark.parametrize("most", [100, 10], ids=["all places", "every fourth place"])
def test_repetition_does_not_depend_on_what_carries_the_world(
    n_cam: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(counting, "MAX_PLACES", most)
    by_first, by_second, by_camera = factors(n_cam)
    assert by_camera > 3  # there is something to find
    # The scale settles to 2 % of itself, from another side with another gauge; the factor moves by less than it.
    assert by_first == pytest.approx(by_camera, rel=0.02)
    assert by_second == pytest.approx(by_camera, rel=0.02)


def test_it_would_depend_on_it_if_the_held_frame_were_a_place_like_others(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(counting, "MAX_PLACES", 10)
    monkeypatch.setattr(Gauge, "without_frames", lambda gauge: gauge)
    by_first, _, by_camera = factors(2)
    assert by_first < 0.5 * by_camera
