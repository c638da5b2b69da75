"""What is known before clouds are compared: poses and depth errors.

Owns      Prior, its normal equations in parts whose sizes are not certain.
Leaves    these sizes to icp_evidence, what clouds say to icp_equations.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

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
Term = tuple[slice, Array, Array]  # where some unknowns stand, their information, how far they are from their mean


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """What is known of a camera's pose without clouds."""

    T_world_cam: Pose
    covariance: Array | None = None  # (6, 6) left perturbation in world axes; None: nobody has said

    def moved(self, T_new_old: Pose) -> Prior:
        """The same in another world, with a covariance that can be inverted."""
        T, Ad = T_new_old @ self.T_world_cam, adjoint(T_new_old)
        if self.covariance is None:
            return Prior(T_world_cam=T)
        back = centre_jacobian(T[:3, 3], inverse=True)
        least = back @ np.diag([LEAST_TURN_RAD**2] * 3 + [LEAST_SHIFT_M**2] * 3) @ back.T
        return Prior(T_world_cam=T, covariance=Ad @ self.covariance @ Ad.T + least)


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
    """Normal equations of unknowns whose standard deviations share a factor, at a factor of one."""

    normal: Normal
    n: int  # unknowns


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
        S = self.poses[camera].covariance
        return self._default(camera, scales) if S is None else scales.given**2 * S

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
        poses = [(self.layout.pose(c), self.covariance(c, scales), self.off(state, c)) for c in self.layout.cameras]
        biases = [(self.layout.bias(c), self.bias_covariance(c, scales), state.bias[c]) for c in self.layout.cameras]
        return self._summed([(at, np.linalg.inv(S), off) for at, S, off in (*poses, *biases)])

    def parts(self, state: State) -> dict[str, Part]:
        """Each aspect of each pose without a covariance, poses with one, depth errors, lean, and what is measured."""
        groups: dict[str, list[Term]] = {}
        for c in self.layout.cameras:
            for group, term in (*self._of_pose(state, c), *self._of_bias(state, c)):
                groups.setdefault(group, []).append(term)
        return {
            name: Part(normal=self._summed(terms), n=sum(int(np.linalg.matrix_rank(W)) for _, W, _ in terms))
            for name, terms in groups.items()
        }

    def _of_pose(self, state: State, camera: str) -> Iterator[tuple[str, Term]]:
        """What is known of a camera's pose, by the names of its parts."""
        at, off, S = self.layout.pose(camera), self.off(state, camera), self.poses[camera].covariance
        if S is not None:
            yield "given", (at, np.linalg.inv(S), off)
            return
        J = centre_jacobian(self.poses[camera].T_world_cam[:3, 3])
        for aspect, components in ASPECTS.items():
            rows = (J / _DEFAULT_SIGMA[:, None])[list(components)]
            yield default_of(aspect, camera), (at, rows.T @ rows, off)

    def _of_bias(self, state: State, camera: str) -> Iterator[tuple[str, Term]]:
        """Likewise of its depth error."""
        S, b, k = self.bias_covariance(camera, Scales()), state.bias[camera], self.layout.bias(camera).start
        yield "measured" if self.measured(camera) else "bias", (slice(k, k + 2), np.linalg.inv(S[:2, :2]), b[:2])
        yield "lean", (slice(k + 2, k + 4), np.linalg.inv(S[2:, 2:]), b[2:])

    def _summed(self, terms: Iterable[Term]) -> Normal:
        size = self.layout.size
        H, g, chi2 = np.zeros((size, size)), np.zeros(size), 0.0
        for at, W, off in terms:
            H[at, at] += (W + W.T) / 2
            g[at] += W @ off
            chi2 += float(off @ W @ off)
        return Normal(H=H, g=g, chi2=chi2)
