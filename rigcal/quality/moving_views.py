"""Views of a moved target, each with the velocity of its corners in the image.

Owns      velocities from neighbouring frames of one camera, frames freed of whatever the target's pose can explain.
Leaves    what velocities explain to timing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.model import Camera
from aruco.pose_math import Array, invert_transform, skew, transform_points

# A frame that is missing may be bridged by the next one. Farther apart, a target in a hand has turned round.
MAX_SLACK = 1.0
# Where displacements before and after a frame differ in direction by more than 60 degrees, the motion is not smooth
# (separate places, another frame's view), unless it is so slow that the difference is noise.
MIN_COSINE = 0.5
SLOW_PX = 1.0
MIN_CORNERS = 4
# Whatever the length of a recording, so many frames tell offsets to a few percent.
MAX_FRAMES = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """All views, also rejected ones, under the poses of a finished adjustment; corners of one view stand together."""

    cameras: Sequence[Camera]
    T_world_cam: Array  # (c, 4, 4)
    T_world_target: Array  # (f, 4, 4)
    times: Array  # (f,) of the frames, in frame periods: their numbers do
    camera: NDArray[np.int64]  # (n,) of each corner
    frame: NDArray[np.int64]  # (n,)
    marker: NDArray[np.int64]  # (n,) its corners always in the same order
    points: Array  # (n, 3) target frame [m]
    pixels: Array  # (n, 2)
    period_s: float = 0.0  # zero where unknown


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Corners of a view that neighbouring views show too; every view counts as one, as its corners err together."""

    camera: int
    r: Array  # (2k,) predicted minus seen [px / sqrt(k)], likewise all others
    J: Array  # (2k, 6) by the target's twist in world axes
    velocity: Array  # (2k,) px a period
    turned: Array  # (2k,) the same, turned by a right angle


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The views of one frame, free of whatever another pose of the target explains."""

    cameras: NDArray[np.int64]  # (m,)
    r: Array  # (n,)
    by_camera: Array  # (n, 6 c) by the cameras' twists
    by_time: tuple[Array, Array]  # (n, m) each: by every view's offset, along the motion and across
    squares: Array  # (m,) of every view's speed


def frames_of(seen: Seen, stride: int) -> list[Frame]:
    """Frames with several views in order of time, with velocities over ``stride`` frame periods to both sides."""
    by_frame: dict[int, list[View]] = {}
    every = max(1, len(seen.times) // MAX_FRAMES)
    for c in range(len(seen.cameras)):
        for f, view in _views_of(seen, c, stride, every):
            by_frame.setdefault(f, []).append(view)
    in_order = sorted((f for f, views in by_frame.items() if len(views) > 1), key=lambda f: seen.times[f])
    return [_stacked(by_frame[f], len(seen.cameras)) for f in in_order]


def _views_of(seen: Seen, c: int, stride: int, every: int) -> Iterator[tuple[int, View]]:
    """One camera's views of every so many frames that lie between two others, with their frames."""
    rows = np.flatnonzero(seen.camera == c)
    rows = rows[np.argsort(seen.times[seen.frame[rows]], kind="stable")]
    views = [k for k in np.split(rows, np.flatnonzero(np.diff(seen.frame[rows])) + 1) if len(k)]
    ids = [_corner_ids(seen.marker[k]) for k in views]
    t = np.array([seen.times[seen.frame[k[0]]] for k in views])
    for k in range(len(views)):
        f = int(seen.frame[views[k][0]])
        near = None if f % every else _neighbours(t, k, stride)
        if near is None:
            continue
        at = [near[0], k, near[1]]
        common = sorted(ids[at[0]].keys() & ids[k].keys() & ids[at[2]].keys())
        if len(common) < MIN_CORNERS:
            continue
        first, mine, last = (views[v][[ids[v][i] for i in common]] for v in at)
        came = (seen.pixels[mine] - seen.pixels[first]) / (t[k] - t[at[0]])
        goes = (seen.pixels[last] - seen.pixels[mine]) / (t[at[2]] - t[k])
        if _is_smooth(came, goes):
            velocity = (seen.pixels[last] - seen.pixels[first]) / (t[at[2]] - t[at[0]])
            yield f, _view(seen, c, f, mine, velocity)


def _neighbours(t: Array, k: int, stride: int) -> tuple[int, int] | None:
    """The nearest views before and after that are a stride apart; None where one is missing."""
    # Stamps are not quite even: a quarter of a period is no whole one.
    before = int(np.searchsorted(t, t[k] - stride + 0.25, side="right")) - 1
    after = int(np.searchsorted(t, t[k] + stride - 0.25))
    farthest = stride + MAX_SLACK + 0.25
    if before < 0 or after == len(t) or max(t[after] - t[k], t[k] - t[before]) > farthest:
        return None
    return before, after


def _corner_ids(marker: NDArray[np.int64]) -> dict[tuple[int, int], int]:
    """Marker and number of its corner -> row, of one view."""
    ids: dict[tuple[int, int], int] = {}
    count: dict[int, int] = {}
    for row, m in enumerate(marker.tolist()):
        ids[m, count.get(m, 0)] = row
        count[m] = count.get(m, 0) + 1
    return ids


def _is_smooth(came: Array, goes: Array) -> bool:
    a, b = float(np.linalg.norm(came)), float(np.linalg.norm(goes))
    slow = max(a, b) <= SLOW_PX * np.sqrt(len(came))
    return slow or float((came * goes).sum()) >= MIN_COSINE * a * b


def _view(seen: Seen, c: int, f: int, rows: NDArray[np.int64], velocity: Array) -> View:
    camera, T_cam_world = seen.cameras[c], invert_transform(seen.T_world_cam[c])
    in_world = transform_points(seen.T_world_target[f], seen.points[rows])
    r = lens.project(camera, transform_points(T_cam_world, in_world)) - seen.pixels[rows]
    step = 1e-4  # m; central differences of a lens are then exact to a millionth
    by_point = np.stack(
        [
            lens.project(camera, transform_points(T_cam_world, in_world + step * e))
            - lens.project(camera, transform_points(T_cam_world, in_world - step * e))
            for e in np.eye(3)
        ],
        axis=2,
    ) / (2 * step)
    J = np.concatenate([-by_point @ skew(in_world), by_point], axis=2)
    turned = np.stack([-velocity[:, 1], velocity[:, 0]], axis=1)
    weight = 1 / np.sqrt(len(rows))
    return View(c, weight * r.ravel(), weight * J.reshape(-1, 6), weight * velocity.ravel(), weight * turned.ravel())


def _stacked(views: Sequence[View], n_cam: int) -> Frame:
    sizes = [len(view.r) for view in views]
    start = np.concatenate([[0], np.cumsum(sizes)]).astype(int).tolist()
    n, m = 6 * n_cam, len(views)
    all_columns = np.zeros((start[-1], n + 2 * m + 1))
    for k, view in enumerate(views):
        rows = slice(start[k], start[k + 1])
        # A camera's derivative is the target's with the other sign; what is seen too late is predicted too far back.
        all_columns[rows, 6 * view.camera : 6 * view.camera + 6] = -view.J
        all_columns[rows, n + k], all_columns[rows, n + m + k] = -view.velocity, -view.turned
        all_columns[rows, -1] = view.r
    J = np.concatenate([view.J for view in views])
    E = J.T @ all_columns
    products = all_columns.T @ all_columns - E.T @ np.linalg.pinv(J.T @ J, rcond=1e-12, hermitian=True) @ E
    # Only these products count: a root of them is a frame with the same ones and fewer rows.
    values, U = np.linalg.eigh(products)
    R = np.sqrt(np.maximum(values, 0.0))[:, None] * U.T
    return Frame(
        cameras=np.array([view.camera for view in views]),
        r=R[:, -1],
        by_camera=R[:, :n],
        by_time=(R[:, n : n + m], R[:, n + m : -1]),
        squares=np.array([float(view.velocity @ view.velocity) for view in views]),
    )
