"""What depth measures on markers: where it is looked for, from which frames, and what is left out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from depth_boards import CAMERA, MARKER, plane_depth, pose
from loguru import logger
from numpy.typing import NDArray
from target_views import sight

from aruco.board import board_geometry, parse_board
from aruco.depth_patches import MARGIN_PX, WHOLE_BOARD, FaceDepth, Patch, face_depth, patches, spread_frames
from aruco.depth_save import CameraDepth
from aruco.depth_verify import verify_depth
from aruco.model import SILENT, BadFrame, Camera, Detection, Frame, Recording
from aruco.pose_math import Array, invert_transform, make_pose
from aruco.rig_estimate import RigEstimate
from rigcal.config import CalibrateConfig, DepthConfig
from rigcal.depth_samples import MAX_FRAMES_MOVED, depth_cameras, face_depths
from rigcal.evidence import Evidence, look
from rigcal.kept import NOTHING_KEPT
from rigcal.placing import place_cameras
from rigcal.sim import RIGS, Simulation, simulate, simulate_rig
from rigcal.target import marker_target

# --- where in an image ----------------------------------------------------------------------------------------------


def patch_of(T_cam_target: Array) -> Patch:
    (patch,) = patches(CAMERA, sight(CAMERA, T_cam_target, MARKER, 0.0, np.random.default_rng(0)), MARKER)
    return patch


def test_samples_lie_well_inside_and_are_predicted_pixel_by_pixel() -> None:
    T = pose((0.0, 0.0, 1.6), tilt_deg=45.0)
    patch, plane = patch_of(T), plane_depth(T)
    face = face_depth(patch, plane, camera="a", frame=3)
    assert face is not None
    np.testing.assert_allclose(face.measured_m, face.predicted_m(T, CAMERA.K), rtol=1e-6)
    assert np.ptp(face.measured_m) > 0.2
    assert (face.camera, face.frame, face.marker, face.n_averaged) == ("a", 3, 0, 1)
    np.testing.assert_allclose(face.corners_target @ face.normal_target, face.offset_m, atol=1e-12)
    # The corners: half a pixel of rounding on a print that gains 4 mm a pixel.
    np.testing.assert_allclose(face.corner_depth_m, face.predicted_corners_m(T), atol=4e-3)
    # Nothing of what lies nearer to the outline than the margin was looked at.
    x0, y0 = np.floor(patch.outline_px.min(axis=0) + MARGIN_PX).astype(int)
    outside = np.full_like(plane, np.nan)
    outside[:y0], outside[:, :x0] = 1.0, 1.0
    assert face_depth(patch, outside, camera="a", frame=0) is None


def test_another_pose_predicts_another_depth() -> None:
    T = pose((0.0, 0.0, 2.0))
    face = face_depth(patch_of(T), plane_depth(T), camera="a", frame=0)
    assert face is not None
    nearer = make_pose(np.eye(3), np.array([0.0, 0.0, -0.1])) @ T
    # Along its rays, a plane at 1.9 m instead of 2 m is nearer by a twentieth.
    np.testing.assert_allclose(face.predicted_m(nearer, CAMERA.K) / face.measured_m, 0.95, atol=1e-6)
    behind = make_pose(np.eye(3), np.array([0.0, 0.0, -4.0])) @ T
    assert np.isnan(face.predicted_m(behind, CAMERA.K)).all()


def test_beside_a_corner_holes_borders_and_edges_are_no_depth() -> None:
    T = pose((0.0, 0.0, 1.5))
    patch, depth = patch_of(T), plane_depth(T)
    (u0, v0), (u1, _), (u2, v2), (u3, v3) = np.rint(patch.corners_px).astype(int)
    depth[v0 - 3 : v0 + 4, u0 - 3 : u0 + 2] = np.nan  # five columns of seven
    depth[:, u1:] = 3.0  # half of the window behind the marker
    depth[v2 - 3, u2 - 3] = 0.0
    found = face_depth(patch, depth, camera="a", frame=0)
    assert found is not None
    assert np.isnan(found.corner_depth_m[[0, 1]]).all()
    assert found.corner_depth_m[3] == pytest.approx(depth[v3, u3], abs=2e-3)
    outside = replace(patch, corners_px=patch.corners_px - [u0, 0])
    cut = face_depth(outside, depth, camera="a", frame=0)
    assert cut is not None
    assert np.isnan(cut.corner_depth_m[0])


def test_untrusted_pixels_are_marked_and_not_beside_corners() -> None:
    T = pose((0.0, 0.0, 1.5))
    confidence = np.zeros((480, 640), dtype=np.uint8)
    confidence[:, 320:] = 100
    face = face_depth(patch_of(T), plane_depth(T), camera="a", frame=0, confidence=confidence)
    assert face is not None
    np.testing.assert_array_equal(face.trusted, face.pixels[:, 0] < 320)
    assert np.isfinite(face.corner_depth_m).sum() == 2


def test_a_board_is_one_surface() -> None:
    geometry = board_geometry(parse_board("charuco:7x5:0.1:0.075:DICT_4X4_50"))
    T = pose((-0.35, -0.25, 1.5), tilt_deg=20.0)
    seen = board_sight(geometry, T)
    (patch,) = patches(CAMERA, seen, geometry)
    face = face_depth(patch, plane_depth(T), camera="a", frame=0)
    assert face is not None
    assert face.marker == WHOLE_BOARD
    assert len(face.corner_depth_m) == len(geometry)
    np.testing.assert_allclose(face.measured_m, face.predicted_m(T, CAMERA.K), rtol=1e-6)


def board_sight(geometry: Mapping[int, Array], T_cam_target: Array) -> Detection:
    points = np.array([geometry[i] for i in sorted(geometry)])[:, 0] @ T_cam_target[:3, :3].T + T_cam_target[:3, 3]
    pixels = points[:, :2] / points[:, 2:] * 400.0 + [320, 240]
    n = len(points)
    return Detection(ids=np.array(sorted(geometry)), corners_px=pixels[:, None], sigma_px=np.full((n, 1), 0.1))


def test_spread_frames_may_be_more() -> None:
    assert len(spread_frames(dict.fromkeys(range(100), 1), at_most=MAX_FRAMES_MOVED)) == MAX_FRAMES_MOVED


# --- from which frames ----------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Watched:
    """A recording that notes which depth was read, and may withhold it."""

    recording: Recording
    blind: str = ""
    read: list[tuple[str, int]] = field(default_factory=list)

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return self.recording.cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        return self.recording.stamps_ns(camera)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        return np.empty(0, np.int64) if camera == self.blind else self.recording.depth_indices(camera)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        for index, frame in zip(indices, self.recording.frames(camera, indices, depth=depth)):
            if depth:
                self.read.append((camera, index))
            if isinstance(frame, Frame) and camera == self.blind:
                frame = replace(frame, depth_m=None)
            yield frame


def seen(simulation: Simulation, config: CalibrateConfig, blind: str = "") -> tuple[Evidence, RigEstimate]:
    """What the cameras saw, and the rig placed with the poses that are true in its world."""
    target = marker_target(simulation.faces, simulation.dictionary)
    evidence = look(Watched(simulation.recording, blind), target, config, jobs=2, progress=SILENT)
    rig = place_cameras(evidence, NOTHING_KEPT)[0]
    T_new_world = rig.T_world_target[rig.world_frame] @ invert_transform(simulation.T_world_target[rig.world_frame])
    placed = {n: replace(p, T_world_cam=T_new_world @ simulation.T_world_cam[n]) for n, p in rig.cameras.items()}
    targets = {f: T_new_world @ simulation.T_world_target[f] for f in rig.T_world_target}
    return evidence, replace(rig, cameras=placed, T_world_target=targets)


@pytest.fixture(scope="module")
def resting() -> tuple[Evidence, RigEstimate]:
    return seen(simulate("demo", seed=3, depth_bias=False), CalibrateConfig())


@pytest.fixture(scope="module")
def moved() -> tuple[Evidence, RigEstimate]:
    rig = replace(RIGS["demo"], moving=True, n_frames=4, n_cameras=2, bias_scale=0.0, bias_disparity_px=0.0)
    return seen(simulate_rig(rig, seed=2), CalibrateConfig(moving_target=True))


def worst_share(evidence: Evidence, rig: RigEstimate, faces: Mapping[str, Sequence[FaceDepth]]) -> float:
    found = verify_depth(faces, rig, depth_cameras(evidence))
    return max(abs(agreement.faces.median_share) for agreement in found.values())


def test_a_resting_target_is_measured_once_in_pooled_depth(resting: tuple[Evidence, RigEstimate]) -> None:
    evidence, rig = resting
    faces = face_depths(evidence, rig)
    assert faces.keys() == rig.cameras.keys()
    for name, measured in faces.items():
        assert {face.frame for face in measured} == {rig.world_frame}
        assert {face.n_averaged for face in measured} == {3}
        markers = {int(i) for d in evidence.detections[name].values() for i in d.ids}
        assert {face.marker for face in measured} <= markers
        assert len(measured) == len({face.marker for face in measured})
    # Unbiased depth of three frames: noise that is shared over 28 pixels leaves 0.1 percent.
    assert worst_share(evidence, rig, faces) < 2e-3


def test_depth_that_was_pooled_before_is_used_and_nothing_read(resting: tuple[Evidence, RigEstimate]) -> None:
    evidence, rig = resting
    first, second = sorted(rig.cameras)[:2]
    camera = next(c for c in evidence.cameras if c.name == first)
    depth = np.full((camera.height, camera.width), 1.25, dtype=np.float32)
    pooled = {first: CameraDepth(depth=depth, K=camera.K, n_frames=40)}
    assert isinstance(evidence.recording, Watched)
    before = len(evidence.recording.read)
    faces = face_depths(evidence, rig, pooled)
    assert len(evidence.recording.read) == before
    assert faces.keys() == {first}
    assert second not in faces
    assert all((face.measured_m == 1.25).all() and face.n_averaged == 40 for face in faces[first])
    counted = {first: replace(pooled[first], count=np.full(depth.shape, 7, dtype=np.uint16))}
    assert all(face.n_averaged == 7 for face in face_depths(evidence, rig, counted)[first])


def test_a_moved_target_is_measured_frame_by_frame(moved: tuple[Evidence, RigEstimate]) -> None:
    evidence, rig = moved
    faces = face_depths(evidence, rig, {})
    for name, measured in faces.items():
        frames = {face.frame for face in measured}
        assert len(frames) > 2
        assert frames <= set(rig.cameras[name].frames)
        assert all(face.n_averaged == 1 for face in measured)
    # Single frames of unbiased depth, several markers each.
    assert worst_share(evidence, rig, faces) < 3e-3
    # It bites: with the target of another frame it is nowhere near.
    first, *_, last = sorted(rig.T_world_target)
    wrong = replace(rig, T_world_target={**rig.T_world_target, last: rig.T_world_target[first]})
    found = verify_depth(faces, wrong, depth_cameras(evidence))
    assert max(float(np.abs(a.faces.errors_m / a.faces.predicted_m).max()) for a in found.values()) > 0.05


def test_cameras_without_depth_or_pose_measure_nothing(resting: tuple[Evidence, RigEstimate]) -> None:
    evidence, rig = resting
    blind, lost = sorted(rig.cameras)[:2]
    assert isinstance(evidence.recording, Watched)
    without = replace(evidence, recording=Watched(evidence.recording.recording, blind))
    fewer = replace(rig, cameras={n: p for n, p in rig.cameras.items() if n != lost})
    assert face_depths(without, fewer).keys() == rig.cameras.keys() - {blind, lost}


def test_stretches_of_rest_have_no_depth_and_it_is_said(resting: tuple[Evidence, RigEstimate]) -> None:
    evidence, rig = resting
    lines: list[str] = []
    sink = logger.add(lambda message: lines.append(str(message)), level="WARNING", format="{message}")
    try:
        assert face_depths(replace(evidence, config=replace(evidence.config, still=True)), rig) == {}
        assert len(lines) == 1
        assert "--verify-depth has nothing to compare with --still" in lines[0]
        face_depths(evidence, rig)
    finally:
        logger.remove(sink)
    assert len(lines) == 1


def test_noise_goes_by_the_baseline_that_is_known(resting: tuple[Evidence, RigEstimate]) -> None:
    evidence, _ = resting
    assert isinstance(evidence.recording, Watched)
    known = depth_cameras(evidence)
    for camera in evidence.cameras:
        assert camera.baseline_m is not None
        assert known[camera.name].noise.focal_baseline == pytest.approx(camera.K[0, 0] * camera.baseline_m)
        np.testing.assert_array_equal(known[camera.name].K, camera.K)

    @dataclass(eq=False)
    class Untold(Watched):
        @property
        def cameras(self) -> tuple[Camera, ...]:
            K = np.array([[200.0, 0, 99], [0, 200, 60], [0, 0, 1]])
            return tuple(replace(camera, baseline_m=None, depth_K=K) for camera in self.recording.cameras)

    untold = replace(evidence, recording=Untold(evidence.recording.recording))
    assert all(c.noise.focal_baseline is None and c.K[0, 0] == 200 for c in depth_cameras(untold).values())
    told = replace(untold, config=replace(untold.config, depth=DepthConfig(baseline_m=0.1)))
    assert all(c.noise.focal_baseline == pytest.approx(20.0) for c in depth_cameras(told).values())
