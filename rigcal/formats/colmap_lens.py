"""Intrinsics in COLMAP's camera models.

Owns      which model holds a lens, the order of its parameters, both ways.
Leaves    files to colmap.

COLMAP puts the centre of the top left pixel at (0.5, 0.5): its principal point is ours plus half a pixel. Its models
OPENCV, FULL_OPENCV and OPENCV_FISHEYE have OpenCV's formulas (its source, sensor/models.h).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from aruco.errors import InputError
from aruco.model import Camera, DistortionModel
from aruco.pose_math import Array
from rigcal.formats.reading import placed
from rigcal.formats.rig import HALF_PIXEL, pinhole_of

# Model -> its parameters in order. f stands for both focal lengths.
PARAMETERS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}
_BROWN = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # OpenCV's order
_FISHEYE = ("k1", "k2", "k3", "k4")


def colmap_model(camera: Camera) -> tuple[str, Array]:
    """The smallest model that holds a camera's lens, and its parameters.

    Raises:
        InputError: The camera's axes are not square to each other, which no model holds.
    """
    fx, fy, cx, cy = pinhole_of(camera, "colmap")
    pinhole = [fx, fy, cx + HALF_PIXEL, cy + HALF_PIXEL]
    d = camera.distortion
    if not camera.has_distortion:
        return "PINHOLE", np.array(pinhole)
    if camera.distortion_model == "equidistant":
        return "OPENCV_FISHEYE", np.array([*pinhole, *d])
    if not d[4:].any():
        return "OPENCV", np.array([*pinhole, *d[:4]])
    return "FULL_OPENCV", np.array([*pinhole, *d, *np.zeros(8 - len(d))])


def camera_of_model(name: str, model: str, width: int, height: int, parameters: Sequence[float], where: str) -> Camera:
    """The camera that a model and its parameters describe.

    Raises:
        InputError: The model is not known here or has another number of parameters; ``where`` names file and line.
    """
    names = PARAMETERS.get(model)
    if names is None:
        raise InputError(f"{where}: camera model {model} has no counterpart here; known: {', '.join(PARAMETERS)}.")
    if len(parameters) != len(names):
        raise InputError(f"{where}: {model} wants {len(names)} parameters, got {len(parameters)}.")
    given = dict(zip(names, parameters))
    fx, fy = given.get("fx", given.get("f")), given.get("fy", given.get("f"))
    K = np.array([[fx, 0.0, given["cx"] - HALF_PIXEL], [0.0, fy, given["cy"] - HALF_PIXEL], [0.0, 0.0, 1.0]])
    kind: DistortionModel = "plumb_bob"
    order = _BROWN[:5]
    if "FISHEYE" in model:
        kind, order = "equidistant", _FISHEYE
    elif any(given.get(key, 0.0) for key in _BROWN[5:]):
        kind, order = "rational_polynomial", _BROWN
    distortion = np.array([given.get(key, 0.0) for key in order])
    with placed(where):
        return Camera(name=name, width=width, height=height, K=K, distortion_model=kind, distortion=distortion)
