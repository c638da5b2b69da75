"""A rig that was calibrated once and is recorded again, without images: what its cameras see, and the earlier file."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from joint_rigs import SimRig, box_rig, rich_box
from numpy.typing import NDArray
from target_views import any_pose, sight

from aruco.detector import MarkerDetector
from aruco.model import BadFrame, Calibration, Camera, Detection, Frame, FrameCounts
from aruco.pose_math import Pose, invert_transform, make_pose, pose_distance
from aruco.svo_sync import SyncResult
from aruco.view_pose import solve_view
from rigcal.config import CalibrateConfig
from rigcal.detecting import Seen
from rigcal.evidence import Evidence
from rigcal.frames import Moments
from rigcal.kept import KeptRig
from rigcal.solve.joint import adjust_rig
from rigcal.solve.problem import Poses
from rigcal.target import Target

SIGMA_PX = 0.05


@dataclass(frozen=True, slots=True)
class NoImages:
    """A Recording whose images were looked at already; one frame a second."""

    cameras: tuple[Camera, ...]
    n: int

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        return np.arange(self.n) * 1_000_000_000

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        return np.arange(0)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        yield from ()


def seen_by(rig: SimRig, **options: Any) -> Evidence:
    """What the pipeline gets of a rig's detections."""
    n = 1 + max(f for views in rig.detections.values() for f in views)
    groups = np.tile(np.arange(n)[:, None], (1, len(rig.cameras)))
    names = tuple(camera.name for camera in rig.cameras)
    sync = SyncResult(
        cameras=names, groups=groups, spans_ns=np.zeros(n, np.int64), tolerance_ns=1, unpaired={}, closest_ns=0
    )
    return Evidence(
        recording=NoImages(rig.cameras, n),
        target=Target(faces=(), geometry=rig.geometry, detector=MarkerDetector()),
        config=CalibrateConfig(**options),
        moments=Moments(sync=sync, groups=groups),
        seen={camera.name: _seen(camera, rig) for camera in rig.cameras},
    )


def _seen(camera: Camera, rig: SimRig) -> Seen:
    mine = rig.detections.get(camera.name, {})
    views = (solve_view(camera, f, d, rig.geometry) for f, d in mine.items())
    counts = FrameCounts(recorded=len(rig.frames), read=len(rig.frames), with_markers=len(mine))
    return Seen(
        views=tuple(v for v in views if v is not None), detections=mine, digests=(), stamps_ns=(), counts=counts
    )


def standing(seed: int, n_cam: int = 4) -> SimRig:
    """Cameras that stay where they are."""
    return box_rig(np.random.default_rng(seed), n_cam=n_cam, n_frame=2, geometry=rich_box())


def recorded(rig: SimRig, seed: int, n_frame: int = 12) -> SimRig:
    """The same cameras, the box carried through their middle again."""
    rng = np.random.default_rng([seed, 1])
    middle = rig.truth.T_world_target[:, :3, 3].mean(axis=0)
    targets = [make_pose(any_pose(rng)[:3, :3], middle + 0.2 * rng.standard_normal(3)) for _ in range(n_frame)]
    seen = {
        camera.name: {
            f: sight(camera, invert_transform(T) @ target, rig.geometry, SIGMA_PX, rng)
            for f, target in enumerate(targets)
        }
        for camera, T in zip(rig.cameras, rig.truth.T_world_cam)
    }
    return replace(
        rig,
        detections={name: {f: d for f, d in views.items() if len(d)} for name, views in seen.items()},
        truth=Poses(rig.truth.T_world_cam, np.array(targets)),
        frames=tuple(range(n_frame)),
    )


def at_rest(rig: SimRig, seed: int, n_frame: int = 8) -> SimRig:
    """The same cameras, the box in one place."""
    once = recorded(rig, seed, 1)
    rng = np.random.default_rng([seed, 2])
    detections = {
        name: {f: noisy(view, rng, SIGMA_PX) for f in range(n_frame)}
        for name, views in once.detections.items()
        for view in views.values()
    }
    return replace(once, detections=detections, frames=tuple(range(n_frame)))


def noisy(d: Detection, rng: np.random.Generator, sigma_px: float) -> Detection:
    corners = d.corners_px + sigma_px * rng.standard_normal(d.corners_px.shape)
    return Detection(ids=d.ids, corners_px=corners, sigma_px=d.sigma_px)


def earlier_file(rig: SimRig, names: Collection[str], seed: int) -> KeptRig:
    """An earlier calibration of some of the cameras, with its errors and its covariances."""
    rig = recorded(rig, seed + 1000)
    some = [k for k, camera in enumerate(rig.cameras) if camera.name in names]
    rig = replace(
        rig,
        cameras=tuple(rig.cameras[k] for k in some),
        detections={name: rig.detections[name] for name in names},
        truth=Poses(rig.truth.T_world_cam[some], rig.truth.T_world_target),
    )
    average = rig.estimate(rig.start(np.random.default_rng(seed), 1e-3))
    joint = adjust_rig(average, rig.cameras, rig.detections, rig.geometry, moving=True)
    return KeptRig(
        T_world_cam={name: p.T_world_cam for name, p in joint.rig.cameras.items()},
        meta={"covariance": {name: [float(x) for x in S.ravel()] for name, S in joint.covariance.items()}},
        covariance=joint.covariance,
        world={"up": [0, 1, 0], "origin": "floor"},
        file="old.json",
    )


def displaced(kept: KeptRig, name: str, shift_m: float) -> KeptRig:
    """The same file with one camera shifted along its own x axis."""
    T = np.array(kept.T_world_cam[name])
    T[:3, 3] += shift_m * T[:3, 0]
    return replace(kept, T_world_cam={**kept.T_world_cam, name: T}, entries={})


def off_m(calibration: Calibration, kept: KeptRig, rig: SimRig, new: str, reference: str) -> float:
    """How far a new camera is from its true place beside a kept one."""
    true: Mapping[str, Pose] = {camera.name: T for camera, T in zip(rig.cameras, rig.truth.T_world_cam)}
    found = invert_transform(kept.T_world_cam[reference]) @ calibration.T_world_cam[new]
    return pose_distance(found, invert_transform(true[reference]) @ true[new])[1]


def contradictions(calibration: Calibration) -> list[tuple[str, ...]]:
    """The cameras of every contradiction that the file tells of."""
    return [tuple(c["cameras"]) for c in calibration.notes["kept"]["contradictions"]]
