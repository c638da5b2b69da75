"""Pictures full of markers at known places, as large and as tilted as wished.

Owns      laying markers out, rendering and sensing them, comparing what was found with the truth.
Leaves    rendering to rigcal.sim, finding to the suite.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aruco import lens
from aruco.alignment import rotation_align_vectors
from aruco.model import Camera
from aruco.pose_math import Array, exp_so3
from rigcal.sim.noise import ImageNoise, expose, sense
from rigcal.sim.render import render_image
from rigcal.sim.scene import Panel, Print, Scene, marker_cells, marker_dictionary

WIDTH, HEIGHT, FOCAL_PX = 1920, 1080, 1050.0
BENT = (-0.12, 0.03, 5e-4, -5e-4, 0.0)  # a webcam's lens, plumb_bob
MAX_TILT_RAD = np.deg2rad(60.0)
_DISTANCE_M, _WALL_M = 2.0, 5.0
# A square tilted by 60 degrees is 1.41 times as long as the root of its area; its diagonal with margins is 2.5 times.
_PITCH = 2.6


# What a camera makes of levels of light, (h, w) of 0 to 255.
Response = Callable[[NDArray[np.float32]], NDArray[np.float32]]


def linear(levels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Levels as they are: those of a machine vision camera, and of the simulator."""
    return levels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TagWall:
    """What one picture shows, and the picture without noise."""

    camera: Camera
    ids: NDArray[np.int64]  # (n,) ascending
    corners_px: Array  # (n, 4, 2) recorded pixels
    brightness: NDArray[np.float32]  # (h, w)

    def photograph(self, noise: ImageNoise, seed: int, response: Response = linear) -> NDArray[np.uint8]:
        """The picture (h, w) that a sensor makes of it."""
        return sense(response(expose(self.brightness, noise)), noise, np.random.default_rng(seed))


def tag_walls(
    count: int, sides_px: tuple[float, float], *, seed: int, dictionary: str, bent: bool = False, at_most: int = 40
) -> Iterator[TagWall]:
    """Pictures of markers in random poses before a plain wall.

    Args:
        count: How many pictures.
        sides_px: Range of the root of a marker's area, evenly distributed in its logarithm [px].
        seed: Decides ids, places and poses.
        dictionary: OpenCV's name of the markers' dictionary; a picture shows no id twice.
        bent: Whether the lens distorts.
        at_most: Markers in a picture.
    """
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield _tag_wall(rng, sides_px, dictionary, _camera(rng, bent), at_most)


def _camera(rng: np.random.Generator, bent: bool) -> Camera:
    cx, cy = np.array([WIDTH - 1, HEIGHT - 1]) / 2 + rng.uniform(-8, 8, 2)
    K = np.array([[FOCAL_PX, 0, cx], [0, FOCAL_PX, cy], [0, 0, 1]])
    return Camera(name="wall", width=WIDTH, height=HEIGHT, K=K, distortion=np.array(BENT if bent else ()))


def _tag_wall(
    rng: np.random.Generator, sides_px: tuple[float, float], dictionary: str, camera: Camera, at_most: int
) -> TagWall:
    printed = marker_dictionary(dictionary)
    places = _places(rng, _PITCH * sides_px[1])[:at_most]
    ids = np.sort(rng.permutation(len(printed.bytesList))[: len(places)]).astype(np.int64)
    low, high = np.log(sides_px)
    corners = [_marker(rng, camera, place, float(np.exp(rng.uniform(low, high)))) for place in places[: len(ids)]]
    wall = 4 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * _WALL_M + [0, 0, _WALL_M]
    panels = [Panel(vertices=wall, albedo=0.45, contrast=0.1)]
    for marker, square in zip(ids, corners):
        cells = marker_cells(printed, int(marker))
        middle = square.mean(axis=0)
        card = middle + (square - middle) * (1 + 2 / len(cells))  # as large as the marker's white margin
        panels.append(Panel(vertices=card, albedo=0.45, prints=(Print(corners=square, white=cells),)))
    return TagWall(
        camera=camera,
        ids=ids,
        corners_px=np.array([lens.project(camera, square) for square in corners]),
        brightness=render_image(Scene(panels=tuple(panels)), camera, np.eye(4)),
    )


def _places(rng: np.random.Generator, pitch_px: float) -> Array:
    """Points (n, 2) on a grid that keeps markers apart and inside, in random order and off the pixels' raster [px]."""
    columns, rows = int((WIDTH - 20) // pitch_px), int((HEIGHT - 20) // pitch_px)
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2)
    start = (np.array([WIDTH, HEIGHT]) - pitch_px * np.array([columns, rows])) / 2
    return rng.permutation(start + (grid + 0.5) * pitch_px + rng.uniform(-0.5, 0.5, grid.shape))


def _marker(rng: np.random.Generator, camera: Camera, place_px: Array, side_px: float) -> Array:
    """Corners (4, 3) [m], camera frame, of a marker around a pixel: turned and tilted at random, of a given size."""
    straight = lens.straighten(camera, place_px[None])[0]
    ray = np.linalg.inv(camera.K) @ [*straight, 1.0]
    axis, tilt, roll = rng.uniform(0, 2 * np.pi), rng.uniform(0, MAX_TILT_RAD), rng.uniform(0, 2 * np.pi)
    tilted = exp_so3(tilt * np.array([np.cos(axis), np.sin(axis), 0.0])) @ exp_so3(np.array([0.0, 0.0, roll]))
    R = rotation_align_vectors(np.array([0.0, 0.0, 1.0]), ray / np.linalg.norm(ray)) @ tilted
    square = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]]) @ R.T
    side_m = side_px * _DISTANCE_M / FOCAL_PX
    for _ in range(2):  # perspective makes the area only nearly proportional to the square of the side
        side_m *= side_px / np.sqrt(_area(lens.project(camera, ray * _DISTANCE_M + side_m * square)))
    return ray * _DISTANCE_M + side_m * square


def _area(polygon: Array) -> float:
    after = np.roll(polygon, -1, axis=0)
    return float(abs(polygon[:, 0] @ after[:, 1] - polygon[:, 1] @ after[:, 0]) / 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CornerErrors:
    """Found corners minus true ones, over several pictures."""

    found: dict[tuple[int, int], Array]  # (picture, id) -> (4, 2) [px]
    centres: dict[tuple[int, int], Array]  # unit vectors (4, 2) from each true corner to its marker's centre
    shown: int  # markers in the pictures
    false: int  # finds of markers that are not there

    @property
    def errors_px(self) -> Array:
        """(n, 2) over all corners of all found markers."""
        return np.array(list(self.found.values())).reshape(-1, 2)

    @property
    def share(self) -> float:
        """Found markers, of those that are there."""
        return len(self.found) / self.shown

    @property
    def median_px(self) -> float:
        """Median distance from the truth."""
        return float(np.median(np.linalg.norm(self.errors_px, axis=1)))

    @property
    def rms_px(self) -> float:
        """Root mean square distance from the truth."""
        return float(np.sqrt(np.mean(np.sum(self.errors_px**2, axis=1))))

    @property
    def rms_centred_px(self) -> float:
        """The same after taking the mean error off: what a method would be like without its offset."""
        errors = self.errors_px - self.errors_px.mean(axis=0)
        return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))

    @property
    def offset_px(self) -> float:
        """Length of the mean error: what all corners are shifted by."""
        return float(np.linalg.norm(self.errors_px.mean(axis=0)))

    @property
    def inward_px(self) -> float:
        """Mean error towards the marker's centre: markers look smaller by it."""
        inward = [np.sum(error * self.centres[key], axis=1) for key, error in self.found.items()]
        return float(np.mean(inward))


def corner_errors(walls: list[TagWall], finds: list[tuple[NDArray[np.int64], Array]]) -> CornerErrors:
    """Compare finds, (ids (n,), corners (n, 4, 2) [px]) for each picture, with the truth."""
    found: dict[tuple[int, int], Array] = {}
    centres: dict[tuple[int, int], Array] = {}
    false = 0
    for picture, (wall, (ids, corners)) in enumerate(zip(walls, finds)):
        true = dict(zip(wall.ids.tolist(), wall.corners_px))
        for marker, square in zip(ids.tolist(), corners):
            # A find elsewhere is another thing that looks like this marker.
            if marker not in true or np.linalg.norm((square - true[marker]).mean(axis=0)) > 10:
                false += 1
                continue
            found[picture, marker] = square - true[marker]
            inward = true[marker].mean(axis=0) - true[marker]
            centres[picture, marker] = inward / np.linalg.norm(inward, axis=1, keepdims=True)
    return CornerErrors(found=found, centres=centres, shown=sum(len(wall.ids) for wall in walls), false=false)
