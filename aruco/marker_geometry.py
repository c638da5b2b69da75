"""Where every marker corner of a target is, in the target's frame.

Owns      reading, checking and writing marker maps (parquet), and the maps that ship with the project.
Leaves    finding markers in images to detector.

A map has one row a face: ``name: string``, ``ids: list<int64>``, ``corners: (N, 4, 3)`` metres. Corners are in
ArUco's order (top left, top right, bottom right, bottom left, looking at the print), so the printed side faces along
``-cross(c1 - c0, c3 - c0)``.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aruco.atomic import write_whole
from aruco.errors import InputError
from aruco.pose_math import Array

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

SHIPPED_MAPS = Path(__file__).parent / "markers"

# A print may be a little off square, a map that mixes units or corners is far off.
MAX_SIDE_MISMATCH = 0.05  # longest side over shortest, minus one
MAX_CORNER_MISMATCH = 0.05  # cosine between neighbouring sides
MIN_SIDE_M = 1e-3
MAX_COORDINATE_M = 100.0
MAX_ID = 2**31 - 1
# Millions of numbers are a wrong file, not a target; a small file can unpack to more than fits in memory.
MAX_FILE_BYTES = 64 * 2**20
MAX_VALUES = 10_000_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Face:
    """One flat side of a target and its markers."""

    name: str
    ids: tuple[int, ...]
    corners: Array  # (len(ids), 4, 3) metres, target frame


def load_marker_geometry(path: str | os.PathLike[str]) -> dict[int, Array]:
    """The corners of every marker of a map.

    Args:
        path: A parquet file as described at the top of this module.

    Returns:
        Marker id -> (4, 3) corners [m] in the target frame, ArUco order.

    Raises:
        InputError: The file cannot be read or a marker cannot be one; the message names file, row and marker.
    """
    return {marker: corners for face in load_faces(path) for marker, corners in zip(face.ids, face.corners)}


def load_face_mapping(path: str | os.PathLike[str]) -> dict[str, list[int]]:
    """The marker ids of every named face of a map; raises like load_marker_geometry."""
    return {face.name: list(face.ids) for face in load_faces(path)}


def load_faces(path: str | os.PathLike[str]) -> list[Face]:
    """The faces of a map in file order; raises like load_marker_geometry."""
    path = Path(path)
    rows = _read_rows(path)
    faces = [_checked_face(row, f"{path}, row {number}") for number, row in enumerate(rows)]
    if not any(face.ids for face in faces):
        raise InputError(f"{path}: the marker map has no markers; write one row a face with name, ids and corners.")
    _refuse_repeats(faces, path)
    return faces


def _read_rows(path: Path) -> list[dict[str, Any]]:
    if not os.path.isfile(path):
        raise InputError(f"{path}: no such marker map; give a parquet file, or one of {_shipped_names()}.")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise InputError(f"{path}: over {MAX_FILE_BYTES >> 20} MiB, which is not a marker map; check the path.")
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # Not read_table: it takes a folder called "a=b" on the way to the file for a column a.
        with pq.ParquetFile(path) as file:
            _refuse_wrong_columns(file, path)
            return file.read(columns=["name", "ids", "corners"]).to_pylist()
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: not a readable parquet file ({reason}); write the marker map anew.") from error


def _refuse_wrong_columns(file: pq.ParquetFile, path: Path) -> None:
    names = file.schema_arrow.names
    missing = [column for column in ("name", "ids", "corners") if column not in names]
    if missing:
        raise InputError(
            f"{path}: the marker map lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; "
            f"it has {', '.join(names) or 'none'} and needs name, ids and corners."
        )
    if len(names) != len(set(names)):
        raise InputError(f"{path}: the marker map has two columns of one name ({', '.join(names)}); keep one of each.")
    groups = [file.metadata.row_group(g) for g in range(file.metadata.num_row_groups)]
    if sum(group.column(c).num_values for group in groups for c in range(group.num_columns)) > MAX_VALUES:
        raise InputError(f"{path}: over {MAX_VALUES} numbers, which is not a marker map; check the path.")


def _shipped_names() -> str:
    return ", ".join(sorted(map(str, SHIPPED_MAPS.glob("*.parquet"))))


def _checked_face(row: Mapping[str, Any], where: str) -> Face:
    name, ids, values = row["name"], row["ids"], row["corners"]
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: the face has no name; give it one.")
    where = f"{where} (face {name})"
    if not isinstance(ids, list) or not all(type(i) is int and 0 <= i <= MAX_ID for i in ids):
        raise InputError(f"{where}: ids must be a list of whole numbers from 0 to {MAX_ID}, got {ids!r:.80}.")
    try:
        corners: Array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        corners = np.empty(0)
    if not ids and not corners.size:
        corners = corners.reshape(0, 4, 3)
    if corners.shape != (len(ids), 4, 3):
        shape = corners.shape if corners.ndim and corners.size else "a ragged or empty list"
        raise InputError(f"{where}: {len(ids)} ids want corners of shape ({len(ids)}, 4, 3), got {shape}.")
    for k, marker in enumerate(ids):
        _check_square(corners[k], f"{where}: marker {marker}")
    corners.setflags(write=False)
    return Face(name=name, ids=tuple(ids), corners=corners)


def _check_square(quad: Array, where: str) -> None:
    if not np.isfinite(quad).all():
        raise InputError(f"{where} has NaN or infinite corners; measure the map again.")
    if np.abs(quad).max() > MAX_COORDINATE_M:
        raise InputError(
            f"{where} has a coordinate of {np.abs(quad).max():g} m; coordinates are metres below {MAX_COORDINATE_M:g}: "
            "if the map was written in millimetres, divide by 1000."
        )
    sides = np.roll(quad, -1, axis=0) - quad
    lengths = np.linalg.norm(sides, axis=1)
    if lengths.min() < MIN_SIDE_M:
        raise InputError(f"{where} is collapsed: its shortest side is {1e3 * lengths.min():.3g} mm.")
    cosines = np.einsum("ij,ij->i", sides, np.roll(sides, -1, axis=0)) / (lengths * np.roll(lengths, -1))
    crooked = float(np.abs(cosines).max())
    if crooked <= MAX_CORNER_MISMATCH:
        # A fold along a diagonal hardly changes sides and angles: the four corners must also lie in one plane.
        normal = np.cross(sides[0], -sides[3])
        lift = abs(normal @ (quad[2] - quad[0])) / (np.linalg.norm(normal) * lengths.mean())
        crooked = max(crooked, float(lift))
    if lengths.max() / lengths.min() - 1 > MAX_SIDE_MISMATCH or crooked > MAX_CORNER_MISMATCH:
        shown = ", ".join(f"{1e3 * length:.1f}" for length in lengths)
        raise InputError(
            f"{where} is not square: sides {shown} mm, corners up to {math.degrees(math.asin(min(1.0, crooked))):.1f} "
            "degrees off a right angle; corners go top left, top right, bottom right, bottom left."
        )


def _refuse_repeats(faces: Sequence[Face], path: Path) -> None:
    owners: dict[int, str] = {}
    names: set[str] = set()
    for number, face in enumerate(faces):
        if face.name in names:
            raise InputError(f"{path}, row {number}: a second face is called {face.name}; names must differ.")
        names.add(face.name)
        for marker in face.ids:
            if marker in owners:
                raise InputError(
                    f"{path}, row {number} (face {face.name}): marker {marker} is listed twice, first on face "
                    f"{owners[marker]}; every id may stand on the target once."
                )
            owners[marker] = face.name


def corrected_faces(faces: Sequence[Face], geometry: Mapping[int, Array]) -> list[Face]:
    """The same faces with the corners (4, 3) [m] that a geometry has for their markers."""
    return [_with_corners(face, [geometry[marker] for marker in face.ids]) for face in faces]


def _with_corners(face: Face, corners: Sequence[Array]) -> Face:
    together: Array = np.array(corners, dtype=np.float64).reshape(-1, 4, 3)
    together.setflags(write=False)
    return Face(name=face.name, ids=face.ids, corners=together)


def save_faces(path: str | os.PathLike[str], faces: Sequence[Face]) -> None:
    """Write a marker map whole or not at all.

    Raises:
        OutputError: The file cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    buffer = pa.BufferOutputStream()
    pq.write_table(_table(faces), buffer)
    write_whole(Path(path), buffer.getvalue().to_pybytes())


def _table(faces: Sequence[Face]) -> pa.Table:
    import pyarrow as pa

    schema = pa.schema(
        [
            ("name", pa.string()),
            ("ids", pa.list_(pa.int64())),
            ("corners", pa.list_(pa.list_(pa.list_(pa.float64())))),
        ]
    )
    columns = {
        "name": [face.name for face in faces],
        "ids": [list(face.ids) for face in faces],
        "corners": [face.corners.tolist() for face in faces],
    }
    return pa.table(columns, schema=schema)
