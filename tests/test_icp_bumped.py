"""A camera that was bumped is taken up where it is found, and a place that is refused leaves no trace."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from floor_rooms import BASELINE_M, ROOM, cameras, depth_image, zoomed
from icp_rooms import box, clouds_of

from aruco import icp_bumped, icp_registration
from aruco.floor_model import centre_jacobian
from aruco.floor_plane import FloorPlane
from aruco.icp_bumped import Answer, believed, found_elsewhere, found_prior
from aruco.icp_registration import refine_with_icp
from aruco.icp_solve import Prior, register
from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics
from aruco.pose_math import Array, Pose, exp_so3, make_pose, pose_distance

UP = np.array([0.0, 1.0, 0.0])
PLANE = FloorPlane(normal=UP, d=0.0)
BUMP_DEG, BUMP_M = 8.0, 0.25
RAISED = ICPConfig(global_init=True, max_rotation_deg=15.0, max_translation_m=0.5)
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
    poses, metrics = furnished.refined(start, RAISED)
    degrees, mm = _errors(poses["cam1"], truth["cam1"])
    assert degrees < BACK_DEG
    assert mm < BACK_MM
    assert metrics.cameras["cam1"].accepted
    assert "its surroundings place it" in metrics.cameras["cam1"].reason
    assert "Found elsewhere than they were said to stand, and moved there: cam1." in metrics.message
    # The others stood well, and do.
    for name in truth.keys() - {"cam1"}:
        assert _errors(poses[name], truth[name])[1] < 2.0
    # Clouds alone do not bring it back, however far it may be moved: what is known of its given pose forbids it.
    missed, _ = furnished.refined(start, replace(RAISED, global_init=False))
    degrees, mm = _errors(missed["cam1"], truth["cam1"])
    assert degrees > BACK_DEG
    assert mm > BACK_MM


def test_a_bumped_camera_stays_where_bounds_do_not_reach(furnished: Furnished) -> None:
    truth = furnished.truth
    start = {**truth, "cam1": _bumped(truth["cam1"])}
    poses, metrics = furnished.refined(start, ICPConfig(global_init=True))
    np.testing.assert_array_equal(poses["cam1"], start["cam1"])
    assert not metrics.cameras["cam1"].accepted
    assert "elsewhere" not in metrics.message


def test_nothing_changes_where_nobody_was_bumped(furnished: Furnished, monkeypatch: pytest.MonkeyPatch) -> None:
    turn = exp_so3(np.array([0.0, 0.004, 0.0]))
    start = {n: make_pose(turn @ T[:3, :3], T[:3, 3]) if n == "cam2" else T for n, T in furnished.truth.items()}
    poses, metrics = furnished.refined(start, RAISED)
    plain, plain_metrics = furnished.refined(start, replace(RAISED, global_init=False))
    for name, T in plain.items():
        assert poses[name].tobytes() == T.tobytes()
        assert metrics.cameras[name].reason == plain_metrics.cameras[name].reason
        assert metrics.covariances[name].tobytes() == plain_metrics.covariances[name].tobytes()
    assert metrics.message == plain_metrics.message
    # Nor by a wrong proposal, which clouds refuse.
    wrong = make_pose(start["cam2"][:3, :3], start["cam2"][:3, 3] + [0.25, 0.0, 0.25])
    monkeypatch.setattr(icp_registration, "found_elsewhere", lambda *_: {"cam2": wrong})
    poses, metrics = furnished.refined(start, RAISED)
    for name, T in plain.items():
        assert poses[name].tobytes() == T.tobytes()
    assert "A place 0.00 degrees and 353.6 mm from where it was said to stand" in metrics.cameras["cam2"].reason
    assert metrics.message.endswith("Found elsewhere, but kept where they were said to stand: cam2.")


# ------------------------------------------------------------------------------------------------- who is looked for


def _proposing(monkeypatch: pytest.MonkeyPatch, wrong: set[str], blamed: dict[str, str]) -> list[tuple[str, set[str]]]:
    """Lets wrong cameras be found, and blamed ones as long as another is there; answers what is asked."""
    asked: list[tuple[str, set[str]]] = []

    def start(source: Any, targets: Any, T_world_cam: Any, config: ICPConfig) -> Pose | None:
        assert config.region == "full"
        names = {target.camera for target in targets}
        asked.append((source.camera, names))
        found = source.camera in wrong or blamed.get(source.camera) in names
        return _places(1.0)[0] if found else None

    monkeypatch.setattr(icp_bumped, "global_start", start)
    monkeypatch.setattr(icp_bumped, "cloud_of", lambda name, *_, **__: SimpleNamespace(camera=name))
    return asked


def test_the_reference_is_not_looked_for_and_all_others_are(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = _proposing(monkeypatch, {"cam0", "cam2"}, {})
    truth = cameras(4)
    found = found_elsewhere({name: {} for name in truth}, truth, PLANE, {}, ICPConfig())
    assert list(found) == ["cam2"]
    assert asked == [(name, {*truth}) for name in ("cam1", "cam2", "cam3")]


def test_who_only_seems_bumped_beside_a_bumped_one_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = _proposing(monkeypatch, {"cam2"}, {"cam3": "cam2"})
    truth = cameras(4)
    found = found_elsewhere({name: {} for name in truth}, truth, PLANE, {}, ICPConfig())
    assert list(found) == ["cam2"]
    assert asked[3:] == [("cam2", {"cam0", "cam1", "cam2"}), ("cam3", {"cam0", "cam1", "cam3"})]


def test_nobody_is_found_without_depth() -> None:
    truth = cameras(2)
    assert found_elsewhere({}, truth, None, {}, ICPConfig()) == {}
    assert found_elsewhere({}, {}, None, {}, ICPConfig()) == {}
    useless = {name: {"depth": np.zeros((3,)), "K": np.eye(3)} for name in truth}
    assert found_elsewhere(useless, truth, None, {}, ICPConfig()) == {}


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


def test_a_refused_place_leaves_no_trace() -> None:
    given = dict(zip("abc", _places(0.0, 1.0, 2.0)))
    found = dict(zip("bc", _places(1.5, 2.5)))
    asked: list[list[str]] = []

    def refined(elsewhere: Mapping[str, Pose]) -> Answer:
        asked.append(sorted(elsewhere))
        # b is refused; as long as it is there, it pulls a.
        pulled = _places(0.2)[0] if "b" in elsewhere else given["a"]
        return _answer({**given, "a": pulled, "c": elsewhere["c"]}, {"a", "c"})

    poses, metrics = believed(given, found, refined)
    assert asked == [["b", "c"], ["c"]]
    np.testing.assert_array_equal(poses["a"], given["a"])
    np.testing.assert_array_equal(poses["b"], given["b"])
    np.testing.assert_array_equal(poses["c"], found["c"])
    assert metrics.message == (
        "All is done. Found elsewhere than they were said to stand, and moved there: c. "
        "Found elsewhere, but kept where they were said to stand: b."
    )
    reason = metrics.cameras["b"].reason
    assert reason.startswith("It keeps its pose: why. A place 0.00 degrees and 500.0 mm from where it was said")
    assert reason.endswith('was refused ("It keeps its pose: why.").')
    assert metrics.cameras["a"].reason == "It keeps its pose: why."


def test_a_place_from_which_nothing_can_be_done_is_refused() -> None:
    given = dict(zip("ab", _places(0.0, 1.0)))

    def refined(elsewhere: Mapping[str, Pose]) -> Answer:
        if elsewhere:
            return dict(given), ICPMetrics(success=False, message="No clouds overlap.")
        return _answer(given, set())

    poses, metrics = believed(given, {"b": _places(9.0)[0]}, refined)
    assert metrics.success
    np.testing.assert_array_equal(poses["b"], given["b"])
    assert 'was refused ("No clouds overlap.")' in metrics.cameras["b"].reason


def test_without_proposals_the_answer_is_as_it_was() -> None:
    given = dict(zip("ab", _places(0.0, 1.0)))
    answer = _answer(given, {"b"})
    _, metrics = believed(given, {}, lambda _: answer)
    assert metrics.message == answer[1].message
    assert metrics.cameras == answer[1].cameras


# ------------------------------------------------------------------------------------------ where an estimate begins


def test_an_estimate_begins_elsewhere_for_free_cameras_only() -> None:
    truth = cameras(3)
    clouds = clouds_of(truth)
    start = {**truth, "cam1": _bumped(truth["cam1"])}
    priors = {name: Prior(T_world_cam=T) for name, T in truth.items()}
    pairs = [("cam0", "cam1"), ("cam0", "cam2"), ("cam1", "cam2")]
    config = ICPConfig(max_iterations=[2, 2, 2])
    options: dict[str, Any] = {"floor": PLANE, "reference": "cam0", "begin": {"cam1": truth["cam1"]}}
    free = register(clouds, start, priors, pairs, config, **options)
    assert _errors(free.T_world_cam["cam1"], truth["cam1"])[1] < BACK_MM
    kept = register(clouds, start, priors, pairs, config, kept=("cam1",), **options)
    np.testing.assert_array_equal(kept.T_world_cam["cam1"], start["cam1"])
    # Kept cameras do not begin elsewhere, nor does the reference.
    plain = register(clouds, start, priors, pairs, config, kept=("cam1",), floor=PLANE, reference="cam0")
    away = {"cam0": start["cam1"], "cam1": truth["cam1"]}
    same = register(clouds, start, priors, pairs, config, kept=("cam1",), **{**options, "begin": away})
    np.testing.assert_array_equal(same.T_world_cam["cam2"], plain.T_world_cam["cam2"])
