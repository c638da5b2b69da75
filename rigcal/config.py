"""Every knob a user can turn, on one page.

Algorithms never see these classes: the stories in pipeline hand them plain arguments.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from aruco.errors import InputError
from aruco.model import UpAxis

MAX_BASELINE_M = 2.0  # no depth camera is wider; a number above it is in other units
MAX_TOLERANCE_MS = 3_600_000.0  # frames an hour apart are no moment


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameConfig:
    """Which frames take part."""

    sync_tolerance_ms: float | None = None  # None: half the slowest camera's frame period, at most 100 ms
    sample_interval: int = 1  # every Nth synchronised frame
    max_samples: int | None = None  # at most so many of these, spread over the recording

    def __post_init__(self) -> None:
        """Refuse a tolerance that is no time."""
        if self.sync_tolerance_ms is not None and not 0 <= self.sync_tolerance_ms < MAX_TOLERANCE_MS:
            raise InputError(
                f"--sync-tolerance-ms {self.sync_tolerance_ms:g}: want milliseconds from 0 to {MAX_TOLERANCE_MS:g}."
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectConfig:
    """How markers are found."""

    dictionary: str = "DICT_APRILTAG_36h11"
    min_markers: int = 1  # a view with fewer is left out


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignConfig:
    """Whether and how the world is turned upright."""

    enabled: bool = False
    ground_face: str | None = None
    ground_marker_id: int | None = None
    up_axis: UpAxis = "+y"
    up_from: Literal["target", "imu"] = "target"  # what tells up: how the target lies, or the cameras' accelerometers


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthConfig:
    """What the rig's own depth is asked."""

    save: bool = False  # pool it over time and hand it out
    verify: bool = False  # compare it with the target
    refine: bool = False  # estimate its bias, and let it correct poses, each where held-out data bear it out
    model: Literal["stereo", "offset"] = "stereo"  # of its bias
    baseline_m: float | None = None  # of stereo cameras whose recording does not say
    max_rotation_deg: float = 5.0  # if depth would move any camera farther, all poses stay
    max_translation_m: float = 0.1

    def __post_init__(self) -> None:
        """Refuse a correction of what was not looked at, and baselines that are none."""
        if self.refine and not self.verify:
            raise InputError("--refine-depth corrects what --verify-depth has looked at: give both.")
        if self.baseline_m is not None and not 0 < self.baseline_m <= MAX_BASELINE_M:
            raise InputError(
                f"--baseline {self.baseline_m:g}: want the distance of a camera's two eyes in metres, 0.12 for a ZED 2."
            )

    @property
    def needed(self) -> bool:
        """Whether any depth has to be read for it."""
        return self.save or self.verify


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrateConfig:
    """Everything that changes the result of a calibration; how it is computed stands beside it in Resources."""

    frames: FrameConfig = field(default_factory=FrameConfig)
    detect: DetectConfig = field(default_factory=DetectConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    moving_target: bool = False
    still: bool = False  # use the stretches in which the target rests instead of single frames
    joint: bool = True  # adjust all cameras and frames together after the average
    refine_target: bool = False  # estimate the places of the target's markers too
    seed: int = 0

    @property
    def target_moves(self) -> bool:
        """Whether the target has a pose of its own in every frame; in every stretch, where rests are used."""
        return self.moving_target or self.still

    def as_dict(self) -> dict[str, Any]:
        """Plain values for the provenance."""
        return asdict(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Resources:
    """What changes the time and memory of a run, never its result."""

    jobs: int = field(default_factory=lambda: os.cpu_count() or 1)
