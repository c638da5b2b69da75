"""What is known before clouds are compared: poses and depth errors.

Owns      Prior, its normal equations in parts whose sizes are not certain.
Leaves    these sizes to icp_evidence, what clouds say to icp_equations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from aruco.floor_model import centre_jacobian
from aruco.icp_cloud import Cloud
from aruco.icp_equations import State
from aruco.icp_normal import Normal
from aruco.icp_rows import Layout
from aruco.pose_math import Array, Pose, adjoint, invert_transform, log_se3

# Pose errors of one camera where nobody has said them, one sigma; their size is then scaled by the evidence.
DEFAULT_TURN_RAD = math.radians(0.3)
DEFAULT_SHIFT_M = 0.006
# No covariance is believed beyond this: tripods creep, lenses breathe, and it keeps the equations solvable.
LEAST_TURN_RAD = math.radians(0.005)
LEAST_SHIFT_M = 0.0002


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """What is known of a camera's pose without clouds."""

    T_world_cam: Pose
    covariance: Array | None = None  # (6, 6) left perturbation in world axes; None: the default, scaled by the evidence

    def moved(self, T_new_old: Pose) -> Prior:
        """The same in another world, with a covariance that can be inverted."""
        T, Ad = T_new_old @ self.T_world_cam, adjoint(T_new_old)
        if self.covariance is None:
            turn, shift, S = DEFAULT_TURN_RAD, DEFAULT_SHIFT_M, np.zeros((6, 6))
        else:
            turn, shift, S = LEAST_TURN_RAD, LEAST_SHIFT_M, Ad @ self.covariance @ Ad.T
        back = centre_jacobian(T[:3, 3], inverse=True)
        least = back @ np.diag([turn**2] * 3 + [shift**2] * 3) @ back.T
        return Prior(T_world_cam=T, covariance=S + least)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scales:
    """Factors on standard deviations of what is known beforehand."""

    poses: dict[str, float]  # camera -> of its pose
    bias: float = 1.0  # of depth errors that nobody has measured: scale and inverse depth or offset
    lean: float = 1.0  # of their growth across the image


def default_of(camera: str) -> str:
    """The name of the part that is one camera's pose where nobody has said how well it is known."""
    return f"default {camera}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Part:
    """Normal equations of unknowns whose standard deviations share a factor, at a factor of one."""

    normal: Normal
    n: int  # unknowns


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Known:
    """Everything that is known beforehand, in the equations' world."""

    layout: Layout
    poses: dict[str, Prior]  # with a covariance
    given: dict[str, bool]  # whether somebody has said it
    clouds: Mapping[str, Cloud]

    def off(self, state: State, camera: str) -> Array:
        """(6,) how far a camera is from where it should be."""
        return log_se3(state.T_world_cam[camera] @ invert_transform(self.poses[camera].T_world_cam))

    def covariance(self, camera: str, scales: Scales) -> Array:
        """(6, 6) of a camera's given pose."""
        S = self.poses[camera].covariance
        assert S is not None
        return scales.poses[camera] ** 2 * S

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
        return self._summed([*poses, *biases])

    def parts(self, state: State) -> dict[str, Part]:
        """Each pose without a covariance by its camera, those with one, depth errors, lean, and what is measured."""
        cameras, one = self.layout.cameras, Scales(poses=dict.fromkeys(self.layout.cameras, 1.0))
        groups: dict[str, list[tuple[slice, Array, Array]]] = {}
        for c in cameras:
            group = "given" if self.given[c] else default_of(c)
            groups.setdefault(group, []).append((self.layout.pose(c), self.covariance(c, one), self.off(state, c)))
            S, b, k = self.bias_covariance(c, one), state.bias[c], self.layout.bias(c).start
            group = "measured" if self.measured(c) else "bias"
            groups.setdefault(group, []).append((slice(k, k + 2), S[:2, :2], b[:2]))
            groups.setdefault("lean", []).append((slice(k + 2, k + 4), S[2:, 2:], b[2:]))
        return {
            name: Part(normal=self._summed(terms), n=sum(len(off) for _, _, off in terms))
            for name, terms in groups.items()
        }

    def _summed(self, terms: list[tuple[slice, Array, Array]]) -> Normal:
        size = self.layout.size
        H, g, chi2 = np.zeros((size, size)), np.zeros(size), 0.0
        for at, covariance, off in terms:
            W = np.linalg.inv(covariance)
            H[at, at] = (W + W.T) / 2
            g[at] = W @ off
            chi2 += float(off @ W @ off)
        return Normal(H=H, g=g, chi2=chi2)
