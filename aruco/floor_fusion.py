"""Floors against poses: the common floor, and each camera's pitch, roll and height, all at once.

Owns      the linear Gaussian estimate and its covariance.
Leaves    the equations to floor_model, the size of pose errors to floor_evidence, bounds to ground_plane.

Unknown are the floor (two slopes and a height, about which nothing is assumed) and of each camera a turn about two
level axes and a rise, with a prior from its pose's covariance. Measured is each camera's plane ``a`` (see floor_view),
with a covariance of noise and bias. A good pose thus is hardly moved by depth that may be biased; a bad one is moved
nearly all the way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aruco.floor_evidence import Scales, told_scales
from aruco.floor_model import FloorState, Sight, centre_jacobian, level_rows, predicted_plane
from aruco.floor_plane import FloorPlane, plane_axes
from aruco.pose_math import Array, Pose

_ROUNDS = 10
_CONVERGED = 1e-11  # rad and m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fusion:
    """The floor and the corrections that explain all measurements best."""

    turns: dict[str, Array]  # camera -> rotation vector (3,), level
    rises: dict[str, float]
    covariance: Array  # (3 + 3 n, 3 + 3 n) of slopes, height, and (turn, turn, rise) of each camera in order
    slopes: dict[str, tuple[Array, Array]]  # camera -> derivative of its a by (floor, its own correction), each (3, 3)
    scales: Scales
    chi2: float  # of what is left, measurements and priors
    cameras: tuple[str, ...]
    state: FloorState

    @property
    def floor(self) -> FloorPlane:
        """The floor in the given world."""
        return FloorPlane(self.state.normal, -float(self.state.normal @ self.state.anchor))

    def gain(self, sight: Sight) -> float:
        """How much of what its floor asks for a camera was moved by: the geometric mean over three directions."""
        at = self.part(sight.camera)
        prior = self.scales.poses[sight.camera] ** 2 * sight.prior
        left = np.linalg.slogdet(self.covariance[at, at])[1] - np.linalg.slogdet(prior)[1]
        return float(-np.expm1(left / 3.0))

    @property
    def floor_covariance(self) -> Array:
        """(3, 3) of what the floor's own error does to all poses alike.

        Of (turn about x [rad], turn about z [rad], rise along y [m]): components of the left perturbation of every
        pose, in the axes and about the origin of the given world, whose floor is level.
        """
        up, axes = self.state.up, plane_axes(self.state.up)
        M = np.zeros((3, 3))
        # A floor that slopes more than estimated turns every camera back by n x up; its height is that at the pivot.
        M[:2, :2] = np.cross(axes, up)[:, [0, 2]].T
        M[2, :2] = -up[1] * (axes @ self.state.pivot)
        M[2, 2] = -up[1]
        return M @ self.covariance[:3, :3] @ M.T

    def part(self, camera: str) -> slice:
        """Where a camera stands in the covariance."""
        k = 3 + 3 * self.cameras.index(camera)
        return slice(k, k + 3)


def fuse(sights: Sequence[Sight], guess: FloorPlane, up: Array, *, scales: Scales | None = None) -> Fusion:
    """The most probable floor and corrections.

    Args:
        sights: At least one.
        guess: A first guess of the floor, in the world.
        up: (3,) unit.
        scales: Of the errors of poses and bias; default: told by the evidence.
    """
    pivot = np.mean([s.T_world_cam[:3, 3] for s in sights], axis=0)
    slopes = plane_axes(up) @ guess.normal / float(guess.normal @ up)
    height = float(pivot @ up) - float(guess.distances(pivot)) / float(guess.normal @ up)
    start = FloorState(up=up, pivot=pivot, floor=np.array([*slopes, height]), corrections=np.zeros((len(sights), 3)))
    return _solved(sights, start, told_scales(sights, start) if scales is None else scales)


def _solved(sights: Sequence[Sight], state: FloorState, scales: Scales) -> Fusion:
    """Gauss-Newton; the equations are nearly linear."""
    for _ in range(_ROUNDS):
        H, g, _ = _equations(sights, state, scales)
        step = np.linalg.solve(H, g)
        state = replace(
            state, floor=state.floor + step[:3], corrections=state.corrections + step[3:].reshape(len(sights), 3)
        )
        if np.abs(step).max() < _CONVERGED:
            break
    H, _, chi2 = _equations(sights, state, scales)
    axes, names = plane_axes(state.up), [sight.camera for sight in sights]
    derivatives = [predicted_plane(s.T_world_cam, state, c)[1:] for s, c in zip(sights, state.corrections)]
    return Fusion(
        state=state,
        turns={name: c[:2] @ axes for name, c in zip(names, state.corrections)},
        rises={name: float(c[2]) for name, c in zip(names, state.corrections)},
        covariance=np.linalg.inv(H),
        slopes=dict(zip(names, derivatives)),
        scales=scales,
        chi2=chi2,
        cameras=tuple(names),
    )


def _equations(sights: Sequence[Sight], state: FloorState, scales: Scales) -> tuple[Array, Array, float]:
    """Normal equations H (m, m), g (m,) of the next step, m = 3 + 3 n, and the chi-square of the state."""
    m = 3 + 3 * len(sights)
    H, g, chi2 = np.zeros((m, m)), np.zeros(m), 0.0
    for k, sight in enumerate(sights):
        correction, at = state.corrections[k], slice(3 + 3 * k, 6 + 3 * k)
        predicted, by_floor, by_camera = predicted_plane(sight.T_world_cam, state, correction)
        W = np.linalg.inv(sight.noise + scales.bias**2 * sight.bias)
        known = np.linalg.inv(scales.poses[sight.camera] ** 2 * sight.prior)
        J = np.zeros((3, m))
        J[:, :3], J[:, at] = by_floor, by_camera
        off = sight.a - predicted
        H += J.T @ W @ J
        g += J.T @ W @ off
        H[at, at] += known
        g[at] -= known @ correction
        chi2 += float(off @ W @ off + correction @ known @ correction)
    return H, g, chi2


def fused_covariances(
    fusion: Fusion, sights: Mapping[str, Sight], covariances: Mapping[str, Array]
) -> dict[str, Array]:
    """(6, 6) of the corrected poses against the true floor, left perturbation in the axes of the given world."""
    return {
        name: _fused_covariance(fusion, sights[name], fusion.scales.honest[name] ** 2 * np.asarray(covariances[name]))
        for name in fusion.cameras
    }


def _fused_covariance(fusion: Fusion, sight: Sight, covariance: Array) -> Array:
    up, name, at = fusion.state.up, sight.camera, fusion.part(sight.camera)
    by_floor, by_camera = fusion.slopes[name]
    to_wish = np.linalg.inv(by_camera) @ np.hstack([by_floor, by_camera])
    both = np.r_[0:3, at.start : at.stop]
    posterior = to_wish @ fusion.covariance[np.ix_(both, both)] @ to_wish.T
    # How much of the old error of turn and rise is left in the new one.
    prior = fusion.scales.poses[name] ** 2 * sight.prior
    left = to_wish @ fusion.covariance[both, at] @ np.linalg.inv(prior)
    # Of a larger error than the estimate worked with as much more is left.
    more = (fusion.scales.honest[name] ** 2 - fusion.scales.poses[name] ** 2) * sight.prior
    posterior = posterior + left @ more @ left.T
    J = centre_jacobian(sight.T_world_cam[:3, 3])
    at_centre = J @ covariance @ J.T
    rows = level_rows(up)
    keep = np.eye(6) - rows.T @ rows
    cross = rows.T @ (left @ rows @ at_centre @ keep)
    new = keep @ at_centre @ keep + cross + cross.T + rows.T @ posterior @ rows
    centre = sight.T_world_cam[:3, 3] + fusion.rises[name] * up
    back = centre_jacobian(centre, inverse=True)
    return back @ new @ back.T


def uncorrected_covariance(fusion: Fusion, T_world_cam: Pose, covariance: Array) -> Array:
    """(6, 6) of a pose that was not corrected, against the true floor: its own errors and those of the floor."""
    _, by_floor, by_camera = predicted_plane(T_world_cam, fusion.state, np.zeros(3))
    to_wish = np.linalg.inv(by_camera) @ by_floor
    rows = level_rows(fusion.state.up)
    back = centre_jacobian(T_world_cam[:3, 3], inverse=True) @ rows.T
    return covariance + back @ (to_wish @ fusion.covariance[:3, :3] @ to_wish.T) @ back.T
