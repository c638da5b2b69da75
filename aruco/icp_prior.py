"""What is known before clouds are compared: poses and depth errors.

Owns      Prior, its normal equations, and its parts whose sizes are not certain.
Leaves    these sizes to icp_evidence, what clouds say to icp_equations.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from aruco.floor_model import centre_jacobian
from aruco.icp_cloud import Cloud
from aruco.icp_equations import State
from aruco.icp_normal import Normal
from aruco.icp_rows import Layout
from aruco.pose_math import Array, Pose, adjoint, invert_transform, log_se3

# Pose errors of one camera where nobody has said them, one sigma; their sizes are then scaled by the evidence.
DEFAULT_TURN_RAD = math.radians(0.3)
DEFAULT_SHIFT_M = 0.006
# These have two sizes: floors tell both turns about level axes and the rise, and say nothing of yaw, x and z. With one
# size for all six, floors that agree, as they do after levelling, would vouch for yaw, x and z as well. Components of
# (turn, shift of the camera's centre) in world axes, up being y or -y.
ASPECTS = {"level": (0, 2, 4), "plan": (1, 3, 5)}
_DEFAULT_SIGMA = np.array([DEFAULT_TURN_RAD] * 3 + [DEFAULT_SHIFT_M] * 3)
# No covariance is believed beyond this: tripods creep, lenses breathe, and it keeps the equations solvable.
LEAST_TURN_RAD = math.radians(0.005)
LEAST_SHIFT_M = 0.0002


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """What is known of a camera's pose without clouds."""

    T_world_cam: Pose
    covariance: Array | None = None  # (6, 6) left perturbation in world axes; None: nobody has said
    scaled: bool = True  # by the factor that is common to all covariances, and told by all

    def moved(self, T_new_old: Pose) -> Prior:
        """The same in another world, with a covariance that can be inverted."""
        T, Ad = T_new_old @ self.T_world_cam, adjoint(T_new_old)
        if self.covariance is None:
            return Prior(T_world_cam=T)
        back = centre_jacobian(T[:3, 3], inverse=True)
        least = back @ np.diag([LEAST_TURN_RAD**2] * 3 + [LEAST_SHIFT_M**2] * 3) @ back.T
        return replace(self, T_world_cam=T, covariance=Ad @ self.covariance @ Ad.T + least)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scales:
    """Factors on standard deviations of what is known beforehand."""

    given: float = 1.0  # of poses of which somebody has said how well they are known
    default: Mapping[str, float] = field(default_factory=dict)  # of the others, see default_of; 1 where absent
    bias: float = 1.0  # of depth errors that nobody has measured: scale and inverse depth or offset
    lean: float = 1.0  # of their growth across the image


def default_of(aspect: str, camera: str) -> str:
    """The name of one aspect of a camera's pose where nobody has said how well it is known."""
    return f"{aspect} of {camera}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """Unknowns whose standard deviations share a factor: ``rows @ x + off`` has variance one at a factor of one."""

    rows: Array  # (n, size)
    off: Array  # (n,) at x = 0

    @classmethod
    def joined(cls, parts: Sequence[Part]) -> Part:
        """All of several that share a factor."""
        return cls(rows=np.vstack([part.rows for part in parts]), off=np.concatenate([part.off for part in parts]))

    def scaled(self, factor: float) -> Part:
        """The same with standard deviations times a factor."""
        return Part(rows=self.rows / factor, off=self.off / factor)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """Everything that is known beforehand, in the equations' world."""

    layout: Layout
    poses: dict[str, Prior]
    clouds: Mapping[str, Cloud]

    def off(self, state: State, camera: str) -> Array:
        """(6,) how far a camera is from where it should be."""
        return log_se3(state.T_world_cam[camera] @ invert_transform(self.poses[camera].T_world_cam))

    def given(self, camera: str) -> bool:
        """Whether somebody has said how well a camera's pose is known."""
        return self.poses[camera].covariance is not None

    def covariance(self, camera: str, scales: Scales) -> Array:
        """(6, 6) of a camera's given pose."""
        prior = self.poses[camera]
        if prior.covariance is None:
            return self._default(camera, scales)
        return prior.covariance * (scales.given**2 if prior.scaled else 1.0)

    def _default(self, camera: str, scales: Scales) -> Array:
        sigma = _DEFAULT_SIGMA.copy()
        for aspect, at in ASPECTS.items():
            sigma[list(at)] *= scales.default.get(default_of(aspect, camera), 1.0)
        back = centre_jacobian(self.poses[camera].T_world_cam[:3, 3], inverse=True)
        return back @ np.diag(sigma**2) @ back.T

    def bias_covariance(self, camera: str, scales: Scales) -> Array:
        """(4, 4) of a camera's depth error."""
        bias = 1.0 if self.measured(camera) else scales.bias
        D = np.diag([bias, bias, scales.lean, scales.lean])
        return D @ self.clouds[camera].bias_covariance @ D

    def measured(self, camera: str) -> bool:
        """Whether somebody has measured the depth error and said how well."""
        bias = self.clouds[camera].given_bias
        return bias is not None and bias.covariance is not None

    def normal(self, state: State, scales: Scales) -> Normal:
        """Its normal equations."""
        size = self.layout.size
        H, g, chi2 = np.zeros((size, size)), np.zeros(size), 0.0
        for c in self.layout.cameras:
            for at, S, off in (
                (self.layout.pose(c), self.covariance(c, scales), self.off(state, c)),
                (self.layout.bias(c), self.bias_covariance(c, scales), state.bias[c]),
            ):
                W = np.linalg.inv(S)
                H[at, at] = (W + W.T) / 2
                g[at] = W @ off
                chi2 += float(off @ W @ off)
        return Normal(H=H, g=g, chi2=chi2)

    def parts(self, state: State) -> dict[str, Part]:
        """Each aspect of each pose without a covariance, poses with one, depth errors, lean, and what is certain."""
        groups: dict[str, list[Part]] = {}
        for c in self.layout.cameras:
            for group, part in (*self._of_pose(state, c), *self._of_bias(state, c)):
                groups.setdefault(group, []).append(part)
        return {name: Part.joined(parts) for name, parts in groups.items()}

    def _of_pose(self, state: State, camera: str) -> Iterator[tuple[str, Part]]:
        """What is known of a camera's pose, by the names of its parts."""
        at, off, prior = self.layout.pose(camera), self.off(state, camera), self.poses[camera]
        if prior.covariance is not None:
            yield "given" if prior.scaled else "certain", self._part(at, _root(prior.covariance), off)
            return
        J = centre_jacobian(prior.T_world_cam[:3, 3]) / _DEFAULT_SIGMA[:, None]
        for aspect, components in ASPECTS.items():
            yield default_of(aspect, camera), self._part(at, J[list(components)], off)

    def _of_bias(self, state: State, camera: str) -> Iterator[tuple[str, Part]]:
        """Likewise of its depth error."""
        S, b, k = self.bias_covariance(camera, Scales()), state.bias[camera], self.layout.bias(camera).start
        name = "certain" if self.measured(camera) else "bias"
        yield name, self._part(slice(k, k + 2), _root(S[:2, :2]), b[:2])
        yield "lean", self._part(slice(k + 2, k + 4), _root(S[2:, 2:]), b[2:])

    def _part(self, at: slice, root: Array, off: Array) -> Part:
        """Of unknowns that are ``off`` their mean, the information of which is ``root.T @ root``."""
        rows = np.zeros((len(root), self.layout.size))
        rows[:, at] = root
        return Part(rows=rows, off=root @ off)


def _root(S: Array) -> Array:
    """A matrix R of which R.T @ R is the inverse of a covariance."""
    return np.linalg.inv(np.linalg.cholesky(S))
