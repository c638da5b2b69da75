"""What registration of clouds is asked for, and what it answers.

Owns      ICPConfig, ICPResult, ICPMetrics and what these are made of.
Leaves    the work to the other icp modules; icp_registration is their front.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, field
from typing import Literal

from aruco.depth_bias import DepthBias
from aruco.errors import InputError
from aruco.pose_math import Array, Pose

Pair = tuple[str, str]  # of cameras, in their order: source and target
Method = Literal["point_to_plane", "gicp"]
Region = Literal["floor", "hybrid", "full"]
METHODS: tuple[Method, ...] = ("point_to_plane", "gicp")
REGIONS: tuple[Region, ...] = ("floor", "hybrid", "full")
# Why a camera keeps its pose, for whoever counts: the move is not proved, makes distances grow, is beyond the bounds,
# beyond what the given pose is known to, wants a depth that nobody believes, leaves clouds that do not fit, or a floor
# that is not level; no overlap leads to the reference; no cloud of it could be used; it is the reference.
Refusal = Literal[
    "", "unproved", "worse", "too_far", "prior", "depth", "misfit", "floor", "unlinked", "no_cloud", "reference"
]
# Whatever is larger is a slip of the hand or another unit.
MOST = {
    "voxel_size": 1.0,
    "band_height": 100.0,
    "min_fitness": 1.0,
    "min_overlap_area": 1e4,
    "overlap_margin": 100.0,
    "gravity_penalty_weight": 1e9,
    "max_correspondence_distance_factor": 100.0,
    "max_rotation_deg": 180.0,
    "max_translation_m": 100.0,
}
MAY_BE_ZERO = ("min_fitness", "min_overlap_area", "overlap_margin", "gravity_penalty_weight")
MOST_ITERATIONS = 10_000
VOXELS = (4, 2, 1)  # of the three scales that max_iterations is for


@dataclass(frozen=True, slots=True)
class ICPConfig:
    """How clouds are registered, and how far a camera may be moved by it."""

    voxel_size: float = 0.02  # [m] of the finest scale
    max_iterations: list[int] = field(default_factory=lambda: [50, 30, 14])  # at 4, 2 and 1 voxels
    method: Method = "point_to_plane"  # normals of the target; gicp: covariances of both surfaces, not Open3D's
    band_height: float = 0.3  # [m] above the floor that takes part
    min_fitness: float = 0.3  # of the points that could have met, those that did
    min_overlap_area: float = 1.0  # [m^2] on the floor; pairs with less are not looked at
    overlap_margin: float = 0.5  # [m]
    # For callers of apply_gravity_constraint; refine_with_icp does not read it and weighs tilt by covariances.
    gravity_penalty_weight: float = 10.0
    max_correspondence_distance_factor: float = 1.4  # times the voxel
    max_rotation_deg: float = 5.0  # of one camera, beyond the motion that the others have in common
    max_translation_m: float = 0.1  # likewise, of its centre
    _: KW_ONLY
    region: Region = "hybrid"  # floor: the band; hybrid: the band and what stands upright; full: everything
    depth_bias: bool = True  # tell each camera's depth bias; else it is only allowed for, as one more uncertainty
    global_init: bool = False  # look for cameras that were bumped, from features instead of the given pose
    stride: int = 4  # every so many rows and columns of the depth
    seed: int = 0
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)  # or (0, -1, 0)

    def __post_init__(self) -> None:
        """Refuse what cannot be registered with."""
        for name, most in MOST.items():
            value = getattr(self, name)
            least_is_in = name in MAY_BE_ZERO and value == 0
            if not (math.isfinite(value) and (least_is_in or 0 < value <= most)):
                raise InputError(f"ICP: {name} must be above 0 and at most {most:g}, got {value}.")
        its = self.max_iterations
        if len(its) != len(VOXELS) or not all(isinstance(n, int) and 0 < n <= MOST_ITERATIONS for n in its):
            raise InputError(f"ICP: max_iterations wants three numbers from 1 to {MOST_ITERATIONS}, got {its}.")
        if self.method not in METHODS or self.region not in REGIONS:
            raise InputError(
                f"ICP: method must be one of {', '.join(METHODS)} and region one of {', '.join(REGIONS)}, got "
                f"{self.method!r} and {self.region!r}."
            )
        if self.stride < 1 or self.seed < 0:
            raise InputError(f"ICP: want a stride from 1 and a seed from 0, got {self.stride} and {self.seed}.")
        if tuple(float(x) for x in self.up) not in ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0)):
            raise InputError(f"ICP: up must be (0, 1, 0) or (0, -1, 0), got {self.up}; run --auto-align first.")


@dataclass(frozen=True, slots=True, eq=False)
class ICPResult:
    """One pair of clouds."""

    transformation: Pose  # T_target_source
    fitness: float
    inlier_rmse: float  # [m]
    information_matrix: Array  # (6, 6) of a left perturbation (rotation, translation) of it, in the target's frame
    converged: bool
    _: KW_ONLY
    overlap_m2: float = math.nan
    # Of the source that met the target: of all that is left of voxels (pairwise_icp), or of every second sample, which
    # are those that refine_with_icp looks up.
    n_points: int = 0
    rotation_deg: float = 0.0  # how much the pair was turned against each other from where it stood
    translation_mm: float = 0.0
    unobservable: tuple[str, ...] = ()  # directions of which the pair says nothing, in words
    verdict: str = ""
    overlaps: bool = True  # else too little is shared, or no surface, and it was not looked at


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraMove:
    """What registration wanted of one camera, and whether it got it."""

    accepted: bool
    reason: str  # one sentence: why it moved or kept its pose
    rotation_deg: float = 0.0  # of the move, or of the one asked for and refused, against the reference camera
    translation_mm: float = 0.0  # of its centre
    held_out_before_mm: float = math.nan  # distance between clouds where it was not fitted: median of absolute values
    held_out_after_mm: float = math.nan
    # How significantly that of all cameras whose moves were proved together, this among them, shrank.
    gain_sigmas: float = math.nan
    prior_sigmas: float = math.nan  # how far the estimate is from the given pose, in its covariance
    unobservable: tuple[str, ...] = ()  # directions in which clouds say less than the given pose, in words
    refusal: Refusal = ""
    n_samples: int = 0  # of its depth that could be used


@dataclass(frozen=True, slots=True, eq=False)
class ICPMetrics:
    """What was tried and done."""

    success: bool = False  # it could run; so it did where every pose was kept
    num_pairs_attempted: int = 0
    num_pairs_converged: int = 0
    num_cameras_optimized: int = 0  # took part in the joint adjustment, the reference among them
    num_disconnected: int = 0
    per_pair_results: dict[Pair, ICPResult] = field(default_factory=dict)  # of all pairs of clouds
    reference_camera: str = ""
    message: str = ""
    _: KW_ONLY
    warnings: tuple[str, ...] = ()  # what wants to be done about the rig, a sentence each
    remarks: tuple[str, ...] = ()  # what is worth knowing of the whole rig
    cameras: dict[str, CameraMove] = field(default_factory=dict)
    covariances: dict[str, Array] = field(default_factory=dict)  # (6, 6) of the returned poses
    biases: dict[str, DepthBias] = field(default_factory=dict)  # estimated, with covariance, what was given included
    floor_tilt_deg: float = math.nan  # of the common floor in the returned world against the one before
    floor_rise_m: float = math.nan
    floor_sigmas: float = math.nan  # how significantly it lies otherwise than before
    settled: bool = True  # the estimate came to rest

    @property
    def moved(self) -> list[str]:
        """Cameras whose pose is a new one."""
        return sorted(name for name, move in self.cameras.items() if move.accepted)
