"""The adjustment as arrays: which camera saw which corner where.

Owns      gathering sightings into arrays, residuals, their derivatives, and their sums over views.
Leaves    minimising them to adjust.

A corner X of the target in frame f, seen by camera c, is predicted at

    p = project_c(T_cam_world @ T_world_target[f] @ X)

Poses are perturbed on the left in world axes, ``Exp(xi) @ T``: a target's twist moves the corner in the camera as
``Ad(T_cam_world) @ xi`` does, and a camera's twist moves it backwards. So if B (2, 6) is the derivative of a pixel
with respect to a twist in camera axes, every view enters the normal equations through one 6x6 matrix
``W = Ad^T (sum B^T B) Ad`` and one vector ``g = Ad^T (sum B^T r)``, whatever its number of corners: +g for the target,
-g for the camera, W for both, -W between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, adjoint, invert_transform

# A piece of this size fits into a processor's cache a few times over; larger ones are no faster.
CHUNK_CORNERS = 4096
# The residuals' scale is no smaller than this: exact corners, as tests have them, must not divide by zero.
MIN_SCALE = 1e-3
# The upper triangle of a symmetric 6x6 matrix.
_ROW, _COLUMN = np.triu_indices(6)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """n corners in v views of c cameras and f frames; corners of one view stand together, views by camera."""

    cameras: tuple[Camera, ...]  # c
    frames: tuple[int, ...]  # f, labels of the frames
    view_camera: NDArray[np.int64]  # (v,) index into cameras, ascending
    view_frame: NDArray[np.int64]  # (v,) index into frames
    start: NDArray[np.int64]  # (v + 1,) where each view's corners begin
    points: Array  # (n, 3) corners in the target's frame [m]
    pixels: Array  # (n, 2) as recorded
    sigma_px: Array  # (n,) standard deviation of a coordinate
    marker: NDArray[np.int64]  # (n,) id of the marker that a corner belongs to
    least_scale: float = MIN_SCALE  # residuals are never taken for smaller than so many sigmas

    @property
    def n_views(self) -> int:
        """How many views there are."""
        return len(self.view_camera)

    @property
    def corners_per_view(self) -> NDArray[np.int64]:
        """(v,) number of corners."""
        return np.diff(self.start)

    @property
    def corner_view(self) -> NDArray[np.int64]:
        """(n,) index of the view that a corner belongs to."""
        return np.repeat(np.arange(self.n_views), self.corners_per_view)

    def only_views(self, keep: NDArray[np.bool_]) -> Sightings:
        """The views where a mask (v,) is true; cameras and frames keep their numbers."""
        corners = np.repeat(keep, self.corners_per_view)
        return Sightings(
            cameras=self.cameras,
            frames=self.frames,
            view_camera=self.view_camera[keep],
            view_frame=self.view_frame[keep],
            start=np.concatenate([[0], np.cumsum(self.corners_per_view[keep])]),
            points=self.points[corners],
            pixels=self.pixels[corners],
            sigma_px=self.sigma_px[corners],
            marker=self.marker[corners],
            least_scale=self.least_scale,
        )

    def with_noise(self, noise_px: float) -> Sightings:
        """The same with a noise added to every corner that all corners of a view may share.

        The scatter of single corners then says nothing about how wrong a view may be.
        """
        if not noise_px:
            return self
        return replace(self, sigma_px=np.hypot(self.sigma_px, noise_px), least_scale=1.0)


def gather(
    cameras: Sequence[Camera],
    detections: Mapping[str, Mapping[int, Detection]],
    geometry: Mapping[int, Array],
    noise_px: float = 0.0,
) -> Sightings:
    """Arrays of all corners.

    Args:
        cameras: In the order they are to have.
        detections: Camera -> frame -> markers; markers that the geometry lacks are ignored.
        geometry: Marker id -> (k, 3) points [m], target frame.
        noise_px: Model noise; see Sightings.with_noise.
    """
    frames = tuple(sorted({frame for by_frame in detections.values() for frame in by_frame}))
    number = {frame: k for k, frame in enumerate(frames)}
    rows = [
        (c, number[frame], detection)
        for c, camera in enumerate(cameras)
        for frame, detection in sorted(detections.get(camera.name, {}).items())
    ]
    known = [(c, f, d.only(np.array([int(i) in geometry for i in d.ids], dtype=bool))) for c, f, d in rows]
    used = [(c, f, d) for c, f, d in known if len(d)]
    sizes = [d.sigma_px.size for _, _, d in used]
    gathered = Sightings(
        cameras=tuple(cameras),
        frames=frames,
        view_camera=np.array([c for c, _, _ in used], dtype=np.int64),
        view_frame=np.array([f for _, f, _ in used], dtype=np.int64),
        start=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        points=_stacked([geometry[int(i)] for _, _, d in used for i in d.ids], 3),
        pixels=_stacked([d.corners_px.reshape(-1, 2) for _, _, d in used], 2),
        sigma_px=np.concatenate([np.empty(0), *(d.sigma_px.ravel() for _, _, d in used)]),
        marker=np.concatenate([np.empty(0, np.int64), *(np.repeat(d.ids, d.sigma_px.shape[1]) for _, _, d in used)]),
    )
    return gathered.with_noise(noise_px)


def _stacked(parts: Sequence[Array], width: int) -> Array:
    return np.concatenate([np.empty((0, width)), *parts])


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """The unknowns: where cameras and targets are."""

    T_world_cam: Pose  # (c, 4, 4)
    T_world_target: Pose  # (f, 4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class ViewSums:
    """What the corners of every view add to the normal equations, and how far each corner is off."""

    W: Array  # (v, 6, 6) sum of w B^T B, world axes
    g: Array  # (v, 6) sum of w B^T r, world axes
    squares: Array  # (n,) squared distance of every corner, in its variances; NaN behind the camera


def view_sums(sightings: Sightings, poses: Poses, kappa: float, power: int = 1) -> ViewSums:
    """Normal equations of every view, with weights ``(1 + e / kappa^2)^-power`` for squared distances e.

    Args:
        sightings: Corners.
        poses: Where everything is.
        kappa: Scale of the Cauchy loss, in standard deviations of the corners.
        power: 1 for the gradient of the loss, 2 for the mean of its second derivative.
    """
    W = np.empty((sightings.n_views, 21))
    g = np.empty((sightings.n_views, 6))
    squares = np.empty(len(sightings.points))
    for views, corners, r, B in _chunks(sightings, poses):
        e = r[0] ** 2 + r[1] ** 2
        squares[corners] = e
        w = (1.0 + e / kappa**2) ** -power
        starts = sightings.start[views] - sightings.start[views.start]
        u, v = B[0] * w, B[1] * w
        W[views] = _view_totals(u[_ROW] * B[0][_COLUMN] + v[_ROW] * B[1][_COLUMN], starts)
        g[views] = _view_totals(u * r[0] + v * r[1], starts)
    square = np.empty((sightings.n_views, 6, 6))
    square[:, _ROW, _COLUMN] = W
    square[:, _COLUMN, _ROW] = W
    for c, T in enumerate(poses.T_world_cam):
        mine = slice(*np.searchsorted(sightings.view_camera, [c, c + 1]))
        Ad = adjoint(invert_transform(T))
        square[mine] = Ad.T @ square[mine] @ Ad
        g[mine] = g[mine] @ Ad
    return ViewSums(square, g, squares)


@dataclass(frozen=True, slots=True, eq=False)
class DirectionSums:
    """What a shift of every corner along a given direction adds to the normal equations of every view."""

    h: Array  # (v, 6) sum of w B^T s, world axes: coupling with the target's twist
    q: Array  # (v,) sum of w s^T s
    t: Array  # (v,) sum of w s^T r


def direction_sums(sightings: Sightings, poses: Poses, kappa: float, direction: Array) -> DirectionSums:
    """Normal equations for one more unknown a view, which moves corners along ``direction`` (n, 2) [px a unit]."""
    h = np.empty((sightings.n_views, 6))
    q, t = np.empty((2, sightings.n_views))
    for views, corners, r, B in _chunks(sightings, poses):
        w = 1.0 / (1.0 + (r[0] ** 2 + r[1] ** 2) / kappa**2)
        s = direction[corners].T / sightings.sigma_px[corners]
        starts = sightings.start[views] - sightings.start[views.start]
        h[views] = _view_totals(w * (B[0] * s[0] + B[1] * s[1]), starts)
        q[views], t[views] = _view_totals(np.stack([w * (s**2).sum(axis=0), w * (s * r).sum(axis=0)]), starts).T
    for c, T in enumerate(poses.T_world_cam):
        mine = slice(*np.searchsorted(sightings.view_camera, [c, c + 1]))
        h[mine] = h[mine] @ adjoint(invert_transform(T))
    return DirectionSums(h, q, t)


def _view_totals(values: Array, starts: NDArray[np.int64]) -> Array:
    """Sums (v, k) of values (k, n) over corners from each start to the next."""
    size, uneven = divmod(values.shape[1], len(starts))
    if uneven or (np.diff(starts) != size).any():
        return np.add.reduceat(values, starts, axis=1).T
    # Many short sums of one length, taken as one product, need a tenth of the time.
    return (values.reshape(len(values), -1, size) @ np.ones(size)).T


def residuals(sightings: Sightings, poses: Poses) -> Array:
    """Predicted minus seen of every corner, (n, 2), in standard deviations; NaN behind the camera."""
    return np.concatenate([np.empty((0, 2)), *(r.T for _, _, r, _ in _chunks(sightings, poses))])


def _chunks(sightings: Sightings, poses: Poses) -> Iterator[tuple[slice, slice, Array, Array]]:
    """Some views at a time, so that memory does not grow with the number of corners.

    Yields:
        A range of views, their corners, residuals (2, k) and B (2, 6, k), both divided by sigma.
    """
    for c, camera in enumerate(sightings.cameras):
        T_cam_world = invert_transform(poses.T_world_cam[c])
        first, last = np.searchsorted(sightings.view_camera, [c, c + 1])
        for views in _pieces(sightings.start, int(first), int(last)):
            corners = slice(int(sightings.start[views.start]), int(sightings.start[views.stop]))
            T = T_cam_world @ poses.T_world_target[sightings.view_frame[views]]
            T = np.repeat(T, sightings.corners_per_view[views], axis=0)
            p = np.einsum("nij,nj->in", T[:, :3, :3], sightings.points[corners]) + T[:, :3, 3].T
            r, B = _residuals_of(camera, p, sightings.pixels[corners].T)
            weight = 1.0 / sightings.sigma_px[corners]
            yield views, corners, r * weight, B * weight


def _pieces(start: NDArray[np.int64], first: int, last: int) -> Iterator[slice]:
    """Ranges of whole views with at most CHUNK_CORNERS corners each, or one view."""
    while first < last:
        end = int(np.searchsorted(start, start[first] + CHUNK_CORNERS, side="right")) - 1
        end = min(max(end, first + 1), last)
        yield slice(first, end)
        first = end


def _residuals_of(camera: Camera, p: Array, pixels: Array) -> tuple[Array, Array]:
    """Residuals (2, n) [px] and B (2, 6, n) for points p (3, n) in the camera frame."""
    inverse_z = 1.0 / np.where(p[2] > 1e-6, p[2], np.nan)
    x, y = p[0] * inverse_z, p[1] * inverse_z
    none, one = np.zeros_like(x), inverse_z
    # Derivatives of (X/Z, Y/Z) with respect to a left twist (rotation, translation) in camera axes.
    along_x = np.stack([-x * y, 1.0 + x * x, -y, one, none, -x * one])
    along_y = np.stack([-1.0 - y * y, x * y, x, none, one, -y * one])
    (fx, skew), (_, fy) = camera.K[:2, :2]
    if camera.has_distortion:
        distorted, D = lens.distort(camera, np.stack([x, y], axis=1))
        x, y = distorted.T
        along_x, along_y = D[:, 0, 0] * along_x + D[:, 0, 1] * along_y, D[:, 1, 0] * along_x + D[:, 1, 1] * along_y
    predicted = np.stack([fx * x + skew * y + camera.K[0, 2], fy * y + camera.K[1, 2]])
    return predicted - pixels, np.stack([fx * along_x + skew * along_y, fy * along_y])
