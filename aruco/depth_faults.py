"""Depth that no bias explains: images of another camera, mirrored ones, a wrong unit.

Owns      what is too far off to be a camera's bias or noise, and the words for it.
Leaves    the fit to depth_fusion, fitting again without such a camera to depth_refine.

One such camera spoils the others through the floor and the poses that they share, so it has to go before they are
judged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from aruco.depth_fusion import DepthSensor, Estimate, MarkerEquations, residuals, robust_scale
from aruco.depth_tiles import FLOOR, Tiles
from aruco.pose_math import Array

# Tiles on the target are off by this many times what cameras' tiles usually are: no noise, whatever shape it has.
MAX_SIGMAS = 5.0
# What is usual is asked of the cameras themselves, but if they all are this much worse than promised it is no noise.
MAX_USUAL = 3.0
# A bias has two parameters; with a prior that is right one camera in 3000 is farther off than this.
MAX_OF_PRIOR = 4.0
# Of its tiles the worst tenth may lie on something else.
TRUSTED_SHARE = 0.9
MIN_TILES = 4
_CHECK = (
    "it takes no part and gets no bias: check that its depth images are its own and not mirrored, depth_scale and "
    "unit, and the depth's intrinsics and baseline"
)
_CHECK_LEAN = "it gets no bias; check its rectification, and that the depth's intrinsics are its own"


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """Why a camera's depth cannot be believed."""

    camera: int  # index
    excess: float  # over what is allowed
    said: str  # in words


def worst_fault(
    found: Estimate, markers: MarkerEquations, tiles: Tiles, sensors: Mapping[str, DepthSensor]
) -> Fault | None:
    """The camera whose depth is farthest beyond noise and bias after the fit; None if none is."""
    present = np.unique(tiles.camera).tolist()
    e = residuals(tiles, found, sensors, markers) * tiles.sigma / tiles.alone
    on_target = (tiles.target != FLOOR) & np.isfinite(e)
    mine = {c: on_target & (tiles.camera == c) for c in present}
    usual = np.sort([robust_scale(e[mine[c]]) for c in present])[(len(present) - 1) // 2]
    sensor = {c: sensors[markers.cameras[c]] for c in present}
    faults = [_of_residuals(c, e[mine[c]], tiles.only(mine[c]), min(float(usual), MAX_USUAL)) for c in present]
    faults += [_of_bias(c, found.bias[c], sensor[c]) for c in present]
    return max((fault for fault in faults if fault.excess > 1.0), key=lambda fault: fault.excess, default=None)


def indescribable(written: Estimate, markers: MarkerEquations, sensors: Mapping[str, DepthSensor]) -> dict[int, str]:
    """Cameras (indices) whose biases only serve to stand for leans, where nothing else may be taken out; and why."""
    found = {c: _sigmas(written.bias[c], sensors[name]) for c, name in enumerate(markers.cameras)}
    return {
        c: f"two numbers do not describe how its depth is wrong, which leans across the image: {_CHECK_LEAN}"
        for c, sigmas in found.items()
        if sigmas > MAX_OF_PRIOR
    }


def _of_residuals(camera: int, e: Array, tiles: Tiles, usual: float) -> Fault:
    """From residuals (n,) of a camera's tiles on the target, in standard deviations."""
    best = np.argsort(np.abs(e))[: math.ceil(TRUSTED_SHARE * len(e))]
    if len(e) < MIN_TILES:
        return Fault(camera=camera, excess=0.0, said="")
    sigmas = float(np.sqrt(np.mean(e[best] ** 2)))
    off_mm = 1e3 * float(np.sqrt(np.mean((e * tiles.alone / tiles.inverse**2)[best] ** 2)))
    said = f"depth is {off_mm:.0f} mm ({sigmas:.0f} sigmas, RMSE) off the target whatever its bias, so {_CHECK}"
    return Fault(camera=camera, excess=sigmas / (MAX_SIGMAS * usual), said=said)


def _of_bias(camera: int, bias: Array, sensor: DepthSensor) -> Fault:
    """From a bias (2,) that was fitted."""
    sigmas = _sigmas(bias, sensor)
    said = f"depth would need a bias {sigmas:.1f} times as large as is usual ({_named(sensor, bias)}), so {_CHECK}"
    return Fault(camera=camera, excess=sigmas / MAX_OF_PRIOR, said=said)


def _sigmas(bias: Array, sensor: DepthSensor) -> float:
    """How far from its prior a bias (2,) is."""
    return math.sqrt(float(bias @ np.linalg.solve(sensor.prior, bias)))


def _named(sensor: DepthSensor, bias: Array) -> str:
    scale = f"scale {100 * bias[0]:+.2f} %"
    if sensor.model == "offset":
        return f"{scale}, offset {1e3 * bias[1]:+.1f} mm"
    if sensor.focal_baseline is None:
        return f"{scale}, inverse depth {bias[1]:+.5f} 1/m"
    return f"{scale}, disparity {bias[1] * sensor.focal_baseline:+.3f} px"
