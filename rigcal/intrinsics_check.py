"""Intrinsics of another resolution, told from views that do not fit.

Owns      trying a camera's matrix at the ratios that video modes have to each other.

A camera_info.yaml written for 1080p beside images of 720p is wrong by one factor in all four numbers. No pose explains
a whole box then; with the factor taken out, it does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from aruco.model import Camera, Detection
from aruco.pose_math import Array
from aruco.view_pose import solve_view

# Widths of common video modes (320 ... 3840) over each other.
RATIOS = (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)
MAX_VIEWS = 8
# The right resolution makes views fit by pixels better; noise and lenses do not differ between ratios by so much.
MUCH_BETTER = 0.4
WORTH_A_WORD_PX = 1.0
FITS_PX = 3.0


def other_resolution(camera: Camera, detections: Mapping[int, Detection], geometry: Mapping[int, Array]) -> str:
    """A sentence when a camera's views fit far better with its matrix scaled to another resolution; else ""."""
    fullest = sorted(detections, key=lambda frame: (-len(detections[frame]), frame))[:MAX_VIEWS]
    some = [detections[frame] for frame in sorted(fullest)]
    now_px = _misfit_px(camera, some, geometry)
    if not now_px > WORTH_A_WORD_PX:
        return ""
    found = {ratio: _misfit_px(_scaled(camera, ratio), some, geometry) for ratio in RATIOS}
    ratio = min(found, key=lambda ratio: found[ratio])
    if not found[ratio] < min(MUCH_BETTER * now_px, FITS_PX):
        return ""
    width, height = round(camera.width / ratio), round(camera.height / ratio)
    return (
        f"its camera_matrix is that of images of about {width} x {height}, but these are {camera.width} x "
        f"{camera.height}: take the intrinsics of this resolution, or multiply fx, fy, cx, cy by {ratio:.4g}"
    )


def _scaled(camera: Camera, ratio: float) -> Camera:
    return replace(camera, K=np.diag([ratio, ratio, 1.0]) @ camera.K)


def _misfit_px(camera: Camera, detections: list[Detection], geometry: Mapping[int, Array]) -> float:
    """The median misfit of single views; infinite where no pose explains half of them."""
    views = [solve_view(camera, k, detection, geometry) for k, detection in enumerate(detections)]
    misfits = [np.inf if view is None else view.best.rms_px for view in views]
    return float(np.median(misfits)) if misfits else 0.0
