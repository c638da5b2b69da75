"""The pose of a target in one view, with every rival solution that explains the view nearly as well.

Owns      PnP over all markers seen together, its two-fold ambiguities, the information of a view.
Leaves    choosing between rivals by other frames and cameras to resting_target and moved_target.

A square seen nearly face on has two poses of nearly equal error (Collins and Bartoli, "Infinitesimal plane-based pose
estimation", 2014), and iterations started from the wrong one of a box's face may stay there. Every marker therefore
offers both of its planar solutions, all corners together refine them, and what ends in different places is kept apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from aruco import lens
from aruco.model import Camera, Detection
from aruco.pose_math import (
    Array,
    Pose,
    exp_se3,
    invert_transform,
    make_pose,
    pose_distance,
    rvec_tvec_to_matrix,
    skew,
    transform_points,
)

# Rivals differ by the tilt that a reflection about the viewing ray gives: far more than this, even for flat views.
SAME_POSE_RAD = np.radians(1.0)
SAME_POSE_SHARE = 0.01  # of the distance
# Starts this many times farther apart still end in one place, and are refined once.
TWIN_STARTS = 3.0
# Points this flat, as a share of their extent, are a plane; this narrow, a line.
FLAT = 1e-3
MAX_RIVALS = 4
MAX_STEPS = 100  # from a far start; from a near one it takes five
CONVERGED = 1e-9
# A rival is ruled out when its misfit is worse by five standard deviations of the corners' noise; what the fit of one
# square's edges promises is optimistic for real lenses and prints, so the noise is never taken below MIN_SIGMA_PX.
RULED_OUT_CHI2 = 25.0
MIN_SIGMA_PX = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """One pose that explains a view."""

    T_cam_target: Pose
    chi2: float  # weighted squared residuals of all corners
    rms_px: float  # per corner
    information: Array  # (6, 6) of the left perturbation in camera axes, for unit scale of the corners' sigma


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """What one camera knows about the target in one frame."""

    camera: str
    frame: int
    ids: tuple[int, ...]
    n_corners: int  # of all of them
    candidates: tuple[Candidate, ...]  # best first, at least one

    @property
    def best(self) -> Candidate:
        """The candidate with the smallest residuals."""
        return self.candidates[0]

    @property
    def dof(self) -> int:
        """Residuals beyond the six that a pose absorbs."""
        return 2 * self.n_corners - 6

    def is_ambiguous(self, scale2: float) -> bool:
        """Whether a rival cannot be ruled out when the corners' variances are ``scale2`` times what they say."""
        if len(self.candidates) < 2:
            return False
        return self.candidates[1].chi2 - self.best.chi2 < RULED_OUT_CHI2 * scale2


def variance_factor(views: Sequence[View]) -> float:
    """How many times larger than promised the variance of a camera's corners is, by the views' own residuals.

    The median over views of chi2 beside the median that its degrees of freedom promise (Wilson and Hilferty 1931);
    never below one.
    """
    ratios = [view.best.chi2 / (view.dof * (1 - 2 / (9 * view.dof)) ** 3) for view in views]
    return max(1.0, float(np.median(ratios)))


def solve_view(camera: Camera, frame: int, detection: Detection, geometry: Mapping[int, Array]) -> View | None:
    """All poses of the target that explain a detection.

    Args:
        camera: Intrinsics and lens.
        frame: Index of the synchronised frame, kept in the result.
        detection: Markers; those that the geometry lacks are ignored.
        geometry: Marker id -> (4, 3) corners [m] in the target frame.

    Returns:
        The view, or None when no pose in front of the camera explains it.
    """
    used = detection.only(np.array([int(i) in geometry for i in detection.ids], dtype=bool))
    if not len(used):
        return None
    points = np.concatenate([geometry[int(i)] for i in used.ids])
    pixels = lens.straighten(camera, used.corners_px.reshape(-1, 2))
    sigma = np.maximum(used.sigma_px.reshape(-1), MIN_SIGMA_PX)
    if not np.isfinite(pixels).all():
        return None
    starts = _starts(camera.K, points, pixels, _flat_parts(points, used.corners_px.shape[1]))
    refined = [_refine(camera.K, points, pixels, sigma, T) for T in starts]
    candidates = _distinct([c for c in refined if c is not None])
    if not candidates:
        return None
    return View(
        camera=camera.name, frame=frame, ids=tuple(map(int, used.ids)), n_corners=len(points), candidates=candidates
    )


def _flat_parts(points: Array, corners_each: int) -> list[slice]:
    """Stretches of points (n, 3) that lie in one plane: every marker, and the whole of a flat target."""
    markers = [slice(k, k + corners_each) for k in range(0, len(points), corners_each)] if corners_each >= 4 else []
    _, spread, _ = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    flat = spread[2] < FLAT * spread[0] if len(points) > 3 else False
    return markers + ([slice(0, len(points))] if flat and len(markers) != 1 else [])


def _starts(K: Array, points: Array, pixels: Array, flat_parts: Sequence[slice]) -> list[Pose]:
    """Both planar solutions of every flat part, and the general one, best first and without near twins."""
    found: list[Pose] = []
    for part in flat_parts:
        found += _planar(K, points[part], pixels[part])
    if len(points) > 4:
        found += _pnp(K, points, pixels, cv2.SOLVEPNP_SQPNP)
    in_front = [T for T in found if (points @ T[2, :3] + T[2, 3] > 0).all()]
    cost = [float((_residuals(K, points, pixels, T)[0] ** 2).sum()) for T in in_front]
    kept: list[Pose] = []
    for k in np.argsort(cost, kind="stable"):
        if len(kept) < MAX_RIVALS and not any(_same(in_front[k], T, rough=TWIN_STARTS) for T in kept):
            kept.append(in_front[k])
    return kept


def _planar(K: Array, points: Array, pixels: Array) -> list[Pose]:
    """Both solutions of coplanar points."""
    # In the plane's own frame: for some planes of the target's frame (z = 0.3 seen from +z) OpenCV 4.14's IPPE is
    # wrong by half a turn.
    middle = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - middle, full_matrices=False)
    if spread[1] < FLAT * spread[0]:  # on a line, or all in one place
        return []
    axes[2] *= np.linalg.det(axes)
    T_target_plane = make_pose(axes.T, middle)
    T_plane_target = invert_transform(T_target_plane)
    on_plane = transform_points(T_plane_target, points) * [1.0, 1.0, 0.0]
    return [T_cam_plane @ T_plane_target for T_cam_plane in _pnp(K, on_plane, pixels, cv2.SOLVEPNP_IPPE)]


def _pnp(K: Array, points: Array, pixels: Array, method: int) -> list[Pose]:
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(points, pixels, K, None, flags=method)
    except cv2.error:  # collapsed or collinear corners: no pose from these
        return []
    poses = [rvec_tvec_to_matrix(np.asarray(r, np.float64), np.asarray(t, np.float64)) for r, t in zip(rvecs, tvecs)]
    return [T for T in poses if np.isfinite(T).all()]


def _residuals(K: Array, points: Array, pixels: Array, T_cam_target: Pose) -> tuple[Array, Array]:
    """Pinhole pixels minus measured (n, 2), and the points in the camera frame (n, 3)."""
    p = points @ T_cam_target[:3, :3].T + T_cam_target[:3, 3]
    projected = p[:, :2] / p[:, 2:] @ K[:2, :2].T + K[:2, 2]
    return projected - pixels, p


def _jacobian(K: Array, p: Array) -> Array:
    """d(pixel) / d(twist of a left perturbation), (n, 2, 6), for points p (n, 3) in the camera frame."""
    z = p[:, 2]
    d_point = np.zeros((len(p), 2, 3))
    d_point[:, 0, 0] = d_point[:, 1, 1] = 1 / z
    d_point[:, :, 2] = -p[:, :2] / z[:, None] ** 2
    d_point = K[:2, :2] @ d_point
    return np.concatenate([-d_point @ skew(p), d_point], axis=2)


def _refine(K: Array, points: Array, pixels: Array, sigma: Array, T: Pose) -> Candidate | None:
    """Levenberg-Marquardt from a start; None when it leaves the room in front of the camera."""
    weight = np.repeat(1 / sigma, 2)
    r, p = _residuals(K, points, pixels, T)
    cost = float(((r.ravel() * weight) ** 2).sum())
    damping = 1e-6
    for _ in range(MAX_STEPS):
        J = _jacobian(K, p).reshape(-1, 6) * weight[:, None]
        H = J.T @ J
        g = J.T @ (r.ravel() * weight)
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
        T_new = exp_se3(step) @ T
        r_new, p_new = _residuals(K, points, pixels, T_new)
        cost_new = float(((r_new.ravel() * weight) ** 2).sum())
        if (p_new[:, 2] <= 0).any() or not cost_new <= cost:
            damping = max(damping, 1e-6) * 10
            if damping > 1e6:
                break
            continue
        converged = cost - cost_new <= CONVERGED * cost
        T, r, p, cost, damping = T_new, r_new, p_new, cost_new, damping / 10
        if converged:
            break
    if not np.isfinite(cost) or (p[:, 2] <= 0).any():
        return None
    J = _jacobian(K, p).reshape(-1, 6) * weight[:, None]
    rms = float(np.sqrt((r**2).sum(axis=1).mean()))
    return Candidate(T_cam_target=make_pose(T[:3, :3], T[:3, 3]), chi2=cost, rms_px=rms, information=J.T @ J)


def _same(T_a: Pose, T_b: Pose, rough: float = 1.0) -> bool:
    angle, distance = pose_distance(T_a, T_b)
    reach = float(np.linalg.norm(T_a[:3, 3]))
    return angle < rough * SAME_POSE_RAD and distance < rough * SAME_POSE_SHARE * reach


def _distinct(candidates: list[Candidate]) -> tuple[Candidate, ...]:
    kept: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda c: c.chi2):
        if not any(_same(candidate.T_cam_target, other.T_cam_target) for other in kept):
            kept.append(candidate)
    return tuple(kept)
