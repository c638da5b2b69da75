"""From biased recordings to a level rig: markers, depth refinement, store, floor, as the two commands run them."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from aruco.depth_save import save_depth_data
from aruco.ground_plane import GroundPlaneConfig
from aruco.pose_math import Array
from benchmarks.metric import Metric
from benchmarks.rig_errors import UP, rig_of
from rigcal.config import DepthConfig
from rigcal.formats.native import poses_of, write_extrinsics
from rigcal.levelling import level_files
from rigcal.listeners import Listeners
from rigcal.pipeline import calibrate
from rigcal.quality.truth import pair_errors, tilt_error
from rigcal.sim import Simulation, simulate

# Cameras with target and floor from 1.5 to 5 m, depth biased by 0.3 percent and 0.15 px (standard deviations).
LIMITS = {"bias_scale": 0.3, "bias_disparity": 0.1, "tilt": 0.15, "height": 8.0}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Levelled:
    """How far one rig is from its truth."""

    scales: Array  # (k,) percent
    disparities: Array  # (k,) px
    tilts: Array  # (k,) deg
    heights: Array  # (k,) mm
    pairs: Array  # mm


def run(*, quick: bool) -> list[Metric]:
    names = ["box-static"] if quick else [*["box-static"] * 5, "box-moved"]
    rigs = [_levelled(simulate(name, seed=100 + k, depth=True)) for k, name in enumerate(names)]
    what = f"{len(rigs)} biased recordings, one of a moved box"
    return [
        _worst("bias_scale", "%", "error of a camera's scale", (r.scales for r in rigs), what),
        _worst("bias_disparity", "px", "error of a camera's disparity offset", (r.disparities for r in rigs), what),
        _worst("tilt", "deg", "tilt of a camera", (r.tilts for r in rigs), what),
        _worst("height", "mm", "height error of a camera", (r.heights for r in rigs), what),
        _worst("pair", "mm", "error of a relative pose", (r.pairs for r in rigs), what),
    ]


def _levelled(simulation: Simulation) -> _Levelled:
    rig = rig_of(simulation)
    config = replace(rig.config, depth=DepthConfig(save=True, verify=True, refine=True))
    with tempfile.TemporaryDirectory() as folder:
        poses, store = Path(folder) / "extrinsics.json", Path(folder) / "depth.h5"
        keep = Listeners(depth=lambda pooled: save_depth_data(store, pooled))
        calibration = calibrate(rig.recording, rig.target, config, listeners=keep)
        write_extrinsics(poses, calibration)
        content = level_files(poses, store, GroundPlaneConfig()).content
    T_world_cam, found = poses_of(content, poses), content["_meta"].get("depth_bias", {})
    truth, biases = rig.T_world_cam, simulation.depth_bias
    none = {"scale": 0.0, "disparity_px": 0.0}
    return _Levelled(
        scales=np.array([100 * (found.get(n, none)["scale"] - b.scale) for n, b in biases.items()]),
        disparities=np.array([found.get(n, none)["disparity_px"] - b.disparity_px for n, b in biases.items()]),
        tilts=np.array([np.degrees(tilt_error({n: T}, truth, UP)) for n, T in T_world_cam.items()]),
        heights=np.array([1e3 * (T[1, 3] - truth[n][1, 3]) for n, T in T_world_cam.items()]),
        pairs=np.array([1e3 * shift for _, shift in pair_errors(T_world_cam, truth).values()]),
    )


def _worst(key: str, unit: str, about: str, values: Iterable[Array], what: str) -> Metric:
    return Metric(
        key=f"{key}_worst",
        value=float(np.abs(np.concatenate(list(values))).max()),
        unit=unit,
        about=f"worst {about}; {what}",
        limit=LIMITS.get(key),
        rel_tol=0.3,
    )
