"""Pictures of many markers at known places, for tests of corners: rays say what a pixel sees, projection the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.model import Camera, DistortionModel
from aruco.pose_math import Array, exp_so3
from rigcal.sim.render import render_image
from rigcal.sim.scene import FLAT_LIGHT, Panel, Print, Scene, marker_cells, marker_dictionary

DICTIONARY = "DICT_APRILTAG_36h11"
FOCAL_PX = 700.0
WHITE_GREY = 240.0
LENSES: dict[str, tuple[DistortionModel, list[float]]] = {
    "pinhole": ("plumb_bob", []),
    "plumb_bob": ("plumb_bob", [-0.25, 0.08, 1e-3, -8e-4, 0.0]),
    "rational_polynomial": ("rational_polynomial", [0.3, 0.1, 1e-3, 0.0, 0.01, 0.5, 0.1, 0.02]),
    "equidistant": ("equidistant", [0.02, -0.01, 0.003, 0.0]),
}


def make_camera(name: str = "cam", lens_model: str = "pinhole", width: int = 1280, height: int = 720) -> Camera:
    model, distortion = LENSES[lens_model]
    K = np.array([[FOCAL_PX, 0.0, width / 2 - 1.7], [0.0, FOCAL_PX + 2.0, height / 2 + 1.6], [0.0, 0.0, 1.0]])
    return Camera(name=name, width=width, height=height, K=K, distortion_model=model, distortion=np.array(distortion))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Picture:
    """A noise-free picture of markers 0 to n - 1, and where their corners truly are."""

    clean: NDArray[np.float32]  # (h, w) levels of 255, a sharp lens
    corners_px: Array  # (n, 4, 2)
    camera: Camera

    def painted(self, polygons: Sequence[Array], grey: float) -> Picture:
        """The same with polygons (k, 2) [px] painted over it."""
        clean = self.clean.copy()
        for polygon in polygons:
            # OpenCV's polygons have coordinates of four binary places.
            cv2.fillConvexPoly(clean, np.rint(16 * polygon).astype(np.int32), grey, cv2.LINE_8, 4)
        return replace(self, clean=clean)

    def taken(self, blur_px: float = 0.6, noise: float = 0.0, seed: int = 0) -> NDArray[np.uint8]:
        """What a camera makes of it; noise is a standard deviation in grey levels."""
        blurred = cv2.GaussianBlur(self.clean, (0, 0), blur_px) if blur_px > 0 else self.clean
        noisy = blurred + noise * np.random.default_rng(seed).standard_normal(blurred.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@cache
def take_picture(
    side_px: tuple[float, float],
    *,
    lens_model: str = "pinhole",
    size_px: tuple[int, int] = (1280, 720),
    max_tilt_deg: float = 50.0,
    seed: int = 0,
    dictionary: str = DICTIONARY,
) -> Picture:
    """A grid of markers, each turned and tilted at random, with sides of ``side_px`` before they are tilted."""
    rng = np.random.default_rng(seed)
    camera = make_camera(lens_model=lens_model, width=size_px[0], height=size_px[1])
    cv_dictionary = marker_dictionary(dictionary)
    pitch_px = 1.95 * side_px[1]  # the diagonal of the paper, and room for perspective
    columns, rows = int(camera.width // pitch_px), int(camera.height // pitch_px)
    panels, corners = [], []
    for k in range(min(columns * rows, len(cv_dictionary.bytesList))):
        slot = np.array([(k % columns + 0.5) * camera.width / columns, (k // columns + 0.5) * camera.height / rows])
        middle = slot + rng.uniform(-0.5, 0.5, 2)
        quad = posed_square(camera, middle, rng.uniform(*side_px), max_tilt_deg, rng)
        panels.append(marker_panel(quad, marker_cells(cv_dictionary, k)))
        corners.append(lens.project(camera, quad))
    image = render_image(Scene(panels=tuple(panels), light=FLAT_LIGHT, background=0.35), camera, np.eye(4))
    return Picture(clean=(WHITE_GREY * image).astype(np.float32), corners_px=np.array(corners), camera=camera)


def posed_square(
    camera: Camera, middle_px: Array, side_px: float, max_tilt_deg: float, rng: np.random.Generator
) -> Array:
    """Corners (4, 3) of a square of 0.2 m, seen at a pixel with about this size, turned anyhow [m]."""
    half = 0.1
    square = np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
    tilt, about, turn = np.radians(rng.uniform(0, max_tilt_deg)), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi)
    R = exp_so3(tilt * np.array([np.cos(about), np.sin(about), 0.0])) @ exp_so3(np.array([0.0, 0.0, turn]))
    ray = np.append(lens.undistort(camera, middle_px[None])[0], 1.0)
    # A wide lens shrinks what is far from its axis: how many pixels a step at the middle is.
    around = ray[:2] + 1e-4 * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    seen = lens.project(camera, np.c_[around, np.ones(3)])
    scale = np.sqrt(abs(np.linalg.det((seen[1:] - seen[0]) / 1e-4)))
    # Facing the camera along the ray, then tilted.
    facing = _facing(ray / np.linalg.norm(ray))
    depth = scale * 2 * half / side_px
    return square @ (facing @ R).T + depth * ray


def _facing(ray: Array) -> Array:
    """The smallest rotation that turns +Z to a unit vector."""
    axis = np.cross([0.0, 0.0, 1.0], ray)
    sine = float(np.linalg.norm(axis))
    return np.eye(3) if sine < 1e-12 else exp_so3(axis / sine * np.arctan2(sine, ray[2]))


def marker_panel(quad: Array, white: NDArray[np.bool_], paper: float = 0.9) -> Panel:
    """A marker printed on paper one cell wider on every side."""
    centre = quad.mean(axis=0)
    margin = centre + (quad - centre) * (1 + 2 / len(white))
    return Panel(vertices=margin, albedo=paper, prints=(Print(corners=quad, white=white),))


def outward_px(errors_px: Array, corners_px: Array) -> Array:
    """The part of corner errors (n, 4, 2) that points away from the marker's middle, (n, 4)."""
    away = corners_px - corners_px.mean(axis=1, keepdims=True)
    return (errors_px * away).sum(axis=2) / np.linalg.norm(away, axis=2)
