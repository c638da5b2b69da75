"""How the clouds of a levelled rig were registered, and what its file says of it under ``_meta.icp_refined``.

Owns      Registration, the layout of the entry; nothing in it depends on time or place.
Leaves    registering to aruco.icp_registration, when and with what to icp_refining.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from aruco.depth_bias import DepthBias
from aruco.icp_headline import is_elsewhere
from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics, ICPResult, Pair
from aruco.pose_math import Array, Pose, invert_transform, pose_text
from rigcal import __version__
from rigcal.ground_note import DepthFile
from rigcal.levelled_file import RigFile


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """What became of a levelled rig when its clouds were registered."""

    config: ICPConfig
    T_start_cam: Mapping[str, Pose]  # levelled
    T_world_cam: Mapping[str, Pose]  # the same where a camera was not moved
    metrics: ICPMetrics
    given_bias: Mapping[str, DepthBias] = field(default_factory=dict)  # that was taken out of the depth before

    @property
    def moved(self) -> list[str]:
        """Cameras whose pose is a new one."""
        return self.metrics.moved if self.metrics.success else []

    @property
    def new_bias(self) -> dict[str, DepthBias]:
        """The biases that go with the new poses: of the cameras that were moved, and of those they were moved against.

        Where a pose was refused, the bias estimated beside it was refused with it; and a reference of a part of the rig
        in which nobody moved has stood beside refused poses only.
        """
        moved = set(self.moved)
        stood = {name for name, move in self.metrics.cameras.items() if move.refusal == "reference"}
        stood.add(self.metrics.reference_camera)
        goes = moved | (stood & _linked(moved, self.metrics.per_pair_results))
        return {name: bias for name, bias in sorted(self.metrics.biases.items()) if name in goes}

    @property
    def bias(self) -> dict[str, DepthBias]:
        """Every camera's bias as it is known now."""
        return {**self.given_bias, **self.new_bias}

    @property
    def fact(self) -> str:
        """What became of it, in a sentence that says so if nothing did."""
        said = self.metrics.message.rstrip(".")
        if self.metrics.success:
            return f"ICP refinement: {said}."
        return f"ICP refinement failed: {said}. Using ground-plane-only extrinsics."

    def covariance(self, levelled: Mapping[str, Array]) -> dict[str, Array]:
        """(6, 6) of the poses of the cameras that had one: of clouds where they were moved, else as they were."""
        new = {name: S for name, S in self.metrics.covariances.items() if name in self.moved}
        return {name: new.get(name, S) for name, S in levelled.items()}


def registered_content(
    content: Mapping[str, Any], registration: Registration, note: Mapping[str, Any]
) -> dict[str, Any]:
    """The content of a levelled file with what its clouds have told beyond poses and covariances."""
    meta = {**content["_meta"], "icp_refined": dict(note)}
    if isinstance(meta.get("quality"), dict):
        meta["quality"] = _judged(meta["quality"], registration)
    known = meta.get("depth_bias")
    new = {name: bias.as_dict() for name, bias in registration.new_bias.items()}
    if new:
        meta["depth_bias"] = {**(known if isinstance(known, dict) else {}), **new}
    return {**content, "_meta": meta}


def _judged(quality: Mapping[str, Any], registration: Registration) -> dict[str, Any]:
    """``_meta.quality``, which cannot be good while clouds place a camera elsewhere than its pose."""
    metrics = registration.metrics
    elsewhere = [name for name, move in metrics.cameras.items() if is_elsewhere(move, registration.config)]
    if not (metrics.success and elsewhere):
        return dict(quality)
    told = quality.get("reasons", [])
    reason = f"The cloud of {', '.join(elsewhere)} contradicts the given pose; see icp_refined.warnings."
    before = {"verdict_before_icp": quality["verdict"]} if "verdict" in quality else {}
    return {**quality, **before, "verdict": "bad", "reasons": [reason, *(told if isinstance(told, list) else [])]}


def icp_note(given: RigFile, source: DepthFile, registration: Registration) -> dict[str, Any]:
    """The entry: what was tried, every camera and every pair, biases before and after, options and inputs."""
    metrics = registration.metrics
    cameras = sorted(metrics.cameras.items())
    return {
        "success": bool(metrics.success),
        "message": metrics.message,
        "warnings": list(metrics.warnings),
        "remarks": list(metrics.remarks),
        "settled": bool(metrics.settled),
        "reference": metrics.reference_camera,
        "moved": registration.moved,
        "pairs_attempted": metrics.num_pairs_attempted,
        "pairs_converged": metrics.num_pairs_converged,
        "cameras_optimized": metrics.num_cameras_optimized,
        "cameras_disconnected": metrics.num_disconnected,
        "cameras": {name: _camera(move, _motion(registration, name)) for name, move in cameras},
        "pairs": [_pair(a, b, result) for (a, b), result in sorted(metrics.per_pair_results.items())],
        "depth_bias": {name: _bias(registration, name) for name in sorted(metrics.biases)},
        "covariance": {name: _numbers(S) for name, S in sorted(metrics.covariances.items())},
        "floor": {
            "tilt_deg": _number(metrics.floor_tilt_deg),
            "rise_m": _number(metrics.floor_rise_m),
            "sigmas": _number(metrics.floor_sigmas),
        },
        "provenance": {
            "rigcal": __version__,
            "options": {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(registration.config).items()},
            "inputs": {"extrinsics": given.name, "depth": source.name},
            "inputs_sha256": {"extrinsics": given.digest, "depth": source.digest},
        },
    }


def _linked(cameras: Collection[str], results: Mapping[Pair, ICPResult]) -> set[str]:
    """These cameras, and those that lead to them over pairs that meet."""
    meet = [{*pair} for pair, result in results.items() if result.converged]
    found = set(cameras)
    while new := set().union(*(pair for pair in meet if pair & found)) - found:
        found |= new
    return found


def _motion(registration: Registration, name: str) -> Pose:
    """The left motion of a camera in the levelled world."""
    if name not in registration.moved:
        return np.eye(4)
    return registration.T_world_cam[name] @ invert_transform(registration.T_start_cam[name])


def _camera(move: CameraMove, T_world_new_old: Pose) -> dict[str, Any]:
    return {
        "accepted": bool(move.accepted),
        "reason": move.reason,
        "refusal": move.refusal or None,
        "n_samples": int(move.n_samples),
        "T_world_new_old": pose_text(T_world_new_old),
        "rotation_deg": _number(move.rotation_deg),
        "translation_mm": _number(move.translation_mm),
        "held_out_before_mm": _number(move.held_out_before_mm),
        "held_out_after_mm": _number(move.held_out_after_mm),
        "gain_sigmas": _number(move.gain_sigmas),
        "prior_sigmas": _number(move.prior_sigmas),
        "unobservable": list(move.unobservable),
    }


def _pair(source: str, target: str, result: ICPResult) -> dict[str, Any]:
    return {
        "source": source,
        "target": target,
        "overlaps": bool(result.overlaps),
        "converged": bool(result.converged),
        "verdict": result.verdict,
        "overlap_m2": _number(result.overlap_m2),
        "n_points": int(result.n_points),
        "fitness": _number(result.fitness),
        "rmse_mm": _number(1e3 * result.inlier_rmse),
        "rotation_deg": _number(result.rotation_deg),
        "translation_mm": _number(result.translation_mm),
        "unobservable": list(result.unobservable),
        "T_target_source": pose_text(result.transformation),
        "information": _numbers(result.information_matrix),
    }


def _bias(registration: Registration, name: str) -> dict[str, Any]:
    before = registration.given_bias.get(name)
    return {
        "before": None if before is None else before.as_dict(),
        "after": registration.metrics.biases[name].as_dict(),
        "written": name in registration.new_bias,
    }


def _numbers(matrix: Array) -> list[float | None]:
    return [_number(x) for x in np.asarray(matrix, dtype=np.float64).ravel()]


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return float(value) if math.isfinite(value) else None
