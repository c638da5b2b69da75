"""A depth store gives back what was put in, appears whole or not at all, and is refused where it is none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from aruco.depth_pool import KeptFrame, pool_depth
from aruco.depth_save import CameraDepth, camera_depth, load_depth_data, save_depth_data
from aruco.errors import InputError, OutputError

SIZE = (30, 40)
K = np.array([[35.0, 0.0, 19.5], [0.0, 35.0, 14.5], [0.0, 0.0, 1.0]])


def _depth(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = (3.0 + 0.01 * rng.standard_normal(SIZE)).astype(np.float32)
    depth[rng.random(SIZE) < 0.02] = np.nan
    return depth


def _camera(seed: int = 0) -> CameraDepth:
    confidence = np.full(SIZE, 7, dtype=np.uint8)
    pooled = pool_depth([(10**18 + k, _depth(seed + k), confidence) for k in range(7)])
    return camera_depth(pooled, K=K, baseline_m=0.12)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A sound store of two cameras."""
    path = tmp_path / "depth.h5"
    save_depth_data(path, {"left": _camera(0), "41182735": _camera(50)})
    return path


def _same(a: CameraDepth, b: CameraDepth) -> None:
    for name in ("depth", "K", "confidence", "spread", "count", "n_frames", "baseline_m"):
        x, y = getattr(a, name), getattr(b, name)
        np.testing.assert_array_equal(x, y, err_msg=name)
        assert x is None or np.asarray(x).dtype == np.asarray(y).dtype
    assert list(a.frames) == list(b.frames)
    for stamp, frame in a.frames.items():
        np.testing.assert_array_equal(frame.depth, b.frames[stamp].depth)
        assert frame.score == b.frames[stamp].score


def test_what_is_saved_is_loaded(store: Path) -> None:
    loaded = load_depth_data(store)
    assert list(loaded) == ["41182735", "left"]
    _same(loaded["left"], _camera(0))
    _same(loaded["41182735"], _camera(50))
    assert len(loaded["left"].frames) == 5
    assert loaded["left"].focal_baseline == pytest.approx(35 * 0.12)
    assert not load_depth_data(store, frames=False)["left"].frames


def test_what_is_optional_can_be_absent(tmp_path: Path) -> None:
    plain = CameraDepth(depth=_depth(), K=K)
    save_depth_data(tmp_path / "x.h5", {"a": plain})
    _same(load_depth_data(tmp_path / "x.h5")["a"], plain)
    data = plain.as_camera_data()
    assert set(data) == {"depth", "K", "confidence", "spread", "count", "baseline", "n_frames"}
    assert data["depth"] is plain.depth


def test_the_layout_is_that_of_the_conventions(store: Path) -> None:
    with h5py.File(store) as file:
        assert dict(file.attrs) == {"format": "rigcal.depth", "version": 1, "units": "m"}
        group: Any = file["cameras/left"]
        assert (group.attrs["width"], group.attrs["height"], group.attrs["n_frames"]) == (40, 30, 7)
        assert group.attrs["baseline"] == 0.12
        types = {name: group[name].dtype.str for name in group if name != "frames"}
        assert types == {"intrinsics": "<f8", "depth": "<f4", "confidence": "|u1", "spread": "<f4", "count": "<u2"}
        for stamp, frame in group["frames"].items():
            assert int(stamp) >= 10**18
            assert 0.9 < frame.attrs["score"] <= 1.0
            assert frame["depth"].dtype == np.float32


def test_same_input_same_bytes(store: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.h5"
    save_depth_data(again, {"41182735": _camera(50), "left": _camera(0)})
    assert again.read_bytes() == store.read_bytes()


def test_a_store_is_smaller_than_its_numbers(tmp_path: Path) -> None:
    rows = np.linspace(1.5, 4.0, 720, dtype=np.float32)[:, None]
    rng = np.random.default_rng(0)
    frames = [
        (k, (rows + 0.01 * rng.standard_normal((720, 1280), dtype=np.float32)).astype(np.float32), None)
        for k in range(2)
    ]
    pooled = camera_depth(pool_depth(frames, n_kept=0), K=np.array([[700.0, 0, 640], [0, 700, 360], [0, 0, 1]]))
    save_depth_data(tmp_path / "x.h5", {"a": pooled})
    # Depth, spread and count are 10 bytes a pixel; white noise of 10 mm, rounded to an eighth of one, is 1.3 bytes.
    assert (tmp_path / "x.h5").stat().st_size < 0.55 * 10 * 720 * 1280


def test_a_failure_leaves_what_was_there(store: Path) -> None:
    before = store.read_bytes()
    bad = replace(_camera(), depth=np.full(SIZE, 2000.0, dtype=np.float32))
    with pytest.raises(InputError, match=r"camera b: .*millimetres"):
        save_depth_data(store, {"a": _camera(), "b": bad})
    assert store.read_bytes() == before
    assert [p.name for p in store.parent.iterdir()] == ["depth.h5"]


def test_places_that_cannot_be_written_are_told(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="does not exist"):
        save_depth_data(tmp_path / "no" / "x.h5", {"a": _camera()})
    with pytest.raises(OutputError, match="folder"):
        save_depth_data(tmp_path, {"a": _camera()})
    with pytest.raises(InputError, match="nothing to keep"):
        save_depth_data(tmp_path / "x.h5", {})


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "a/b", "a\\b", "_meta", "a\nb", "a\0b", "x" * 300])
def test_names_that_lead_elsewhere_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"camera's name: [^:]*; rename the camera") as caught:
        save_depth_data(tmp_path / "x.h5", {name: _camera()})
    assert ("cannot be printed" in str(caught.value)) == (name == "a\nb")
    assert ("start with _" in str(caught.value)) == (name == "_meta")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"depth": np.ones((2, 3, 4))}, "an image"),
        ({"spread": np.ones((3, 4), dtype=np.float32)}, "spread of shape"),
        ({"frames": {1: KeptFrame(depth=np.ones((3, 4), dtype=np.float32), score=1.0)}}, "frame 1 of shape"),
        ({"K": np.eye(4)}, r"\(3, 3\)"),
        ({"K": np.full((3, 3), np.nan)}, "NaN"),
        ({"K": -K}, "no camera matrix"),
        ({"n_frames": 0}, "n_frames"),
        ({"n_frames": 10**15}, "n_frames"),
        ({"confidence": np.full(SIZE, 300)}, "confidence must hold whole numbers from 0 to 100"),
        ({"confidence": np.full(SIZE, 101, dtype=np.uint8)}, "from 0 to 100"),
        ({"confidence": np.full(SIZE, 0.5)}, "from 0 to 100"),
        ({"count": np.full(SIZE, -1)}, "count must hold whole numbers from 0 to 65535"),
        ({"count": np.full(SIZE, 2**16)}, "from 0 to 65535"),
        ({"baseline_m": -0.1}, "baseline"),
        ({"baseline_m": np.nan}, "baseline"),
    ],
)
def test_what_does_not_fit_together_is_refused_at_birth(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        replace(CameraDepth(depth=_depth(), K=K), **changes)


@pytest.mark.parametrize("factor", [0.5, 1.5, 2.0])
def test_intrinsics_of_another_resolution_are_refused(factor: float, tmp_path: Path) -> None:
    scaled = K * [[factor], [factor], [1.0]]
    with pytest.raises(InputError, match=r"camera a: .*do not fit depth of 40 x 30"):
        save_depth_data(tmp_path / "x.h5", {"a": CameraDepth(depth=_depth(), K=scaled)})


@pytest.mark.parametrize(
    "wild",
    [
        np.array([[1e300, 0, 19.5], [0, 35, 14.5], [0, 0, 1]]),
        np.array([[35, 0, 19.5], [0, 1e-300, 14.5], [0, 0, 1]]),
        np.array([[35, 1e4, 19.5], [0, 35, 14.5], [0, 0, 1]]),
    ],
)
def test_focal_lengths_of_no_camera_are_refused(wild: np.ndarray, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"camera a: intrinsics with focal lengths .* no camera of 40 x 30 pixels"):
        save_depth_data(tmp_path / "x.h5", {"a": CameraDepth(depth=_depth(), K=wild)})


def _with_frames(frames: dict[int, KeptFrame]) -> CameraDepth:
    return CameraDepth(depth=_depth(), K=K, frames=frames)


def test_stamps_before_the_beginning_of_time_are_kept(tmp_path: Path) -> None:
    frames = {stamp: KeptFrame(depth=_depth(), score=0.5) for stamp in (-(2**63), -5, 0, 5, 2**63 - 1)}
    save_depth_data(tmp_path / "x.h5", {"a": _with_frames(frames)})
    _same(load_depth_data(tmp_path / "x.h5")["a"], _with_frames(frames))


@pytest.mark.parametrize(
    ("stamp", "score", "says"),
    [
        (5, np.nan, "score must be from 0 to 1, got nan"),
        (5, np.inf, "score"),
        (5, -0.1, "score"),
        (5, 1.5, "score"),
        (2**63, 1.0, "no stamp in ns"),
        (-(10**20), 1.0, "no stamp in ns"),
    ],
)
def test_what_could_not_be_read_again_is_not_written(stamp: int, score: float, says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"camera a, frame {stamp}: .*{says}"):
        save_depth_data(tmp_path / "x.h5", {"a": _with_frames({stamp: KeptFrame(depth=_depth(), score=score)})})
    assert not list(tmp_path.iterdir())


def test_holes_are_nan_whatever_the_file_marks_them_with(store: Path) -> None:
    holes = _depth().astype(np.float64)
    holes[0, :4] = [0.0, np.inf, 1e300, np.nan]
    with h5py.File(store, "r+") as file:
        del file["cameras/left/depth"]
        file.create_dataset("cameras/left/depth", data=holes)
    read = load_depth_data(store)["left"].depth
    assert read.dtype == np.float32
    assert np.isnan(read[0, :4]).all()
    assert np.isfinite(read).any()


def _set(path: str, key: str, value: Any) -> Callable[[Any], None]:
    return lambda file: file[path].attrs.__setitem__(key, value)


def _put(path: str, **how: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        if path in file:
            del file[path]
        file.create_dataset(path, **how)

    return change


def _link(path: str, link: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[path]
        file[path] = link

    return change


LEFT = "cameras/left"


def _twice(stamp: int, otherwise: str) -> Callable[[Any], None]:
    """One stamp, written in two ways."""

    def change(file: Any) -> None:
        for name in (str(stamp), otherwise):
            frame = file.create_group(f"{LEFT}/frames/{name}")
            frame.attrs["score"] = 1.0
            frame["depth"] = _depth()

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_set("/", "version", 2), "version 2"),
        (_set("/", "version", "1"), "version 1"),
        (_set("/", "format", "other"), "not a depth store"),
        (_set("/", "units", "mm"), "'mm'"),
        (lambda file: file.attrs.__delitem__("format"), "not a depth store"),
        (lambda file: file.__delitem__("cameras"), "cameras"),
        (lambda file: [file["cameras"].__delitem__(name) for name in list(file["cameras"])], "0 cameras"),
        (lambda file: file.create_group("cameras/.."), "camera's name"),
        (lambda file: file.create_group("cameras/_meta"), "camera's name"),
        (_put("cameras/right", data=1), "right is no group"),
        (_set(LEFT, "width", 41), "shape"),
        (_set(LEFT, "width", 40.0), "width must be a whole number"),
        (lambda file: file[LEFT].attrs.__delitem__("height"), "height"),
        (_set(LEFT, "height", 10**9), "no size of a depth image"),
        (_set(LEFT, "n_frames", 0), "n_frames"),
        (_set(LEFT, "baseline", -1.0), "baseline"),
        (_set(LEFT, "baseline", "wide"), "left: baseline must be a number"),
        (lambda file: file[LEFT].__delitem__("depth"), "no depth"),
        (lambda file: file[LEFT].__delitem__("intrinsics"), "no intrinsics"),
        (_put(f"{LEFT}/intrinsics", data=np.full((3, 3), np.nan)), "NaN"),
        (_put(f"{LEFT}/intrinsics", data=np.zeros((3, 3))), "no camera matrix"),
        (_put(f"{LEFT}/intrinsics", data=K[:2]), "shape"),
        (_put(f"{LEFT}/intrinsics", data=K * [[3], [3], [1]]), "do not fit"),
        (_put(f"{LEFT}/depth", data=np.zeros(SIZE, dtype="f4")), "zero everywhere"),
        (_put(f"{LEFT}/depth", data=np.full(SIZE, np.nan, dtype="f4")), "NaN everywhere"),
        (_put(f"{LEFT}/depth", data=np.full(SIZE, np.inf, dtype="f4")), "infinite everywhere"),
        (_put(f"{LEFT}/depth", data=np.full(SIZE, -1, dtype="f4")), "negative"),
        (_put(f"{LEFT}/depth", data=np.full(SIZE, 2000, dtype="u2")), "millimetres"),
        (_put(f"{LEFT}/depth", data=np.full(SIZE, b"abc")), "does not hold"),
        (_put(f"{LEFT}/depth", shape=(2**20, 2**20), dtype="f4", chunks=(64, 64)), "shape"),
        (_put(f"{LEFT}/depth", shape=SIZE, dtype="f4", external=[("/etc/hostname", 0, 4800)]), "kept in a way"),
        (_put(f"{LEFT}/confidence", data=np.full(SIZE, np.nan)), "confidence does not hold uint8"),
        (_put(f"{LEFT}/confidence", data=np.full(SIZE, 300)), "confidence does not hold uint8"),
        (_put(f"{LEFT}/confidence", data=np.full(SIZE, 101, dtype="u1")), "left: confidence must hold .* 0 to 100"),
        (_put(f"{LEFT}/count", data=np.full(SIZE, -1)), "count does not hold uint16"),
        (_set(LEFT, "n_frames", 10**15), "left: n_frames"),
        (_put(f"{LEFT}/depth", data=np.full(SIZE, 1e300)), "infinite everywhere"),
        (_put(f"{LEFT}/intrinsics", data=K * [[1e298], [1], [1]]), "focal lengths"),
        (_twice(17, "017"), "same stamp twice"),
        (_twice(0, "-0"), "same stamp twice"),
        (lambda file: file.create_group(f"{LEFT}/frames/--5"), "stamps"),
        (lambda file: file.create_group(f"{LEFT}/frames/+5"), "stamps"),
        (_put(f"{LEFT}/spread", data=np.zeros((3, 3), dtype="f4")), "spread has shape"),
        (_link(f"{LEFT}/depth", h5py.ExternalLink("other.h5", "/x")), "of its own"),
        (_link(f"{LEFT}/depth", h5py.SoftLink("/cameras/41182735/depth")), "of its own"),
        (_link(LEFT, h5py.SoftLink("/cameras/41182735")), "of its own"),
        (lambda file: file.create_group(f"{LEFT}/frames/yesterday"), "stamps"),
        (lambda file: file.create_group(f"{LEFT}/frames/17"), "frame 17"),
    ],
)
def test_stores_that_are_none_are_refused_in_one_sentence(
    store: Path, change: Callable[[Any], None], says: str
) -> None:
    with h5py.File(store, "r+") as file:
        change(file)
    with pytest.raises(InputError, match=says) as caught:
        load_depth_data(store)
    message = str(caught.value)
    assert message.startswith(str(store))
    assert "\n" not in message


def test_sizes_are_looked_at_before_anything_is_read(store: Path) -> None:
    with h5py.File(store, "r+") as file:
        group: Any = file[LEFT]
        for name in list(group):
            if name != "intrinsics":
                del group[name]
        group.attrs.update({"width": 8192, "height": 8192})
        # A quarter of a gigabyte each, and a few kilobytes on disk.
        group.create_dataset("depth", (8192, 8192), "f4", chunks=(8192, 64), compression="gzip", fillvalue=1.0)
        for stamp in range(20):
            frame = group.create_group(f"frames/{stamp}")
            frame.attrs["score"] = 1.0
            frame["depth"] = group["depth"]
    with pytest.raises(InputError, match="over 4 GiB"):
        load_depth_data(store)


@pytest.mark.parametrize("part", [0.0, 0.001, 0.2, 0.5, 0.9, 0.999])
def test_a_store_that_is_cut_off_is_refused(store: Path, part: float) -> None:
    whole = store.read_bytes()
    store.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(InputError, match=r"not an HDF5 file|cut off or damaged") as caught:
        load_depth_data(store)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("place", ["depth", "confidence", "frames"])
def test_a_damaged_chunk_is_told_by_camera_and_dataset(store: Path, place: str) -> None:
    with h5py.File(store, "r") as file:
        frames = file["cameras/left/frames"]
        assert isinstance(frames, h5py.Group)
        place = place if not place.startswith("frames") else f"frames/{next(iter(frames))}/depth"
        dataset = file[f"cameras/left/{place}"]
        assert isinstance(dataset, h5py.Dataset)
        chunk = dataset.id.get_chunk_info(0)
    data = bytearray(store.read_bytes())
    middle = chunk.byte_offset + chunk.size // 2
    data[middle : middle + 8] = bytes(255 - byte for byte in data[middle : middle + 8])
    store.write_bytes(data)
    with pytest.raises(InputError) as caught:
        load_depth_data(store)
    names = place.split("/")
    where = "camera left" if len(names) == 1 else f"camera left, frame {names[1]}"
    assert str(caught.value).startswith(f"{store}: {where}: {names[-1]} is cut off or damaged (")
    assert str(caught.value).endswith("; copy the file again, or write it again with --save-depth.")
    # Where nothing asks for the single frames, they do no harm.
    if len(names) > 1:
        assert list(load_depth_data(store, frames=False)) == ["41182735", "left"]


def _is_refused(path: Path) -> bool:
    try:
        load_depth_data(path)
    except InputError as error:
        return "\n" not in str(error)
    return False


def test_damage_is_found(store: Path) -> None:
    whole = store.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(40):
        damaged = bytearray(whole)
        for place in rng.integers(0, len(whole), 20):
            damaged[place] ^= int(rng.integers(1, 256))
        store.write_bytes(damaged)
        refused += _is_refused(store)
    # Compressed images carry checksums and are nearly all of the file; anything but an InputError fails the test.
    assert refused >= 38


def test_other_files_are_no_stores(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be read \(No such file"):
        load_depth_data(tmp_path / "no.h5")
    with pytest.raises(InputError, match="cannot be read"):
        load_depth_data(tmp_path)
    (tmp_path / "x.json").write_text("{}")
    with pytest.raises(InputError, match="not an HDF5 file"):
        load_depth_data(tmp_path / "x.json")
