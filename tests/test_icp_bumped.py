"""A camera that was bumped is taken up where it is found, and a place that is refused leaves no trace."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from floor_rooms import BASELINE_M, ROOM, cameras, depth_image, zoomed
from icp_rooms import box, clouds_of

from aruco import icp_bumped, icp_looking
from aruco.floor_model import centre_jacobian
from aruco.floor_plane import FloorPlane
from aruco.icp_bumped import Answer, found_prior, looked_for
from aruco.icp_looking import Looked
from aruco.icp_registration import refine_with_icp
from aruco.icp_solve import Prior, register
from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics
from aruco.pose_math import Array, Pose, exp_so3, make_pose, pose_distance

UP = np.array([0.0, 1.0, 0.0])
PLANE = FloorPlane(normal=UP, d=0.0)
BUMP_DEG, BUMP_M = 20.0, 0.4
LOOKING = ICPConfig(global_init=True)
# What is asked of a bumped camera that is moved back.
BACK_DEG, BACK_MM = 0.3, 10.0


def _bumped(T: Pose, axis: Array = UP) -> Pose:
    """Turned about its own centre, and shifted."""
    direction = np.array([0.6, 0.1, -0.8])
    shift = BUMP_M * direction / np.linalg.norm(direction)
    return make_pose(exp_so3(math.radians(BUMP_DEG) * axis / np.linalg.norm(axis)) @ T[:3, :3], T[:3, 3] + shift)


def _errors(T: Pose, truth: Pose) -> tuple[float, float]:
    """Degrees, millimetres."""
    angle, distance = pose_distance(T, truth)
    return math.degrees(angle), 1e3 * distance


def _covariance(T: Pose) -> Array:
    """(6, 6) of a pose that markers are said to tell to 0.1 degrees and 4 mm."""
    back = centre_jacobian(T[:3, 3], inverse=True)
    return back @ np.diag([math.radians(0.1) ** 2] * 3 + [0.004**2] * 3) @ back.T


def _places(*shifts_m: float) -> list[Pose]:
    return [make_pose(np.eye(3), np.array([shift, 0.0, 0.0])) for shift in shifts_m]


class Furnished:
    """Cameras around furniture in a room with walls, and what each measured."""

    def __init__(self) -> None:
        walls = (
            *ROOM,
            *box((-0.5, 0.0, -0.2), (0.3, 0.7, 0.4)),
            *box((0.7, 0.0, -1.3), (1.2, 0.5, -0.6)),
            *box((-1.4, 0.0, 0.8), (-0.9, 0.9, 1.5)),
            *box((0.4, 0.0, 1.0), (1.0, 0.4, 1.4)),
        )
        self.truth = cameras(3)
        # Of 960 x 540: errors of depth that neighbours share reach over so many pixels that small images hold little.
        self.data: dict[str, dict[str, Any]] = {
            name: {
                "depth": depth_image(T, walls, seed=k, zoom=3),
                "K": zoomed(3),
                "baseline": BASELINE_M / 3,
                "n_frames": 20,
            }
            for k, (name, T) in enumerate(self.truth.items())
        }

    def refined(self, start: Mapping[str, Pose], config: ICPConfig) -> Answer:
        floors = dict.fromkeys(self.truth, PLANE)
        covariances = {name: _covariance(T) for name, T in start.items()}
        return refine_with_icp(self.data, start, floors, config, covariances=covariances)


@pytest.fixture(scope="module")
def furnished() -> Furnished:
    return Furnished()


# --------------------------------------------------------------------------------------------------- the whole of it


def test_a_bumped_camera_comes_back(furnished: Furnished) -> None:
    truth = furnished.truth
    start = {**truth, "cam1": _bumped(truth["cam1"], np.array([0.3, 1.0, -0.2]))}
    poses, metrics = furnished.refined(start, LOOKING)
    degrees, mm = _errors(poses["cam1"], truth["cam1"])
    assert degrees < BACK_DEG
    assert mm < BACK_MM
    move = metrics.cameras["cam1"]
    assert move.accepted
    assert "its surroundings place it" in move.reason
    # Told is the way from where it was said to stand.
    assert move.rotation_deg == pytest.approx(BUMP_DEG, abs=BACK_DEG)
    assert move.translation_mm == pytest.approx(1e3 * BUMP_M, abs=BACK_MM)
    assert "Found elsewhere than they were said to stand, and moved there: cam1 (by " in metrics.message
    # The others stood well, and do.
    for name in truth.keys() - {"cam1"}:
        assert _errors(poses[name], truth[name])[1] < 2.0
    # Clouds alone do not bring it back, however far it may be moved: what is known of its given pose forbids it.
    far = ICPConfig(max_rotation_deg=40.0, max_translation_m=1.0)
    missed, _ = furnished.refined(start, far)
    degrees, mm = _errors(missed["cam1"], truth["cam1"])
    assert degrees > BACK_DEG
    assert mm > BACK_MM


def test_a_bumped_reference_is_named_and_nobody_is_moved_for_it(furnished: Furnished) -> None:
    truth = furnished.truth
    start = {**truth, "cam0": _bumped(truth["cam0"])}
    poses, metrics = furnished.refined(start, LOOKING)
    assert "The reference, cam0, contradicts the others" in metrics.message
    reason = metrics.cameras["cam0"].reason
    assert "those of cam1, cam2, which agree among themselves, and they place it 2" in reason
    assert "calibrate it again, or rename it" in reason
    for name, T in start.items():
        assert _errors(poses[name], T)[1] < BACK_MM
        assert _errors(poses[name], T)[0] < BACK_DEG


def test_nothing_changes_where_nobody_was_bumped(furnished: Furnished, monkeypatch: pytest.MonkeyPatch) -> None:
    turn = exp_so3(np.array([0.0, 0.004, 0.0]))
    start = {n: make_pose(turn @ T[:3, :3], T[:3, 3]) if n == "cam2" else T for n, T in furnished.truth.items()}
    poses, metrics = furnished.refined(start, LOOKING)
    plain, plain_metrics = furnished.refined(start, ICPConfig())
    for name, T in plain.items():
        assert poses[name].tobytes() == T.tobytes()
        assert metrics.cameras[name].reason == plain_metrics.cameras[name].reason
        assert metrics.covariances[name].tobytes() == plain_metrics.covariances[name].tobytes()
    assert metrics.message == plain_metrics.message
    # Nor by a wrong proposal, which is refused.
    wrong = make_pose(start["cam2"][:3, :3], start["cam2"][:3, 3] + [0.25, 0.0, 0.25])
    monkeypatch.setattr(icp_bumped, "looked_at", lambda *_: Looked(found={"cam2": wrong}))
    poses, metrics = furnished.refined(start, LOOKING)
    for name, T in plain.items():
        assert poses[name].tobytes() == T.tobytes()
    assert "A place 0.00 degrees and 353.6 mm from where it was said to stand" in metrics.cameras["cam2"].reason
    assert metrics.message.endswith("Found elsewhere, but kept where they were said to stand: cam2.")


# ------------------------------------------------------------------------------------------------- who is looked for


def _refined_as_given(poses: Mapping[str, Pose]) -> Any:
    def refined(elsewhere: Mapping[str, Pose]) -> Answer:
        return _answer({**poses, **elsewhere}, {*elsewhere})

    return refined


def _searched(
    monkeypatch: pytest.MonkeyPatch, furnished: Furnished, start: Mapping[str, Pose], found: Mapping[str, Pose]
) -> tuple[Answer, list[tuple[str, list[str]]]]:
    """The answer where registration believes everything, and who was looked for among whom."""
    asked: list[tuple[str, list[str]]] = []

    def fake(source: Any, targets: Any, T_world_cam: Any, config: ICPConfig) -> Pose | None:
        assert config.max_rotation_deg >= icp_looking.LOOK_DEG
        asked.append((source.camera, [target.camera for target in targets]))
        return found.get(source.camera)

    monkeypatch.setattr(icp_looking, "global_start", fake)
    data = {name: furnished.data[name] for name in start}
    return looked_for(data, start, {}, PLANE, {}, LOOKING, _refined_as_given(start)), asked


def test_only_cameras_that_look_bumped_are_looked_for(monkeypatch: pytest.MonkeyPatch, furnished: Furnished) -> None:
    start = {**furnished.truth, "cam2": _bumped(furnished.truth["cam2"])}
    (poses, _), asked = _searched(monkeypatch, furnished, start, furnished.truth)
    assert asked == [("cam2", ["cam0", "cam1"])]
    np.testing.assert_array_equal(poses["cam2"], furnished.truth["cam2"])
    _, asked = _searched(monkeypatch, furnished, furnished.truth, {})
    assert asked == []


def test_of_two_cameras_the_other_one_is_looked_for(monkeypatch: pytest.MonkeyPatch, furnished: Furnished) -> None:
    truth = furnished.truth
    start = {"cam0": _bumped(truth["cam0"]), "cam1": truth["cam1"]}
    (_, metrics), asked = _searched(monkeypatch, furnished, start, {})
    assert asked == [("cam1", ["cam0"])]
    assert "Its cloud contradicts that of cam0, and within 30 degrees and 0.6 m" in metrics.cameras["cam1"].reason
    assert metrics.message.endswith("Not where they are said to stand, and found nowhere else: cam1.")


def test_a_place_where_clouds_contradict_each_other_is_refused(
    monkeypatch: pytest.MonkeyPatch, furnished: Furnished
) -> None:
    truth = furnished.truth
    start = {**truth, "cam2": _bumped(truth["cam2"])}
    # Whatever registration believes: the place is 8 cm and 2 degrees off.
    near = make_pose(exp_so3(math.radians(2.0) * UP) @ truth["cam2"][:3, :3], truth["cam2"][:3, 3] + [0.06, 0.0, 0.05])
    (poses, metrics), _ = _searched(monkeypatch, furnished, start, {"cam2": near})
    np.testing.assert_array_equal(poses["cam2"], start["cam2"])
    assert "of what could meet other clouds contradicts them" in metrics.cameras["cam2"].reason
    (poses, _), _ = _searched(monkeypatch, furnished, start, truth)
    np.testing.assert_array_equal(poses["cam2"], truth["cam2"])


def _contradicting(poses: Mapping[str, Pose], away: set[str]) -> Any:
    """Registration that believes all but that some stand where they are said to."""

    def refined(elsewhere: Mapping[str, Pose]) -> Answer:
        out, metrics = _answer({**poses, **elsewhere}, {*elsewhere})
        cameras = {
            name: replace(move, refusal="prior") if name in away - {*elsewhere} else move
            for name, move in metrics.cameras.items()
        }
        return out, replace(metrics, cameras=cameras)

    return refined


def test_who_contradicts_its_pose_only_by_the_estimate_is_looked_for_too(
    monkeypatch: pytest.MonkeyPatch, furnished: Furnished
) -> None:
    asked: list[str] = []

    def fake(source: Any, targets: Any, T_world_cam: Any, config: ICPConfig) -> Pose:
        asked.append(source.camera)
        return truth[source.camera]

    monkeypatch.setattr(icp_looking, "global_start", fake)
    truth = furnished.truth
    start = {**truth, "cam2": make_pose(truth["cam2"][:3, :3], truth["cam2"][:3, 3] + [0.03, 0.0, 0.0])}
    by = _contradicting(start, {"cam2"})
    poses, metrics = looked_for(furnished.data, start, {}, PLANE, {}, LOOKING, by)
    assert asked == ["cam2"]
    np.testing.assert_array_equal(poses["cam2"], truth["cam2"])
    assert metrics.message.endswith("moved there: cam2 (by 0.00 degrees and 30.0 mm).")
    # Where all others do, it is the reference.
    by = _contradicting(start, {"cam1", "cam2"})
    poses, metrics = looked_for(furnished.data, start, {}, PLANE, {}, LOOKING, by)
    np.testing.assert_array_equal(poses["cam2"], start["cam2"])
    assert "The reference, cam0, contradicts the others" in metrics.message
    assert "contradicts those of cam1, cam2" in metrics.cameras["cam0"].reason


def test_nobody_is_found_without_depth() -> None:
    truth = cameras(2)
    for data in ({}, {name: {"depth": np.zeros((3,)), "K": np.eye(3)} for name in truth}):
        poses, metrics = looked_for(data, truth, {}, None, {}, LOOKING, _refined_as_given(truth))
        assert metrics.message == "All is done."
        assert poses.keys() == truth.keys()
    _, metrics = looked_for({}, {}, {}, None, {}, LOOKING, _refined_as_given({}))
    assert metrics.message == "All is done."


def test_a_found_place_is_known_to_degrees_and_decimetres_at_the_camera() -> None:
    T = make_pose(exp_so3(np.array([0.3, -0.4, 0.5])), np.array([7.0, 1.5, -4.0]))
    prior = found_prior(T)
    assert prior.covariance is not None
    J = centre_jacobian(T[:3, 3])
    sigmas = np.array([math.radians(2.0)] * 3 + [0.1] * 3)
    np.testing.assert_allclose(J @ prior.covariance @ J.T, np.diag(sigmas**2), atol=1e-12)
    # In world axes about the origin, 8 m away, a turn is a shift of decimetres more.
    assert math.sqrt(prior.covariance[3:, 3:].trace()) > 0.3


# ------------------------------------------------------------------------------------------------ what is believed


def _answer(poses: Mapping[str, Pose], accepted: set[str], reason: str = "It keeps its pose: why.") -> Answer:
    moves = {name: CameraMove(accepted=name in accepted, reason=reason) for name in poses}
    return dict(poses), ICPMetrics(success=True, message="All is done.", cameras=moves)


def _believing(monkeypatch: pytest.MonkeyPatch, given: Mapping[str, Pose], found: dict[str, Pose], by: Any) -> Answer:
    monkeypatch.setattr(icp_bumped, "looked_at", lambda *_: Looked(found=found))
    return looked_for({}, given, {}, None, {}, LOOKING, by)


def test_a_refused_place_leaves_no_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    given = dict(zip("abc", _places(0.0, 1.0, 2.0)))
    found = dict(zip("bc", _places(1.5, 2.5)))
    asked: list[list[str]] = []

    def refined(elsewhere: Mapping[str, Pose]) -> Answer:
        asked.append(sorted(elsewhere))
        # b is refused; as long as it is there, it pulls a.
        pulled = _places(0.2)[0] if "b" in elsewhere else given["a"]
        return _answer({**given, "a": pulled, "c": elsewhere["c"]}, {"a", "c"})

    poses, metrics = _believing(monkeypatch, given, found, refined)
    assert asked == [["b", "c"], ["c"]]
    np.testing.assert_array_equal(poses["a"], given["a"])
    np.testing.assert_array_equal(poses["b"], given["b"])
    np.testing.assert_array_equal(poses["c"], found["c"])
    assert metrics.message == (
        "All is done. Found elsewhere than they were said to stand, and moved there: c (by 0.00 degrees and 500.0 mm). "
        "Found elsewhere, but kept where they were said to stand: b."
    )
    reason = metrics.cameras["b"].reason
    assert reason.startswith("It keeps its pose: why. A place 0.00 degrees and 500.0 mm from where it was said")
    assert reason.endswith('was refused ("It keeps its pose: why.").')
    assert metrics.cameras["a"].reason == "It keeps its pose: why."


def test_a_place_that_clouds_do_not_tell_in_every_direction_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    given = dict(zip("ab", _places(0.0, 1.0)))

    def refined(elsewhere: Mapping[str, Pose]) -> Answer:
        poses, metrics = _answer({**given, **elsewhere}, {*elsewhere})
        cameras = {name: replace(move, unobservable=("shift along x",)) for name, move in metrics.cameras.items()}
        return poses, replace(metrics, cameras=cameras)

    poses, metrics = _believing(monkeypatch, given, {"b": _places(1.5)[0]}, refined)
    np.testing.assert_array_equal(poses["b"], given["b"])
    assert "do not tell its shift along x" in metrics.cameras["b"].reason


def test_a_place_from_which_nothing_can_be_done_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    given = dict(zip("ab", _places(0.0, 1.0)))

    def refined(elsewhere: Mapping[str, Pose]) -> Answer:
        if elsewhere:
            return dict(given), ICPMetrics(success=False, message="No clouds overlap.")
        return _answer(given, set())

    poses, metrics = _believing(monkeypatch, given, {"b": _places(9.0)[0]}, refined)
    assert metrics.success
    np.testing.assert_array_equal(poses["b"], given["b"])
    assert 'was refused ("No clouds overlap.")' in metrics.cameras["b"].reason


# ------------------------------------------------------------------------------------------ where an estimate begins


def test_an_estimate_begins_elsewhere_but_for_the_reference() -> None:
    truth = cameras(3)
    clouds = clouds_of(truth)
    start = {**truth, "cam1": _bumped(truth["cam1"])}
    priors = {name: Prior(T_world_cam=T) for name, T in truth.items()}
    pairs = [("cam0", "cam1"), ("cam0", "cam2"), ("cam1", "cam2")]
    config = ICPConfig(max_iterations=[2, 2, 2])
    options: dict[str, Any] = {"floor": PLANE, "reference": "cam0", "begin": {"cam1": truth["cam1"]}}
    free = register(clouds, start, priors, pairs, config, **options)
    assert _errors(free.T_world_cam["cam1"], truth["cam1"])[1] < BACK_MM
    # The reference does not.
    away = {**options["begin"], "cam0": start["cam1"]}
    same = register(clouds, start, priors, pairs, config, **{**options, "begin": away})
    np.testing.assert_array_equal(same.T_world_cam["cam2"], free.T_world_cam["cam2"])
