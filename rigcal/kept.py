"""Cameras that an earlier calibration placed and that stay where they are: the file given as --fix.

Owns      what is kept of that file: poses to the bit, entries, the world they are in.
Leaves    reading and writing the file to formats.native.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from aruco.errors import InputError
from aruco.model import UpAxis
from aruco.pose_math import Array, Pose
from rigcal.formats import native


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeptRig:
    """The cameras of an extrinsics file, which no step may move."""

    T_world_cam: Mapping[str, Pose]
    entries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # as they stand in the file
    covariance: Mapping[str, Array] = field(default_factory=dict)  # (6, 6), where the file has it
    world: Mapping[str, Any] = field(default_factory=dict)  # the file's _meta.world
    digest: str = ""  # SHA-256 of poses and world

    @property
    def up(self) -> UpAxis | None:
        """Which way is up in the file's world, if the file says so."""
        return next((axis for axis, vector in native.UP_VECTORS.items() if self.world.get("up") == vector), None)


def kept_from_file(path: Path) -> KeptRig:
    """The cameras of an extrinsics file.

    Raises:
        InputError: It cannot be read, or an entry has no rigid pose.
    """
    poses = native.read_poses(path)
    content = native.read_json(path)
    meta = content.get("_meta")
    meta = meta if isinstance(meta, dict) else {}
    world = meta.get("world")
    world = world if isinstance(world, dict) else {"up": None, "origin": "camera"}
    return KeptRig(
        T_world_cam=poses,
        entries={name: content[name] for name in poses},
        covariance=_covariances(meta.get("covariance"), poses, path),
        world=world,
        digest=hashlib.sha256(json.dumps([{n: content[n]["pose"] for n in poses}, world]).encode()).hexdigest(),
    )


def _covariances(given: Any, poses: Mapping[str, Pose], path: Path) -> dict[str, Array]:
    found: dict[str, Array] = {}
    for name, numbers in given.items() if isinstance(given, dict) else ():
        try:
            covariance = np.array(numbers, dtype=np.float64).reshape(6, 6)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{path}: the covariance of camera {name} is not 36 numbers; mend or remove it."
            ) from error
        if name in poses and np.isfinite(covariance).all():
            found[name] = covariance
    return found
