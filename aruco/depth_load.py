"""Reading a depth store, and refusing what is none.

Owns      every check that stands between a file from anywhere and arrays in memory.
Leaves    the layout to depth_save, whether the numbers are depth to camera_depth.

Sizes are checked before anything is read, and only data inside the file are: HDF5 can name other files.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from aruco.camera_depth import CameraDepth, check_camera, check_name
from aruco.depth_image import Depth, check_depth, with_holes
from aruco.depth_pool import KeptFrame
from aruco.errors import InputError, RigError

FORMAT, VERSION, UNITS = "rigcal.depth", 1, "m"
MAX_SIDE_PX = 32768
MAX_PIXELS = 2**26
# Twenty 1080p cameras with five kept frames each take 1.3 GB in memory.
MAX_BYTES = 4 * 2**30
MAX_CHUNK_BYTES = 2**28
MAX_CAMERAS = 1000
MAX_KEPT = 1000
T = TypeVar("T")
_STAMP = re.compile(r"-?[0-9]{1,19}", re.ASCII)


def load_depth_data(path: Path, *, frames: bool = True, blind: bool = False) -> dict[str, CameraDepth]:
    """Camera -> what its depth saw, sorted by name.

    Args:
        path: A file that save_depth_data wrote.
        frames: Whether to read the kept single frames too, which are most of the file.
        blind: Whether to return cameras without any measurement too, rather than to refuse the file.

    Raises:
        InputError: The file cannot be read, is damaged, of another kind or version, or what it holds is no depth.
    """
    path = Path(path)
    return _readable(str(path), lambda: _opened(path, with_frames=frames, blind=blind))


def _opened(path: Path, *, with_frames: bool, blind: bool) -> dict[str, CameraDepth]:
    import h5py  # late: only this and writing a store need it

    with path.open("rb"):
        pass
    if not h5py.is_hdf5(path):
        raise InputError(f"{path}: is not an HDF5 file; give a depth store as --save-depth writes it.")
    with h5py.File(path, "r", locking=False) as file:
        return _read(file, path, with_frames=with_frames, blind=blind)


def _readable(where: str, read: Callable[[], T]) -> T:
    """What is read; whatever is wrong with the file says where: file, camera, dataset as far as that is known."""
    try:
        return read()
    except RigError:
        raise
    except OSError as error:
        if error.strerror:
            raise InputError(f"{where}: cannot be read ({error.strerror}); check the path.") from error
        raise _damaged(where, error) from error
    # What h5py raises on a damaged file depends on where the damage is.
    except (RuntimeError, KeyError, ValueError, TypeError, OverflowError, MemoryError) as error:
        raise _damaged(where, error) from error


def _damaged(where: str, error: Exception) -> InputError:
    reason = str(error).strip("'\"").splitlines()[0][:120] if str(error) else type(error).__name__
    return InputError(
        f"{where} is cut off or damaged ({reason}); copy the file again, or write it again with --save-depth."
    )


def _read(file: Any, path: Path, *, with_frames: bool, blind: bool) -> dict[str, CameraDepth]:
    kind, version, units = (_attribute(file, key) for key in ("format", "version", "units"))
    if kind != FORMAT:
        raise InputError(f"{path}: is HDF5, but not a depth store (format {kind!r}); give what --save-depth writes.")
    if version != VERSION or isinstance(version, bool):
        raise InputError(f"{path}: is a depth store of version {version}, and this program reads {VERSION}; update it.")
    if units != UNITS:
        raise InputError(f"{path}: holds depth in {units!r}, and it must be in {UNITS!r}; write it again.")
    cameras = _group(file, "cameras", str(path))
    if not 0 < len(cameras) <= MAX_CAMERAS:
        raise InputError(f"{path}: holds {len(cameras)} cameras; want 1 to {MAX_CAMERAS}: write it again.")
    groups = {name: _group(cameras, check_name(name, str(path)), str(path)) for name in sorted(cameras)}
    places = {name: f"{path}: camera {name}" for name in groups}
    n_bytes = sum(
        _readable(places[name], partial(_most_bytes, group, places[name], with_frames))
        for name, group in groups.items()
    )
    if n_bytes > MAX_BYTES:
        raise InputError(f"{path}: holds over {MAX_BYTES >> 30} GiB of depth; keep fewer frames or cameras in a store.")
    read = partial(_read_camera, with_frames=with_frames, blind=blind)
    return {name: _readable(places[name], partial(read, group, places[name])) for name, group in groups.items()}


def _most_bytes(group: Any, where: str, with_frames: bool) -> int:
    """What a camera takes in memory, by what it says of its size."""
    n_frames = len(_group(group, "frames", where)) if with_frames and "frames" in group else 0
    return 4 * math.prod(_size(group, where)) * (4 + n_frames)


def _size(group: Any, where: str) -> tuple[int, int]:
    """Height and width of a camera's depth."""
    height, width = _whole(group, "height", where), _whole(group, "width", where)
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX and width * height <= MAX_PIXELS):
        raise InputError(f"{where}: {width} x {height} is no size of a depth image; write the store again.")
    return height, width


def _read_camera(group: Any, where: str, *, with_frames: bool, blind: bool) -> CameraDepth:
    size = _size(group, where)
    optional: dict[str, Any] = {
        name: _array(group, name, size, where, kind)
        for name, kind in (("confidence", np.uint8), ("spread", np.float32), ("count", np.uint16))
        if name in group
    }
    try:
        camera = CameraDepth(
            depth=_depth(group, size, where, with_holes if blind else check_depth),
            K=_array(group, "intrinsics", (3, 3), where, np.float64),
            n_frames=_whole(group, "n_frames", where),
            baseline_m=_number(group, "baseline", where) if "baseline" in group.attrs else None,
            frames=_kept(group, size, where) if with_frames and "frames" in group else {},
            **optional,
        )
    except InputError as error:
        message = str(error)
        raise InputError(message if message.startswith(where) else f"{where}: {message}") from error
    check_camera(camera, where, may_be_blind=blind)
    return camera


def _kept(group: Any, size: tuple[int, int], where: str) -> Mapping[int, KeptFrame]:
    frames = _group(group, "frames", where)
    if len(frames) > MAX_KEPT or not all(_STAMP.fullmatch(name) for name in frames):
        raise InputError(f"{where}: frames must be at most {MAX_KEPT} groups named by stamps in ns; write it again.")
    if len({int(name) for name in frames}) < len(frames):
        raise InputError(f"{where}: frames hold the same stamp twice, written in two ways; write it again.")
    kept: dict[int, KeptFrame] = {}
    for name in sorted(frames, key=int):
        frame = _group(frames, name, where)
        score = _number(frame, "score", f"{where}, frame {name}")
        depth = _depth(frame, size, f"{where}, frame {name}", with_holes)
        kept[int(name)] = KeptFrame(depth=depth, score=score)
    return kept


def _attribute(group: Any, key: str) -> Any:
    """A plain value, or None."""
    value = group.attrs.get(key)
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value.item() if isinstance(value, np.generic) else value


def _whole(group: Any, key: str, where: str) -> int:
    value = _attribute(group, key)
    if not isinstance(value, int) or isinstance(value, bool):
        raise InputError(f"{where}: {key} must be a whole number, got {value!r}; write the store again.")
    return value


def _number(group: Any, key: str, where: str) -> float:
    value = _attribute(group, key)
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
        raise InputError(f"{where}: {key} must be a number, got {value!r}; write the store again.")
    return float(value)


def _own(group: Any, name: str, where: str) -> Any:
    """What a group holds itself; links can lead to other files."""
    import h5py

    if name not in group or not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise InputError(f"{where}: has no {name} of its own; write the store again.")
    return _readable(f"{where}: {name}", lambda: group[name])


def _group(group: Any, name: str, where: str) -> Any:
    import h5py

    found = _own(group, name, where)
    if not isinstance(found, h5py.Group):
        raise InputError(f"{where}: {name} is no group; write the store again.")
    return found


def _depth(group: Any, size: tuple[int, int], where: str, checked: Callable[[Any, str], Depth]) -> NDArray[np.float32]:
    """Depth with NaN for holes, whatever a file marks them with."""
    return np.asarray(checked(_array(group, "depth", size, where, np.float32), where), dtype=np.float32)


def _array(group: Any, name: str, shape: tuple[int, int], where: str, kind: type[np.number[Any]]) -> NDArray[Any]:
    """The numbers of a dataset that has the size wanted; whole numbers must have the type wanted, or they wrap."""
    import h5py

    found = _own(group, name, where)
    if not isinstance(found, h5py.Dataset) or not _fits(found.dtype, np.dtype(kind)):
        raise InputError(f"{where}: {name} does not hold {np.dtype(kind)}; write the store again.")
    if found.shape != shape:
        raise InputError(f"{where}: {name} has shape {found.shape}, not {shape}; write the store again.")
    chunk_bytes = math.prod(found.chunks or shape) * found.dtype.itemsize
    if found.external or found.is_virtual or chunk_bytes > MAX_CHUNK_BYTES:
        raise InputError(f"{where}: {name} is kept in a way that no depth store is; write the store again.")
    with np.errstate(over="ignore"):  # beyond single precision nothing is a depth; infinite is a hole
        return np.asarray(_readable(f"{where}: {name}", lambda: found[()])).astype(kind, copy=False)


def _fits(given: np.dtype[Any], wanted: np.dtype[Any]) -> bool:
    if wanted.kind == "u":
        return given.kind == "u" and given.itemsize == wanted.itemsize  # in either order of bytes
    return given.kind in "fiu"
