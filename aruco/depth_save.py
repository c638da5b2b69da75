"""The depth store: what every camera saw of the resting scene, in one HDF5 file.

Owns      the layout that docs/conventions.md describes, writing it whole.
Leaves    reading it to depth_load, what goes into it to camera_depth and depth_pool.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.atomic import write_whole
from aruco.camera_depth import CameraDepth, camera_depth, check_camera, check_name
from aruco.depth_image import with_holes
from aruco.depth_load import FORMAT, UNITS, VERSION, load_depth_data
from aruco.errors import InputError

__all__ = ["CameraDepth", "camera_depth", "load_depth_data", "save_depth_data"]

# Measured on noisy 720p depth of float32: shuffled bytes with gzip 1 take a quarter less than lzf, for 10 ms more an
# image; gzip 4 gains 5 percent for twice the time; without shuffling all take half as much again.
_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
_CHUNK_ROWS = 64


def save_depth_data(path: Path, cameras: Mapping[str, CameraDepth]) -> None:
    """Write a store whole or not at all; the same content gives the same bytes.

    Args:
        path: Where; an existing file is replaced.
        cameras: By name. The packed file is held in memory: about 10 MB a 720p camera with five kept frames.

    Raises:
        InputError: No camera, a name that cannot be one, depth that is none, or anything that could not be read again.
        OutputError: The file cannot be written.
    """
    import h5py  # late: only this and reading a store need it

    path = Path(path)
    if not cameras:
        raise InputError(f"{path}: no camera has depth, so there is nothing to keep.")
    for name, camera in cameras.items():
        check_camera(camera, f"camera {check_name(name, str(path))}")
    packed = io.BytesIO()
    with h5py.File(packed, "w") as file:
        file.attrs.update({"format": FORMAT, "version": VERSION, "units": UNITS})
        for name in sorted(cameras):
            _write_camera(file.create_group(f"cameras/{name}"), cameras[name], f"camera {name}")
    write_whole(path, packed.getvalue())


def _write_camera(group: Any, camera: CameraDepth, where: str) -> None:
    height, width = camera.depth.shape
    group.attrs.update({"width": width, "height": height, "n_frames": camera.n_frames})
    if camera.baseline_m is not None:
        group.attrs["baseline"] = float(camera.baseline_m)
    group.create_dataset("intrinsics", data=camera.K, track_times=False)
    _write_image(group, "depth", with_holes(camera.depth, where).astype(np.float32))
    if camera.confidence is not None:
        _write_image(group, "confidence", camera.confidence)
    if camera.spread is not None:
        _write_image(group, "spread", np.asarray(camera.spread, dtype=np.float32))
    if camera.count is not None:
        _write_image(group, "count", camera.count)
    for stamp in sorted(camera.frames):
        frame = group.create_group(f"frames/{stamp}")
        frame.attrs["score"] = float(camera.frames[stamp].score)
        _write_image(frame, "depth", with_holes(camera.frames[stamp].depth, where).astype(np.float32))


def _write_image(group: Any, name: str, image: NDArray[Any]) -> None:
    chunks = (min(_CHUNK_ROWS, image.shape[0]), image.shape[1])
    group.create_dataset(name, data=image, chunks=chunks, track_times=False, **_PACKED)
