"""The marker map's scale against depth: true maps pass, wrong ones are measured, and one camera cannot outvote many."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from target_views import sight

from aruco.depth_patches import MAX_FRAMES, spread_frames
from aruco.marker_geometry import Face
from aruco.model import SILENT, BadFrame, Camera, Detection, Frame, Recording
from aruco.pose_math import Array, Pose, invert_transform, make_pose
from aruco.rig_estimate import Placement, RigEstimate
from rigcal.config import CalibrateConfig, DetectConfig
from rigcal.depth_scale import (
    CAMERA_SIGMA,
    CameraRatio,
    DepthScale,
    agreed,
    depth_scale,
    scale_from_depth,
)
from rigcal.evidence import Evidence, look
from rigcal.kept import NOTHING_KEPT
from rigcal.placing import place_cameras
from rigcal.quality.gates import GATES, Quality
from rigcal.sim import Simulation, simulate
from rigcal.sim.noise import DepthNoise
from rigcal.solve.joint import adjust_rig
from rigcal.sources import open_recordings
from rigcal.target import Target, marker_target, marker_target_from_file
from rigcal.validation import validate
from rigcal.verdict import SCALE_REMARK, quality_of

# The bias of one simulated camera at 2 m of f B = 46 px m is 0.3 percent and 0.15 px * 2 / 46 = 0.65 percent, of the
# mean of four half as much: one percent is nearly three sigma.
SCALE_TOLERANCE = 0.01
# The same for one camera, three sigma.
CAMERA_TOLERANCE = 0.025

ChangeFrame = Callable[[Frame], Frame | BadFrame]


@dataclass(eq=False)
class Changed:
    """A recording whose frames or cameras are changed on the way; counts what is read."""

    recording: Recording
    change: ChangeFrame = lambda frame: frame
    told: Mapping[str, Camera] = field(default_factory=dict)
    reads: int = 0

    @property
    def cameras(self) -> tuple[Camera, ...]:
        return tuple(self.told.get(camera.name, camera) for camera in self.recording.cameras)

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        return self.recording.stamps_ns(camera)

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        return self.recording.depth_indices(camera)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame | BadFrame]:
        for frame in self.recording.frames(camera, indices, depth=depth):
            self.reads += 1
            yield frame if isinstance(frame, BadFrame) else self.change(frame)


@dataclass(frozen=True, kw_only=True)
class Known:
    """A rig known exactly, and what its cameras saw."""

    recording: Recording
    rig: RigEstimate
    detections: Mapping[str, Mapping[int, Detection]]
    geometry: Mapping[int, Array]

    def scale(self) -> DepthScale:
        found = self.scale_or_none()
        assert found is not None
        return found

    def scale_or_none(self) -> DepthScale | None:
        images = {name: {frame: frame for frame in seen} for name, seen in self.detections.items()}
        return depth_scale(self.recording, self.rig, self.detections, images, self.geometry)

    def with_map(self, factor: float) -> Known:
        """As any solver finds it with a map that is too large by a factor: everything is, and no pixel moves."""
        cameras = {n: replace(p, T_world_cam=enlarged(p.T_world_cam, factor)) for n, p in self.rig.cameras.items()}
        target = {f: enlarged(T, factor) for f, T in self.rig.T_world_target.items()}
        rig = replace(self.rig, cameras=cameras, T_world_target=target)
        return replace(self, rig=rig, geometry={marker: factor * c for marker, c in self.geometry.items()})

    def changed(self, change: ChangeFrame) -> Known:
        return replace(self, recording=Changed(self.recording, change))


def enlarged(T: Pose, factor: float) -> Pose:
    return make_pose(T[:3, :3], factor * T[:3, 3])


def known(simulation: Simulation) -> Known:
    """The truth, and corners as exact as a good detector's."""
    geometry = {marker: c for face in simulation.faces for marker, c in zip(face.ids, face.corners)}
    targets, rng = dict(enumerate(simulation.T_world_target)), np.random.default_rng(0)
    detections: dict[str, dict[int, Detection]] = {}
    for camera in simulation.recording.cameras:
        T_cam_world = invert_transform(simulation.T_world_cam[camera.name])
        detections[camera.name] = {f: sight(camera, T_cam_world @ T, geometry, 0.05, rng) for f, T in targets.items()}
    placed = {
        name: Placement(
            T_world_cam=T, spread_rad=0.0, spread_m=0.0, frames=tuple(targets), n_views=len(targets), n_ambiguous=0
        )
        for name, T in simulation.T_world_cam.items()
    }
    rig = RigEstimate(cameras=placed, lost={}, T_world_target=targets)
    return Known(recording=simulation.recording, rig=rig, detections=detections, geometry=geometry)


@pytest.fixture(scope="module")
def simulated() -> Simulation:
    return simulate("demo", seed=3)


@pytest.fixture(scope="module")
def demo_known(simulated: Simulation) -> Known:
    return known(simulated)


def scaled_depth(camera: str, factor: float) -> ChangeFrame:
    def change(frame: Frame) -> Frame:
        if frame.depth_m is None or frame.camera != camera:
            return frame
        return replace(frame, depth_m=np.float32(factor) * frame.depth_m)

    return change


# --- simulated rigs -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1.0, 1.05, 0.9])
def test_the_factor_of_a_wrong_map_is_found(demo_known: Known, factor: float) -> None:
    found = demo_known.with_map(factor).scale()
    assert found.scale == pytest.approx(1 / factor - 1, abs=SCALE_TOLERANCE)
    assert found.odd == ()
    assert found.cameras.keys() == demo_known.rig.cameras.keys()
    assert all(c.ratio == pytest.approx(1 / factor, abs=CAMERA_TOLERANCE) for c in found.cameras.values())
    # At four cameras the floor of the standard error; a true map is never that far off.
    assert CAMERA_SIGMA / 2 <= found.sigma < 0.01


@pytest.mark.parametrize("name", ["box-static", "corner-static"])
def test_other_targets_and_larger_images(name: str) -> None:
    found = known(simulate(name, seed=1, n_frames=2)).scale()
    assert abs(found.scale) < SCALE_TOLERANCE
    assert found.odd == ()


def test_unbiased_depth_is_right_to_a_thousandth() -> None:
    # Noise of 0.12 px, over hundreds of pixels and nine samples, leaves 1e-4; 1e-3 would be a fault of geometry.
    found = known(simulate("demo", seed=2, depth_bias=False)).scale()
    assert found.scale == pytest.approx(0.0, abs=1e-3)


def test_distorted_images_beside_rectified_depth() -> None:
    simulation = simulate("demo", seed=4, distortion=True, depth_bias=False)
    assert all(camera.has_distortion for camera in simulation.recording.cameras)
    assert known(simulation).scale().scale == pytest.approx(0.0, abs=1e-3)


def test_grown_edges_do_not_disturb_but_a_plain_mean_over_the_marker_does() -> None:
    noise = DepthNoise(grown_px=9)
    truth = known(simulate("demo", seed=5, depth_bias=False, depth_noise=noise))
    assert truth.scale().scale == pytest.approx(0.0, abs=1e-3)
    # The naive way: the mean depth in the upright rectangle around a marker against the depth of its middle.
    misses: list[float] = []
    for camera in truth.recording.cameras:
        (frame,) = truth.recording.frames(camera.name, [0], depth=True)
        T_cam_target = invert_transform(truth.rig.cameras[camera.name].T_world_cam) @ truth.rig.T_world_target[0]
        assert isinstance(frame, Frame)
        assert frame.depth_m is not None
        seen = truth.detections[camera.name][0]
        for marker, quad in zip(seen.ids.tolist(), seen.corners_px):
            (left, top), (right, bottom) = quad.min(axis=0).astype(int), quad.max(axis=0).astype(int) + 1
            middle = T_cam_target[:3, :3] @ truth.geometry[marker].mean(axis=0) + T_cam_target[:3, 3]
            misses.append(float(np.nanmean(frame.depth_m[top:bottom, left:right]) / middle[2] - 1))
    assert max(map(abs, misses)) > 5 * SCALE_TOLERANCE


@pytest.mark.parametrize("factor", [10.0, 0.1, 1.12])
def test_a_camera_of_another_depth_scale_is_named_and_not_believed(demo_known: Known, factor: float) -> None:
    name = demo_known.recording.cameras[1].name
    found = demo_known.changed(scaled_depth(name, factor)).scale()
    assert found.odd == (name,)
    assert abs(found.scale) < SCALE_TOLERANCE
    # The plain mean over all cameras misses the tolerance.
    assert abs(np.mean([c.ratio for c in found.cameras.values()]) - 1) > SCALE_TOLERANCE


def test_what_a_camera_does_not_trust_is_not_asked(demo_known: Known) -> None:
    def spoil(frame: Frame, confidence: int) -> Frame:
        assert frame.depth_m is not None
        depth_m, doubt = frame.depth_m.copy(), np.zeros(frame.depth_m.shape, dtype=np.uint8)
        for k in (0, 1, 2):
            depth_m[k::5] *= np.float32(1.04)
            doubt[k::5] = confidence
        return replace(frame, depth_m=depth_m, confidence=doubt)

    found = demo_known.changed(lambda frame: spoil(frame, 100)).scale()
    assert abs(found.scale) < SCALE_TOLERANCE
    # It bites: where the camera says nothing of them, they are the majority.
    assert demo_known.changed(lambda frame: spoil(frame, 0)).scale().scale > 2 * SCALE_TOLERANCE


def test_something_before_a_fifth_of_a_marker_does_not_disturb(demo_known: Known) -> None:
    def hide(frame: Frame) -> Frame:
        assert frame.depth_m is not None
        covered = frame.depth_m.copy()
        covered[::10], covered[1::10] = 0.8, 0.8
        return replace(frame, depth_m=covered)

    # The median of the rest becomes its 37th percentile, a third of a sigma of 0.3 to 0.6 percent.
    assert abs(demo_known.changed(hide).scale().scale) < SCALE_TOLERANCE


def test_a_mixture_of_surfaces_tells_nothing(demo_known: Known) -> None:
    def mixed(frame: Frame) -> Frame:
        assert frame.depth_m is not None
        return replace(frame, depth_m=frame.depth_m * np.where(np.arange(frame.depth_m.shape[1]) % 2, 1.0, 0.7))

    assert demo_known.changed(mixed).scale_or_none() is None


def test_depth_of_other_intrinsics(demo_known: Known) -> None:
    K = {c.name: np.array([[0.6, 0, 5.0], [0, 0.55, -3.0], [0, 0, 1.0]]) @ c.K for c in demo_known.recording.cameras}
    cameras = {c.name: replace(c, depth_K=K[c.name]) for c in demo_known.recording.cameras}

    def resampled(frame: Frame) -> Frame:
        assert frame.depth_m is not None
        rows, columns = np.mgrid[:250, :380]
        u, v = np.rint((columns - 5.0) / 0.6).astype(int), np.rint((rows + 3.0) / 0.55).astype(int)
        inside = (u >= 0) & (u < frame.depth_m.shape[1]) & (v >= 0) & (v < frame.depth_m.shape[0])
        depth = frame.depth_m[v.clip(0, frame.depth_m.shape[0] - 1), u.clip(0, frame.depth_m.shape[1] - 1)]
        return replace(frame, depth_m=np.where(inside, depth, np.float32(np.nan)))

    told = replace(demo_known, recording=Changed(demo_known.recording, resampled, cameras))
    untold = replace(demo_known, recording=Changed(demo_known.recording, resampled))
    plain, found, wrong = demo_known.scale(), told.scale(), untold.scale_or_none()
    # Rounding to the nearest pixel moves single samples, not their median.
    assert found.scale == pytest.approx(plain.scale, abs=2e-3)
    assert wrong is None or not abs(wrong.scale) < SCALE_TOLERANCE


# --- too little -----------------------------------------------------------------------------------------------------


def test_without_depth_there_is_no_answer_and_no_frame_is_read() -> None:
    truth = known(simulate("demo", seed=3, depth=False, n_frames=8))
    recording = Changed(truth.recording)
    assert replace(truth, recording=recording).scale_or_none() is None
    assert recording.reads == 0


def test_cameras_without_depth_and_frames_that_cannot_be_read_are_left_out(demo_known: Known) -> None:
    without, bad = (camera.name for camera in demo_known.recording.cameras[:2])

    def change(frame: Frame) -> Frame | BadFrame:
        if frame.camera == without:
            return replace(frame, depth_m=None)
        first = demo_known.recording.stamps_ns(bad)[0]
        return BadFrame(bad, frame.stamp_ns, "torn") if frame.camera == bad and frame.stamp_ns == first else frame

    whole, found = demo_known.scale(), demo_known.changed(change).scale()
    assert found.cameras.keys() == whole.cameras.keys() - {without}
    assert found.cameras[bad].n_samples == whole.cameras[bad].n_samples * 2 // 3  # two frames of three
    assert abs(found.scale) < SCALE_TOLERANCE


@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0, np.inf])
def test_depth_of_nothing_says_nothing(demo_known: Known, value: float) -> None:
    def empty(frame: Frame) -> Frame:
        assert frame.depth_m is not None
        return replace(frame, depth_m=np.full_like(frame.depth_m, value))

    assert demo_known.changed(empty).scale_or_none() is None


def test_few_frames_are_read_those_with_most_markers() -> None:
    n_markers = dict.fromkeys(range(0, 200, 2), 1) | {30: 3, 90: 2, 198: 4}
    chosen = spread_frames(n_markers)
    assert len(chosen) == MAX_FRAMES
    assert {30, 90, 198} <= set(chosen)
    assert spread_frames({7: 2, 3: 1}) == [3, 7]
    assert spread_frames({}) == []


# --- what cameras agree on ------------------------------------------------------------------------------------------


def voted(*ratios: float) -> DepthScale:
    return agreed({name: CameraRatio(ratio=r, spread=0.001, n_samples=9) for name, r in zip("abcdef", ratios)})


def test_one_camera_is_known_to_its_bias_and_several_better() -> None:
    alone, four = voted(1.03), voted(1.03, 1.03, 1.03, 1.03)
    assert (alone.scale, alone.sigma) == (pytest.approx(0.03), CAMERA_SIGMA)
    assert (four.scale, four.sigma) == (pytest.approx(0.03), CAMERA_SIGMA / 2)
    # Cameras that differ are trusted less: 2 percent between two are 1 percent of their mean.
    assert voted(1.0, 1.02).sigma == pytest.approx(0.01, rel=0.02)


def test_the_map_decides_between_two_and_nobody_between_two_strangers() -> None:
    assert voted(1.0, 10.0).odd == voted(1.01, 1.12).odd == ("b",)
    stranger = voted(0.9, 1.12)
    assert math.isnan(stranger.scale)
    assert stranger.odd == ("a", "b")
    # But two that agree win against one that fits the map.
    assert voted(1.1, 1.0, 1.11).odd == ("b",)


# --- the verdict ----------------------------------------------------------------------------------------------------


def calibrated(recording: Recording, target: Target, config: CalibrateConfig) -> tuple[Evidence, DepthScale, Quality]:
    """What a calibration with this map comes to."""
    evidence = look(recording, target, config, jobs=2, progress=SILENT)
    average, moving = place_cameras(evidence, NOTHING_KEPT)[0], config.target_moves
    joint = adjust_rig(average, evidence.cameras, evidence.detections, target.geometry, moving=moving)
    found = scale_from_depth(evidence, joint.rig)
    assert found is not None
    validation = validate(average, joint, evidence.cameras, evidence.detections, target.geometry, moving=moving)
    return evidence, found, quality_of(validation, depth_scale=found)


def with_map(simulation: Simulation, factor: float) -> Target:
    faces = [Face(name=f.name, ids=f.ids, corners=factor * f.corners) for f in simulation.faces]
    return marker_target(faces, simulation.dictionary)


def about_scale(quality: Quality) -> tuple[str, float]:
    """What is said of the scale, and the number."""
    said = " ".join(r for r in quality.reasons if "marker map" in r and ("epth" in r or r == SCALE_REMARK))
    return said, next(c.value for c in quality.checks if c.name == "scale against depth")


def test_a_right_map_is_confirmed_instead_of_doubted(simulated: Simulation) -> None:
    evidence, found, quality = calibrated(simulated.recording, with_map(simulated, 1.0), CalibrateConfig())
    said, percent = about_scale(quality)
    assert abs(found.scale) < SCALE_TOLERANCE
    assert SCALE_REMARK not in quality.reasons
    assert said.startswith("Depth agrees with the scale of the marker map within ")
    assert percent == pytest.approx(100 * abs(found.scale))
    # Stretches of rest are not numbered like frames.
    resting = replace(evidence, config=replace(evidence.config, still=True, moving_target=True))
    rig = place_cameras(evidence, NOTHING_KEPT)[0]
    assert scale_from_depth(resting, rig) is None


@pytest.mark.parametrize(("factor", "way"), [(1.06, "smaller"), (0.9, "larger")])
def test_a_wrong_map_is_bad_and_only_depth_says_so(simulated: Simulation, factor: float, way: str) -> None:
    _, found, quality = calibrated(simulated.recording, with_map(simulated, factor), CalibrateConfig())
    said, _ = about_scale(quality)
    assert found.scale == pytest.approx(1 / factor - 1, abs=0.015)  # the bias, and poses of a small static rig
    assert quality.verdict == "bad"
    assert f"percent {way} than the marker map makes it: measure the side of one printed marker" in said
    assert SCALE_REMARK not in quality.reasons
    blind = {c.name for c in quality.checks if GATES[c.name].exceeded(c.value, GATES[c.name].bad)}
    assert blind == {"scale against depth"}


def test_a_camera_of_another_depth_scale_is_told_by_name(simulated: Simulation) -> None:
    name = simulated.recording.cameras[2].name
    recording = Changed(simulated.recording, scaled_depth(name, 10.0))
    _, _, quality = calibrated(recording, with_map(simulated, 1.0), CalibrateConfig())
    (said,) = (r for r in quality.reasons if "depth_scale" in r)
    assert f"camera {name} +" in said
    assert not any(other.name in said for other in simulated.recording.cameras if other.name != name)
    assert any(r.startswith("Depth agrees") for r in quality.reasons)
    assert quality.verdict != "bad"


def test_a_real_recording_confirms_its_map(cube3_b: Path) -> None:
    target = marker_target_from_file(cube3_b / "markers.parquet", "DICT_4X4_50")
    config = CalibrateConfig(detect=DetectConfig(dictionary="DICT_4X4_50"), moving_target=True)
    _, found, quality = calibrated(open_recordings([cube3_b / "recording"]), target, config)
    # 22 mm markers at 0.35 m: found 0.0 +- 0.6 percent, single cameras -1.1, +0.5 and +0.5.
    assert abs(found.scale) < 0.015
    assert found.odd == ()
    assert all(abs(c.ratio - 1) < 0.02 and c.n_samples >= 5 for c in found.cameras.values())
    assert any(r.startswith("Depth agrees with the scale") for r in quality.reasons)
