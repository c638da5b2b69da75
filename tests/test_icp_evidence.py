"""How large errors are, told by the clouds: by whom, and that no short cut changes it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import cache

import numpy as np
import pytest
from floor_rooms import cameras
from icp_rooms import BOXES, LEVEL, clouds_of, covariance

from aruco.floor_evidence import SCALE_LOG_SIGMA
from aruco.icp_bumped import found_prior
from aruco.icp_cloud import Cloud
from aruco.icp_equations import State
from aruco.icp_evidence import told_scales
from aruco.icp_gates import set_aside
from aruco.icp_match import overlapping_pairs
from aruco.icp_normal import Normal
from aruco.icp_prior import ASPECTS, Known, Prior, Scales, default_of
from aruco.icp_rows import Layout
from aruco.icp_solve import Registration, register
from aruco.icp_types import ICPConfig
from aruco.pose_math import Array, Pose, exp_se3, exp_so3, make_pose

RIG = cameras()
FULL = ICPConfig(region="full", stride=2, max_iterations=[6, 4, 4])


@cache
def seen() -> dict[str, Cloud]:
    return clouds_of(RIG, BOXES, FULL)


def rough(seed: int) -> dict[str, Pose]:
    rng = np.random.default_rng(seed)
    return {
        name: make_pose(exp_so3(np.radians(rng.normal(0, 0.6, 3))) @ T[:3, :3], T[:3, 3] + rng.normal(0, 0.012, 3))
        for name, T in RIG.items()
    }


def registered(start: Mapping[str, Pose], priors: Mapping[str, Prior], silent: Collection[str] = ()) -> Registration:
    clouds, pairs = set_aside(seen(), overlapping_pairs(seen(), start, FULL), silent)
    return register(clouds, start, priors, pairs, FULL, floor=LEVEL, reference="cam0")


@pytest.mark.parametrize("silent", [("cam3",), ("cam2", "cam3")])
def test_cameras_set_aside_do_not_vouch_for_poses(silent: tuple[str, ...]):
    """That they stay where they are is no testimony that poses are right: taken for it, factors fell to 0.01."""
    for seed in (1, 3):
        start = rough(seed)
        priors = {name: Prior(T_world_cam=T) for name, T in start.items()}
        free, left = (registered(start, priors, left_out).scales.default for left_out in ((), silent))
        for aspect in ASPECTS:
            names = [default_of(aspect, name) for name in RIG]
            ratio = np.log([left[name] for name in names]).mean() - np.log([free[name] for name in names]).mean()
            # Half the cameras tell it, and such a size is known to about a half.
            assert abs(ratio) < np.log(2.5)


def test_cameras_set_aside_do_not_vouch_for_covariances():
    start = rough(3)
    priors = {name: Prior(T_world_cam=T, covariance=covariance(T, 0.03, 2.0)) for name, T in start.items()}
    # Poses are wrong by some 20 sigmas. Had two cameras been held, their being where they are would make it 1.
    assert registered(start, priors, ("cam2", "cam3")).scales.given > 10.0


# ----------------------------------------------------------------------------------------- small problems by themselves

NAMES = ("a", "b", "c", "d")
LAYOUT = Layout(NAMES)


def small(priors: Mapping[str, Prior], rng: np.random.Generator) -> tuple[Known, State, Normal]:
    """Cameras off their priors, where clouds want them."""
    cloud = seen()["cam0"]
    known = Known(layout=LAYOUT, poses=dict(priors), clouds=dict.fromkeys(NAMES, cloud))
    state = State(
        T_world_cam={name: exp_se3(rng.normal(0, 0.004, 6)) @ p.T_world_cam for name, p in priors.items()},
        bias={name: rng.normal(0, 1e-3, 4) for name in NAMES},
        floor=np.zeros(3),
        up=np.array([0.0, 1.0, 0.0]),
    )
    J = 1e4 * rng.normal(size=(30, LAYOUT.size))
    off = rng.normal(size=len(J))
    return known, state, Normal(H=J.T @ J, g=J.T @ off, chi2=float(off @ off))


def free() -> Array:
    """All unknowns but the floor, which the clouds here do not tell."""
    return np.eye(LAYOUT.size)[:, : LAYOUT.floor.start]


def test_factors_are_those_of_the_likelihood_itself():
    """Integrated over each factor by itself, from determinants and solutions of the whole equations."""
    rng = np.random.default_rng(0)
    poses = {name: make_pose(np.eye(3), rng.normal(0, 2.0, 3)) for name in NAMES}
    priors = {
        name: Prior(T_world_cam=T, covariance=None if name < "c" else covariance(T, 0.1, 3.0))
        for name, T in poses.items()
    }
    known, state, clouds = small(priors, rng)
    found = told_scales(known, state, clouds, free(), Scales())

    def likelihood(scales: Scales) -> float:
        total = clouds + known.normal(state, scales)
        H, g = free().T @ total.H @ free(), free().T @ total.g
        blocks = [known.covariance(name, scales) for name in NAMES]
        log_prior = sum(np.linalg.slogdet(S)[1] for S in blocks)
        return -0.5 * (total.chi2 - g @ np.linalg.solve(H, g) + np.linalg.slogdet(H)[1] + log_prior)

    # Told last, so that all others hold already.
    values = np.geomspace(0.02, 50.0, 60)
    logs = np.array(
        [likelihood(Scales(given=v, default=found.default, bias=found.bias, lean=found.lean)) for v in values]
    )
    logs -= 0.5 * (np.log(values) / SCALE_LOG_SIGMA) ** 2
    weights = np.exp(logs - logs.max())
    mean = np.exp(weights @ np.log(values) / weights.sum())
    # Exact but for rounding.
    assert found.given == pytest.approx(max(mean, 1.0), rel=1e-8)
    assert found.given > 1.1  # not the least that is allowed


def test_places_that_were_found_do_not_vouch_for_marker_poses():
    rng = np.random.default_rng(1)
    poses = {name: make_pose(np.eye(3), rng.normal(0, 2.0, 3)) for name in NAMES}
    given = {name: Prior(T_world_cam=T, covariance=covariance(T, 0.05, 2.0)) for name, T in poses.items()}
    told = []
    for found in (
        found_prior(poses["d"]),
        Prior(T_world_cam=poses["d"], covariance=found_prior(poses["d"]).covariance),
    ):
        known, state, clouds = small({**given, "d": found}, np.random.default_rng(2))
        told.append(told_scales(known, state, clouds, free(), Scales()).given)
    # A place known to 2 degrees and met to 0.2 makes the others' pass for better than they are.
    assert told[0] > 1.1 * told[1]
    assert known.covariance("a", Scales(given=3.0)) == pytest.approx(9.0 * known.covariance("a", Scales()))
    assert known.poses["a"].scaled
    assert not found_prior(poses["d"]).moved(np.eye(4)).scaled
