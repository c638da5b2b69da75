"""Flat calibration boards: ChArUco and Kalibr's AprilGrid, from a short text or a small YAML file.

Owns      what a board is, reading its description, where its corners and markers are.
Leaves    finding boards in images to board_detector.

Frames. A ChArUco board has OpenCV's: origin at the outer corner of the first chessboard square, x along the columns,
y down the rows, z into the print. Inner corner ``row * (columns - 1) + column`` lies at ``(column + 1, row + 1)``
squares. An AprilGrid has Kalibr's: origin at the lower left corner of the first tag, x to the right, y up, z out of
the print towards the viewer; ids run row by row from the lower left. In both, a marker's four corners are in ArUco's
order (top left, top right, bottom right, bottom left) of the upright print.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.detector import dictionary_names, get_dictionary
from aruco.errors import InputError
from aruco.marker_geometry import Face
from aruco.pose_math import Array

CHARUCO_FORM = "charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY"
APRILGRID_FORM = "aprilgrid:COLUMNSxROWS:TAG_M:SPACING[:DICTIONARY[:FIRST_ID[:BORDER_BITS]]]"
# Kalibr prints the family 36h11, with a border two cells wide.
KALIBR_DICTIONARY = "DICT_APRILTAG_36h11"
KALIBR_BORDER_BITS = 2
MAX_SQUARES = 100  # along a side
# A square as large as this was written in millimetres.
MAX_SIDE_M = 2.0
MIN_SIDE_M = 1e-3
MAX_FILE_BYTES = 64 * 2**10

# The first code word of the family 36h11 (Olson, "AprilTag", 2011), from the upper left of the upright tag.
_TAG36H11_0 = 0xD5D628584

_CHARUCO_FIELDS = ("columns", "rows", "square_m", "marker_m", "dictionary")
_APRILGRID_FIELDS = ("columns", "rows", "tag_m", "spacing")
_APRILGRID_EXTRAS = ("dictionary", "first_id", "border_bits")
_KALIBR_FIELDS = {"tagCols": "columns", "tagRows": "rows", "tagSize": "tag_m", "tagSpacing": "spacing"}


@dataclass(frozen=True, slots=True, kw_only=True)
class CharucoBoard:
    """A chessboard with markers in its white squares, numbered as ``cv2.aruco.CharucoBoard`` does."""

    columns: int  # squares along x
    rows: int
    square_m: float
    marker_m: float
    dictionary: str
    legacy_pattern: bool = False  # OpenCV before 4.6: with an even number of rows the first square is white

    def __post_init__(self) -> None:
        """Refuse what cannot be printed."""
        _check_counts(self.columns, self.rows, least=2)
        _check_length(self.square_m, "SQUARE_M")
        _check_length(self.marker_m, "MARKER_M")
        if self.marker_m >= self.square_m:
            raise InputError(
                f"the marker of {self.marker_m:g} m does not fit into a square of {self.square_m:g} m; "
                "give the square first, then the marker."
            )
        if min(self.columns, self.rows) < 3:
            raise InputError(
                f"a board of {self.columns}x{self.rows} squares has its inner corners in one row, too few for a pose; "
                "print one of 3x3 squares or more."
            )
        _check_ids(self.dictionary, 0, self.columns * self.rows // 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class AprilGrid:
    """A grid of tags with black squares between their corners, as Kalibr prints it."""

    columns: int  # tags along x
    rows: int
    tag_m: float
    spacing: float  # gap between tags, as a share of the tag
    dictionary: str = KALIBR_DICTIONARY
    first_id: int = 0
    border_bits: int = KALIBR_BORDER_BITS  # cells of black around a tag's code

    def __post_init__(self) -> None:
        """Refuse what cannot be printed."""
        _check_counts(self.columns, self.rows, least=1)
        _check_length(self.tag_m, "TAG_M")
        if not 0 < self.spacing <= 1:
            raise InputError(f"SPACING {self.spacing:g} is the gap as a share of the tag, above 0 and at most 1.")
        if not 1 <= self.border_bits <= 4:
            raise InputError(
                f"BORDER_BITS {self.border_bits}: a tag's border is 1 to 4 cells wide, 2 in Kalibr's prints."
            )
        if self.first_id < 0:
            raise InputError(f"FIRST_ID {self.first_id} is negative; ids count from 0.")
        _check_ids(self.dictionary, self.first_id, self.columns * self.rows)


Board = CharucoBoard | AprilGrid


def parse_board(text: str) -> Board:
    """A board from its description.

    Args:
        text: CHARUCO_FORM, APRILGRID_FORM, or the path of a YAML file with the same fields in small letters and
            ``type: charuco`` or ``type: aprilgrid``, or one of Kalibr's (``target_type: aprilgrid``, ``tagCols`` ...).

    Raises:
        InputError: It is none of these, or no such board can be printed; the message shows the form.
    """
    kind, _, rest = text.strip().partition(":")
    kind = kind.lower()
    if kind == "charuco" and rest:
        return _named(text, CHARUCO_FORM, kind, _spec_fields(text, rest, _CHARUCO_FIELDS, (), CHARUCO_FORM))
    if kind == "aprilgrid" and rest:
        fields = _spec_fields(text, rest, _APRILGRID_FIELDS, _APRILGRID_EXTRAS, APRILGRID_FORM)
        return _named(text, APRILGRID_FORM, kind, fields)
    path = Path(text.strip())
    if text.strip() and os.path.isfile(path):
        return _from_yaml(path)
    raise InputError(
        f"--board {text}: neither a board nor a YAML file; write {CHARUCO_FORM} or {APRILGRID_FORM}, "
        "for instance charuco:4x5:0.054:0.0405:DICT_4X4_1000."
    )


def board_text(board: Board) -> str:
    """The description that parse_board reads; without ``legacy_pattern``, which only a YAML file can tell."""
    size = f"{board.columns}x{board.rows}"
    if isinstance(board, CharucoBoard):
        return f"charuco:{size}:{board.square_m!r}:{board.marker_m!r}:{board.dictionary}"
    return f"aprilgrid:{size}:{board.tag_m!r}:{board.spacing!r}:{board.dictionary}:{board.first_id}:{board.border_bits}"


def board_geometry(board: Board) -> dict[int, Array]:
    """The points that a detection of the board measures.

    Returns:
        ChArUco: inner corner -> (1, 3). AprilGrid: tag -> (4, 3) corners. Metres in the board's frame, z = 0.
    """
    if isinstance(board, AprilGrid):
        return board_markers(board)
    places = [(column, row) for row in range(1, board.rows) for column in range(1, board.columns)]
    return {k: board.square_m * np.array([[column, row, 0.0]]) for k, (column, row) in enumerate(places)}


def board_markers(board: Board) -> dict[int, Array]:
    """Marker id -> its corners (4, 3) [m] in the board's frame, ArUco order of the upright print."""
    if isinstance(board, CharucoBoard):
        margin = (board.square_m - board.marker_m) / 2
        square = board.marker_m * np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
        square[:, :2] += margin
        places = np.argwhere(white_squares(board))
        return {k: square + board.square_m * np.array([column, row, 0.0]) for k, (row, column) in enumerate(places)}
    pitch = board.tag_m * (1 + board.spacing)
    upright = board.tag_m * np.array([[0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return {
        board.first_id + row * board.columns + column: upright + pitch * np.array([column, row, 0.0])
        for row in range(board.rows)
        for column in range(board.columns)
    }


def white_squares(board: CharucoBoard) -> NDArray[np.bool_]:
    """Which squares (rows, columns) are white and hold a marker."""
    first_white = board.legacy_pattern and board.rows % 2 == 0
    row, column = np.mgrid[0 : board.rows, 0 : board.columns]
    return (row + column + first_white) % 2 == 1


def tag_turns(board: AprilGrid) -> int:
    """How many corners OpenCV's numbering of a tag is ahead of the upright print's.

    OpenCV before 5 draws the AprilTag families upside down; their authors and Kalibr do not.
    """
    if not board.dictionary.startswith("DICT_APRILTAG"):
        return 0
    drawn = get_dictionary(KALIBR_DICTIONARY).generateImageMarker(0, 8)[1:-1, 1:-1].ravel() > 0
    upright = [bit == "1" for bit in f"{_TAG36H11_0:036b}"]
    return 0 if list(drawn) == upright else 2


def board_face(board: Board) -> Face:
    """All markers of the board as one flat face, for a board that is used as a plain marker target."""
    markers = board_markers(board)
    return Face(name="board", ids=tuple(markers), corners=np.array(list(markers.values())))


def _spec_fields(text: str, rest: str, names: tuple[str, ...], extras: tuple[str, ...], form: str) -> dict[str, Any]:
    parts = rest.split(":")
    least = len(names) - 1  # columns and rows are one part
    if not least <= len(parts) <= least + len(extras):
        raise InputError(f"--board {text}: {len(parts) + 1} parts between colons do not make a board; write {form}.")
    size = parts[0].lower().split("x")
    if len(size) != 2:
        raise InputError(f"--board {text}: {parts[0]!r} is not COLUMNSxROWS, such as 4x5; write {form}.")
    return dict(zip((*names, *extras), (*size, *parts[1:])))


def _named(text: str, form: str, kind: str, fields: Mapping[str, Any]) -> Board:
    """The board of some fields; every complaint begins with where it comes from and ends with the form."""
    try:
        values = {name: _value(name, given) for name, given in fields.items()}
        return CharucoBoard(**values) if kind == "charuco" else AprilGrid(**values)
    except InputError as error:
        raise InputError(f"--board {text}: {str(error).rstrip('.')}; the form is {form}.") from None


def _value(name: str, given: Any) -> Any:
    if name == "dictionary":
        return str(given)
    if name == "legacy_pattern":
        if not isinstance(given, bool):
            raise InputError(f"legacy_pattern is true or false, not {given!r:.40}")
        return given
    if name in ("columns", "rows", "first_id", "border_bits"):
        return _whole(name, given)
    return _length(name, given)


def _whole(name: str, given: Any) -> int:
    if isinstance(given, bool) or not isinstance(given, (int, str)):
        raise InputError(f"{name.upper()} is a whole number, not {given!r:.40}")
    try:
        return int(given)
    except ValueError:
        raise InputError(f"{name.upper()} is a whole number, not {given!r:.40}") from None


def _length(name: str, given: Any) -> float:
    try:
        if isinstance(given, bool) or not isinstance(given, (int, float, str)):
            raise ValueError
        value = float(given)
    except (ValueError, OverflowError):
        raise InputError(f"{name.upper()} is a number, not {given!r:.40}") from None
    if not math.isfinite(value):
        raise InputError(f"{name.upper()} is a finite number, not {given!r:.40}")
    return value


def _from_yaml(path: Path) -> Board:
    entries = _yaml_entries(path)
    kind = entries.get("type", entries.get("target_type"))
    if kind not in ("charuco", "aprilgrid"):
        raise InputError(f"--board {path}: want type: charuco or type: aprilgrid, got {kind!r:.40}.")
    fields = {_KALIBR_FIELDS.get(name, name): value for name, value in entries.items()}
    needed = _CHARUCO_FIELDS if kind == "charuco" else _APRILGRID_FIELDS
    known = (*needed, "legacy_pattern") if kind == "charuco" else (*needed, *_APRILGRID_EXTRAS)
    missing = [name for name in needed if name not in fields]
    strange = [name for name in fields if name not in (*known, "type", "target_type")]
    if missing or strange:
        wrong = f"lacks {', '.join(missing)}" if missing else f"does not know {', '.join(map(str, strange))[:80]}"
        raise InputError(f"--board {path}: the {kind} board {wrong}; its fields are {', '.join(known)}.")
    form = CHARUCO_FORM if kind == "charuco" else APRILGRID_FORM
    return _named(str(path), form, kind, {name: fields[name] for name in known if name in fields})


def _yaml_entries(path: Path) -> dict[Any, Any]:
    import yaml

    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
        if len(data) > MAX_FILE_BYTES:
            raise InputError(f"--board {path}: over {MAX_FILE_BYTES >> 10} KiB, which is no board; check the path.")
        entries = yaml.safe_load(data)
    except OSError as error:
        raise InputError(f"--board {path}: cannot be read ({error.strerror or error}); check the path.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(
            f"--board {path}: not readable YAML; write type: charuco and its fields, one a line."
        ) from error
    if not isinstance(entries, dict):
        raise InputError(f"--board {path}: not a list of fields; write type: charuco and its fields, one a line.")
    return entries


def _check_counts(columns: int, rows: int, least: int) -> None:
    if not (least <= columns <= MAX_SQUARES and least <= rows <= MAX_SQUARES):
        raise InputError(f"COLUMNSxROWS {columns}x{rows}: want {least} to {MAX_SQUARES} each.")


def _check_length(value: float, name: str) -> None:
    if not MIN_SIDE_M <= value <= MAX_SIDE_M:
        raise InputError(f"{name} {value:g}: want metres between {MIN_SIDE_M:g} and {MAX_SIDE_M:g}, not millimetres.")


def _check_ids(dictionary: str, first: int, count: int) -> None:
    if dictionary not in dictionary_names():
        raise InputError(f"{dictionary!r:.60}: no such dictionary; known: {', '.join(dictionary_names())}.")
    size = len(get_dictionary(dictionary).bytesList)
    if first + count > size:
        raise InputError(
            f"the board needs markers {first} to {first + count - 1}, but {dictionary} has 0 to {size - 1}; "
            "choose a larger dictionary or a smaller board."
        )
