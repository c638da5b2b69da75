"""A board's description says where its corners are, as OpenCV and Kalibr have it, and wrong ones are refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from aruco.board import (
    MAX_FILE_BYTES,
    AprilGrid,
    Board,
    CharucoBoard,
    board_face,
    board_geometry,
    board_markers,
    board_text,
    parse_board,
    tag_turns,
    white_squares,
)
from aruco.detector import get_dictionary
from aruco.errors import InputError

WEBCAMS = "charuco:4x5:0.054:0.0405:DICT_4X4_1000"
KALIBR = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.088\ntagSpacing: 0.3\n"


def in_opencv(board: CharucoBoard) -> cv2.aruco.CharucoBoard:
    size, dictionary = (board.columns, board.rows), get_dictionary(board.dictionary)
    known = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary)
    known.setLegacyPattern(board.legacy_pattern)
    return known


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(4, 5), (7, 5), (5, 6), (6, 4)])
def test_a_charuco_board_is_opencvs(columns: int, rows: int, legacy: bool) -> None:
    board = CharucoBoard(
        columns=columns, rows=rows, square_m=0.05, marker_m=0.03, dictionary="DICT_5X5_100", legacy_pattern=legacy
    )
    known = in_opencv(board)
    corners = np.concatenate(list(board_geometry(board).values()))
    # OpenCV keeps float32: 1e-7 of a board of half a metre.
    np.testing.assert_allclose(corners, known.getChessboardCorners(), atol=1e-7)
    markers = board_markers(board)
    assert list(markers) == list(np.ravel(known.getIds()))
    np.testing.assert_allclose(list(markers.values()), np.array(known.getObjPoints()), atol=1e-7)
    drawn = known.generateImage((100 * columns, 100 * rows))
    # The very corner of a square is outside of its marker.
    np.testing.assert_array_equal(drawn[5::100, 5::100] > 0, white_squares(board))


def test_corners_have_one_point_and_tags_four() -> None:
    corners = board_geometry(parse_board(WEBCAMS))
    assert list(corners) == list(range(12))
    assert {points.shape for points in corners.values()} == {(1, 3)}
    tags = board_geometry(parse_board("aprilgrid:3x2:0.1:0.25"))
    assert list(tags) == list(range(6))
    assert {points.shape for points in tags.values()} == {(4, 3)}


def test_an_aprilgrid_is_kalibrs() -> None:
    tags = board_geometry(parse_board("aprilgrid:3x2:0.1:0.25:DICT_APRILTAG_36h11:7"))
    # Ids row by row from the lower left, y up; corners from the upper left, clockwise for who looks at the print.
    np.testing.assert_allclose(tags[7], [[0, 0.1, 0], [0.1, 0.1, 0], [0.1, 0, 0], [0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(tags[8] - tags[7], np.tile([0.125, 0, 0], (4, 1)), atol=1e-12)
    np.testing.assert_allclose(tags[10] - tags[7], np.tile([0, 0.125, 0], (4, 1)), atol=1e-12)


@pytest.mark.parametrize(("text", "towards"), [(WEBCAMS, -1.0), ("aprilgrid:3x2:0.1:0.25", 1.0)])
def test_the_print_faces_the_side_that_the_frame_says(text: str, towards: float) -> None:
    for c0, c1, _, c3 in board_face(parse_board(text)).corners:
        visible = -np.cross(c1 - c0, c3 - c0)
        np.testing.assert_allclose(visible / np.linalg.norm(visible), [0, 0, towards], atol=1e-12)


def test_the_turn_of_opencvs_tags_is_told_from_its_own_drawing() -> None:
    # The upper row of the first tag of 36h11 as its authors publish it.
    drawn = get_dictionary("DICT_APRILTAG_36h11").generateImageMarker(0, 8) > 0
    upright = np.rot90(drawn, tag_turns(AprilGrid(columns=2, rows=2, tag_m=0.1, spacing=0.3)))
    assert list(upright[1, 1:-1]) == [bit == "1" for bit in "110101"]
    assert tag_turns(AprilGrid(columns=2, rows=2, tag_m=0.1, spacing=0.3, dictionary="DICT_6X6_50")) == 0


BOARDS = [
    CharucoBoard(columns=4, rows=5, square_m=0.054, marker_m=0.0405, dictionary="DICT_4X4_1000"),
    AprilGrid(columns=6, rows=5, tag_m=0.088, spacing=0.3),
    AprilGrid(columns=2, rows=1, tag_m=1 / 3, spacing=0.1, dictionary="DICT_6X6_50", first_id=4, border_bits=1),
]


@pytest.mark.parametrize("board", BOARDS)
def test_the_text_of_a_board_reads_back(board: Board) -> None:
    assert parse_board(board_text(board)) == board


@pytest.mark.parametrize(
    ("text", "board"),
    [
        (KALIBR, BOARDS[1]),
        (
            "type: charuco\ncolumns: 4\nrows: 5\nsquare_m: 0.054\nmarker_m: 4.05e-2\ndictionary: DICT_4X4_1000",
            BOARDS[0],
        ),
        ("type: aprilgrid\ncolumns: 6\nrows: 5\ntag_m: 0.088\nspacing: 0.3\nborder_bits: 2", BOARDS[1]),
    ],
)
def test_a_yaml_file_says_the_same(tmp_path: Path, text: str, board: Board) -> None:
    file = tmp_path / "board.yaml"
    file.write_text(text, encoding="utf-8")
    assert parse_board(str(file)) == board


def test_a_legacy_pattern_is_said_in_yaml(tmp_path: Path) -> None:
    file = tmp_path / "board.yaml"
    fields = "type: charuco\ncolumns: 4\nrows: 6\nsquare_m: 0.05\nmarker_m: 0.04\ndictionary: DICT_4X4_50\n"
    file.write_text(fields + "legacy_pattern: true\n", encoding="utf-8")
    board = parse_board(str(file))
    assert isinstance(board, CharucoBoard)
    assert board.legacy_pattern
    file.write_text(fields + "legacy_pattern: 1\n", encoding="utf-8")
    with pytest.raises(InputError, match="legacy_pattern is true or false"):
        parse_board(str(file))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "neither a board nor a YAML file; write charuco:COLUMNSxROWS"),
        ("charuco", "neither a board"),
        ("no/such/board.yaml", "neither a board"),
        ("charuco:4x5:0.054:0.0405", "4 parts .* write charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY"),
        ("charuco:4:0.054:0.0405:DICT_4X4_50", "'4' is not COLUMNSxROWS"),
        ("charuco:4x5:0.0405:0.054:DICT_4X4_50", "does not fit .* square first"),
        ("charuco:4x5:54:40.5:DICT_4X4_50", "SQUARE_M 54: want metres .* not millimetres"),
        ("charuco:4x5:-1:0.04:DICT_4X4_50", "SQUARE_M -1"),
        ("charuco:4x5:wide:0.04:DICT_4X4_50", "SQUARE_M is a number, not 'wide'"),
        ("charuco:4x5:inf:0.04:DICT_4X4_50", "finite"),
        ("charuco:4.5x5:0.05:0.04:DICT_4X4_50", "COLUMNS is a whole number"),
        ("charuco:1x5:0.05:0.04:DICT_4X4_50", "COLUMNSxROWS 1x5: want 2 to 100"),
        ("charuco:2x2:0.05:0.04:DICT_4X4_50", "too few for a pose"),
        ("charuco:9x2:0.05:0.04:DICT_4X4_50", "in one row"),
        ("charuco:4x5:0.05:0.04:DICT_4X4", "'DICT_4X4': no such dictionary; known: .*DICT_4X4_50"),
        ("charuco:12x12:0.05:0.04:DICT_4X4_50", "needs markers 0 to 71, but DICT_4X4_50 has 0 to 49"),
        ("aprilgrid:6x6:0.088", "3 parts .* write aprilgrid:"),
        ("aprilgrid:6x6:0.088:30", "SPACING 30 is the gap as a share"),
        ("aprilgrid:6x6:0.088:0.3:DICT_APRILTAG_36h11:580", "needs markers 580 to 615"),
        ("aprilgrid:6x6:0.088:0.3:DICT_APRILTAG_36h11:-1", "FIRST_ID -1 is negative"),
        ("aprilgrid:6x6:0.088:0.3:DICT_APRILTAG_36h11:0:9", "BORDER_BITS 9"),
    ],
)
def test_a_wrong_text_is_refused_with_the_right_form(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_board(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a list of fields"),
        ("- 1\n- 2\n", "not a list of fields"),
        ("a: [", "not readable YAML"),
        ("[" * 5000, "not readable YAML"),
        ("!!python/object/apply:os.getcwd []", "not readable YAML"),
        ("target_type: checkerboard\n", "want type: charuco or type: aprilgrid, got 'checkerboard'"),
        ("type: charuco\ncolumns: 4\n", "lacks rows, square_m, marker_m, dictionary"),
        (KALIBR + "colour: red\n", "does not know colour"),
        (KALIBR.replace("6", "true"), "COLUMNS is a whole number, not True"),
        (KALIBR.replace("0.088", "[1, 2]"), "TAG_M is a number"),
        ("#" * (MAX_FILE_BYTES + 1), "over 64 KiB"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "board.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        parse_board(str(file))
    assert str(file) in str(caught.value)
