"""Registration of a real recording whose cameras face each other and hardly overlap, through the whole tool."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from itertools import combinations
from pathlib import Path

import numpy as np

from aruco.depth_save import save_depth_data
from aruco.floor_plane import FloorPlane
from aruco.ground_plane import GroundPlaneConfig
from aruco.icp_types import ICPConfig
from aruco.pose_math import Pose, invert_transform, pose_distance
from benchmarks.metric import Metric, Skipped
from benchmarks.suite.cube3_b import DATA, DICTIONARY
from rigcal.config import AlignConfig, CalibrateConfig, DepthConfig, DetectConfig
from rigcal.formats.native import write_extrinsics
from rigcal.icp_refining import register_clouds
from rigcal.levelled_rig import Levelling
from rigcal.levelling import level_files
from rigcal.listeners import Listeners
from rigcal.pipeline import calibrate
from rigcal.sources import open_recordings
from rigcal.target import marker_target_from_file

# cam1 sees little of what the others see; those two see the same table.
FAR, OVERLAPPING = "cam1", ("cam0", "cam2")
STAYS_MM = 5.0
# Of two planes, by unit.
WHAT = {"deg": "angle", "mm": "difference"}


def run(*, quick: bool) -> list[Metric]:
    if not DATA.is_dir():
        raise Skipped("the recording is not there")
    levelling = register_clouds(_levelled(), ICPConfig(stride=2))
    found = levelling.registration
    assert found is not None
    markers = levelling.given.T_world_cam
    stays = {"levelled": found.T_start_cam, "registered": found.T_world_cam}
    return [
        *(_moved(markers, T_world_cam, when) for when, T_world_cam in stays.items()),
        Metric(
            key="moved",
            value=float(len(found.moved)),
            unit="cameras",
            about="moved by registration",
            rel_tol=None,
        ),
        *_table(levelling, found.T_start_cam, "levelled"),
        *_table(levelling, found.T_world_cam, "registered"),
        *_worse(levelling, found.T_start_cam, found.T_world_cam),
    ]


def _levelled() -> Levelling:
    """The recording calibrated by markers, and levelled on the table, by way of files."""
    config = CalibrateConfig(
        detect=DetectConfig(dictionary=DICTIONARY),
        align=AlignConfig(enabled=True),
        depth=DepthConfig(save=True),
        moving_target=True,
    )
    recording = open_recordings([DATA / "recording"])
    target = marker_target_from_file(DATA / "markers.parquet", DICTIONARY)
    with tempfile.TemporaryDirectory() as folder:
        poses, store = Path(folder) / "extrinsics.json", Path(folder) / "depth.h5"
        keep = Listeners(depth=lambda pooled: save_depth_data(store, pooled))
        write_extrinsics(poses, calibrate(recording, target, config, listeners=keep))
        return level_files(poses, store, GroundPlaneConfig(stride=2))


def _moved(markers: Mapping[str, Pose], T_world_cam: Mapping[str, Pose], when: str) -> Metric:
    """How far the camera with little overlap has gone from where the markers put it against the others."""
    away = [
        pose_distance(
            invert_transform(T_world_cam[name]) @ T_world_cam[FAR], invert_transform(markers[name]) @ markers[FAR]
        )[1]
        for name in OVERLAPPING
    ]
    return Metric(
        key=f"far.{when}_mm",
        value=1e3 * max(away),
        unit="mm",
        about=f"{FAR}, whose depth overlaps little, against where the markers put it beside the others; {when}",
        limit=STAYS_MM,
        rel_tol=0.3,
        abs_tol=0.3,
    )


def _table(levelling: Levelling, T_world_cam: Mapping[str, Pose], when: str) -> list[Metric]:
    """How well cameras agree about the table under them: largest of all pairs."""
    figures = _disagreement(levelling, T_world_cam)
    return [
        Metric(
            key=f"table.{when}_{unit}",
            value=figures[unit],
            unit=unit,
            about=f"largest {what} of two cameras' table planes, {when}",
            rel_tol=0.3,
            abs_tol=0.05 if unit == "deg" else 0.5,
        )
        for unit, what in WHAT.items()
    ]


def _worse(levelling: Levelling, before: Mapping[str, Pose], after: Mapping[str, Pose]) -> list[Metric]:
    """By how much less cameras agree about the table after registration; below 0 they agree better."""
    was, now = (_disagreement(levelling, T_world_cam) for T_world_cam in (before, after))
    return [
        Metric(
            key=f"table.worse_{unit}",
            value=now[unit] - was[unit],
            unit=unit,
            about=f"growth of the largest {what} of two cameras' table planes by registration",
            limit=0.0,
            rel_tol=None,
        )
        for unit, what in WHAT.items()
    ]


def _disagreement(levelling: Levelling, T_world_cam: Mapping[str, Pose]) -> dict[str, float]:
    planes = {
        name: _plane(levelling, name, T) for name, T in T_world_cam.items() if name in levelling.metrics.corrections
    }
    angles, steps = [0.0], [0.0]
    for i, j in combinations(sorted(planes), 2):
        middle = np.mean([T_world_cam[name][:3, 3] for name in (i, j)], axis=0)
        angles.append(math.degrees(math.acos(min(1.0, float(planes[i].normal @ planes[j].normal)))))
        steps.append(1e3 * abs(float(planes[i].distances(middle) - planes[j].distances(middle))))
    return {"deg": max(angles), "mm": max(steps)}


def _plane(levelling: Levelling, camera: str, T_world_cam: Pose) -> FloorPlane:
    """The table as a camera measured it, in the world of a pose of that camera."""
    measured = levelling.metrics.camera_planes[camera]
    return measured.moved(T_world_cam @ invert_transform(levelling.T_world_cam[camera]))
