"""Clouds of several cameras brought together, with what the given poses and depth errors are known to.

Owns      register, Registration: what it answers.
Leaves    the way there to icp_steps, what pairs say to icp_information, whether a move may be believed to icp_gates,
          where cameras are put some of which stay to icp_placing.

One linear Gaussian estimate, made anew about its own result until it stays: poses and depth errors of all cameras and
one floor, from the gaps between all clouds that overlap, the floor that each camera sees, and what is known
beforehand. All cameras are free in it; the world is then moved back so that the reference stands where it stood.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from aruco.floor_model import centre_jacobian
from aruco.floor_plane import FloorPlane, Mask
from aruco.icp_cloud import Cloud
from aruco.icp_information import PairInformation, fit_of, pair_information, unobserved
from aruco.icp_match import Matches
from aruco.icp_normal import Normal, free_inverse
from aruco.icp_placing import placed
from aruco.icp_prior import Prior, Scales
from aruco.icp_rows import Layout, Rows
from aruco.icp_steps import Fit, Pair, Setup, fitted, set_up
from aruco.icp_types import ICPConfig
from aruco.pose_math import Array, Pose, invert_transform, log_se3
from aruco.uncertainty import carried

__all__ = ["Normal", "PairInformation", "Prior", "Registration", "register"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """Poses and depth errors that bring the clouds together."""

    start: dict[str, Pose]  # T_world_cam before
    start_covariance: dict[str, Array]  # (6, 6) of that, in the returned world
    T_world_cam: dict[str, Pose]  # the reference's exactly as at the start
    bias: dict[str, Array]  # (4,) beyond the given one; see icp_cloud.Cloud.slopes
    bias_covariance: dict[str, Array]  # (4, 4)
    covariance: dict[str, Array]  # (6, 6) of the poses returned, left perturbation in world axes
    reference: str
    unlinked: tuple[str, ...]  # no pairs link them with the reference
    floor: FloorPlane | None  # common, in the returned world
    pairs: dict[Pair, PairInformation]  # (a, b), a < b: source a, target b
    matches: dict[Pair, Matches]  # (source, target), both directions, at the end
    unobservable: dict[str, tuple[str, ...]]  # camera -> directions in which clouds say less than its prior, in words
    scale: float  # factor on the noise promised; see icp_equations.residual_scale
    scales: Scales  # how large errors of poses and depth were taken to be
    rounds: int  # relinearisations
    settled: bool
    # About the final state, in a world of its own: x changes poses by left twists there. See icp_rows.
    layout: Layout
    rows: Rows  # all of them, as they meet at the end
    clouds: Normal  # of all rows
    prior: Normal  # of poses and depth errors, without clouds
    frozen: Mask  # (size,) unknowns that are not estimated
    joint: Array  # (size, size) covariance of all unknowns, were the reference as free as the others
    back: dict[str, Array]  # camera -> (6,) twist that takes it to its start, relative to the reference
    T_out_own: Pose  # from the equations' world to the returned one

    def pair_covariance(self, a: str, b: str) -> Array:
        """(6, 6) of the relative pose of two cameras as estimated: turn of b, shift of its centre, seen from a.

        In world axes. Of cameras put beside others that stay it is a little more.
        """
        # The equations' world is turned against the returned one by what the poses have changed: of no consequence.
        lever = centre_jacobian((invert_transform(self.T_out_own) @ self.T_world_cam[b])[:3, 3])
        J = np.zeros((6, self.layout.size))
        J[:, self.layout.pose(b)], J[:, self.layout.pose(a)] = lever, -lever
        return J @ self.joint @ J.T

    def pair_sigma_mm(self, a: str, b: str) -> float:
        """Root of the mean squared error of camera b's place in the frame of camera a that is to be expected."""
        return 1e3 * float(np.sqrt(np.trace(self.pair_covariance(a, b)[3:, 3:])))


def register(
    clouds: Mapping[str, Cloud],
    start: Mapping[str, Pose],
    priors: Mapping[str, Prior],
    pairs: Iterable[Pair] | Mapping[Pair, float],
    config: ICPConfig,
    *,
    floor: FloorPlane | None,
    reference: str,
    begin: Mapping[str, Pose] | None = None,
    start_covariances: Mapping[str, Array] | None = None,
) -> Registration:
    """Bring clouds together.

    Args:
        clouds: Camera -> what it sees, given depth errors taken out.
        start: Camera -> T_world_cam: where the estimate begins, and where the reference stays.
        priors: Camera -> what is known of its pose.
        pairs: Of cameras (a < b) that see the same surfaces, with the area on the floor that they share.
        config: Scales, iterations, method, whether depth errors are estimated.
        floor: Common floor in the world of ``start``; None: there is none to go by.
        reference: The camera that does not move.
        begin: Camera -> T_world_cam where the estimate begins for it in place of its start.
        start_covariances: Camera -> (6, 6) of its pose in ``start``, of depth too where that made it, for what is told
            of cameras that stay; default: that of the prior.
    """
    setup = set_up(clouds, start, priors, pairs, config, floor=floor, reference=reference, begin=begin)
    fit = fitted(setup)
    areas = dict(pairs) if isinstance(pairs, Mapping) else dict.fromkeys(setup.pairs, float("nan"))
    T_world_own = invert_transform(setup.T_own_world)
    known = {name: carried(setup.known.covariance(name, fit.scales), T_world_own) for name in setup.layout.cameras}
    told = {name: S for name, S in (start_covariances or {}).items() if name in known}
    return placed(_answer(setup, fit, start, known | told, areas), ())


def _answer(
    setup: Setup,
    fit: Fit,
    start: Mapping[str, Pose],
    start_covariance: dict[str, Array],
    areas: Mapping[Pair, float],
) -> Registration:
    layout, reference, T = setup.layout, setup.reference, fit.state.T_world_cam
    prior = setup.known.normal(fit.state, fit.scales)
    joint = free_inverse(fit.clouds.H + prior.H, setup.frozen)
    T_restored = setup.start.T_world_cam[reference] @ invert_transform(T[reference])
    T_out_own = invert_transform(setup.T_own_world) @ T_restored
    return Registration(
        start={name: start[name] for name in layout.cameras},
        start_covariance=start_covariance,
        T_world_cam={name: T_out_own @ T[name] for name in layout.cameras},
        bias=fit.state.bias,
        bias_covariance={name: joint[layout.bias(name), layout.bias(name)] for name in layout.cameras},
        covariance={},  # when cameras are placed
        reference=reference,
        unlinked=setup.unlinked,
        floor=fit.state.plane.moved(T_out_own) if setup.floors else None,
        pairs={pair: _pair(setup, fit, pair, areas[pair]) for pair in setup.pairs},
        matches=fit.matches,
        unobservable={name: _unobserved(setup, fit, name, joint) for name in layout.cameras},
        scale=fit.noise,
        scales=fit.scales,
        rounds=fit.rounds,
        settled=fit.settled,
        layout=layout,
        rows=fit.rows,
        clouds=fit.clouds,
        prior=prior,
        frozen=setup.frozen,
        joint=joint,
        back={
            name: log_se3(invert_transform(T_restored) @ setup.start.T_world_cam[name] @ invert_transform(T[name]))
            for name in layout.cameras
        },
        T_out_own=T_out_own,
    )


def _unobserved(setup: Setup, fit: Fit, camera: str, joint: Array) -> tuple[str, ...]:
    if camera == setup.reference:
        return ()
    a, r = setup.layout.pose(camera), setup.layout.pose(setup.reference)
    after = joint[a, a] + joint[r, r] - joint[a, r] - joint[r, a]
    before = setup.known.covariance(camera, fit.scales) + setup.known.covariance(setup.reference, fit.scales)
    return unobserved(before, after, fit.state.T_world_cam[camera][:3, 3])


def _pair(setup: Setup, fit: Fit, pair: Pair, area_m2: float) -> PairInformation:
    source, target = pair
    information, words = pair_information(
        fit.rows,
        setup.layout,
        [setup.known.bias_covariance(name, fit.scales) for name in pair],
        pair,
        fit.state.T_world_cam,
        setup.known.covariance(source, fit.scales) + setup.known.covariance(target, fit.scales),
        scale=fit.noise,
    )
    fitness, rmse, n_points = fit_of(fit.matches[source, target], fit.matches[target, source])
    return PairInformation(
        information=information,
        unobservable=words,
        fitness=fitness,
        rmse=rmse,
        n_points=n_points,
        overlap_m2=area_m2,
    )
