"""A rig on its floor: what was found, and what is derived from it for the file, the terminal and the page.

Owns      the result of levelling; who was levelled on a floor of its own, and who was not.
Leaves    the order of the steps to levelling and icp_refining, layouts to levelled_file, ground_note and icp_note,
          drawing to the room report.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from aruco.depth_bias import DepthBias
from aruco.depth_mask import mask_edges
from aruco.depth_noise import DepthNoise
from aruco.ground_plane import GroundPlaneConfig, GroundPlaneMetrics
from aruco.pose_math import Array, Pose
from rigcal.ground_doubts import GroundDoubts, ground_doubts
from rigcal.ground_note import DepthFile, facts_of, ground_note
from rigcal.icp_note import Registration, icp_note, registered_content
from rigcal.levelled_file import RigFile, levelled_content
from rigcal.report.floor_views import FloorFigures, FloorView, floor_figures, floor_view
from rigcal.report.icp_views import CloudView, cloud_view


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Levelling:
    """A rig on its floor, and how it came there."""

    given: RigFile
    depth_file: DepthFile
    data: Mapping[str, Mapping[str, Any]]  # camera -> its depth, as ground_plane takes it
    config: GroundPlaneConfig
    T_world_cam: Mapping[str, Pose]  # on the floor
    metrics: GroundPlaneMetrics
    registration: Registration | None = None  # of its clouds; None: not asked for

    @property
    def partial(self) -> dict[str, str]:
        """Cameras that were moved with the whole rig only, or not at all, and why."""
        why = {name: reason for name, reason in self.metrics.without_floor.items() if name in self.data}
        unseen = self.given.T_world_cam.keys() - self.data.keys()
        why |= dict.fromkeys(unseen, "it has no depth in the store, or an image without any measurement")
        why |= {name: c.reason for name, c in self.metrics.corrections.items() if not c.accepted}
        why |= dict.fromkeys(self.given.apart, "it stands in a world of its own (_meta.parts), which stays as it was")
        return dict(sorted(why.items()))

    @property
    def is_whole(self) -> bool:
        """Whether all was done that was asked for, to every camera by the floor that it sees itself and that agrees."""
        failed = self.registration is not None and not self.registration.metrics.success
        return not self.partial and not self.doubts.cameras and not failed

    @property
    def doubts(self) -> GroundDoubts:
        """What the floor contradicts."""
        return ground_doubts(self.metrics, self.given.covariance.keys())

    @property
    def up_y(self) -> int:
        """1 if the world's y axis points up, -1 if down."""
        return 1 if self.config.up[1] > 0 else -1

    @property
    def floor_y(self) -> float:
        """Where the floor is."""
        return self.config.target_floor_y

    @property
    def T_before_cam(self) -> dict[str, Pose]:
        """Every camera's pose as if the rig had only been moved as a whole."""
        return {name: self.metrics.T_level_world @ T for name, T in sorted(self.given.T_world_cam.items())}

    @property
    def covariance(self) -> dict[str, Array]:
        """(6, 6) of the new poses of cameras whose file had one."""
        return {name: self.metrics.covariances[name] for name in self.given.covariance}

    @property
    def note(self) -> dict[str, Any]:
        """The entry ``_meta.ground_refined``."""
        return ground_note(self.given, self.depth_file, self.metrics, self.partial, self.doubts, self.config)

    @property
    def icp_note(self) -> dict[str, Any] | None:
        """The entry ``_meta.icp_refined``; None where that was not asked for."""
        if self.registration is None:
            return None
        return icp_note(self.given, self.depth_file, self.registration)

    @property
    def content(self) -> dict[str, Any]:
        """The new extrinsics file."""
        corrected = [name for name, c in self.metrics.corrections.items() if c.accepted]
        found, note = self.registration, self.icp_note
        if found is None or note is None:
            return levelled_content(
                self.given, self.T_world_cam, self.covariance, self.note, self.doubts, corrected=corrected
            )
        covariance = found.covariance(self.covariance)
        content = levelled_content(
            self.given,
            found.T_world_cam,
            covariance,
            self.note,
            self.doubts,
            corrected=corrected,
            registered=found.moved,
        )
        return registered_content(content, found, note)

    @property
    def facts(self) -> tuple[str, ...]:
        """Sentences about the whole rig."""
        doubt = self.doubts.rig
        return *facts_of(self.metrics, self.config, self.given.depth_bias.keys()), *([doubt] if doubt else [])

    @property
    def figures(self) -> tuple[FloorFigures, ...]:
        """What is told of each camera."""
        seen, why, doubts = self.metrics.corrections, self.partial, self.doubts.cameras
        return tuple(
            floor_figures(
                name,
                T,
                self.T_world_cam[name],
                seen.get(name),
                reason=why.get(name, "" if name in self.doubts.shared else doubts.get(name, "")),
                up_y=self.up_y,
                doubtful=name in doubts,
            )
            for name, T in self.T_before_cam.items()
        )

    def views(self) -> tuple[FloorView, ...]:
        """What is drawn of each camera with depth: without bias, and without the wrong depth beside edges."""
        return tuple(self._view(name, T) for name, T in self.T_before_cam.items() if name in self.data)

    def clouds(self) -> tuple[CloudView, ...]:
        """What is drawn of each camera with depth before and after registration; nothing where there was none."""
        found = self.registration
        if found is None or not found.metrics.success:
            return ()
        return tuple(self._cloud(name, found) for name in sorted(self.data))

    def _cloud(self, camera: str, found: Registration) -> CloudView:
        trusted, old, new = self._trusted(camera), found.given_bias.get(camera), found.bias.get(camera)
        return cloud_view(
            camera,
            _without(old, trusted),
            _without(new, trusted),
            np.asarray(self.data[camera]["K"], dtype=np.float64),
            T_before_cam=found.T_start_cam[camera],
            T_after_cam=found.T_world_cam[camera],
        )

    def _view(self, camera: str, T_before_cam: Pose) -> FloorView:
        data = self.data[camera]
        focal_baseline = self._focal_baseline(camera)
        return floor_view(
            camera,
            _without(data.get("bias"), self._trusted(camera)),
            np.asarray(data["K"], dtype=np.float64),
            T_before_cam=T_before_cam,
            T_after_cam=self.T_world_cam[camera],
            floor=self.metrics.camera_planes.get(camera),
            sigma_m=lambda z: DepthNoise(focal_baseline=focal_baseline).averaged_sigma_m(z, data["n_frames"]),
        )

    def _trusted(self, camera: str) -> Array:
        """A camera's depth (H, W) [m] as it was measured, NaN beside edges."""
        depth, K = self.data[camera]["depth"], np.asarray(self.data[camera]["K"], dtype=np.float64)
        wrong = mask_edges(depth, focal_baseline=self._focal_baseline(camera), focal_px=float(K[0, 0]))
        return np.where(wrong, np.nan, depth)

    def _focal_baseline(self, camera: str) -> float | None:
        data = self.data[camera]
        return float(data["K"][0][0]) * data["baseline"] if data["baseline"] else None


def _without(bias: DepthBias | None, depth: Array) -> Array:
    return depth if bias is None else bias.corrected(depth)
