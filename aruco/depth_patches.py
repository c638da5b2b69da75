"""Where the target lies in depth images, and what they measure there.

Owns      flat parts of the target as a camera should see them, sampling depth well inside of them and beside corners.
Leaves    what the samples mean to depth_verify, depth_refine and the check of the marker map's scale.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.depth_pool import WORST_CONFIDENCE
from aruco.model import Camera, Detection
from aruco.pose_math import Array, Pose, transform_points

MAX_FRAMES = 6
# A stereo matcher smears depth over the edges of surfaces. Markers lie inside a face that goes on around them.
MARGIN_PX = 4.0
MIN_PIXELS = 20
# The middle half of the depths of one flat print spreads by a percent or two; more is a mixture of surfaces.
MAX_SPREAD = 0.05
WHOLE_BOARD = -1
_LEAST_POINTS = 4
_CORNER_WINDOW_PX = 3  # half its side: 49 pixels, about as many as share one error of a stereo matcher
_LEAST_OF_WINDOW = 0.5  # share of its pixels that must have depth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """A flat part of the target as one camera should see it."""

    marker: int  # WHOLE_BOARD for a board
    outline_px: Array  # (m, 2) convex, corner by corner, in the depth image
    corners_px: Array  # (k, 2) as seen, in the depth image
    corners_target: Array  # (k, 3) [m]
    normal_target: Array  # (3,) unit; normal . X = offset_m on the print, target frame
    offset_m: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FaceDepth:
    """Depth measured well inside one marker (or board) in one frame."""

    camera: str
    frame: int  # key of the rig's T_world_target
    marker: int  # WHOLE_BOARD for a board
    normal_target: Array  # (3,) unit; normal . X = offset_m on the print, target frame
    offset_m: float
    pixels: Array  # (n, 2) in the depth image
    measured_m: Array  # (n,) as recorded, without any correction; never NaN
    confidence: Array | None  # (n,) 0..100, lower is more trustworthy
    n_averaged: int  # depth images that were pooled into it; 1: a single frame
    corners_px: Array  # (k, 2) as seen, in the depth image
    corners_target: Array  # (k, 3) [m]
    corner_depth_m: Array  # (k,) measured: median of a small window; NaN where depth is missing or mixed

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """Which pixels (n,) the camera itself trusts, as depth_pool does; all, where it does not say."""
        if self.confidence is None:
            return np.ones(len(self.measured_m), dtype=bool)
        return np.asarray(self.confidence <= WORST_CONFIDENCE)

    def predicted_m(self, T_cam_target: Pose, K: Array) -> Array:
        """Depth (n,) [m] that the pixels should have; NaN where the print's plane is not in front of the camera."""
        return self.plane_depth_m(self.pixels, T_cam_target, K)

    def plane_depth_m(self, pixels: Array, T_cam_target: Pose, K: Array) -> Array:
        """Depth (m,) [m] of the print's plane at pixels (m, 2) of the depth image with intrinsics K (3, 3)."""
        normal = T_cam_target[:3, :3] @ self.normal_target
        return _plane_depth(pixels, normal, self.offset_m + float(normal @ T_cam_target[:3, 3]), K)

    def predicted_corners_m(self, T_cam_target: Pose) -> Array:
        """Depth (k,) [m] of the corners."""
        return transform_points(T_cam_target, self.corners_target)[:, 2]


def spread_frames(n_markers: Mapping[int, int], *, at_most: int = MAX_FRAMES) -> list[int]:
    """At most so many of the frames: of each stretch of the recording the one with the most markers."""
    frames = sorted(n_markers)
    stretches = np.array_split(np.array(frames, dtype=np.int64), min(at_most, max(len(frames), 1)))
    return [max(s.tolist(), key=lambda f: n_markers[f]) for s in stretches if len(s)]


def patches(camera: Camera, detection: Detection, geometry: Mapping[int, Array]) -> Iterator[Patch]:
    """The markers of a detection, or the whole board where points are seen one by one.

    Args:
        camera: Where they were seen.
        detection: Their pixels in the image as recorded; where they are in the depth image follows.
        geometry: Marker id -> (k, 3) points [m], target frame.
    """
    known = detection.only(np.array([int(i) in geometry for i in detection.ids], dtype=bool))
    if not len(known):
        return
    points = np.array([geometry[int(i)] for i in known.ids])
    ids, pixels = known.ids.tolist(), known.corners_px
    if pixels.shape[1] == 1:
        ids, points, pixels = [WHOLE_BOARD], points.reshape(1, -1, 3), pixels.reshape(1, -1, 2)
    for marker, corners, seen in zip(ids, points, pixels):
        in_depth = _in_depth_image(camera, seen)
        if len(seen) >= _LEAST_POINTS and np.isfinite(in_depth).all():
            hull = cv2.convexHull(in_depth.astype(np.float32))[:, 0].astype(np.float64)
            if len(hull) > 2:
                yield _patch(marker, corners, in_depth, hull)


def _patch(marker: int, corners: Array, in_depth: Array, hull: Array) -> Patch:
    centre = corners.mean(axis=0)
    normal = np.linalg.svd(corners - centre)[2][2]
    return Patch(
        marker=marker,
        outline_px=hull,
        corners_px=in_depth,
        corners_target=corners,
        normal_target=normal,
        offset_m=float(normal @ centre),
    )


def _in_depth_image(camera: Camera, pixels: Array) -> Array:
    """Recorded pixels (n, 2) in the depth image, which has no distortion and may have intrinsics of its own."""
    K = camera.K_depth
    return lens.undistort(camera, pixels) @ K[:2, :2].T + K[:2, 2]


def face_depth(
    patch: Patch,
    depth_m: Array,
    *,
    camera: str,
    frame: int,
    confidence: Array | NDArray[np.uint8] | None = None,
    count: Array | NDArray[np.integer[Any]] | None = None,
) -> FaceDepth | None:
    """What a depth image measures of a patch; None where too few pixels well inside of it have depth.

    Args:
        patch: Where to look.
        depth_m: (h, w) along the optical axis, NaN where unknown.
        camera: Whose depth it is.
        frame: The moment, or that of the pose that the target has in a pooled depth image.
        confidence: (h, w) 0..100, lower is more trustworthy, where there is one.
        count: (h, w) measurements that were pooled; None: a single frame.
    """
    columns, rows = _pixels_inside(patch, depth_m.shape)
    measured = np.asarray(depth_m[rows, columns], dtype=np.float64)
    good = np.isfinite(measured) & (measured > 0)
    if int(good.sum()) < MIN_PIXELS:
        return None
    columns, rows = columns[good], rows[good]
    return FaceDepth(
        camera=camera,
        frame=frame,
        marker=patch.marker,
        normal_target=patch.normal_target,
        offset_m=patch.offset_m,
        pixels=np.stack([columns, rows], axis=1).astype(np.float64),
        measured_m=measured[good],
        confidence=None if confidence is None else np.asarray(confidence[rows, columns], dtype=np.float64),
        n_averaged=1 if count is None else max(1, int(np.median(count[rows, columns]))),
        corners_px=patch.corners_px,
        corners_target=patch.corners_target,
        corner_depth_m=np.array([_beside(corner, depth_m, confidence) for corner in patch.corners_px]),
    )


def _beside(corner: Array, depth_m: Array, confidence: Array | NDArray[np.uint8] | None) -> float:
    """Median depth [m] of the window around a corner (2,) [px]; NaN where it is mostly empty, cut off, or mixed."""
    column, row = (round(float(x)) for x in corner)
    low = np.array([row, column]) - _CORNER_WINDOW_PX
    high = low + 2 * _CORNER_WINDOW_PX + 1
    if (low < 0).any() or (high > depth_m.shape).any():
        return math.nan
    window = (slice(low[0], high[0]), slice(low[1], high[1]))
    depths = np.asarray(depth_m[window], dtype=np.float64)
    good = np.isfinite(depths) & (depths > 0)
    if confidence is not None:
        good &= confidence[window] <= WORST_CONFIDENCE
    if good.mean() < _LEAST_OF_WINDOW:
        return math.nan
    quarter, middle, three = np.quantile(depths[good], [0.25, 0.5, 0.75])
    return float(middle) if three - quarter <= MAX_SPREAD * middle else math.nan


def _plane_depth(pixels: Array, normal: Array, offset_m: float, K: Array) -> Array:
    """Depth (n,) [m] of the plane normal . X = offset_m (camera frame) at pixels (n, 2); NaN where it is behind."""
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = offset_m / (rays @ normal)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def _pixels_inside(patch: Patch, shape: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns and rows (n,) of the pixels of an image of a shape that lie well inside a patch."""
    low = np.maximum(np.ceil(patch.outline_px.min(axis=0)), 0).astype(int)
    high = np.minimum(np.floor(patch.outline_px.max(axis=0)) + 1, shape[::-1]).astype(int)
    columns, rows = (g.ravel() for g in np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1])))
    inside = _distance_inside_px(patch.outline_px, np.stack([columns, rows], axis=1)) >= MARGIN_PX
    return columns[inside], rows[inside]


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
    known = np.isfinite(predicted)
    measured, predicted = measured[known], predicted[known]
    if len(measured) < MIN_PIXELS:
        return math.nan
    low, middle, high = np.quantile(measured / predicted, [0.25, 0.5, 0.75])
    return float(middle) if high - low <= MAX_SPREAD * middle else math.nan
