"""Cameras that an earlier calibration placed and that stay where they are: the file given as --fix.

Owns      what is kept of that file: poses to the bit, what stands beside them, the world they are in.
Leaves    reading and writing the file to formats.native, whether the poses still hold to kept_check.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from aruco.errors import InputError
from aruco.model import UpAxis
from aruco.pose_math import Array, Pose, pose_text
from rigcal.formats import native

# What a file says of each camera under its _meta, and what stays true of a camera that stays.
OF_CAMERAS = ("covariance", "depth_bias")
# Of the largest entry: covariances are written with all digits, but by others perhaps not.
SYMMETRIC = 1e-6
NEGATIVE = 1e-9  # likewise


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeptRig:
    """The cameras of an extrinsics file, which no step may move."""

    T_world_cam: Mapping[str, Pose]
    entries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # as they stand in the file
    meta: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # OF_CAMERAS -> camera, likewise
    covariance: Mapping[str, Array] = field(default_factory=dict)  # (6, 6), where the file has it
    # The file's _meta.world; cameras that come from no file are in the target's.
    world: Mapping[str, Any] = field(default_factory=lambda: {"origin": "target"})
    file: str = "the file to keep"  # its name
    digest: str = ""  # SHA-256 of poses and world

    def __post_init__(self) -> None:
        """Cameras that come from no file have an entry too."""
        poses = {name: {"pose": pose_text(T)} for name, T in self.T_world_cam.items()}
        object.__setattr__(self, "entries", {**poses, **self.entries})

    @property
    def up(self) -> UpAxis | None:
        """Which way is up in the file's world, if the file says so."""
        return next((axis for axis, vector in native.UP_VECTORS.items() if self.world.get("up") == vector), None)

    @property
    def origin(self) -> str:
        """What the origin of the file's world is tied to."""
        return self.world.get("origin", "unknown")

    def only(self, names: Collection[str]) -> KeptRig:
        """The same world, which only some of the cameras carry: the others may be moved."""
        return replace(self, T_world_cam={name: T for name, T in self.T_world_cam.items() if name in names})


NOTHING_KEPT = KeptRig(T_world_cam={})


def kept_from_file(path: Path) -> KeptRig:
    """The cameras of an extrinsics file.

    Raises:
        InputError: It cannot be read, or an entry has no rigid pose, or what it says of cameras or world is not that.
    """
    return kept_of(native.read_json(path), path)


def kept_of(content: Mapping[str, Any], path: Path) -> KeptRig:
    """The same, of the content of a file that was read."""
    poses = native.poses_of(content, path)
    meta = content.get("_meta")
    meta = meta if isinstance(meta, dict) else {}
    world = _world(meta.get("world"), path)
    of_cameras = {key: _of_cameras(meta.get(key), key, poses, path) for key in OF_CAMERAS}
    given = of_cameras["covariance"]
    return KeptRig(
        T_world_cam=poses,
        entries={name: content[name] for name in poses},
        meta=of_cameras,
        covariance={
            name: _covariance(numbers, f"{path}: the covariance of camera {name}") for name, numbers in given.items()
        },
        world=world,
        file=path.name,
        digest=hashlib.sha256(json.dumps([{n: content[n]["pose"] for n in poses}, world]).encode()).hexdigest(),
    )


def _world(given: Any, path: Path) -> dict[str, Any]:
    if not isinstance(given, dict):
        return {"up": None, "origin": "unknown"}
    up, origin = given.get("up"), given.get("origin", "unknown")
    if not isinstance(origin, str) or (up is not None and up not in native.UP_VECTORS.values()):
        raise InputError(
            f"{path}: _meta.world wants up [0, 1, 0], [0, -1, 0] or null and an origin in words, not {up!r} and "
            f"{origin!r}; mend or remove it."
        )
    return given


def _of_cameras(given: Any, key: str, names: Collection[str], path: Path) -> dict[str, Any]:
    if given is None:
        return {}
    if not isinstance(given, dict):
        raise InputError(f"{path}: _meta.{key} is not an object of cameras; mend or remove it.")
    return {name: value for name, value in given.items() if name in names}


def _covariance(numbers: Any, where: str) -> Array:
    try:
        covariance = np.array(numbers, dtype=np.float64).reshape(6, 6)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where} is not 36 numbers in a list, row by row; mend or remove it.") from error
    largest = float(np.abs(covariance).max())
    if not (np.abs(covariance - covariance.T) <= SYMMETRIC * largest).all() or (np.diag(covariance) < 0).any():
        raise InputError(f"{where} is not symmetric with variances on its diagonal; mend or remove it.")
    if largest > 0 and np.linalg.eigvalsh(covariance / largest)[0] < -NEGATIVE:
        raise InputError(f"{where} has a negative variance in some direction; mend or remove it.")
    return covariance
