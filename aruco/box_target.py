"""Boxes as targets: the marker maps that ship with the project.

Owns      the corners of markers printed on the sides of a box, and which sides the two shipped boxes have.
Leaves    reading, checking and writing maps to marker_geometry.

A box is centred at the origin of the target frame: +X towards its right side, +Y towards its top, +Z towards its
front. Prints face outward, and those of the four upright sides stand upright.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from aruco.errors import InputError
from aruco.marker_geometry import SHIPPED_MAPS, Face, save_faces
from aruco.pose_math import Array

# Side -> where it faces, and which way the upper edge of its print points. Unfolded around the front side, the
# prints of bottom, front and top make one upright strip.
SIDES: dict[str, tuple[tuple[int, int, int], tuple[int, int, int]]] = {
    "bottom": ((0, -1, 0), (0, 0, 1)),
    "back": ((0, 0, -1), (0, 1, 0)),
    "top": ((0, 1, 0), (0, 0, -1)),
    "front": ((0, 0, 1), (0, 1, 0)),
    "left": ((-1, 0, 0), (0, 1, 0)),
    "right": ((1, 0, 0), (0, 1, 0)),
}
STANDARD_BOX_IDS = {"bottom": 21, "back": 22, "top": 23, "front": 24, "left": 25, "right": 26}
# The sides of the open corner: face a at z < 0, b at y < 0, c at x < 0.
CORNER_SIDES = {"a": "back", "b": "bottom", "c": "left"}
CORNER_IDS = {"a": (16, 17, 18, 19), "b": (20, 21, 22, 23), "c": (24, 25, 26, 27)}


def box_faces(side_m: float, marker_m: float, ids_by_face: Mapping[str, int]) -> list[Face]:
    """A closed box with one marker in the middle of each side named.

    Args:
        side_m: Edge of the box [m].
        marker_m: Edge of a marker's black square [m].
        ids_by_face: Side (bottom, back, top, front, left, right) -> marker id.

    Returns:
        One face a side, corners in the target frame [m].

    Raises:
        InputError: The side is unknown or the marker does not fit on it.
    """
    return [_printed_face(name, [marker], side_m, marker_m, 0.0) for name, marker in ids_by_face.items()]


def corner_faces(
    side_m: float, marker_m: float, pitch_m: float, ids_by_face: Mapping[str, Sequence[int]]
) -> list[Face]:
    """Three mutually perpendicular sides of a box, a square grid of markers on each.

    Args:
        side_m: Edge of the box [m].
        marker_m: Edge of a marker's black square [m].
        pitch_m: Distance of the centres of neighbouring markers [m].
        ids_by_face: Face (a, b, c) -> ids row by row, as seen looking at the print; as many as a square grid has.

    Returns:
        One face a side, corners in the target frame [m]; ``cross(c1 - c0, c3 - c0)`` is +Z, +Y, +X for a, b, c.

    Raises:
        InputError: The face is unknown, the markers overlap or do not fit on it.
    """
    if not pitch_m >= marker_m:
        raise InputError(f"markers of {marker_m:g} m overlap at a pitch of {pitch_m:g} m; widen the pitch.")
    return [_printed_face(name, ids, side_m, marker_m, pitch_m) for name, ids in ids_by_face.items()]


def standard_box() -> list[Face]:
    """The closed 0.6 m box with one 0.45 m marker on each of its six sides."""
    return box_faces(0.6, 0.45, STANDARD_BOX_IDS)


def object_points() -> list[Face]:
    """The open corner: three sides of a 0.6 m box with four 0.24 m markers each."""
    return corner_faces(0.6, 0.24, 0.30, CORNER_IDS)


def write_shipped_maps(folder: Path = SHIPPED_MAPS) -> list[Path]:
    """Write the maps that ship with the project, and return where; raises OutputError."""
    paths = [folder / "standard_box_markers.parquet", folder / "object_points.parquet"]
    for path, faces in zip(paths, (standard_box(), object_points())):
        save_faces(path, faces)
    return paths


def _printed_face(name: str, ids: Sequence[int], side_m: float, marker_m: float, pitch_m: float) -> Face:
    side = CORNER_SIDES.get(name, name)
    if side not in SIDES:
        raise InputError(f"face {name}: a box has no such side; known: {', '.join([*SIDES, *CORNER_SIDES])}.")
    n = round(len(ids) ** 0.5)
    if not ids or n * n != len(ids):
        raise InputError(f"face {name}: {len(ids)} markers are no square grid; give 1, 4, 9, ... ids.")
    if not 0 < marker_m + (n - 1) * pitch_m <= side_m:
        raise InputError(f"face {name}: {n} x {n} markers of {marker_m:g} m do not fit on a side of {side_m:g} m.")
    # In whole steps from the middle, so that opposite markers mirror each other to the last bit.
    steps = (2 * np.arange(n) - (n - 1)) * (pitch_m / 2)
    centres = [(right, -down) for down in steps for right in steps]
    half = marker_m / 2
    square = np.array([(-half, half), (half, half), (half, -half), (-half, -half)])
    on_print = np.array(centres)[:, None, :] + square
    corners = _in_space(on_print, *SIDES[side], side_m / 2)
    corners.setflags(write=False)
    return Face(name=name, ids=tuple(ids), corners=corners)


def _in_space(on_print: Array, outward: ArrayLike, up: ArrayLike, distance_m: float) -> Array:
    """Points (..., 3) of points (..., 2) of a print, (right, up) as seen looking at it [m]."""
    outward, up = np.asarray(outward, dtype=np.float64), np.asarray(up, dtype=np.float64)
    right = np.cross(up, outward)  # the viewer looks along -outward
    # Adding 0.0 turns the -0.0 that products with zeros leave into 0.0.
    return on_print[..., :1] * right + on_print[..., 1:] * up + distance_m * outward + 0.0
