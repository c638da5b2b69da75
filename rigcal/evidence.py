"""What the cameras saw, before anything is made of it.

Owns      choosing frames, looking at them, stretches of rest, looking again with another marker map.
Leaves    what it means to pipeline.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from aruco.errors import CalibrationError
from aruco.model import Camera, Detection, Progress, Recording
from aruco.pose_math import Array
from aruco.still import merge_stretches, still_stretches
from aruco.view_pose import View, solve_view, variance_factor
from rigcal.config import CalibrateConfig
from rigcal.detecting import OnFrame, Seen, watch
from rigcal.frames import Moments, each_alone, synchronised
from rigcal.target import Target

if TYPE_CHECKING:
    from aruco.depth_save import CameraDepth


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """A recording, the target in it, and what every camera saw of it."""

    recording: Recording
    target: Target
    config: CalibrateConfig
    moments: Moments
    seen: Mapping[str, Seen]
    pooled: Mapping[str, CameraDepth] = field(default_factory=dict)  # camera -> its depth over time, if it was read

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """All cameras of the recording."""
        return self.recording.cameras

    @property
    def detections(self) -> dict[str, Mapping[int, Detection]]:
        """Camera -> frame -> markers."""
        return {name: s.detections for name, s in self.seen.items()}

    @property
    def views(self) -> list[View]:
        """All views of all cameras."""
        return [view for s in self.seen.values() for view in s.views]

    @property
    def scale2(self) -> dict[str, float]:
        """Camera -> factor on its corners' variances, from the residuals of all its views."""
        return {name: variance_factor(s.views) for name, s in self.seen.items() if s.views}

    def with_target(self, target: Target) -> Evidence:
        """The same corners on another map of the target."""
        models = {camera.name: camera for camera in self.cameras}
        least = self.config.detect.min_markers
        seen = {n: _viewed(s, models[n], s.detections, target.geometry, least) for n, s in self.seen.items()}
        return replace(self, target=target, seen=seen)


def look(
    recording: Recording,
    target: Target,
    config: CalibrateConfig,
    *,
    jobs: int,
    progress: Progress,
    on_frame: OnFrame | None = None,
) -> Evidence:
    """Search the chosen frames of a recording for the target; see pipeline.calibrate for the arguments.

    Raises:
        InputError: Cameras have no common clock.
    """
    moments = (each_alone if config.still else synchronised)(recording, config.frames)
    seen = watch(
        recording,
        moments,
        target,
        min_markers=config.detect.min_markers,
        jobs=jobs,
        progress=progress,
        on_frame=on_frame,
    )
    return Evidence(recording=recording, target=target, config=config, moments=moments, seen=seen)


def at_rest(evidence: Evidence) -> Evidence:
    """The stretches in which the target rests in the place of single frames.

    Raises:
        CalibrationError: It never rests.
    """
    recording, moments = evidence.recording, evidence.moments
    tracks = {
        name: [(moments.stamp_ns(recording, name, f), detection) for f, detection in sorted(s.detections.items())]
        for name, s in evidence.seen.items()
    }
    stretches = still_stretches(tracks)
    if not stretches:
        raise CalibrationError(
            "The target never rests for 0.3 s while a camera sees it: put it down for a moment wherever two cameras "
            "see it, or leave out --still."
        )
    merged = merge_stretches(tracks, stretches)
    models = {camera.name: camera for camera in evidence.cameras}
    geometry = evidence.target.geometry
    least = evidence.config.detect.min_markers
    seen = {n: _viewed(s, models[n], merged[n], geometry, least) for n, s in evidence.seen.items()}
    return replace(evidence, seen=seen)


def _viewed(
    seen: Seen, camera: Camera, detections: Mapping[int, Detection], geometry: Mapping[int, Array], min_markers: int
) -> Seen:
    views = [
        solve_view(camera, number, detection, geometry)
        for number, detection in detections.items()
        if len(detection) >= min_markers
    ]
    return replace(seen, detections=detections, views=tuple(view for view in views if view is not None))
