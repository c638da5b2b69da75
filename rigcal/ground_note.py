"""What a levelled file says about its levelling under ``_meta.ground_refined``, and the same in words.

Owns      the layout of the entry, and where the depth came from; nothing in it depends on time or place.
Leaves    what is said of contradicted cameras to ground_doubts.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aruco.ground_plane import FloorCorrection, FloorPlane, GroundPlaneConfig, GroundPlaneMetrics
from aruco.pose_math import pose_text, rotation_angle
from rigcal import __version__
from rigcal.ground_doubts import GroundDoubts
from rigcal.levelled_file import RigFile

# What a file says of poses and views under its _meta, and levelling does not measure again.
OF_GIVEN_POSES = ("adjusted", "depth_refined", "depth_verified", "kept", "quality")

# What levelling promises of rough poses; floors that agree so well are not worth a word.
AGREES_DEG, AGREES_MM = 0.1, 4.0
BIAS_OF_FLOOR = (
    "The biases of depth were estimated with the floor's help; where that was in this depth, biases and floor share "
    "its errors, and the covariances count it twice."
)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthFile:
    """Where the depth came from."""

    name: str
    digest: str  # SHA-256 of its bytes


def depth_file(path: Path) -> DepthFile:
    """A file that was read, by its name and digest."""
    with path.open("rb") as stream:
        return DepthFile(name=path.name, digest=hashlib.file_digest(stream, "sha256").hexdigest())


def ground_note(
    given: RigFile,
    source: DepthFile,
    metrics: GroundPlaneMetrics,
    partial: Mapping[str, str],
    doubts: GroundDoubts,
    config: GroundPlaneConfig,
) -> dict[str, Any]:
    """The entry: the common motion, every camera's floor and correction, options and inputs."""
    return {
        "message": metrics.message,
        "common_motion": {
            "T_level_world": pose_text(metrics.T_level_world),
            "rotation_deg": _turn_deg(metrics.T_level_world),
            "raised_m": config.up[1] * float(metrics.T_level_world[1, 3]),
        },
        "floor_before": _plane(metrics.floor_before),
        "floor_covariance": None if metrics.floor_covariance is None else metrics.floor_covariance.ravel().tolist(),
        "contradicted": {"cameras": dict(doubts.cameras), "rig": doubts.rig},
        "pose_scales": {name: float(scale) for name, scale in sorted(metrics.pose_scales.items())},
        "bias_scale": float(metrics.bias_scale),
        "cameras": {
            name: _correction(c, metrics.camera_planes.get(name)) for name, c in sorted(metrics.corrections.items())
        },
        "without_correction": dict(partial),
        "remarks": [BIAS_OF_FLOOR] if given.is_depth_refined else [],
        "still_of_the_given_poses": [key for key in OF_GIVEN_POSES if key in given.meta],
        "up_is_assumed": given.up_is_assumed,
        "depth_bias_applied": sorted(given.depth_bias.keys() & metrics.camera_planes.keys()),
        "provenance": {
            "rigcal": __version__,
            "options": {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(config).items()},
            "inputs": {"extrinsics": given.name, "depth": source.name},
            "inputs_sha256": {"extrinsics": given.digest, "depth": source.digest},
        },
    }


def facts_of(
    metrics: GroundPlaneMetrics, config: GroundPlaneConfig, known_bias: Collection[str] = ()
) -> tuple[str, ...]:
    """Sentences about the whole rig; known_bias are cameras whose depth has no unknown bias."""
    way = "up, against gravity" if config.up[1] > 0 else "down, along gravity"
    world = f"World: the floor is y = {config.target_floor_y:g}; y points {way}."
    kept = {name: c for name, c in metrics.corrections.items() if c.is_kept}
    return metrics.message, world, *([_why_kept(kept, known_bias)] if kept else [])


def _why_kept(kept: Mapping[str, FloorCorrection], known_bias: Collection[str]) -> str:
    tilt_deg = max(c.tilt_before_deg for c in kept.values())
    height_mm = max(1e3 * abs(c.height_before_m) for c in kept.values())
    one, many = ("pose of camera", "is", "its floor"), ("poses of cameras", "are", "their floors")
    pose, verb, floor = many if len(kept) > 1 else one
    said = (
        f"Kept: the {pose} {', '.join(kept)} {verb} known better than {floor}, up to {tilt_deg:.2f} degrees and "
        f"{height_mm:.0f} mm off the common one"
    )
    if kept.keys() <= set(known_bias) or (tilt_deg <= AGREES_DEG and height_mm <= AGREES_MM):
        return f"{said}."
    return f"{said}; bias of depth can do that, and calibrate-extrinsics --refine-depth estimates it."


def _correction(correction: FloorCorrection, plane: FloorPlane | None) -> dict[str, Any]:
    """What one camera's floor was, and what was made of it; the motion is that in the levelled world."""
    return {
        "accepted": bool(correction.accepted),
        "reason": correction.reason,
        "T_world_new_old": pose_text(correction.T_world_new_old),
        "rotation_deg": _number(correction.rotation_deg),
        "translation_m": _number(correction.translation_m),
        "gain": _number(correction.gain),
        "inliers": None if plane is None else int(plane.n_inliers),
        "plane_before": _plane(correction.plane_before),
        "plane_after": _plane(plane or correction.plane_after),
        "residual_before_m": _number(correction.rms_before_m),
        "residual_after_m": _number(correction.rms_after_m),
        "tilt_before_deg": _number(correction.tilt_before_deg),
        "tilt_after_deg": _number(correction.tilt_after_deg),
        "height_before_m": _number(correction.height_before_m),
        "height_after_m": _number(correction.height_after_m),
    }


def _plane(plane: FloorPlane | None) -> dict[str, Any] | None:
    if plane is None:
        return None
    return {"normal": [float(x) for x in plane.normal], "d": float(plane.d), "rms_m": _number(plane.rms_m)}


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return float(value) if math.isfinite(value) else None


def _turn_deg(T: np.ndarray) -> float:
    return math.degrees(rotation_angle(T[:3, :3]))
