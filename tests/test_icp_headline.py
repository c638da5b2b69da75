"""What is said of a whole rig whose clouds were registered, and that results are built as existing users build them."""

from __future__ import annotations

import dataclasses
import inspect
import math
from typing import Any

import numpy as np
import pytest

from aruco.icp_headline import (
    FLOOR_SIGMAS_95,
    RigParts,
    by_far,
    message_of,
    reference_of_part,
    remarks_of,
    too_few,
    warnings_of,
    why_nothing,
)
from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics, ICPResult, Refusal

ONE_PART = RigParts(parts=[("a", "b", "c")], alone=[])


def kept(refusal: Refusal, **figures: Any) -> CameraMove:
    return CameraMove(accepted=False, reason="because", refusal=refusal, **figures)


def metrics(**moves: CameraMove) -> ICPMetrics:
    return ICPMetrics(True, 6, 5, len(moves), 0, {}, "a", cameras={"a": kept("reference"), **moves})


MOVED = CameraMove(accepted=True, reason="", rotation_deg=0.3, translation_mm=5.0)


def test_the_headline_counts_who_moved_and_why_others_did_not() -> None:
    found = metrics(b=MOVED, c=kept("unproved"), d=kept("unproved"), e=kept("prior"))
    assert message_of(found) == (
        "5 of 6 overlapping pairs of clouds meet; 1 of 5 cameras moved, by up to 0.30 degrees and 5.0 mm against "
        "camera a, the reference; 3 kept (2 not proved to be better, 1 against what is known of the given pose)."
    )
    # A camera that was found elsewhere is told of beside the headline.
    assert "1 of 2 cameras moved against camera a" in message_of(metrics(b=MOVED), "b")
    assert message_of(metrics(b=MOVED)).endswith("none keeps its pose but the reference.")
    assert message_of(metrics(b=kept("floor"))) == (
        "5 of 6 overlapping pairs of clouds meet; every camera keeps its pose (1 floor would not stay level)."
    )
    nothing = dataclasses.replace(metrics(b=kept("unlinked")), num_pairs_converged=0)
    assert message_of(nothing).startswith("0 of 6 overlapping pairs of clouds meet well enough")


@pytest.mark.parametrize("refusal", ["prior", "too_far"])
def test_a_camera_that_stands_elsewhere_is_warned_of_with_what_to_do(refusal: Refusal) -> None:
    found = metrics(b=kept(refusal, rotation_deg=2.1, translation_mm=57.0, prior_sigmas=9.4), c=kept("unproved"))
    (warning,) = warnings_of(found, ONE_PART, ICPConfig())
    for word in ("Camera b (2.10 degrees and 57 mm", "reference a", "calibrate what was bumped", "--icp-global-init"):
        assert word in warning
    assert ("9.4 sigma" in warning) == (refusal == "prior")
    # Wider bounds do not help against what is known of a pose.
    assert ("--max-rotation-deg" in warning) == (refusal == "too_far")
    (looked,) = warnings_of(found, ONE_PART, ICPConfig(global_init=True))
    assert "--icp-global-init" not in looked
    both = dataclasses.replace(found, cameras={**found.cameras, "d": found.cameras["b"]})
    (of_two,) = warnings_of(both, ONE_PART, ICPConfig())
    assert "Cameras b (" in of_two
    assert "), d (" in of_two


def test_of_several_that_stand_elsewhere_the_one_by_far_is_named() -> None:
    small, large = ({"rotation_deg": 0.06, "translation_mm": 5.0}, {"rotation_deg": 0.34, "translation_mm": 39.0})
    b, c, d = kept("prior", **small), kept("prior", **large), kept("prior", **small)
    (warning,) = warnings_of(metrics(b=b, c=c, d=d), ONE_PART, ICPConfig())
    assert warning.startswith("Camera c (0.34 degrees and 39 mm")
    assert warning.endswith("b, d would move much less, most likely along with it.")
    assert by_far({"b": b, "c": c, "d": d}) == "c"
    # Others that ask for about as much may be right, and the reference wrong.
    half = kept("prior", rotation_deg=0.2, translation_mm=20.0)
    assert by_far({"b": half, "c": c}) is None
    assert by_far({}) is None
    assert by_far({"c": c}) is None


@pytest.mark.parametrize("refusal", ["depth", "misfit"])
def test_a_move_beyond_the_bounds_is_warned_of_whatever_it_was_refused_for(refusal: Refusal) -> None:
    far, near = (kept(refusal, rotation_deg=deg, translation_mm=50.0) for deg in (12.3, 0.5))
    (warning,) = warnings_of(metrics(b=far), ONE_PART, ICPConfig())
    assert "Camera b (12.30 degrees" in warning
    assert not warnings_of(metrics(b=near), ONE_PART, ICPConfig())


def test_clouds_that_overlap_and_do_not_meet_are_warned_of() -> None:
    nothing = dataclasses.replace(metrics(b=kept("unlinked")), num_pairs_converged=0)
    (warning,) = warnings_of(nothing, ONE_PART, ICPConfig(min_fitness=0.4))
    assert "40 %" in warning
    assert "--icp-global-init" in warning
    (looked,) = warnings_of(nothing, ONE_PART, ICPConfig(global_init=True))
    assert "--icp-global-init" not in looked
    # Where nothing overlaps the message says it.
    assert not warnings_of(dataclasses.replace(nothing, num_pairs_attempted=0), ONE_PART, ICPConfig())


def test_a_rig_in_parts_is_warned_of() -> None:
    found = metrics(b=MOVED, c=kept("unproved"))
    assert not warnings_of(found, ONE_PART, ICPConfig())
    (warning,) = warnings_of(found, RigParts(parts=[("a", "b"), ("c", "d", "e")], alone=["f"]), ICPConfig())
    assert "in 3 parts whose clouds do not overlap: a and b; c, d, e; f." in warning
    assert "nothing was learnt" in warning
    assert "(d, e besides)" in reference_of_part(["d", "e"])


def test_a_floor_that_lies_otherwise_is_remarked_only_beyond_chance() -> None:
    off = {"floor_tilt_deg": 0.12, "floor_rise_m": -0.0043}
    beyond = dataclasses.replace(metrics(b=MOVED), floor_sigmas=1.1 * FLOOR_SIGMAS_95, **off)
    (remark,) = remarks_of(beyond)
    assert "0.12 degrees and -4.3 mm" in remark
    # As the warning of levelling again with the same depth has it.
    assert "once more, without --icp" in remark
    assert "count its floor twice" in remark
    assert not remarks_of(dataclasses.replace(beyond, floor_sigmas=0.9 * FLOOR_SIGMAS_95))
    assert not remarks_of(dataclasses.replace(beyond, floor_sigmas=math.nan))
    # Where nothing moved the floor is where levelling has put it.
    assert not remarks_of(dataclasses.replace(beyond, cameras={"b": kept("unproved")}))


def test_an_estimate_that_did_not_come_to_rest_is_remarked() -> None:
    assert not remarks_of(metrics())
    (remark,) = remarks_of(dataclasses.replace(metrics(), settled=False))
    assert "max_iterations" in remark


def test_too_few_samples_name_the_count_and_what_to_change() -> None:
    told = too_few(83, 100, ICPConfig(voxel_size=0.5))
    for word in ("83 samples", "0.5 m", "want 100", "--icp-voxel-size", "hybrid"):
        assert word in told
    both = why_nothing(2, 0, {"a": told, "b": too_few(7, 100, ICPConfig())}, ICPConfig())
    for word in ("a: 83 samples", "b: 7 samples", "--icp-voxel-size"):
        assert word in both
    assert "a pose of 1" in why_nothing(1, 0, {}, ICPConfig())
    assert "No two cameras' clouds overlap" in why_nothing(2, 2, {}, ICPConfig())


# -- the contract with existing users: shared/contract.md lists names, order and defaults


def test_configuration_results_and_metrics_keep_their_order_and_defaults() -> None:
    config = ICPConfig(0.02, [50, 30, 14], "point_to_plane", 0.3, 0.3, 1.0, 0.5, 10.0, 1.4, 5.0, 0.1)
    assert config == ICPConfig()
    result = ICPResult(np.eye(4), 0.5, 0.01, np.eye(6), True)
    assert (result.fitness, result.inlier_rmse, result.converged) == (0.5, 0.01, True)
    wanted = "success num_pairs_attempted num_pairs_converged num_cameras_optimized num_disconnected "
    wanted += "per_pair_results reference_camera message"
    parameters = inspect.signature(ICPMetrics).parameters.values()
    assert [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD] == wanted.split()
    assert ICPMetrics(True, 6, 5, 4, 0, {}, "a", "done").message == "done"
    for kind in (ICPConfig, ICPResult, ICPMetrics):
        more = [p for p in inspect.signature(kind).parameters.values() if p.kind is p.KEYWORD_ONLY]
        assert more
        assert all(p.default is not p.empty for p in more)
