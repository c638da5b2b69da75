"""The floor under a rig: find it in all cameras' depth, level the world on it, and correct each camera by it.

Owns      refine_ground_from_depth, its configuration and its metrics; the names that users import.
Leaves    planes in points to floor_plane, what one camera sees to floor_view, which plane is the floor to
          floor_consensus, weighing floors against poses to floor_fusion, motions and bounds to floor_correction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from loguru import logger

from aruco.errors import InputError
from aruco.floor_checks import check_floor, check_not_mirrored, check_not_upside_down
from aruco.floor_consensus import Consensus, choose_floor, offset_of
from aruco.floor_correction import (
    MAX_ROTATION_DEG,
    MAX_TRANSLATION_M,
    FloorCorrection,
    compute_floor_correction,
    target_height,
)
from aruco.floor_doubts import FloorDoubts, floor_doubts
from aruco.floor_levelling import Bounds, Levelling, level_world, of_one_height
from aruco.floor_plane import (
    UP,
    FloorPlane,
    Mat44,
    PointsNC,
    Vec3,
    detect_floor_plane,
    unproject_depth_to_points,
)
from aruco.floor_view import FloorSamples, SeenPlane, floor_samples, level_planes
from aruco.pose_math import Array, Pose, checked_pose, rotation_angle, transform_points

__all__ = [
    "FloorCorrection",
    "FloorPlane",
    "GroundPlaneConfig",
    "GroundPlaneMetrics",
    "Mat44",
    "PointsNC",
    "Vec3",
    "compute_floor_correction",
    "detect_floor_plane",
    "refine_ground_from_depth",
    "unproject_depth_to_points",
]

# Whatever is larger is a slip of the hand or another unit: no pose is that far off, no floor that far away or thick.
MOST = {"max_rotation_deg": 90.0, "max_translation_m": 10.0, "ransac_threshold_m": 1.0}
MOST_FLOOR_Y_M = 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GroundPlaneConfig:
    """How the floor is searched and how far cameras may be moved."""

    max_rotation_deg: float = MAX_ROTATION_DEG  # of one camera beyond the common motion
    max_translation_m: float = MAX_TRANSLATION_M
    ransac_threshold_m: float | None = None  # how far from a plane a point belongs to it; None: by the depth's noise
    height_range: tuple[float, float] | None = None  # of the floor along up in the given world, lowest and highest [m]
    stride: int = 4  # every so many rows and columns of the depth
    target_floor_y: float = 0.0
    seed: int = 0
    up: tuple[float, float, float] = UP  # (0, 1, 0) or (0, -1, 0)

    def __post_init__(self) -> None:
        """Refuse numbers that no floor can be searched with."""
        for name, most in MOST.items():
            value = getattr(self, name)
            if value is not None and not 0 < value <= most:
                raise InputError(f"{name} must be above 0 and at most {most:g}, got {value}.")
        if self.stride < 1 or self.seed < 0 or not abs(self.target_floor_y) <= MOST_FLOOR_Y_M:
            raise InputError(
                f"want a stride from 1, a seed from 0 and a target_floor_y within {MOST_FLOOR_Y_M:g} m of 0, got "
                f"{self.stride}, {self.seed} and {self.target_floor_y}."
            )
        if self.height_range is not None and not self.height_range[0] < self.height_range[1]:
            raise InputError(f"height_range wants the lower height first, got {self.height_range}.")
        if tuple(float(x) for x in self.up) not in ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0)):
            raise InputError(f"up must be (0, 1, 0) or (0, -1, 0), got {self.up}; run --auto-align first.")

    @property
    def bounds(self) -> Bounds:
        """What the levelling needs of it."""
        return Bounds(
            max_rotation_deg=self.max_rotation_deg,
            max_translation_m=self.max_translation_m,
            target_floor_y=self.target_floor_y,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GroundPlaneMetrics:
    """What was found and done."""

    success: bool
    message: str
    camera_planes: dict[str, FloorPlane] = field(default_factory=dict)  # in the returned world, measured again
    floor_before: FloorPlane | None = None  # the common floor in the given world
    T_level_world: Mat44 = field(default_factory=lambda: np.eye(4))  # the common motion
    corrections: dict[str, FloorCorrection] = field(default_factory=dict)  # of every camera that sees the floor
    without_floor: dict[str, str] = field(default_factory=dict)  # camera -> why; these get the common motion only
    covariances: dict[str, Array] = field(default_factory=dict)  # camera -> (6, 6) of the returned pose
    floor_covariance: Array | None = None  # (3, 3) of (turn about x, about z, rise) that all of these share; see Fusion
    pose_scales: dict[str, float] = field(default_factory=dict)  # camera -> factor on its pose's sigmas, by evidence
    bias_scale: float = 1.0  # on the sigmas of all cameras' bias
    doubts: FloorDoubts = field(default_factory=FloorDoubts)  # cameras whose pose the floor contradicts


def refine_ground_from_depth(
    camera_data: Mapping[str, Mapping[str, Any]],
    extrinsics: Mapping[str, Pose],
    config: GroundPlaneConfig = GroundPlaneConfig(),
    *,
    covariances: Mapping[str, Array] | None = None,
    target_points: Array | None = None,
) -> tuple[dict[str, Pose], GroundPlaneMetrics]:
    """Level the world on the floor that the cameras see, and correct each camera's pitch, roll and height by it.

    First one common tilt and rise brings the common floor to ``config.target_floor_y``. Then each camera is turned
    about a level axis through its centre and raised; that is weighed between what its depth knows (noise, and what
    bias may do) and what its pose knows.

    Args:
        camera_data: Camera -> ``depth`` (h, w) [m] and ``K`` (3, 3); optional ``confidence`` (h, w), ``baseline`` [m],
            ``n_frames`` that were pooled, ``bias`` (a DepthBias, which is taken out).
        extrinsics: Camera -> T_world_cam in an upright world.
        config: See GroundPlaneConfig.
        covariances: Camera -> (6, 6) of its pose, left perturbation (rotation, translation) in world axes. Cameras
            without one get a default, scaled by how much the cameras' floors disagree.
        target_points: (n, 3) points of the calibration target in the given world, which cannot all lie under the floor.

    Returns:
        The poses of all of ``extrinsics``, and what was done. Where no camera sees a floor: the poses as they were,
        and metrics without success.

    Raises:
        InputError: Depth, intrinsics or poses cannot be used.
        CalibrationError: Floor, cameras and target contradict each other.
    """
    up = np.array(config.up, dtype=np.float64)
    poses = {name: _checked_rigid(name, T) for name, T in extrinsics.items()}
    views = _views(camera_data, poses, config, up)
    consensus = choose_floor({name: view.planes for name, view in views.items()}, poses, up)
    if consensus is None:
        check_not_upside_down({name: view.samples for name, view in views.items()}, poses, up, config.seed)
        return poses, GroundPlaneMetrics(
            success=False,
            message=f"No camera sees a level surface below itself{_range_note(config)}; the poses are as they were.",
            without_floor={name: _why_not(name, views, None) for name in sorted(poses)},
        )
    check_not_mirrored({name: view.planes for name, view in views.items()}, consensus, poses, up)
    check_floor(consensus.floor, poses, up, target_points)
    consensus = of_one_height(consensus, poses, covariances or {}, config.bounds, up)
    levelling = level_world(consensus, poses, covariances or {}, config.bounds, up)
    check_floor(levelling.floor, poses, up, target_points)
    consensus = replace(consensus, floor=levelling.floor)
    logger.debug("floor: {} cameras, pose scales {}", len(consensus.planes), levelling.scales)
    corrections = {name: _with_residuals(name, levelling, views[name], consensus, config) for name in levelling.moves}
    return levelling.T_world_cam, GroundPlaneMetrics(
        success=True,
        message=_message(levelling, len(poses), up),
        camera_planes={name: p.in_world(levelling.T_world_cam[name]) for name, p in consensus.planes.items()},
        floor_before=levelling.floor,
        T_level_world=levelling.T_level_world,
        corrections=corrections,
        without_floor={n: _why_not(n, views, consensus) for n in sorted(poses) if n not in consensus.planes},
        covariances=levelling.covariances,
        floor_covariance=levelling.floor_covariance,
        pose_scales=levelling.scales,
        bias_scale=levelling.bias_scale,
        doubts=floor_doubts(corrections, levelling.scales, (covariances or {}).keys()),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _View:
    """What one camera sees."""

    T_world_cam: Pose
    samples: FloorSamples
    planes: list[SeenPlane]


def _checked_rigid(name: str, T: Any) -> Pose:
    try:
        return checked_pose(T, f"camera {name}")
    except ValueError as error:
        raise InputError(f"{error}; repair its pose or leave the camera out.") from None


def _views(
    camera_data: Mapping[str, Mapping[str, Any]], poses: Mapping[str, Pose], config: GroundPlaneConfig, up: Array
) -> dict[str, _View]:
    views: dict[str, _View] = {}
    for k, name in enumerate(sorted(poses.keys() & camera_data.keys())):
        T = poses[name]
        samples = floor_samples(name, camera_data[name], config.stride)
        planes = level_planes(
            samples,
            T[:3, :3].T @ up,
            threshold_m=config.ransac_threshold_m,
            rng=np.random.default_rng([config.seed, k]),
            height_range=config.height_range,
            centre_height_m=float(T[:3, 3] @ up),
        )
        logger.debug("camera {}: {} samples, {} level planes", name, len(samples.inverse), len(planes))
        views[name] = _View(T_world_cam=T, samples=samples, planes=planes)
    return views


def _why_not(name: str, views: Mapping[str, _View], consensus: Consensus | None) -> str:
    """Why a camera has no part in the floor."""
    if name not in views:
        return "there is no depth of it"
    planes = views[name].planes
    if not planes or consensus is None:
        return "it sees no level surface below itself"
    T = views[name].T_world_cam
    tilt, rise = min((offset_of(consensus.floor, plane, T) for plane in planes), key=lambda offset: abs(offset[1]))
    return (
        f"of the level surfaces it sees the nearest to the others' floor is {abs(rise):.2f} m "
        f"{'above' if rise > 0 else 'below'} that and {math.degrees(tilt):.1f} degrees off"
    )


def _range_note(config: GroundPlaneConfig) -> str:
    if config.height_range is None:
        return ""
    return f" between {config.height_range[0]:g} and {config.height_range[1]:g} m"


def _with_residuals(
    name: str, levelling: Levelling, view: _View, consensus: Consensus, config: GroundPlaneConfig
) -> FloorCorrection:
    """A correction, and what it did to its camera's floor."""
    plane, up = consensus.planes[name], np.array(config.up, dtype=np.float64)
    height = target_height(config.target_floor_y, up)
    floor = FloorPlane(up, -height)
    T_after = levelling.T_world_cam[name]
    T_before = np.linalg.inv(levelling.moves[name].T_world_new_old) @ T_after
    points = view.samples.points[plane.inliers]
    (tilt_before, rise_before), (tilt_after, rise_after) = (offset_of(floor, plane, T) for T in (T_before, T_after))
    rms = [float(np.sqrt(np.mean(floor.distances(transform_points(T, points)) ** 2))) for T in (T_before, T_after)]
    return replace(
        levelling.moves[name],
        plane_before=plane.in_world(T_before),
        plane_after=plane.in_world(T_after),
        rms_before_m=rms[0],
        rms_after_m=rms[1],
        tilt_before_deg=math.degrees(tilt_before),
        tilt_after_deg=math.degrees(tilt_after),
        height_before_m=rise_before,
        height_after_m=rise_after,
    )


def _message(levelling: Levelling, n_cameras: int, up: Array) -> str:
    common = levelling.T_level_world
    accepted = [move for move in levelling.moves.values() if move.accepted]
    rejected = len(levelling.moves) - len(accepted)
    raised_m = float(common[:3, 3] @ up)
    parts = [
        f"{len(levelling.moves)} of {n_cameras} cameras see the floor",
        f"the world was turned by {math.degrees(rotation_angle(common[:3, :3])):.2f} degrees and "
        f"{'raised' if raised_m >= 0 else 'lowered'} by {1e3 * abs(raised_m):.0f} mm",
    ]
    if accepted:
        turn, rise = max(m.rotation_deg for m in accepted), max(abs(m.translation_m) for m in accepted)
        parts.append(f"single cameras by up to {turn:.2f} degrees and {1e3 * rise:.1f} mm")
    if rejected:
        parts.append(f"{rejected} rejected as too large")
    return "; ".join(parts) + "."
