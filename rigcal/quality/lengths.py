"""Known lengths measured again: corners triangulated from the cameras alone, beside the marker map.

Owns      triangulation of corners that several cameras see, and what the distances between them say.
Leaves    which frames to look at to rigcal.validation, limits to gates.

Triangulation needs no pose of the target, so lengths see errors that a pose of the target would absorb. What they
cannot see is a map that is wrong by one factor everywhere: the cameras then stand apart by that factor too, and no
image tells. A wrong size of the markers at right places does show: markers and the distances between them disagree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose

# Rays that meet at a smaller angle say little of the distance along them: 0.05 px at 5 degrees is 2 mm at 2 m.
MIN_ANGLE_RAD = np.radians(5.0)
REFINE_STEPS = 4  # from the linear solution, whose error is a share of a pixel, Gauss-Newton needs two
# More lengths than this make no number better, only the run longer.
MAX_LENGTHS_PER_FRAME = 2000
MAX_CORNERS = 4000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lengths:
    """Triangulated against known distances between corners of the target."""

    n: int
    n_corners: int  # triangulated
    scale_error: float  # share: 0.01 when distances come out one percent too long
    markers_scale_error: float  # the same for sides and diagonals of markers alone; NaN without any
    between_scale_error: float  # the same for distances between markers; NaN without any
    mean_m: float  # of measured minus known
    spread_m: float
    rms_m: float
    miss_px: float  # root mean square distance of seen corners from the triangulated ones
    cameras: tuple[str, ...]  # those whose corners took part


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """n corners, each seen by some of c cameras."""

    frame: NDArray[np.int64]  # (n,)
    marker: NDArray[np.int64]  # (n,)
    known: Array  # (n, 3) in the target's frame [m]
    rays: Array  # (n, c, 2) normalised pinhole coordinates; NaN where not seen
    weight: Array  # (n, c) one over the standard deviation of a normalised coordinate; zero where not seen
    sigma_px: Array  # (n, c)

    def only(self, keep: NDArray[np.bool_]) -> Tracks:
        """The corners where a mask (n,) is true."""
        return Tracks(
            self.frame[keep],
            self.marker[keep],
            self.known[keep],
            self.rays[keep],
            self.weight[keep],
            self.sigma_px[keep],
        )


def measure_lengths(
    cameras: Sequence[Camera],
    T_world_cam: Mapping[str, Pose],
    detections: Mapping[str, Mapping[int, Detection]],
    geometry: Mapping[int, Array],
) -> Lengths | None:
    """All distances between corners of one frame that two or more cameras see, beside those of the map.

    Args:
        cameras: Those with a pose.
        T_world_cam: Camera -> pose.
        detections: Camera -> frame -> markers, of the frames to look at; views known to be wrong left out.
        geometry: Marker id -> (k, 3) points [m], target frame.

    Returns:
        The numbers, or None when no two corners of a frame can be triangulated.
    """
    T = np.array([T_world_cam[camera.name] for camera in cameras]).reshape(-1, 4, 4)
    tracks = _tracks(cameras, detections, geometry)
    tracks = tracks.only(widest_angle(tracks.rays, T) >= MIN_ANGLE_RAD)
    points = triangulate(tracks.rays, tracks.weight, T)
    good = np.isfinite(points.sum(axis=1))
    tracks, points = tracks.only(good), points[good]
    first, second = _pairs(tracks.frame)
    if not len(first):
        return None
    known = np.linalg.norm(tracks.known[first] - tracks.known[second], axis=1)
    error = np.linalg.norm(points[first] - points[second], axis=1) - known
    inside = tracks.marker[first] == tracks.marker[second]
    miss = _misses(tracks.rays, tracks.weight, T, points) * tracks.sigma_px[:, :, None]
    return Lengths(
        n=len(known),
        n_corners=len(points),
        scale_error=_scale_error(error, known),
        markers_scale_error=_scale_error(error[inside], known[inside]),
        between_scale_error=_scale_error(error[~inside], known[~inside]),
        mean_m=float(error.mean()),
        spread_m=float(error.std()),
        rms_m=float(np.sqrt(np.mean(error**2))),
        miss_px=float(np.sqrt((miss**2).sum() / (tracks.weight > 0).sum())),
        cameras=tuple(camera.name for camera, seen in zip(cameras, tracks.weight.sum(axis=0)) if seen > 0),
    )


def _scale_error(error: Array, known: Array) -> float:
    """Least squares of ``measured = (1 + s) known``: long distances say more than short ones."""
    return float(error @ known / (known @ known)) if len(known) else float("nan")


def _tracks(
    cameras: Sequence[Camera], detections: Mapping[str, Mapping[int, Detection]], geometry: Mapping[int, Array]
) -> Tracks:
    keys, points, columns, rays, weights, sigmas = [], [], [], [], [], []
    for c, camera in enumerate(cameras):
        for frame, found in detections.get(camera.name, {}).items():
            d = found.only(np.array([int(i) in geometry for i in found.ids], dtype=bool))
            if not len(d):
                continue
            k = d.sigma_px.shape[1]
            corner = np.tile(np.arange(k), len(d))
            keys.append(np.stack([np.full(len(corner), frame), np.repeat(d.ids, k), corner], axis=1))
            points.append(np.concatenate([geometry[int(i)] for i in d.ids]))
            columns.append(np.full(len(corner), c))
            rays.append(d.corners_px.reshape(-1, 2))
            sigmas.append(d.sigma_px.ravel())
            weights.append(np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / d.sigma_px.ravel())
    empty = np.empty(0)
    key = np.concatenate([np.empty((0, 3), np.int64), *keys])
    column = np.concatenate([np.empty(0, np.int64), *columns])
    unique, first, row = np.unique(key, axis=0, return_index=True, return_inverse=True)
    seen = np.concatenate([np.empty((0, 2)), *rays])
    for c, camera in enumerate(cameras):
        seen[column == c] = lens.undistort(camera, seen[column == c])
    x = np.full((len(unique), len(cameras), 2), np.nan)
    weight, sigma = np.zeros(x.shape[:2]), np.zeros(x.shape[:2])
    x[row.ravel(), column] = seen
    weight[row.ravel(), column] = np.concatenate([empty, *weights])
    sigma[row.ravel(), column] = np.concatenate([empty, *sigmas])
    weight[np.isnan(x).any(axis=2)] = 0.0
    tracks = Tracks(unique[:, 0], unique[:, 1], np.concatenate([np.empty((0, 3)), *points])[first], x, weight, sigma)
    shared = np.flatnonzero((weight > 0).sum(axis=1) >= 2)
    # Whole frames, so that distances within a frame stay.
    return tracks.only(np.isin(tracks.frame, _some_frames(tracks.frame[shared])) & ((weight > 0).sum(axis=1) >= 2))


def _some_frames(frame: NDArray[np.int64]) -> NDArray[np.int64]:
    """Frames spread over the recording that hold about MAX_CORNERS corners at most."""
    frames = np.unique(frame)
    step = max(1, -(-len(frame) // MAX_CORNERS))
    return frames[::step]


def widest_angle(rays: Array, T_world_cam: Array) -> Array:
    """The widest angle [rad] between two rays to each corner, (n,)."""
    d = _directions(rays, T_world_cam)
    cosine = np.einsum("nci,ndi->ncd", d, d)
    cosine = np.where(np.isnan(cosine), 1.0, cosine).reshape(len(rays), len(T_world_cam) ** 2)
    return np.arccos(np.clip(cosine.min(axis=1, initial=1.0), -1.0, 1.0))


def _directions(rays: Array, T_world_cam: Array) -> Array:
    """Unit rays (n, c, 3) in the world; NaN where not seen."""
    d = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
    d = np.einsum("cij,ncj->nci", T_world_cam[:, :3, :3], d)
    return d / np.linalg.norm(d, axis=2, keepdims=True)


def triangulate(rays: Array, weight: Array, T_world_cam: Array) -> Array:
    """Points under which rays from several cameras meet best.

    The linear solution is the point nearest to all rays; Gauss-Newton then minimises the distance in the images.

    Args:
        rays: (n, c, 2) normalised pinhole coordinates, NaN where a camera does not see the point.
        weight: (n, c) one over their standard deviations, zero where not seen.
        T_world_cam: (c, 4, 4) poses.

    Returns:
        (n, 3) points in the world [m]; NaN where rays are parallel or the point is behind a camera.
    """
    seen = weight > 0
    d = np.where(seen[:, :, None], _directions(rays, T_world_cam), 0.0)
    across = seen[:, :, None, None] * np.eye(3) - d[..., :, None] * d[..., None, :]
    X = _solved(across.sum(axis=1), np.einsum("ncij,cj->ni", across, T_world_cam[:, :3, 3]))
    for _ in range(REFINE_STEPS):
        r = _misses(rays, weight, T_world_cam, X)
        J = _jacobian(weight, T_world_cam, X)
        X = X - _solved(np.einsum("nckj,nckl->njl", J, J), np.einsum("nckj,nck->nj", J, r))
    z = _in_cameras(T_world_cam, X)[..., 2]
    X[~((z > 0) | ~seen).all(axis=1)] = np.nan
    return X


def _solved(A: Array, b: Array) -> Array:
    """Solutions (n, 3) of (n, 3, 3) systems; NaN where there is none."""
    out = np.full(b.shape, np.nan)
    good = np.isfinite(A.sum(axis=(1, 2)) + b.sum(axis=1))
    good[good] = np.linalg.cond(A[good]) < 1e12
    out[good] = np.linalg.solve(A[good], b[good][:, :, None])[:, :, 0]
    return out


def _in_cameras(T_world_cam: Array, X: Array) -> Array:
    """Points (n, 3) in every camera's frame, (n, c, 3)."""
    return np.einsum("cji,ncj->nci", T_world_cam[:, :3, :3], X[:, None] - T_world_cam[:, :3, 3])


def _misses(rays: Array, weight: Array, T_world_cam: Array, X: Array) -> Array:
    """Predicted minus seen (n, c, 2) in standard deviations; zero where not seen."""
    p = _in_cameras(T_world_cam, X)
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (p[..., :2] / p[..., 2:] - rays) * weight[:, :, None]
    return np.where(weight[:, :, None] > 0, r, 0.0)


def _jacobian(weight: Array, T_world_cam: Array, X: Array) -> Array:
    """d(_misses) / dX, (n, c, 2, 3)."""
    p = _in_cameras(T_world_cam, X)
    z = np.where(weight > 0, p[..., 2], 1.0)
    d = np.zeros((*p.shape[:2], 2, 3))
    d[..., 0, 0] = d[..., 1, 1] = weight / z
    d[..., 2] = -weight[:, :, None] * p[..., :2] / z[..., None] ** 2
    return np.einsum("nckj,clj->nckl", d, T_world_cam[:, :3, :3])


def _pairs(frame: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs of corners of one frame; of many, some that are spread evenly."""
    first, second = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for value in np.unique(frame):
        members = np.flatnonzero(frame == value)
        i, j = np.triu_indices(len(members), 1)
        step = max(1, -(-len(i) // MAX_LENGTHS_PER_FRAME))
        first.append(members[i[::step]])
        second.append(members[j[::step]])
    return np.concatenate(first), np.concatenate(second)
