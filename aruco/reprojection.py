"""How far the corners lie from where the finished rig says they should be.

Owns      residuals of every corner, per camera.
Leaves    judging them to rigcal.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.model import Camera, Detection
from aruco.pose_math import Array, invert_transform, transform_points
from aruco.rig_estimate import RigEstimate


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """Pixel errors of one camera: where the rig puts each corner minus where it was seen."""

    errors_px: Array  # (n, 2)
    markers: NDArray[np.int64]  # (n,) the marker that each corner belongs to

    @property
    def rms_px(self) -> float:
        """Root mean square over corners of the distance, both coordinates together."""
        return float(np.sqrt(np.mean(np.sum(self.errors_px**2, axis=1))))

    def worst_markers(self, count: int) -> list[int]:
        """The markers whose corners are farthest off, by their median, the worst first."""
        distance = np.linalg.norm(self.errors_px, axis=1)
        medians = {int(m): float(np.median(distance[self.markers == m])) for m in np.unique(self.markers)}
        return sorted(medians, key=lambda marker: -medians[marker])[:count]


def reproject(
    cameras: Mapping[str, Camera],
    rig: RigEstimate,
    detections: Mapping[str, Mapping[int, Detection]],
    geometry: Mapping[int, Array],
) -> dict[str, Reprojection]:
    """Residuals of the corners in the views that made the rig.

    Args:
        cameras: Name -> intrinsics.
        rig: The poses.
        detections: Camera -> frame -> markers, for the frames to look at.
        geometry: Marker id -> (4, 3) corners [m], target frame.
    """
    result: dict[str, Reprojection] = {}
    for name, by_frame in detections.items():
        T_cam_world = invert_transform(rig.cameras[name].T_world_cam)
        errors, markers = [np.empty((0, 2))], [np.empty(0, np.int64)]
        for frame, detection in by_frame.items():
            points = np.concatenate([geometry[int(i)] for i in detection.ids])
            in_camera = transform_points(T_cam_world @ rig.T_world_target[frame], points)
            errors.append(lens.project(cameras[name], in_camera) - detection.corners_px.reshape(-1, 2))
            markers.append(np.repeat(detection.ids, detection.sigma_px.shape[1]))
        result[name] = Reprojection(np.concatenate(errors), np.concatenate(markers))
    return result
