"""Letting depth correct what markers have found, as far as it proves right on what was not used.

Owns      which biases can be told apart, how large leans are, when markers are doubted, what is used, the bounds.
Leaves    the estimate itself to depth_fusion, the test on held-out markers and depth to depth_trial, depth that cannot
          be true to depth_faults, words to depth_findings, tiles to depth_tiles, the markers' equations to their maker.
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
from aruco.depth_faults import indescribable, worst_fault
from aruco.depth_findings import finding, why_believed
from aruco.depth_fusion import (
    DepthSensor,
    Estimate,
    MarkerEquations,
    bias_of,
    fuse,
    given_estimate,
    start_estimate,
    without_lean,
)
from aruco.depth_tiles import FLOOR, Tiles
from aruco.depth_trial import HeldOut, MarkerHalf, Trial, on_held_out
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

    poses_accepted: bool  # depth has moved the poses
    bias_accepted: bool  # its biases are taken out of depth; poses may have stayed
    reason: str  # in words, either way
    T_world_cam: Mapping[str, Pose]  # the poses given, unless these are moved
    T_world_target: Mapping[int, Pose]
    covariance: Mapping[str, Array] = field(default_factory=dict)  # camera -> (6, 6); empty unless poses are moved
    biases: Mapping[str, DepthBias] = field(default_factory=dict)  # of cameras that tell; empty unless accepted
    findings: Mapping[str, str] = field(default_factory=dict)  # camera -> what its depth tells, in words
    left_out: Mapping[str, str] = field(default_factory=dict)  # camera whose depth is no biased depth -> why, in words
    moved: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # camera -> turn [rad], shift [m]
    patches: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # camera -> number on the target, on the floor
    scale: float = 1.0  # how many times larger residuals of depth are than its noise model promises
    lean_px: float = 0.0  # how much disparity errs across the images, typically, a unit of the ray
    held_out: HeldOut | None = None

    @property
    def accepted(self) -> bool:
        """Whether depth has corrected anything."""
        return self.poses_accepted or self.bias_accepted

    def as_dict(self) -> dict[str, Any]:
        """The layout of ``_meta.depth_refined``."""
        held = self.held_out
        return {
            "accepted": self.accepted,
            "poses_accepted": self.poses_accepted,
            "bias_accepted": self.bias_accepted,
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
                "depth_median_mm": dict(zip(("before", "biases_alone", "after"), held.depth_mm)),
            },
        }

    def _of_camera(self, name: str) -> dict[str, Any]:
        turn, shift = self.moved.get(name, (0.0, 0.0))
        on_target, on_floor = self.patches.get(name, (0, 0))
        growth = None if self.held_out is None else self.held_out.growth.get(name)
        return {
            "finding": self.findings[name],
            "left_out": name in self.left_out,
            "turn_deg": math.degrees(turn),
            "shift_mm": 1e3 * shift,
            "patches_on_target": on_target,
            "patches_on_floor": on_floor,
            "held_out_markers": None
            if growth is None
            else {
                "n": growth.n_markers,
                "rms_px": {"before": growth.px[0], "after": growth.px[1]},
                "squares_grow": growth.squares,
                "by_chance": growth.chance,
            },
        }


def kept_as_it_was(markers: MarkerEquations, reason: str, **told: Any) -> DepthRefinement:
    """The poses given, and why depth does not correct them."""
    return DepthRefinement(
        poses_accepted=False,
        bias_accepted=False,
        reason=reason,
        T_world_cam=dict(zip(markers.cameras, markers.T_world_cam)),
        T_world_target=dict(zip(markers.targets, markers.T_world_target)),
        **told,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Fit:
    """Everything in one estimate, before anybody believes it."""

    markers: MarkerEquations  # less sure of, where depth shows what they doubt
    tiles: Tiles  # of cameras that take part
    found: Estimate
    lean_px: float
    left_out: Mapping[str, str]


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
    """Correct poses with depth and estimate its biases, each if that predicts what took no part at least as well.

    Args:
        markers: What all markers know.
        halves: Two halves of them.
        tiles: What depth says.
        sensors: Camera -> its depth.
        floor: Roughly, normal and normal . X in the world; None: nobody knows.
        max_rotation_deg: If any camera were turned farther, no pose is moved.
        max_translation_m: Likewise.

    Returns:
        The correction, or the poses given and the reason.
    """
    if floor is None:
        tiles = tiles.only(tiles.target != FLOOR)
    if not len(tiles):
        return kept_as_it_was(markers, "no camera has depth on the target or the floor")
    fit = _fitted(markers, tiles, sensors, floor)
    told: dict[str, Any] = {
        "left_out": fit.left_out,
        "patches": {name: _count(tiles, c) for c, name in enumerate(markers.cameras)},
        "scale": fit.found.scale,
        "lean_px": fit.lean_px,
    }
    if not len(fit.tiles):
        return kept_as_it_was(markers, "no camera's depth can be true", findings=fit.left_out, **told)
    held = inseparable(fit.found)
    if held.any():
        again = fuse(fit.markers, fit.tiles, sensors, fit.found, lean_px=fit.lean_px, fixed_bias=held)
        fit = replace(fit, found=again)
    if fit.markers is not markers:
        halves = [replace(half, train=half.train.doubting()) for half in halves]
    silent = indescribable(without_lean(fit.markers, fit.tiles, sensors, fit.found, held), markers, sensors)
    unwritten = held | np.isin(np.arange(len(held)), list(silent))[:, None]
    trial = on_held_out(halves, fit.tiles, sensors, floor, held, unwritten, (fit.found.scale, fit.lean_px))
    unheard = {**fit.left_out, **{markers.cameras[c]: why for c, why in silent.items()}}
    told |= {"held_out": trial.figures, "scale": fit.found.scale, "left_out": unheard}
    too_far = _beyond_bounds(markers, fit.found, max_rotation_deg, max_translation_m)
    if too_far:
        trial = replace(trial, against_move=too_far)
    result = _judged(fit, trial, unwritten, sensors, floor)
    return replace(result, findings={**result.findings, **unheard}, **told)


def _fitted(
    markers: MarkerEquations, tiles: Tiles, sensors: Mapping[str, DepthSensor], floor: tuple[Array, float] | None
) -> _Fit:
    """Everything in one estimate, without cameras whose depth cannot be true: the worst goes first."""
    start, left_out = start_estimate(markers, floor), dict[str, str]()
    while True:
        lean_px = lean_size(markers, tiles, sensors, start)
        found, trusted = fuse(markers, tiles, sensors, start, lean_px=lean_px), markers
        if markers.doubt is not None:
            doubting = fuse(markers.doubting(), tiles, sensors, start, lean_px=lean_px, scale=found.scale)
            if found.cost - doubting.cost > _more_than_chance(len(markers.cameras)):
                logger.debug("depth shows what markers doubt: their poses are trusted less")
                trusted, found = markers.doubting(), doubting
        fault = worst_fault(found, trusted, tiles, sensors)
        if fault is not None:
            left_out[markers.cameras[fault.camera]] = fault.said
            tiles = tiles.only(tiles.camera != fault.camera)
        if fault is None or not len(tiles):
            return _Fit(markers=trusted, tiles=tiles, found=found, lean_px=lean_px, left_out=left_out)


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


def _judged(
    fit: _Fit,
    trial: Trial,
    held: NDArray[np.bool_],
    sensors: Mapping[str, DepthSensor],
    floor: tuple[Array, float] | None,
) -> DepthRefinement:
    """What is used of a fit after its trial: all of it, biases but those held beside the poses given, or nothing."""
    markers, names, moves = fit.markers, fit.markers.cameras, not trial.against_move
    at = fit.found if moves else replace(given_estimate(markers, floor), scale=fit.found.scale)
    alone = without_lean(markers, fit.tiles, sensors, at, held)
    biases = _biases(fit.found if moves else alone, alone, held, sensors, names)
    findings = {n: finding(biases.get(n), held[c], fit.tiles.only(fit.tiles.camera == c)) for c, n in enumerate(names)}
    if not moves and (trial.against_bias or not biases):
        why = trial.against_bias or "there is too little depth to tell any bias"
        return kept_as_it_was(markers, f"{trial.against_move}; {why}", findings=findings)
    kept = kept_as_it_was(markers, why_believed(trial, moves=moves), biases=biases, findings=findings)
    kept = replace(kept, bias_accepted=bool(biases))
    if not moves:
        return kept
    assert fit.found.covariance is not None, "fuse has told"
    blocks = fit.found.covariance[: 6 * len(names), : 6 * len(names)].reshape(len(names), 6, len(names), 6)
    return replace(
        kept,
        poses_accepted=True,
        T_world_cam=dict(zip(names, fit.found.T_world_cam)),
        T_world_target=dict(zip(markers.targets, fit.found.T_world_target)),
        covariance={name: blocks[c, :, c] for c, name in enumerate(names) if markers.free[c]},
        moved={n: pose_distance(a, b) for n, a, b in zip(names, markers.T_world_cam, fit.found.T_world_cam)},
    )


def _biases(
    known: Estimate,
    written: Estimate,
    held: NDArray[np.bool_],
    sensors: Mapping[str, DepthSensor],
    names: Sequence[str],
) -> dict[str, DepthBias]:
    """What is written of every camera that tells.

    The truth is known by an estimate that has leans; the numbers written are best without them. Their mean square
    error is that estimate's covariance and the square of the difference.
    """
    assert known.covariance is not None, "fuse has told"
    biases: dict[str, DepthBias] = {}
    for c, name in enumerate(names):
        if not held[c].all():
            mine = slice(len(known.twist) + 2 * c, len(known.twist) + 2 * c + 2)
            apart = written.bias[c] - known.bias[c]
            biases[name] = bias_of(
                sensors[name], written.bias[c], known.covariance[mine, mine] + np.outer(apart, apart)
            )
    return biases


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
