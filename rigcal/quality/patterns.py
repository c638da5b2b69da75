"""What residuals look like: a wrong focal length, a wrong lens, a print stretched or of another size.

Owns      the test of each such fault against the residuals of a finished adjustment.
Leaves    residuals of single views and markers to rigcal.solve.

Every fault is one more unknown, a number that ought to be zero. Its best value, and how much of the residuals it would
explain, follow from one linear step of the adjustment in which it is free beside all poses (Rao's score test, 1948):
the poses are eliminated first, because they absorb most of what a wrong focal length does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.model import Camera
from aruco.pose_math import Array, Pose, invert_transform, skew, transform_points

Kind = Literal["focal", "aspect", "lens", "centre_x", "centre_y", "print_stretch", "print_size"]
OF_CAMERA: tuple[Kind, ...] = ("focal", "aspect", "lens", "centre_x", "centre_y")
OF_TARGET: tuple[Kind, ...] = ("print_stretch", "print_size")
# From where on each number is worth a word. A focal length wrong by half a percent puts a camera 10 mm off at 2 m, a
# marker wrong by as much likewise; 0.02 of the third power of a normalised radius is 1.8 px at 350 px from the middle
# of a lens with f = 700 px, ten pixels of a principal point turn a camera by a degree.
WORTH_A_WORD: dict[Kind, float] = {
    "focal": 0.005,
    "aspect": 0.005,
    "lens": 0.02,
    "centre_x": 10.0,
    "centre_y": 10.0,
    "print_stretch": 0.005,
    "print_size": 0.005,
}
# Chance alone, over some dozens of faults tested, passes this once in a hundred rigs.
MIN_SIGMAS = 3.5
# Residuals of real lenses and prints repeat, and a fault that explains little of them may be made up of others: it is
# believed from this share on, or when nothing else could be so many sigmas.
MIN_EXPLAINED = 0.15
ENOUGH_SIGMAS = 10.0
# One fault of all cameras is believed before that of one only when it explains more by this factor.
ALL_BEFORE_ONE = 1.1
_OWN = 6 + len(OF_CAMERA)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Corners:
    """Corners of an adjustment that is finished, with the poses it found."""

    cameras: Sequence[Camera]
    T_world_cam: Array  # (c, 4, 4)
    T_world_target: Array  # (f, 4, 4)
    moving: bool  # whether targets are unknowns; otherwise they carry the world
    camera: NDArray[np.int64]  # (n,)
    frame: NDArray[np.int64]  # (n,)
    marker: NDArray[np.int64]  # (n,)
    points: Array  # (n, 3) target frame [m]
    pixels: Array  # (n, 2)
    sigma_px: Array  # (n,)
    scale: float  # robust standard deviation of residuals, in sigmas


@dataclass(frozen=True, slots=True, kw_only=True)
class Pattern:
    """One fault that explains the residuals."""

    kind: Kind
    camera: str  # "" for all cameras or the target
    value: float  # share, pixels, or coefficient
    sigma: float
    explained: float  # share of the squared residuals

    @property
    def size(self) -> float:
        """How many times larger the fault surely is than what is worth a word; at least one."""
        return max(1.0, (abs(self.value) - 2 * self.sigma) / WORTH_A_WORD[self.kind])

    @property
    def sentence(self) -> str:
        """What it looks like and what to do about it."""
        whose = f"camera {self.camera}" if self.camera else "all cameras"
        way = "long" if self.value < 0 else "short"
        off = f"{100 * abs(self.value):.1f} percent"
        check = "check that camera_info.yaml belongs to this camera, lens and resolution, or calibrate it again"
        if self.kind == "focal":
            return f"The residuals look like a focal length of {whose} that is about {off} too {way}: {check}."
        if self.kind == "aspect":
            return f"The residuals of {whose} look like pixels that are not square by {off}: {check}."
        if self.kind == "lens":
            return f"The residuals of {whose} grow with the distance from the image centre like a wrong lens: {check}."
        if self.kind in ("centre_x", "centre_y"):
            return (
                f"The residuals look like a principal point of {whose} that is {abs(self.value):.0f} px off: {check}."
            )
        if self.kind == "print_stretch":
            return (
                f"The markers look {off} {'wider' if self.value > 0 else 'higher'} than they are in the marker map: "
                "measure a printed marker in both directions and print again without fitting to the page."
            )
        return (
            f"The markers look {off} {'larger' if self.value > 0 else 'smaller'} than the marker map says for the "
            "distances between them: measure a printed marker and correct the map."
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Tested:
    """What the residuals say about all faults."""

    clearest: Pattern | None
    # Camera -> the smallest error (share) of its focal length that would be noticed. A camera that stands farther off
    # with a longer focal length sees nearly the same, so this is how far its distance is checked at all.
    focal_noticed: Mapping[str, float]


def search_patterns(corners: Corners) -> Tested:
    """Every fault against the residuals: the one that explains them best, if clear, and what would go unnoticed."""
    if not len(corners.points):
        return Tested(clearest=None, focal_noticed={})
    R, g, chi2 = _reduced(corners)
    needed = float(np.clip(np.sqrt(MIN_EXPLAINED * chi2) / corners.scale, MIN_SIGMAS, ENOUGH_SIGMAS))
    best: Pattern | None = None
    strongest = 0.0
    noticed: dict[str, float] = {}
    for kind, camera, u in _hypotheses(corners.cameras):
        curvature = max(float(u @ R @ u), 1e-12)  # zero where the poses absorb the fault altogether
        value, sigma = -float(u @ g) / curvature, float(corners.scale / np.sqrt(curvature))
        explained = float(u @ g) ** 2 / curvature / chi2
        if kind == "focal" and camera:
            noticed[camera] = max(needed * sigma, WORTH_A_WORD[kind])
        strength = explained / (ALL_BEFORE_ONE if not camera and kind in OF_CAMERA else 1.0)
        if abs(value) > max(WORTH_A_WORD[kind], needed * sigma) and strength > strongest:
            strongest = strength
            best = Pattern(kind=kind, camera=camera, value=value, sigma=sigma, explained=min(explained, 1.0))
    return Tested(clearest=best, focal_noticed=noticed)


def _hypotheses(cameras: Sequence[Camera]) -> Iterator[tuple[Kind, str, Array]]:
    """Each fault, of one camera, of all, or of the target, as a direction among all unknown faults."""
    n = len(cameras) * len(OF_CAMERA)
    unit = np.eye(n + len(OF_TARGET))
    for k, kind in enumerate(OF_CAMERA):
        for c, camera in enumerate(cameras):
            yield kind, camera.name, unit[c * len(OF_CAMERA) + k]
        if len(cameras) > 1:
            yield kind, "", unit[k : n : len(OF_CAMERA)].sum(axis=0)
    for k, kind in enumerate(OF_TARGET):
        yield kind, "", unit[n + k]


def _reduced(corners: Corners) -> tuple[Array, Array, float]:
    """Normal equations of all faults after the poses are eliminated, and the weighted squared residuals."""
    n_cam = len(corners.cameras)
    size = n_cam * _OWN + len(OF_TARGET)
    H, g, chi2 = np.zeros((size, size)), np.zeros(size), 0.0
    prints = np.stack(_print_faults(corners), axis=2)
    order = np.lexsort([corners.camera, corners.frame])
    for rows in np.split(order, np.flatnonzero(np.diff(corners.frame[order])) + 1):
        E, H_target, g_target = np.zeros((size, 6)), np.zeros((6, 6)), np.zeros(6)
        for mine in np.split(rows, np.flatnonzero(np.diff(corners.camera[rows])) + 1):
            J, r = _view_rows(corners, mine, prints[mine])
            first = int(corners.camera[mine[0]]) * _OWN
            at = np.r_[first : first + _OWN, size - len(OF_TARGET) : size]
            H[np.ix_(at, at)] += J.T @ J
            g[at] += J.T @ r
            # A camera's derivative is the target's with the other sign.
            E[at] -= J.T @ J[:, :6]
            H_target += J[:, :6].T @ J[:, :6]
            g_target -= J[:, :6].T @ r
            chi2 += float(r @ r)
        if corners.moving:
            Y = E @ np.linalg.pinv(H_target, rcond=1e-12, hermitian=True)
            H -= Y @ E.T
            g -= Y @ g_target
    own = np.arange(n_cam * _OWN).reshape(n_cam, _OWN)
    # The world is where the first camera stands, unless the target carries it.
    pose = own[int(corners.moving) :, :6].ravel()
    fault = np.concatenate([own[:, 6:].ravel(), np.arange(n_cam * _OWN, size)])
    Y = H[np.ix_(fault, pose)] @ np.linalg.pinv(H[np.ix_(pose, pose)], rcond=1e-12, hermitian=True)
    return H[np.ix_(fault, fault)] - Y @ H[np.ix_(pose, fault)], g[fault] - Y @ g[pose], chi2


def _view_rows(corners: Corners, mine: NDArray[np.int64], prints: Array) -> tuple[Array, Array]:
    """Of one view, weighted: derivatives by the camera's pose, its faults and the print (2n, 13); residuals (2n,)."""
    c = int(corners.camera[mine[0]])
    camera, T_cam_world = corners.cameras[c], invert_transform(corners.T_world_cam[c])
    T_world_target = corners.T_world_target[corners.frame[mine[0]]]
    T = T_cam_world @ T_world_target
    p = transform_points(T, corners.points[mine])
    D, faults = _pixel_derivatives(camera, p)
    r = lens.project(camera, p) - corners.pixels[mine]
    weight = 1.0 / corners.sigma_px[mine]
    # The Cauchy weight of rigcal.solve, under which these poses are the optimum.
    weight /= np.sqrt(1.0 + (r**2).sum(axis=1) * weight**2 / (2.385 * corners.scale) ** 2)
    twist = _twist(T_world_target, corners.points[mine], D @ T_cam_world[:3, :3])
    J = np.concatenate([-twist, faults, D @ T[:3, :3] @ prints], axis=2) * weight[:, None, None]
    return J.reshape(2 * len(mine), -1), (r * weight[:, None]).ravel()


def _twist(T_world_target: Pose, points: Array, by_world: Array) -> Array:
    """d(pixel) / d(left twist of the target in world axes), (n, 2, 6)."""
    in_world = points @ T_world_target[:3, :3].T + T_world_target[:3, 3]
    return np.concatenate([-by_world @ skew(in_world), by_world], axis=2)


def _pixel_derivatives(camera: Camera, p: Array) -> tuple[Array, Array]:
    """d(pixel) / d(point in the camera) (n, 2, 3), and by the faults OF_CAMERA (n, 2, 5)."""
    z = p[:, 2]
    x = p[:, :2] / z[:, None]
    distorted, D = lens.distort(camera, x)
    K = camera.K[:2, :2]
    d_normal = np.zeros((len(p), 2, 3))
    d_normal[:, 0, 0] = d_normal[:, 1, 1] = 1.0 / z
    d_normal[:, :, 2] = -x / z[:, None]
    by_point = K @ D @ d_normal
    away = distorted @ K.T  # pixels from the principal point
    cubic = (x * (x**2).sum(axis=1, keepdims=True)) @ K.T
    ones, zeros = np.ones_like(z), np.zeros_like(z)
    faults = np.stack(
        [away, away * [0.5, -0.5], cubic, np.stack([ones, zeros], axis=1), np.stack([zeros, ones], axis=1)], axis=2
    )
    return by_point, faults


def _print_faults(corners: Corners) -> tuple[Array, Array]:
    """How corners move in the target when prints are stretched in x against y, and when they grow: (n, 3) each."""
    n = len(corners.marker)
    if n % 4 or (corners.marker.reshape(-1, 4) != corners.marker[::4, None]).any():  # a board of single points
        return np.zeros_like(corners.points), np.zeros_like(corners.points)
    quads = corners.points.reshape(-1, 4, 3)
    away = quads - quads.mean(axis=1, keepdims=True)
    x, y = quads[:, 1] - quads[:, 0], quads[:, 3] - quads[:, 0]
    x, y = (v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12) for v in (x, y))
    along_x, along_y = np.einsum("mkj,mj->mk", away, x), np.einsum("mkj,mj->mk", away, y)
    stretched = 0.5 * (along_x[:, :, None] * x[:, None] - along_y[:, :, None] * y[:, None])
    return stretched.reshape(-1, 3), away.reshape(-1, 3)
