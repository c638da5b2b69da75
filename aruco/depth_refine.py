"""Letting depth correct what markers have found, as far as it proves right on what was not used.

Owns      which biases can be told apart, how large leans are, when markers are doubted, the bounds, the words.
Leaves    the estimate itself to depth_fusion, the test on held-out markers and depth to depth_trial, tiles to
          depth_tiles, the markers' equations to their maker.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from loguru import logger
from numpy.typing import NDArray

from aruco.depth_bias import DepthBias
from aruco.depth_fusion import (
    DepthSensor,
    Estimate,
    MarkerEquations,
    bias_of,
    fuse,
    start_estimate,
)
from aruco.depth_tiles import FLOOR, Tiles
from aruco.depth_trial import HeldOut, MarkerHalf, on_held_out
from aruco.pose_math import Array, Pose, pose_distance

# Data must know the worse known mixture of a bias's two parameters at least as well as the prior does. Else they cannot
# be told apart, and one number stands for both: disparity (or offset), which moves depth more at the ranges of a room
# (0.15 px of 84 px m are 16 mm at 3 m, 0.3 percent are 9 mm). What the other one leaves open stays in the covariance.
SEPARABLE = 1.0
# Leans of disparity [px a unit of the ray] that are thought possible: rectification holds to 0.15 mrad (see the bias
# prior), which about the optical axis are 0.1 px; three times that, and ten times less.
LEANS_PX = np.geomspace(0.01, 0.3, 12)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthRefinement:
    """What depth has corrected, or why nothing was."""

    accepted: bool
    reason: str  # in words, either way
    T_world_cam: Mapping[str, Pose]  # the poses given, unless accepted
    T_world_target: Mapping[int, Pose]
    covariance: Mapping[str, Array] = field(default_factory=dict)  # camera -> (6, 6); empty unless accepted
    common: Mapping[tuple[str, str], Array] = field(default_factory=dict)  # of two cameras; likewise
    biases: Mapping[str, DepthBias] = field(default_factory=dict)  # likewise, of cameras that tell
    findings: Mapping[str, str] = field(default_factory=dict)  # camera -> what its depth tells, in words
    moved: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # camera -> turn [rad], shift [m]
    patches: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # camera -> number on the target, on the floor
    scale: float = 1.0  # how many times larger residuals of depth are than its noise model promises
    lean_px: float = 0.0  # how much disparity errs across the images, typically, a unit of the ray
    held_out: HeldOut | None = None

    def as_dict(self) -> dict[str, Any]:
        """The layout of ``_meta.depth_refined``."""
        held = self.held_out
        return {
            "accepted": self.accepted,
            "reason": self.reason,
            "residual_scale": self.scale,
            "lean_px": self.lean_px,
            "cameras": {name: self._of_camera(name) for name in sorted(self.findings)},
            "held_out": None
            if held is None
            else {
                "markers": held.n_markers,
                "marker_rms_px": {"before": held.marker_px[0], "after": held.marker_px[1]},
                "depth_patches": held.n_patches,
                "depth_median_mm": {"before": held.depth_mm[0], "after": held.depth_mm[1]},
            },
        }

    def _of_camera(self, name: str) -> dict[str, Any]:
        turn, shift = self.moved.get(name, (0.0, 0.0))
        on_target, on_floor = self.patches.get(name, (0, 0))
        return {
            "finding": self.findings[name],
            "turn_deg": math.degrees(turn),
            "shift_mm": 1e3 * shift,
            "patches_on_target": on_target,
            "patches_on_floor": on_floor,
        }


def kept_as_it_was(markers: MarkerEquations, reason: str, **told: Any) -> DepthRefinement:
    """The poses given, and why depth does not correct them."""
    return DepthRefinement(
        accepted=False,
        reason=reason,
        T_world_cam=dict(zip(markers.cameras, markers.T_world_cam)),
        T_world_target=dict(zip(markers.targets, markers.T_world_target)),
        **told,
    )


def refine(
    markers: MarkerEquations,
    halves: Sequence[MarkerHalf],
    tiles: Tiles,
    sensors: Mapping[str, DepthSensor],
    floor: tuple[Array, float] | None,
    *,
    max_rotation_deg: float = 5.0,
    max_translation_m: float = 0.1,
) -> DepthRefinement:
    """Correct poses with depth and estimate its biases, if that predicts what took no part at least as well.

    Args:
        markers: What all markers know.
        halves: Two halves of them.
        tiles: What depth says.
        sensors: Camera -> its depth.
        floor: Roughly, normal and normal . X in the world; None: nobody knows.
        max_rotation_deg: No camera is turned farther.
        max_translation_m: Nor moved.

    Returns:
        The correction, or the poses given and the reason.
    """
    if floor is None:
        tiles = tiles.only(tiles.target != FLOOR)
    if not len(tiles):
        return kept_as_it_was(markers, "no camera has depth on the target or the floor")
    start = start_estimate(markers, floor)
    lean_px = lean_size(markers, tiles, sensors, start)
    found = fuse(markers, tiles, sensors, start, lean_px=lean_px)
    if markers.doubt is not None:
        doubting = fuse(markers.doubting(), tiles, sensors, start, lean_px=lean_px, scale=found.scale)
        if found.cost - doubting.cost > _more_than_chance(len(markers.cameras)):
            logger.debug("depth shows what markers doubt: their poses are trusted less")
            markers, found = markers.doubting(), doubting
            halves = [replace(half, train=half.train.doubting()) for half in halves]
    held = inseparable(found)
    if held.any():
        found = fuse(markers, tiles, sensors, start, lean_px=lean_px, fixed_bias=held)
    told: dict[str, Any] = {
        "findings": {n: _finding(n, c, found, held, tiles, sensors[n]) for c, n in enumerate(markers.cameras)},
        "patches": {n: _count(tiles, c) for c, n in enumerate(markers.cameras)},
        "scale": found.scale,
        "lean_px": lean_px,
    }
    too_far = _beyond_bounds(markers, found, max_rotation_deg, max_translation_m)
    if too_far:
        return kept_as_it_was(markers, too_far, **told)
    figures, worse = on_held_out(halves, tiles, sensors, floor, held, (found.scale, lean_px))
    told["held_out"] = figures
    if worse:
        return kept_as_it_was(markers, worse, **told)
    return replace(_result(markers, found, held, sensors), reason=_why(figures), **told)


def lean_size(markers: MarkerEquations, tiles: Tiles, sensors: Mapping[str, DepthSensor], start: Estimate) -> float:
    """How large leans are [px a unit of the ray], from how well the floor agrees with the markers.

    The root of the mean of the variance's posterior, all possible sizes being equally likely beforehand. With the
    information D on the leans and h = D times what data alone make of them, a variance v has the marginal likelihood
    ``|1 + v D|^(-1/2) exp(h (D + 1/v)^-1 h / 2)``.
    """
    found = fuse(markers, tiles, sensors, start, lean_px=LEANS_PX[-1])
    assert found.covariance is not None, "fuse has told"
    unit = np.repeat([sensors[name].lean_unit for name in markers.cameras], 2)
    n = len(unit)
    information = np.linalg.inv(found.covariance[-n:, -n:] / np.outer(unit, unit))
    h, D = information @ (found.lean.ravel() / unit), information - np.eye(n) / LEANS_PX[-1] ** 2
    log_likelihood = np.array(
        [(h @ np.linalg.solve(D + np.eye(n) / v, h) - np.linalg.slogdet(np.eye(n) + v * D)[1]) / 2 for v in LEANS_PX**2]
    )
    weight = np.exp(log_likelihood - log_likelihood.max())
    return float(np.sqrt(weight @ LEANS_PX**2 / weight.sum()))


def inseparable(found: Estimate) -> NDArray[np.bool_]:
    """Which parameters (c, 2) of the biases stay zero: the scale where two cannot be told apart, both without data."""
    assert found.known is not None, "fuse has told"
    worse, better = found.known.T
    return np.stack([worse < SEPARABLE, better < SEPARABLE], axis=1)


def _result(
    markers: MarkerEquations, found: Estimate, held: NDArray[np.bool_], sensors: Mapping[str, DepthSensor]
) -> DepthRefinement:
    assert found.covariance is not None, "fuse has told"
    names, n_pose = markers.cameras, len(found.twist)
    P = found.covariance
    blocks = P[: 6 * len(names), : 6 * len(names)].reshape(len(names), 6, len(names), 6)
    of_bias = [P[n_pose + 2 * c : n_pose + 2 * c + 2, n_pose + 2 * c : n_pose + 2 * c + 2] for c in range(len(names))]
    return DepthRefinement(
        accepted=True,
        reason="",
        T_world_cam=dict(zip(names, found.T_world_cam)),
        T_world_target=dict(zip(markers.targets, found.T_world_target)),
        covariance={name: blocks[c, :, c] for c, name in enumerate(names) if markers.free[c]},
        common={(a, b): blocks[i, :, j] for i, a in enumerate(names) for j, b in enumerate(names) if i != j},
        biases={n: bias_of(sensors[n], found.bias[c], of_bias[c]) for c, n in enumerate(names) if not held[c].all()},
        moved={n: pose_distance(a, b) for n, a, b in zip(names, markers.T_world_cam, found.T_world_cam)},
    )


def _why(figures: HeldOut) -> str:
    """Why the result is believed."""
    tested = [what for what, n in (("markers", figures.n_markers), ("depth", figures.n_patches)) if n]
    untested = "" if len(tested) == 2 else "; there was too little to hold out " + ("markers" if tested else "anything")
    return (
        f"{' and '.join(tested)} that took no part are predicted at least as well{untested}" if tested else untested[2:]
    )


def _more_than_chance(n: int) -> float:
    """What the sum of n squared normal numbers hardly ever exceeds: its mean and three standard deviations."""
    return n + 3.0 * math.sqrt(2.0 * n)


def _count(tiles: Tiles, camera: int) -> tuple[int, int]:
    on_floor = tiles.target[tiles.camera == camera] == FLOOR
    return int((~on_floor).sum()), int(on_floor.sum())


def _beyond_bounds(markers: MarkerEquations, found: Estimate, max_rotation_deg: float, max_translation_m: float) -> str:
    """Which cameras would be moved farther than allowed, in words; empty if none."""
    far: list[str] = []
    for name, before, after in zip(markers.cameras, markers.T_world_cam, found.T_world_cam):
        turn, shift = pose_distance(before, after)
        if math.degrees(turn) > max_rotation_deg or shift > max_translation_m:
            far.append(f"camera {name} by {math.degrees(turn):.2g} degrees and {1e3 * shift:.3g} mm")
    if not far:
        return ""
    return (
        f"depth would move {', '.join(far)}, more than the {max_rotation_deg:g} degrees and "
        f"{1e3 * max_translation_m:g} mm that are allowed"
    )


# --- words ----------------------------------------------------------------------------------------------------------


def _finding(
    name: str, camera: int, found: Estimate, held: NDArray[np.bool_], tiles: Tiles, sensor: DepthSensor
) -> str:
    """What a camera's depth tells, in words."""
    mine = tiles.camera == camera
    if held[camera].all():
        return "too little depth on target and floor to tell its bias"
    near, far = (1.0 / tiles.inverse[mine].max(), 1.0 / tiles.inverse[mine].min())
    assert found.covariance is not None, "fuse has told"
    first = len(found.twist) + 2 * camera
    sigma = np.sqrt(np.diag(found.covariance)[first : first + 2])
    where = f"on {int(mine.sum())} patches from {near:.1f} to {far:.1f} m"
    second = _second(sensor, float(found.bias[camera, 1]), float(sigma[1]))
    middle = np.array([float(np.median(1.0 / tiles.inverse[mine]))])
    off_mm = 1e3 * float(middle[0] - bias_of(sensor, found.bias[camera]).corrected(middle)[0])
    side = f"{abs(off_mm):.0f} mm too {'far' if off_mm > 0 else 'near'} at {middle[0]:.1f} m"
    if held[camera, 0]:
        what = "offset" if sensor.model == "offset" else "disparity"
        return f"ranges {where} do not tell scale from {what}: scale is left at 0, {second}; {side}"
    return f"scale {100 * found.bias[camera, 0]:+.2f} +- {100 * sigma[0]:.2f} %, {second}, {where}; {side}"


def _second(sensor: DepthSensor, value: float, sigma: float) -> str:
    if sensor.model == "offset":
        return f"offset {1e3 * value:+.1f} +- {1e3 * sigma:.1f} mm"
    if sensor.focal_baseline is None:
        return f"inverse depth {value:+.5f} +- {sigma:.5f} 1/m"
    return f"disparity {value * sensor.focal_baseline:+.3f} +- {sigma * sensor.focal_baseline:.3f} px"
