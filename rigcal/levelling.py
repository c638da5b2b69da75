"""The story of levelling: poses and depth in, the same rig on its real floor out.

Owns      the order of the steps, who takes part, what is said on the way.
Leaves    the floor and corrections on it to aruco.ground_plane, the files to levelled_file and aruco.depth_save, what
          is derived from the result to levelled_rig.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from loguru import logger

from aruco.depth_save import CameraDepth, load_depth_data
from aruco.errors import CalibrationError, InputError
from aruco.ground_plane import GroundPlaneConfig, GroundPlaneMetrics, refine_ground_from_depth
from aruco.pose_math import Pose
from rigcal.ground_note import DepthFile, depth_file
from rigcal.levelled_file import RigFile, rig_file
from rigcal.levelled_rig import Levelling

# The floor may lie somewhat above the origin of a target without being another plane: maps have their own origins.
ORIGIN_BELOW_FLOOR_M = 0.05


def level_files(extrinsics: Path, depth: Path, config: GroundPlaneConfig) -> Levelling:
    """A rig on its floor.

    Args:
        extrinsics: An extrinsics file whose world stands upright.
        depth: A depth store of the same cameras.
        config: How the floor is found, and how far a camera may be moved; which way is up the file says.

    Raises:
        InputError: A file cannot be used as it is.
        CalibrationError: There is no floor, or floor, cameras and world contradict each other.
    """
    given, store = rig_file(extrinsics), load_depth_data(depth, frames=False, blind=True)
    source = depth_file(depth)
    data = _camera_data(given, store, depth)
    _warn_of_input(given, store, source)
    config = replace(config, up=(0.0, 1.0 if given.up == "+y" else -1.0, 0.0))
    T_world_cam, metrics = _on_floor(given, data, config)
    levelling = Levelling(
        given=given, depth_file=source, data=data, config=config, T_world_cam=T_world_cam, metrics=metrics
    )
    _warn_of_result(levelling)
    return levelling


def _camera_data(given: RigFile, store: Mapping[str, CameraDepth], path: Path) -> dict[str, dict[str, Any]]:
    """The depth of cameras that have a pose, with their biases, by name.

    Raises:
        InputError: There is none, or nothing in it.
    """
    both = sorted(given.T_world_cam.keys() & store.keys())
    if not both:
        raise InputError(
            f"{path}: has depth of {', '.join(sorted(store)) or 'no camera'}, but none of the cameras of {given.name} "
            f"({', '.join(sorted(given.T_world_cam))}); give the depth of the same rig."
        )
    seeing = [name for name in both if np.isfinite(store[name].depth).any()]
    if not seeing:
        load_depth_data(path, frames=False)  # says what they are full of
    data = {name: store[name].as_camera_data() for name in seeing}
    for name in seeing:
        if name in given.depth_bias:
            data[name]["bias"] = given.depth_bias[name]
    return data


def _warn_of_input(given: RigFile, store: Mapping[str, CameraDepth], source: DepthFile) -> None:
    """Say what of the two files is taken for granted, used twice, or not used at all."""
    if given.up_is_assumed:
        logger.warning("{} does not say which way is up (_meta.world.up); y is taken to point up", given.name)
    if given.levelled_with == source.digest:
        logger.warning("{} was levelled with this depth before; its covariances count the same floor twice", given.name)
    if given.apart:
        logger.warning("cameras {} stand in worlds of their own (_meta.parts), and stay there", ", ".join(given.apart))
    blind = sorted(n for n in store.keys() & given.T_world_cam.keys() if not np.isfinite(store[n].depth).any())
    if blind:
        logger.warning(
            "depth of {} holds no measurement; only the motion of the whole rig moves {}",
            _cameras(blind),
            "it" if len(blind) == 1 else "them",
        )
    unknown = sorted(store.keys() - given.T_world_cam.keys() - set(given.apart))
    if unknown:
        them = "it" if len(unknown) == 1 else "them"
        logger.warning("depth of {} is not used: {} has no pose of {}", _cameras(unknown), given.name, them)


def _cameras(names: Sequence[str]) -> str:
    return f"camera{'s' * (len(names) > 1)} {', '.join(names)}"


def _on_floor(
    given: RigFile, data: Mapping[str, Mapping[str, Any]], config: GroundPlaneConfig
) -> tuple[dict[str, Pose], GroundPlaneMetrics]:
    """The levelled poses, and how they were found; no floor is an error here."""
    try:
        T_world_cam, metrics = refine_ground_from_depth(data, given.T_world_cam, config, covariances=given.covariance)
    except CalibrationError as error:
        if not given.up_is_assumed:
            raise
        raise CalibrationError(
            f"{error} {given.name} does not say which way is up: if y points down, set _meta.world.up to [0, -1, 0]."
        ) from error
    if not metrics.success:
        raise CalibrationError(
            f"{metrics.message} Look whether the world is upright and the floor in view, and at --height-range."
        )
    return T_world_cam, metrics


def _warn_of_result(levelling: Levelling) -> None:
    """Doubt a floor that lies above the target, or elsewhere than the file has it."""
    given, config = levelling.given, levelling.config
    floor = levelling.metrics.floor_before
    if given.origin == "floor" and floor is not None:
        off_m = floor.height - levelling.up_y * given.floor_y
        if abs(off_m) > ORIGIN_BELOW_FLOOR_M:
            logger.warning(
                "this floor lies {:.2f} m {} the floor that {} was levelled on; if it is a table, say so with "
                "--height-range",
                abs(off_m),
                "above" if off_m > 0 else "below",
                given.name,
            )
    sunk_m = levelling.up_y * (config.target_floor_y - float(levelling.metrics.T_level_world[1, 3]))
    if given.origin == "target" and sunk_m > ORIGIN_BELOW_FLOOR_M:
        logger.warning(
            "the target's origin lies {:.2f} m below this floor; if that is a table, say so with --height-range", sunk_m
        )
