"""Markers and depth in one estimate: poses, every camera's depth bias, and the floor that all cameras see.

Owns      residuals of tiles and their derivatives, Gauss-Newton over all unknowns, the covariance.
Leaves    whether the result may be believed to depth_refine, the markers' equations to their maker.

Markers enter as their normal equations at their own optimum: depth moves poses by fractions of what is known of them,
over which these hold. A tile of camera c on a plane q measures

    e = 1 / corrected(z) - q . r        with  q = n_cam / o_cam,  n_cam = R^T n,  o_cam = o - n . t

for the camera's pose (R, t), the plane n . X = o in the world, and the tile's mean ray r. A left twist (w, v) of the
camera in world axes changes ``q . r`` by ``-w . (n x R r) / o_cam + (q . r) (w . (t x n) + v . n) / o_cam``; a twist of
the plane by the opposite.

A rectification that is off by a fraction of a milliradian makes disparity wrong not only by a constant but by one that
grows across the image. This *lean*, ``l . (x, y)`` in inverse depth, looks like a turn of the camera, and with it the
floor says much less of it; so it is an unknown of every camera, whose size the caller finds out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aruco.depth_bias import MAX_SCALE, DepthBias, DepthModel
from aruco.depth_noise import DEFAULT_FOCAL_BASELINE
from aruco.depth_tiles import FLOOR, MAD_TO_SIGMA, Tiles
from aruco.pose_math import Array, Pose, exp_se3

# 95 % efficient for clean Gaussian tiles (Holland and Welsch 1977), deaf to things that lie on the floor.
KAPPA = 2.385
# Of clean tiles, what the estimate knows over its sum of squared weights: E[psi']^2 / E[psi^2] / E[w^2] for psi = w x.
CURVATURE = 1.206
MAX_STEPS = 25
CONVERGED = 1e-3  # of what is known of an unknown


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MarkerEquations:
    """What markers know about the poses of c cameras and k targets: the optimum is at -H^-1 g from the poses given."""

    cameras: tuple[str, ...]
    targets: tuple[int, ...]  # frames in which depth measures a target
    T_world_cam: Pose  # (c, 4, 4)
    T_world_target: Pose  # (k, 4, 4)
    free: NDArray[np.bool_]  # (c + k,) poses that may move; the others carry the world
    H: Array  # (6 (c + k),) squared, of left twists in world axes, cameras first; information, not mere sums
    g: Array  # (6 (c + k),)
    # (6 (c + k), d) how far all poses may be off together, one sigma each, for reasons that the markers do not show, as
    # shifted edges: no reason to trust depth more unless it asks for it, but part of what is not known in the end.
    doubt: Array | None = None

    def doubting(self) -> MarkerEquations:
        """The same optimum, less sure of by the doubts."""
        if self.doubt is None:
            return self
        free = np.repeat(self.free, 6)
        P = inverse_over(self.H, free)
        H = inverse_over(P + self.doubt @ self.doubt.T, free)
        return replace(self, H=H, g=H @ P @ self.g, doubt=None)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthSensor:
    """What is known of one camera's depth before it is used."""

    model: DepthModel
    focal_baseline: float | None
    prior: Array  # (2, 2) diagonal covariance of (scale, inverse depth [1/m] or offset [m])
    lean_unit: float = 1.0 / DEFAULT_FOCAL_BASELINE  # inverse depth [1/m] of one pixel of disparity


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Poses, biases and floor that fit best, and how well they are known."""

    T_world_cam: Pose  # (c, 4, 4)
    T_world_target: Pose  # (k, 4, 4)
    twist: Array  # (6 (c + k),) how far they are from the poses given
    bias: Array  # (c, 2) scale, and inverse depth or offset
    lean: Array  # (c, 2) growth of inverse depth across the image, along x and y of the ray [1/m]
    floor: tuple[Array, float] | None  # normal and normal . X, world
    scale: float = 1.0  # residuals in what the tiles promise; never below one
    covariance: Array | None = None  # of (twist, bias, lean); with what fixed biases leave open
    cost: float = 0.0  # twice the negative logarithm of the likelihood, up to what does not depend on the unknowns
    known: Array | None = None  # (c, 2) what the data know of each camera's bias, in its prior's information; ascending


def given_estimate(markers: MarkerEquations, floor: tuple[Array, float] | None) -> Estimate:
    """The poses given, with true depth."""
    n = len(markers.cameras)
    return Estimate(
        T_world_cam=markers.T_world_cam,
        T_world_target=markers.T_world_target,
        twist=np.zeros(6 * len(markers.free)),
        bias=np.zeros((n, 2)),
        lean=np.zeros((n, 2)),
        floor=floor,
    )


def start_estimate(markers: MarkerEquations, floor: tuple[Array, float] | None) -> Estimate:
    """Where the markers' optimum is, with true depth."""
    free = np.repeat(markers.free, 6)
    x = np.zeros(len(free))
    if free.any():
        x[free] = -np.linalg.solve(markers.H[np.ix_(free, free)], markers.g[free])
    return _moved(given_estimate(markers, floor), np.concatenate([x, np.zeros(4 * len(markers.cameras) + 3)]))


def fuse(
    markers: MarkerEquations,
    tiles: Tiles,
    sensors: Mapping[str, DepthSensor],
    start: Estimate,
    *,
    lean_px: float,
    fixed_bias: NDArray[np.bool_] | None = None,
    fixed_poses: bool = False,
    scale: float | None = None,
) -> Estimate:
    """The most likely poses, biases and floor.

    Args:
        markers: What markers know.
        tiles: What depth says.
        sensors: Camera -> its depth.
        start: Near the result; a floor there is estimated too, without one tiles on it are not used.
        lean_px: Standard deviation of the leans: disparity a unit of the ray; 0: there are none.
        fixed_bias: (c, 2) parameters that stay zero; what is not known of them is part of the covariance.
        fixed_poses: Estimate floor and biases alone; what is not known of the poses is part of the covariance.
        scale: Of the residuals; None: from themselves.
    """
    if start.floor is None:
        tiles = tiles.only(tiles.target != FLOOR)
    problem = _Problem(markers, tiles, tuple(sensors[name] for name in markers.cameras), lean_px)
    n_cam = len(markers.cameras)
    poses = np.repeat(markers.free & (not fixed_poses), 6)
    held = np.zeros((n_cam, 2), dtype=bool) if fixed_bias is None else fixed_bias
    leans = np.full(2 * n_cam, lean_px > 0)
    free = np.concatenate([poses, ~held.ravel(), leans, np.full(3, start.floor is not None)])
    at, said = replace(start, bias=np.where(held, 0.0, start.bias)), scale or 1.0
    for _ in range(MAX_STEPS):
        e, J = problem.rows(at)
        if scale is None:
            said = robust_scale(e / tiles.alone)
        w = _weights(e, tiles.sigma * said)
        A, b = problem.normal(at, e, J, w)
        step = np.zeros(len(free))
        step[free] = -_solved(A, b, free)
        at = _moved(at, step)
        if (step[free] ** 2 * np.diag(A)[free]).max(initial=0.0) < CONVERGED**2:
            break
    return problem.known(replace(at, scale=said), free)


def without_lean(
    markers: MarkerEquations, tiles: Tiles, sensors: Mapping[str, DepthSensor], at: Estimate, held: NDArray[np.bool_]
) -> Estimate:
    """The biases that are best where nothing else is taken out of the depth: poses stay, and there are no leans.

    Whoever corrects depth later has these two numbers a camera alone.
    """
    start = replace(at, lean=np.zeros_like(at.lean))
    return fuse(markers, tiles, sensors, start, lean_px=0.0, fixed_bias=held, fixed_poses=True, scale=at.scale)


def residuals(tiles: Tiles, at: Estimate, sensors: Mapping[str, DepthSensor], markers: MarkerEquations) -> Array:
    """Residuals (n,) of tiles in their standard deviations; NaN where a bias leaves no depth, or without a floor."""
    return _Problem(markers, tiles, tuple(sensors[name] for name in markers.cameras)).rows(at)[0] / tiles.sigma


def robust_scale(normalised: Array) -> float:
    """How many times larger residuals are than promised, never below one: the mean over a surface needs the promise."""
    good = normalised[np.isfinite(normalised)]
    return max(1.0, MAD_TO_SIGMA * float(np.median(np.abs(good)))) if len(good) else 1.0


def bias_of(sensor: DepthSensor, parameters: Array, covariance: Array | None = None) -> DepthBias:
    """A camera's bias from its two parameters."""
    scale, second = float(parameters[0]), float(parameters[1])
    fB = sensor.focal_baseline
    if sensor.model == "offset":
        return DepthBias(model="offset", scale=scale, offset_m=second, covariance=covariance)
    return DepthBias(scale=scale, inverse_depth=second, focal_baseline=fB, covariance=covariance)


def _weights(e: Array, sigma: Array) -> Array:
    """Cauchy weights (n,) over variances; zero for what is no residual."""
    with np.errstate(invalid="ignore"):
        return np.where(np.isfinite(e), 1.0 / (sigma**2 * (1.0 + (e / sigma / KAPPA) ** 2)), 0.0)


def _solved(A: Array, b: Array, free: NDArray[np.bool_]) -> Array:
    """The solution for the free unknowns, their scales balanced first."""
    M, right = A[np.ix_(free, free)], b[free]
    d = 1.0 / np.sqrt(np.maximum(np.diag(M), 1e-12))
    return d * np.linalg.lstsq(M * np.outer(d, d), d * right, rcond=1e-12)[0]


def _moved(at: Estimate, step: Array) -> Estimate:
    n, n_pose = len(at.T_world_cam), len(at.twist)
    twists, bias, lean = step[:n_pose].reshape(-1, 6), *step[n_pose:-3].reshape(2, n, 2)
    floor = at.floor
    if floor is not None:
        normal = floor[0] + _tangents(floor[0]).T @ step[-3:-1]
        floor = (normal / np.linalg.norm(normal), floor[1] + float(step[-1]))
    return replace(
        at,
        T_world_cam=_left_moved(at.T_world_cam, twists[:n]),
        T_world_target=_left_moved(at.T_world_target, twists[n:]),
        twist=at.twist + step[:n_pose],
        bias=np.clip(at.bias + bias, -MAX_SCALE, MAX_SCALE),
        lean=at.lean + lean,
        floor=floor,
    )


def _left_moved(T: Pose, steps: Array) -> Pose:
    """Poses (k, 4, 4) after left twists (k, 6); those without a twist stay to the bit."""
    if not len(T):
        return T
    return np.array([exp_se3(xi) @ pose if xi.any() else pose for xi, pose in zip(steps, T)])


def _tangents(normal: Array) -> Array:
    """Two unit vectors (2, 3) across a unit normal and each other."""
    a = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    a = a / np.linalg.norm(a)
    return np.stack([a, np.cross(normal, a)])


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The unknowns: twists of cameras and targets, bias and lean of every camera, two tilts and height of the floor."""

    markers: MarkerEquations
    tiles: Tiles
    sensors: tuple[DepthSensor, ...]
    lean_px: float = 0.0

    def rows(self, at: Estimate) -> tuple[Array, Array]:
        """Residuals (n,) [1/m] and their derivatives (n, m)."""
        tiles, n_cam = self.tiles, len(at.T_world_cam)
        n_pose = len(at.twist)
        n, o = self._planes(at)
        R, t = at.T_world_cam[tiles.camera, :3, :3], at.T_world_cam[tiles.camera, :3, 3]
        along = np.einsum("nij,nj->ni", R, tiles.ray)
        o_cam = o - (n * t).sum(axis=1)
        inverse = (n * along).sum(axis=1) / o_cam
        twist = np.concatenate([-np.cross(n, along) + inverse[:, None] * np.cross(t, n), inverse[:, None] * n], axis=1)
        twist /= o_cam[:, None]
        measured, d_bias = self._measured(at.bias)
        J = np.zeros((len(tiles), n_pose + 4 * n_cam + 3))
        every = np.arange(len(tiles))
        J[every[:, None], 6 * tiles.camera[:, None] + np.arange(6)] = -twist
        on_target = np.flatnonzero(tiles.target != FLOOR)
        J[on_target[:, None], 6 * (n_cam + tiles.target[on_target])[:, None] + np.arange(6)] = twist[on_target]
        J[every[:, None], n_pose + 2 * tiles.camera[:, None] + np.arange(2)] = d_bias
        J[every[:, None], n_pose + 2 * (n_cam + tiles.camera)[:, None] + np.arange(2)] = -tiles.ray[:, :2]
        if at.floor is not None:
            on_floor = tiles.target == FLOOR
            tilt = (along + inverse[:, None] * t)[on_floor] @ _tangents(at.floor[0]).T
            J[on_floor, -3:] = -np.column_stack([tilt, -inverse[on_floor]]) / o_cam[on_floor, None]
        measured = measured - (at.lean[tiles.camera] * tiles.ray[:, :2]).sum(axis=1)
        good = np.isfinite(measured) & (o_cam != 0)
        return np.where(good, measured - inverse, np.nan), np.where(good[:, None], J, 0.0)

    def _planes(self, at: Estimate) -> tuple[Array, Array]:
        """Normals (n, 3) and offsets (n,) of the tiles' surfaces, world."""
        tiles = self.tiles
        floor_normal, floor_offset = (np.full(3, np.nan), np.nan) if at.floor is None else at.floor
        normal = np.tile(floor_normal, (len(tiles), 1))
        offset = np.full(len(tiles), floor_offset)
        on = tiles.target != FLOOR
        T = at.T_world_target[tiles.target[on]]
        normal[on] = np.einsum("nij,nj->ni", T[:, :3, :3], tiles.normal[on])
        offset[on] = tiles.offset_m[on] + (normal[on] * T[:, :3, 3]).sum(axis=1)
        return normal, offset

    def _measured(self, bias: Array) -> tuple[Array, Array]:
        """True inverse depth (n,) that tiles measure, and its derivatives (n, 2) by their camera's bias."""
        tiles = self.tiles
        measured, derivative = np.full(len(tiles), np.nan), np.zeros((len(tiles), 2))
        for c, sensor in enumerate(self.sensors):
            mine = tiles.camera == c
            z = 1.0 / tiles.inverse[mine]
            said = bias_of(sensor, bias[c])
            measured[mine] = 1.0 / said.corrected(z)
            derivative[mine] = -(said.derivative(z) * measured[mine] ** 2).T
        return measured, derivative

    def normal(self, at: Estimate, e: Array, J: Array, w: Array) -> tuple[Array, Array]:
        """Information (m, m) and gradient (m,) of everything."""
        JW = J.T * w
        A, b = JW @ J, JW @ np.nan_to_num(e)
        n_pose = len(at.twist)
        A[:n_pose, :n_pose] += self.markers.H
        b[:n_pose] += self.markers.H @ at.twist + self.markers.g
        for c, sensor in enumerate(self.sensors):
            mine = slice(n_pose + 2 * c, n_pose + 2 * c + 2)
            prior = np.linalg.inv(sensor.prior)
            A[mine, mine] += prior
            b[mine] += prior @ at.bias[c]
            if self.lean_px > 0:
                leans = n_pose + 2 * (len(self.sensors) + c) + np.arange(2)
                A[leans, leans] += 1.0 / (self.lean_px * sensor.lean_unit) ** 2
                b[leans] += at.lean[c] / (self.lean_px * sensor.lean_unit) ** 2
        return A, b

    def known(self, at: Estimate, free: NDArray[np.bool_]) -> Estimate:
        """The estimate with its covariance, and with what data say about the biases."""
        e, J = self.rows(at)
        sigma = self.tiles.sigma * at.scale
        # Squared weights as in rigcal.solve.adjust; tiles have one coordinate, corners two.
        A, _ = self.normal(at, e, J, CURVATURE * _weights(e, sigma) ** 2 * sigma**2)
        n_pose, n_cam = len(at.twist), len(at.bias)
        P, follows = self._with_held(A, inverse_over(A, free), free)
        if self.markers.doubt is not None:
            off = follows @ self.markers.doubt
            P = P + off @ off.T
        known = np.array([self._information(A, free, n_pose + 2 * c, self.sensors[c]) for c in range(n_cam)])
        return replace(at, covariance=P[:-3, :-3], known=known.reshape(n_cam, 2), cost=self._cost(at, e, sigma))

    def _cost(self, at: Estimate, e: Array, sigma: Array) -> float:
        free = np.repeat(self.markers.free, 6)
        off = at.twist[free] + np.linalg.solve(self.markers.H[np.ix_(free, free)], self.markers.g[free])
        total = off @ self.markers.H[np.ix_(free, free)] @ off
        total += KAPPA**2 * float(np.log1p(np.nan_to_num(e / sigma / KAPPA) ** 2).sum())
        for bias, lean, sensor in zip(at.bias, at.lean, self.sensors):
            total += float(bias @ np.linalg.solve(sensor.prior, bias))
            total += 0.0 if self.lean_px <= 0 else float(((lean / (self.lean_px * sensor.lean_unit)) ** 2).sum())
        return float(total)

    def _with_held(self, A: Array, P: Array, free: NDArray[np.bool_]) -> tuple[Array, Array]:
        """A covariance P, with what poses and biases add that were held, but are no better known than beforehand.

        And how far everything is off (m, 6 (c + k)) when markers are.
        """
        n_pose, n_bias = len(self.markers.H), 2 * len(self.sensors)
        movable = np.repeat(self.markers.free, 6)
        held = np.flatnonzero(~free[: n_pose + n_bias] & np.append(movable, np.ones(n_bias, dtype=bool)))
        follows = P[:, :n_pose] @ self.markers.H
        if not len(held):
            return P, follows
        before = np.diag(np.append(np.zeros(n_pose), [np.diag(sensor.prior) for sensor in self.sensors]))
        before[:n_pose, :n_pose] = inverse_over(self.markers.H, movable)
        response = -P @ A[:, held]
        response[held] = np.eye(len(held))
        poses = held < n_pose
        follows[:, held[poses]] = response[:, poses]
        return P + response @ before[np.ix_(held, held)] @ response.T, follows

    def _information(self, A: Array, free: NDArray[np.bool_], first: int, sensor: DepthSensor) -> Array:
        """Eigenvalues (2,), ascending, of what everything but its prior knows of one camera's bias, in the prior's."""
        mine = np.arange(first, first + 2)
        others = free.copy()
        others[mine] = False
        C = A[np.ix_(mine, others)]
        root = np.linalg.cholesky(sensor.prior)
        data = A[np.ix_(mine, mine)] - C @ inverse_over(A, others)[np.ix_(others, others)] @ C.T
        return np.linalg.eigvalsh(root.T @ data @ root) - 1.0


def inverse_over(A: Array, free: NDArray[np.bool_]) -> Array:
    """The inverse over the free unknowns, zero elsewhere: covariance from information, and back."""
    P = np.zeros_like(A)
    M = A[np.ix_(free, free)]
    d = 1.0 / np.sqrt(np.maximum(np.diag(M), 1e-24))
    inverse = np.linalg.pinv(M * np.outer(d, d), rcond=1e-13, hermitian=True) * np.outer(d, d)
    P[np.ix_(free, free)] = (inverse + inverse.T) / 2
    return P
