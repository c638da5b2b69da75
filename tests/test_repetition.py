"""Frames that repeat a place are no new knowledge."""

from __future__ import annotations

import numpy as np
import pytest
from joint_rigs import board_rig

from aruco.pose_math import exp_se3
from rigcal.solve import adjust as solver
from rigcal.solve.adjust import Adjustment, Gauge, adjust
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
