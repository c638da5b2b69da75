"""Scenes: flat panels with what is painted and printed on them.

Owns      panels, prints, the lamp, bodies made of panels, marker targets and boards as panels.
Leaves    rays and shading to render; which things stand where to room and placement.

The world is in metres, right-handed, +Y up, with the floor at y = 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from aruco.board import AprilGrid, Board, CharucoBoard, board_markers, tag_turns, white_squares
from aruco.errors import InputError
from aruco.marker_geometry import Face
from aruco.pose_math import Array, Pose, transform_points

# Diffuse reflectances: matt office paper, laser toner on it, corrugated cardboard.
WHITE_ALBEDO = 0.85
BLACK_ALBEDO = 0.05
CARDBOARD_ALBEDO = 0.45

# A marker belongs to a side of its target's body when its corners lie this close to the side's plane.
_SIDE_TOLERANCE_M = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Print:
    """A pattern of black and white cells on a panel, with a white margin of one cell around it.

    Of prints that overlap, the cells of the later one are seen; margins never cover cells.
    """

    corners: Array  # (4, 3) of the pattern, world [m], ArUco's order; seen from -cross(c1 - c0, c3 - c0)
    white: NDArray[np.bool_]  # (rows, columns) from the corner c0 along c0 -> c1 (columns) and c0 -> c3 (rows)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Panel:
    """A flat convex polygon, painted alike on both sides."""

    vertices: Array  # (n, 3) in order around the polygon, world [m]
    albedo: float
    contrast: float = 0.0  # standard deviation of the paint's texture, relative to the albedo
    prints: tuple[Print, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """One lamp above the room and light from everywhere."""

    ambient: float = 0.7
    lamp: float = 0.4  # irradiance on the floor straight below the lamp
    lamp_at_m: tuple[float, float, float] = (0.8, 4.5, 0.6)


# Every surface shows its albedo: for checks of areas and edges.
FLAT_LIGHT = Light(ambient=1.0, lamp=0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scene:
    """Everything a camera can see."""

    panels: tuple[Panel, ...]
    light: Light = field(default_factory=Light)
    background: float = 0.3  # brightness where no panel is


def marker_dictionary(name: str) -> cv2.aruco.Dictionary:
    """One of OpenCV's predefined dictionaries.

    Raises:
        InputError: OpenCV has no dictionary of this name.
    """
    known = sorted(key for key in dir(cv2.aruco) if key.startswith("DICT_"))
    if name not in known:
        raise InputError(f"{name}: no such marker dictionary; known: {', '.join(known)}.")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def marker_cells(dictionary: cv2.aruco.Dictionary, marker: int, border_bits: int = 1) -> NDArray[np.bool_]:
    """The cells (n, n) of a marker with its black border, so many cells wide; True is white.

    Raises:
        InputError: The dictionary has no such marker.
    """
    count = len(dictionary.bytesList)
    if not 0 <= marker < count:
        raise InputError(f"marker {marker} is not in the dictionary, which has 0 to {count - 1}; choose another one.")
    side = dictionary.markerSize + 2 * border_bits
    return dictionary.generateImageMarker(marker, side, borderBits=border_bits) > 0


def box_sides(size_m: Sequence[float]) -> list[tuple[Array, Array]]:
    """The six sides of a box centred at the origin.

    Args:
        size_m: Edges along x, y, z [m].

    Returns:
        For each side its outward unit normal (3,) and its vertices (4, 3) [m].
    """
    half = np.asarray(size_m, dtype=np.float64) / 2
    sides: list[tuple[Array, Array]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal, u, v = sign * np.eye(3)[axis], np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            square = np.array([-u - v, u - v, u + v, -u + v]) + normal
            sides.append((normal, square * half))
    return sides


def box_panels(size_m: Sequence[float], T_world_box: Pose, albedo: float) -> list[Panel]:
    """A closed plain box of edges ``size_m``, centred at its own origin."""
    return [Panel(vertices=transform_points(T_world_box, vertices), albedo=albedo) for _, vertices in box_sides(size_m)]


def cylinder_panels(
    radius_m: float, height_m: float, T_world_base: Pose, albedo: float, facets: int = 32
) -> list[Panel]:
    """An upright cylinder, as a prism; its own origin is the centre of its base, its axis +Y."""
    angles = 2 * np.pi * np.arange(facets) / facets
    ring = np.stack([radius_m * np.cos(angles), np.zeros(facets), radius_m * np.sin(angles)], axis=1)
    base = transform_points(T_world_base, ring)
    top = transform_points(T_world_base, ring + np.array([0.0, height_m, 0.0]))
    around = [
        Panel(vertices=np.array([base[i], base[j], top[j], top[i]]), albedo=albedo)
        for i, j in zip(range(facets), np.roll(np.arange(facets), -1))
    ]
    return [*around, Panel(vertices=top, albedo=albedo)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Target:
    """A body with printed markers: a cube centred at the target's origin, or only its printed sides, or a board."""

    faces: tuple[Face, ...]
    dictionary: str
    body_side_m: float = 0.6
    closed: bool = True  # False: only the sides that carry markers are there
    board: Board | None = None  # the target is this board and no body

    @property
    def centre_m(self) -> Array:
        """The middle (3,) of the target, target frame."""
        return np.zeros(3) if self.board is None else self.faces[0].corners.mean(axis=(0, 1))


def target_panels(target: Target, T_world_target: Pose) -> list[Panel]:
    """The target as it stands in the world.

    Markers on a side of the body are printed on that side, so that nothing lies between a print and its side.
    Markers elsewhere get a panel of their own, as large as they are with their margins.

    Raises:
        InputError: The dictionary is unknown or lacks one of the markers.
    """
    if target.board is not None:
        return [board_panel(target.board, T_world_target)]
    dictionary = marker_dictionary(target.dictionary)
    pending = [
        Print(corners=corners, white=marker_cells(dictionary, marker))
        for face in target.faces
        for marker, corners in zip(face.ids, face.corners)
    ]
    panels: list[Panel] = []
    for normal, vertices in box_sides([target.body_side_m] * 3):
        half = target.body_side_m / 2
        here = [p for p in pending if np.abs(p.corners @ normal - half).max() < _SIDE_TOLERANCE_M]
        pending = [p for p in pending if not any(p is q for q in here)]
        if here or target.closed:
            panels.append(_printed_panel(vertices, here, T_world_target))
    return panels + [_printed_panel(_with_margin(p), [p], T_world_target) for p in pending]


def _printed_panel(vertices: Array, prints: Sequence[Print], T_world_target: Pose) -> Panel:
    return Panel(
        vertices=transform_points(T_world_target, vertices),
        albedo=CARDBOARD_ALBEDO,
        prints=tuple(Print(corners=transform_points(T_world_target, p.corners), white=p.white) for p in prints),
    )


def board_panel(board: Board, T_world_board: Pose) -> Panel:
    """A printed board as it stands in the world, on white paper half a square (or a gap) wider on every side."""
    prints = _charuco_prints(board) if isinstance(board, CharucoBoard) else _aprilgrid_prints(board)
    margin = board.square_m / 2 if isinstance(board, CharucoBoard) else board.tag_m * board.spacing / 2
    points = np.concatenate([p.corners for p in prints])
    (left, low, _), (right, high, _) = points.min(axis=0) - margin, points.max(axis=0) + margin
    paper = np.array([[left, low, 0.0], [right, low, 0.0], [right, high, 0.0], [left, high, 0.0]])
    return Panel(
        vertices=transform_points(T_world_board, paper),
        albedo=WHITE_ALBEDO,
        prints=tuple(Print(corners=transform_points(T_world_board, p.corners), white=p.white) for p in prints),
    )


def _charuco_prints(board: CharucoBoard) -> list[Print]:
    """The chessboard, and the markers over its white squares; board frame."""
    dictionary = marker_dictionary(board.dictionary)
    right, down = board.columns * board.square_m, board.rows * board.square_m
    whole = np.array([[0.0, 0.0, 0.0], [right, 0.0, 0.0], [right, down, 0.0], [0.0, down, 0.0]])
    chessboard, markers = white_squares(board), board_markers(board)
    cells = dictionary.markerSize + 2
    per_square = cells * board.square_m / board.marker_m
    margin = round((per_square - cells) / 2)
    if not math.isclose(per_square, cells + 2 * margin, rel_tol=1e-9):
        drawn = [Print(corners=corners, white=marker_cells(dictionary, k)) for k, corners in markers.items()]
        return [Print(corners=whole, white=chessboard), *drawn]
    # Where cells of markers divide a square evenly, one print of small cells is many times as quick to render.
    white = np.kron(chessboard, np.ones((cells + 2 * margin,) * 2, dtype=bool)).astype(bool)
    for marker, (row, column) in zip(markers, np.argwhere(chessboard) * (cells + 2 * margin) + margin):
        white[row : row + cells, column : column + cells] = marker_cells(dictionary, marker)
    return [Print(corners=whole, white=white)]


def _aprilgrid_prints(board: AprilGrid) -> list[Print]:
    """The upright tags, and the black squares that touch their corners; board frame."""
    dictionary, gap = marker_dictionary(board.dictionary), board.tag_m * board.spacing
    tags = [
        Print(corners=corners, white=np.rot90(marker_cells(dictionary, marker, board.border_bits), tag_turns(board)))
        for marker, corners in board_markers(board).items()
    ]
    square = gap * np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    between = [
        Print(corners=square + (board.tag_m + gap) * np.array([column, row, 0.0]), white=np.zeros((1, 1), dtype=bool))
        for row in range(board.rows + 1)
        for column in range(board.columns + 1)
    ]
    return tags + between


def _with_margin(printed: Print) -> Array:
    centre = printed.corners.mean(axis=0)
    return centre + (printed.corners - centre) * (1 + 2 / len(printed.white))
