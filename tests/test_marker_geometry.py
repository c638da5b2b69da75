"""Marker maps: what is read is what was written, the shipped boxes are as described, wrong maps are refused."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aruco import box_target
from aruco.errors import InputError, OutputError
from aruco.marker_geometry import (
    MAX_CORNER_MISMATCH,
    SHIPPED_MAPS,
    Face,
    load_face_mapping,
    load_faces,
    load_marker_geometry,
    save_faces,
)
from aruco.pose_math import Array, exp_se3, transform_points

STANDARD_BOX = SHIPPED_MAPS / "standard_box_markers.parquet"
OBJECT_POINTS = SHIPPED_MAPS / "object_points.parquet"
REAL_CUBE = Path(__file__).parents[2] / "shared/data/cube3_b/markers.parquet"
SQUARE = np.array([[-0.1, 0.1, 0.0], [0.1, 0.1, 0.0], [0.1, -0.1, 0.0], [-0.1, -0.1, 0.0]])


def write_rows(path: Path, rows: list[dict[str, Any]]) -> Path:
    pq.write_table(pa.Table.from_pylist(rows), path)
    return path


def one_marker(path: Path, quad: Array) -> Path:
    return write_rows(path, [{"name": "f", "ids": [7], "corners": [quad.tolist()]}])


def into_print(quad: Array) -> Array:
    normal = np.cross(quad[1] - quad[0], quad[3] - quad[0])
    return normal / np.linalg.norm(normal)


# The shipped maps


@pytest.mark.parametrize(
    ("path", "made"), [(STANDARD_BOX, box_target.standard_box), (OBJECT_POINTS, box_target.object_points)]
)
def test_shipped_maps_are_what_box_target_makes(path: Path, made: Callable[[], list[Face]]) -> None:
    for stored, fresh in zip(load_faces(path), made(), strict=True):
        assert (stored.name, stored.ids) == (fresh.name, fresh.ids)
        np.testing.assert_array_equal(stored.corners, fresh.corners)


def test_writing_the_shipped_maps_gives_the_shipped_maps(tmp_path: Path) -> None:
    for path in box_target.write_shipped_maps(tmp_path):
        fresh, shipped = load_marker_geometry(path), load_marker_geometry(SHIPPED_MAPS / path.name)
        assert fresh.keys() == shipped.keys()
        assert all(np.array_equal(fresh[marker], shipped[marker]) for marker in fresh)


def test_standard_box_sides_and_ids() -> None:
    into = {"bottom": "+y", "back": "+z", "top": "-y", "front": "-z", "left": "+x", "right": "-x"}
    ids = {"bottom": [21], "back": [22], "top": [23], "front": [24], "left": [25], "right": [26]}
    assert load_face_mapping(STANDARD_BOX) == ids
    for face in load_faces(STANDARD_BOX):
        sign, axis = into[face.name]
        expected = np.eye(3)["xyz".index(axis)] * (1 if sign == "+" else -1)
        (quad,) = face.corners
        np.testing.assert_allclose(into_print(quad), expected, atol=1e-15)  # exact but for one rounding
        np.testing.assert_allclose(quad.mean(axis=0), -0.3 * expected, atol=1e-15)
        np.testing.assert_allclose(np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1), 0.45, atol=1e-15)


def test_standard_box_side_prints_stand_upright() -> None:
    for face in load_faces(STANDARD_BOX):
        if face.name in ("front", "back", "left", "right"):
            np.testing.assert_array_equal(np.sign(face.corners[0, :, 1]), [1, 1, -1, -1])


def test_object_points_sides_and_ids() -> None:
    assert load_face_mapping(OBJECT_POINTS) == {
        "a": [16, 17, 18, 19],
        "b": [20, 21, 22, 23],
        "c": [24, 25, 26, 27],
    }
    for face, axis in zip(load_faces(OBJECT_POINTS), (2, 1, 0), strict=True):
        np.testing.assert_allclose([into_print(q) for q in face.corners], [np.eye(3)[axis]] * 4, atol=1e-15)
        np.testing.assert_allclose(face.corners[..., axis], -0.3, atol=1e-15)
        in_plane = np.delete(face.corners.mean(axis=1), axis, axis=1)
        assert {tuple(np.round(c, 12)) for c in in_plane} == set(itertools.product((-0.15, 0.15), repeat=2))
        sides = np.linalg.norm(np.roll(face.corners, -1, axis=1) - face.corners, axis=2)
        np.testing.assert_allclose(sides, 0.24, atol=1e-15)


def test_object_points_ids_run_row_by_row_on_the_print() -> None:
    for face in load_faces(OBJECT_POINTS):
        first = face.corners[0]
        right, down = (first[1] - first[0]) / 0.24, (first[3] - first[0]) / 0.24
        steps = face.corners.mean(axis=1) - first.mean(axis=0)
        on_print = np.stack([steps @ right, steps @ down], axis=1)
        np.testing.assert_allclose(on_print, [(0, 0), (0.3, 0), (0, 0.3), (0.3, 0.3)], atol=1e-14)


@pytest.mark.parametrize("path", [STANDARD_BOX, OBJECT_POINTS])
def test_printed_sides_face_outward(path: Path) -> None:
    for quad in load_marker_geometry(path).values():
        assert into_print(quad) @ quad.mean(axis=0) < -0.29  # the sides are 0.3 m from the centre
        # Mirrored corners, a common mistake, would fail the line above.
        assert into_print(quad[[1, 0, 3, 2]]) @ quad.mean(axis=0) > 0.29


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: box_target.box_faces(0.6, 0.45, {"lid": 1}), "lid"),
        (lambda: box_target.box_faces(0.6, 0.61, {"top": 1}), "do not fit"),
        (lambda: box_target.box_faces(0.6, float("nan"), {"top": 1}), "do not fit"),
        (lambda: box_target.corner_faces(0.6, 0.31, 0.3, {"a": (1, 2, 3, 4)}), "overlap"),
        (lambda: box_target.corner_faces(0.6, 0.2, 0.3, {"a": (1, 2, 3)}), "square grid"),
    ],
)
def test_impossible_boxes_are_refused(call: Callable[[], object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        call()


# Reading and writing


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    side_m=st.floats(0.002, 5.0),
    ids=st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=5, unique=True),
    turned=st.booleans(),
)
def test_maps_round_trip_exactly(
    tmp_path_factory: pytest.TempPathFactory, seed: int, side_m: float, ids: list[int], turned: bool
) -> None:
    rng = np.random.default_rng(seed)
    square = SQUARE[[0, 3, 2, 1]] if turned else SQUARE  # clockwise and counter-clockwise maps both exist
    corners = np.stack([transform_points(exp_se3(rng.normal(size=6)), square * 5 * side_m) for _ in ids])
    path = tmp_path_factory.mktemp("map") / "map.parquet"
    save_faces(path, [Face(name="Fläche 1", ids=tuple(ids), corners=corners)])
    (face,) = load_faces(path)
    assert (face.name, face.ids) == ("Fläche 1", tuple(ids))
    np.testing.assert_array_equal(face.corners, corners)
    assert [p.name for p in path.parent.iterdir()] == ["map.parquet"]


def test_geometry_is_one_read_only_array_a_marker() -> None:
    geometry = load_marker_geometry(OBJECT_POINTS)
    assert sorted(geometry) == list(range(16, 28))
    assert all(quad.shape == (4, 3) and quad.dtype == np.float64 for quad in geometry.values())
    with pytest.raises(ValueError, match="read-only"):
        geometry[16][0, 0] = 1.0


def test_a_face_without_markers_among_others_is_kept(tmp_path: Path) -> None:
    rows = [{"name": "f", "ids": [7], "corners": [SQUARE.tolist()]}, {"name": "bare", "ids": [], "corners": []}]
    assert load_face_mapping(write_rows(tmp_path / "map.parquet", rows)) == {"f": [7], "bare": []}


def test_further_columns_and_other_number_types_are_read(tmp_path: Path) -> None:
    table = pa.table(
        {
            "note": ["made by hand"],
            "corners": pa.array([[SQUARE.astype(np.float32).tolist()]], pa.list_(pa.list_(pa.list_(pa.float32())))),
            "ids": pa.array([[7]], pa.list_(pa.int32())),
            "name": pa.array(["f"], pa.large_string()),
        }
    )
    pq.write_table(table, tmp_path / "map.parquet")
    np.testing.assert_allclose(load_marker_geometry(tmp_path / "map.parquet")[7], SQUARE, atol=1e-8)  # float32


def test_folder_names_with_an_equals_sign_do_not_become_columns(tmp_path: Path) -> None:
    folder = tmp_path / "name=wrong"
    folder.mkdir()
    path = one_marker(folder / "_map.parquet", SQUARE)
    assert load_face_mapping(path) == {"f": [7]}


def test_real_cube_is_accepted() -> None:
    if not REAL_CUBE.exists():
        pytest.skip("no real data here")
    assert sorted(load_marker_geometry(REAL_CUBE)) == [0, 1, 2, 3, 4]


# Refusals: the message names file, row and marker


def folded(lift_m: float) -> Array:
    quad = SQUARE.copy()
    quad[2, 2] += lift_m
    return quad


BAD_QUADS = {
    "NaN": np.where(np.eye(4, 3) == 1, np.nan, SQUARE),
    "infinite": np.where(np.eye(4, 3) == 1, np.inf, SQUARE),
    "millimetres": SQUARE * 1000 + [500, 0, 0],
    "collapsed": SQUARE * 1e-4,
    "collapsed: ": np.zeros((4, 3)),
    "not square": SQUARE * [1.2, 1.0, 1.0],
    "not square: ": SQUARE[[0, 2, 1, 3]],  # a bow tie
    "not square:  ": SQUARE[[0, 1, 0, 1]] * 1.0,  # there and back along one edge
    "degrees off": SQUARE @ np.array([[1.0, 0, 0], [0.3, 0.95, 0], [0, 0, 1.0]]),
    "degrees off ": folded(0.05),
}


@pytest.mark.parametrize(("words", "quad"), BAD_QUADS.items())
def test_what_is_no_square_is_refused(tmp_path: Path, words: str, quad: Array) -> None:
    path = one_marker(tmp_path / "map.parquet", quad)
    with pytest.raises(InputError, match=words.strip()) as error:
        load_marker_geometry(path)
    assert str(path) in str(error.value)
    assert "row 0 (face f)" in str(error.value)
    assert "marker 7" in str(error.value)


def test_a_print_a_little_off_square_is_accepted(tmp_path: Path) -> None:
    # Half the documented limit: what a printer and a ruler do.
    path = one_marker(tmp_path / "map.parquet", SQUARE * [1.0 + MAX_CORNER_MISMATCH / 2, 1.0, 1.0])
    assert 7 in load_marker_geometry(path)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-9, 1e-3, 1.0, 200.0]))
def test_random_corners_are_refused_without_warnings(
    tmp_path_factory: pytest.TempPathFactory, seed: int, scale: float
) -> None:
    quad: Array = np.random.default_rng(seed).integers(-2, 3, (4, 3)) * np.float64(scale)
    path = one_marker(tmp_path_factory.mktemp("map") / "map.parquet", quad)
    try:
        load_marker_geometry(path)
    except InputError:
        return
    lengths = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
    assert lengths.max() <= 1.05 * lengths.min()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": None}, "no name"),
        ({"name": ""}, "no name"),
        ({"ids": None}, "whole numbers"),
        ({"ids": [-1]}, "whole numbers"),
        ({"ids": [1.5]}, "whole numbers"),
        ({"ids": [True]}, "whole numbers"),
        ({"ids": [7, 8]}, r"\(2, 4, 3\), got \(1, 4, 3\)"),
        ({"corners": [SQUARE[:3].tolist()]}, r"got \(1, 3, 3\)"),
        ({"corners": [SQUARE[:, :2].tolist()]}, r"got \(1, 4, 2\)"),
        ({"corners": [[[0.0], [0.0, 1.0]]]}, "ragged"),
        ({"corners": None}, "ragged"),
        ({"corners": "text"}, "ragged"),
        ({"ids": [], "corners": []}, "no markers"),
    ],
)
def test_rows_that_are_no_face_are_refused(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    row = {"name": "f", "ids": [7], "corners": [SQUARE.tolist()]}
    path = write_rows(tmp_path / "map.parquet", [{**row, **changes}])
    with pytest.raises(InputError, match=words) as error:
        load_faces(path)
    assert str(path) in str(error.value)


def test_repeated_ids_and_names_are_refused(tmp_path: Path) -> None:
    row = {"name": "f", "ids": [7], "corners": [SQUARE.tolist()]}
    path = tmp_path / "map.parquet"
    with pytest.raises(InputError, match=r"row 1 \(face g\): marker 7 is listed twice, first on face f"):
        load_faces(write_rows(path, [row, {**row, "name": "g"}]))
    with pytest.raises(InputError, match=r"row 0 \(face f\): marker 7 is listed twice"):
        load_faces(write_rows(path, [{**row, "ids": [7, 7], "corners": [SQUARE.tolist()] * 2}]))
    with pytest.raises(InputError, match="row 1: a second face is called f"):
        load_faces(write_rows(path, [row, {**row, "ids": [8]}]))


def test_a_missing_column_is_named(tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    pq.write_table(pa.table({"name": ["f"], "marker": [1]}), path)
    with pytest.raises(InputError, match="lacks the columns ids, corners; it has name, marker"):
        load_faces(path)


def test_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    pq.write_table(pa.table([["f"], ["g"], [[7]], [[SQUARE.tolist()]]], ["name", "name", "ids", "corners"]), path)
    with pytest.raises(InputError, match="two columns of one name"):
        load_faces(path)


def test_a_small_file_that_unpacks_to_millions_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    zeros = pa.array(np.zeros(20_000_000, dtype=np.int8))
    pq.write_table(pa.table({"name": zeros, "ids": zeros, "corners": zeros}), path)
    assert path.stat().st_size < 1e6  # it looks harmless
    with pytest.raises(InputError, match="not a marker map"):
        load_faces(path)


@pytest.mark.parametrize("content", [b"", b"PAR1", b"name,ids,corners\n", b"PAR1" + 100 * b"\0" + b"PAR1"])
def test_files_that_are_no_parquet_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "map.parquet"
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a readable parquet file"):
        load_faces(path)


def test_a_damaged_file_never_gives_anything_but_our_error(tmp_path: Path) -> None:
    good = STANDARD_BOX.read_bytes()
    rng = np.random.default_rng(3)
    path = tmp_path / "map.parquet"
    for _ in range(200):
        damaged = bytearray(good)
        for at in rng.integers(len(good), size=3):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(good) // 2, len(good) + 1)])
        with contextlib.suppress(InputError):
            load_faces(path)


def test_a_missing_map_names_the_shipped_ones(tmp_path: Path) -> None:
    for path in (tmp_path / "none.parquet", tmp_path):
        with pytest.raises(InputError, match="no such marker map") as error:
            load_faces(path)
        assert str(STANDARD_BOX) in str(error.value)


@pytest.mark.parametrize("place", ["missing/map.parquet", "file/map.parquet", "folder"])
def test_a_place_that_cannot_be_written_is_named_and_left_clean(tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "folder").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(OutputError, match=place):
        save_faces(tmp_path / place, box_target.standard_box())
    assert sorted(tmp_path.rglob("*")) == before
