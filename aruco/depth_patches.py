"""Where the target lies in depth images, and what they measure there.

Owns      flat parts of the target as a camera should see them, sampling depth well inside of them.
Leaves    what the samples mean to depth_verify, depth_refine and the check of the marker map's scale.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from aruco import lens
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, transform_points

MAX_FRAMES = 6
# A stereo matcher smears depth over the edges of surfaces. Markers lie inside a face that goes on around them.
MARGIN_PX = 4.0
MIN_PIXELS = 20
# The middle half of the depths of one flat print spreads by a percent or two; more is a mixture of surfaces.
MAX_SPREAD = 0.05
_LEAST_POINTS = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """A flat part of the target as one camera should see it."""

    outline_px: Array  # (m, 2) convex, corner by corner, in the depth image
    normal: Array  # (3,) unit, camera frame
    offset_m: float  # normal . X of its points


def spread_frames(n_markers: Mapping[int, int]) -> list[int]:
    """At most MAX_FRAMES of the frames: of each stretch of the recording the one with the most markers."""
    frames = sorted(n_markers)
    stretches = np.array_split(np.array(frames, dtype=np.int64), min(MAX_FRAMES, max(len(frames), 1)))
    return [max(s.tolist(), key=lambda f: n_markers[f]) for s in stretches if len(s)]


def patches(camera: Camera, detection: Detection, T_cam_target: Pose, geometry: Mapping[int, Array]) -> Iterator[Patch]:
    """The markers of a detection, or the whole board where points are seen one by one.

    Args:
        camera: Where they were seen.
        detection: Their pixels in the image as recorded; where they are in the depth image follows.
        T_cam_target: The target's pose.
        geometry: Marker id -> (k, 3) points [m], target frame.
    """
    known = detection.only(np.array([int(i) in geometry for i in detection.ids], dtype=bool))
    if not len(known):
        return
    points = transform_points(T_cam_target, np.array([geometry[int(i)] for i in known.ids]))
    pixels = known.corners_px
    if pixels.shape[1] == 1:
        points, pixels = points.reshape(1, -1, 3), pixels.reshape(1, -1, 2)
    for corners, seen in zip(points, pixels):
        outline = _in_depth_image(camera, seen)
        if len(seen) >= _LEAST_POINTS and np.isfinite(outline).all():
            centre = corners.mean(axis=0)
            normal = np.linalg.svd(corners - centre)[2][2]
            hull = cv2.convexHull(outline.astype(np.float32))[:, 0].astype(np.float64)
            if len(hull) > 2:
                yield Patch(outline_px=hull, normal=normal, offset_m=float(normal @ centre))


def _in_depth_image(camera: Camera, pixels: Array) -> Array:
    """Recorded pixels (n, 2) in the depth image, which has no distortion and may have intrinsics of its own."""
    K = camera.K if camera.depth_K is None else camera.depth_K
    return lens.undistort(camera, pixels) @ K[:2, :2].T + K[:2, 2]


def sample(patch: Patch, K: Array, depth_m: Array) -> tuple[Array, Array]:
    """Measured and predicted depth [m], both (n,), at the pixels well inside a patch that have depth.

    Args:
        patch: Where to look.
        K: (3, 3) of the depth image.
        depth_m: (h, w) along the optical axis, NaN where unknown.
    """
    low = np.maximum(np.ceil(patch.outline_px.min(axis=0)), 0).astype(int)
    high = np.minimum(np.floor(patch.outline_px.max(axis=0)) + 1, depth_m.shape[::-1]).astype(int)
    columns, rows = (g.ravel() for g in np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])))
    inside = _distance_inside_px(patch.outline_px, np.stack([columns, rows], axis=1)) >= MARGIN_PX
    columns, rows = columns[inside], rows[inside]
    measured = np.asarray(depth_m[rows, columns], dtype=np.float64)
    rays = np.stack([columns, rows, np.ones(len(rows))], axis=1) @ np.linalg.inv(K).T
    with np.errstate(divide="ignore", invalid="ignore"):
        predicted = patch.offset_m / (rays @ patch.normal)
    good = np.isfinite(measured) & (measured > 0) & np.isfinite(predicted) & (predicted > 0)
    return measured[good], predicted[good]


def _distance_inside_px(outline: Array, points: Array) -> Array:
    """How far points (n, 2) lie inside a convex outline (m, 2) [px]; negative outside."""
    sides = np.roll(outline, -1, axis=0) - outline
    lengths = np.linalg.norm(sides, axis=1)
    outline, sides = outline[lengths > 0], sides[lengths > 0] / lengths[lengths > 0, None]
    inwards = np.stack([-sides[:, 1], sides[:, 0]], axis=1)
    middle = outline.mean(axis=0)
    inwards *= np.where(((middle - outline) * inwards).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    return (points @ inwards.T - (outline * inwards).sum(axis=1)).min(axis=1, initial=np.inf)


def typical_ratio(measured: Array, predicted: Array) -> float:
    """The median of measured over predicted depth; NaN where pixels are few or of several surfaces."""
    if len(measured) < MIN_PIXELS:
        return math.nan
    low, middle, high = np.quantile(measured / predicted, [0.25, 0.5, 0.75])
    return float(middle) if high - low <= MAX_SPREAD * middle else math.nan
