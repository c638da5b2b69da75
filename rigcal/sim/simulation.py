"""A simulated recording and the truth about it.

Owns      simulate, the Recording that renders its frames on demand, the truth as a document.
Leaves    writing either to disk to its caller.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aruco.board import board_face, board_text, parse_board
from aruco.errors import InputError
from aruco.marker_geometry import SHIPPED_MAPS, Face, load_faces
from aruco.model import Camera, Frame
from aruco.pose_math import Pose, pose_text, transform_points
from rigcal.sim.noise import (
    DepthBias,
    DepthNoise,
    ImageNoise,
    Purpose,
    expose,
    fixed_error,
    generator,
    grow_edges,
    measure_depth,
    sense,
)
from rigcal.sim.placement import arrange
from rigcal.sim.render import render_depth, render_image
from rigcal.sim.rigs import Rig, TargetKind, named_rig
from rigcal.sim.room import floor_panel, furniture_panels, wall_panels
from rigcal.sim.scene import Panel, Scene, Target, target_panels

_FIRST_STAMP_NS = 1_700_000_000_000_000_000
_PERIOD_NS = 33_333_333
_MAX_SKEW_NS = 3_000_000
# Kind -> file of the shipped map, and whether the body is closed.
_TARGETS: dict[TargetKind, tuple[str, bool]] = {
    "box": ("standard_box_markers.parquet", True),
    "corner": ("object_points.parquet", False),
}


class SimulatedRecording:
    """A Recording whose frames are rendered when asked for; each is the same whenever and wherever that happens."""

    def __init__(
        self,
        rig: Rig,
        seed: int,
        cameras: tuple[Camera, ...],
        T_world_cam: tuple[Pose, ...],
        target: Target,
        T_world_target: tuple[Pose, ...],
        room: tuple[Panel, ...],
        depth_bias: tuple[DepthBias, ...],
    ) -> None:
        self._rig = rig
        self._seed = seed
        self._cameras = cameras
        self._T_world_cam = T_world_cam
        self._target = target
        self._T_world_target = T_world_target
        self._room = room
        self._depth_bias = depth_bias
        self._index = {camera.name: k for k, camera in enumerate(cameras)}
        # What stays the same over time is rendered once: the pictures of a target that rests, and fixed errors.
        self._expected: dict[int, NDArray[np.float32]] = {}
        self._grown: dict[int, NDArray[np.float32]] = {}
        self._fixed: dict[int, NDArray[np.float32]] = {}

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The cameras, sorted by name."""
        return self._cameras

    def stamps_ns(self, camera: str) -> NDArray[np.int64]:
        """The sorted time stamps of a camera's frames; raises InputError for an unknown camera."""
        skew = generator(self._seed, Purpose.CLOCK, self._known(camera)).integers(0, _MAX_SKEW_NS)
        return _FIRST_STAMP_NS + _PERIOD_NS * np.arange(self._rig.n_frames, dtype=np.int64) + skew

    def depth_indices(self, camera: str) -> NDArray[np.int64]:
        """All frames, if the rig has depth."""
        return np.arange(len(self.stamps_ns(camera)) if self._rig.depth else 0)

    def frames(self, camera: str, indices: Sequence[int], *, depth: bool = False) -> Iterator[Frame]:
        """A camera's frames at ascending indices; with depth if asked for and the rig has it.

        Raises:
            InputError: The camera is unknown or an index is out of range.
        """
        k, stamps = self._known(camera), self.stamps_ns(camera)
        for index in indices:
            if not 0 <= index < len(stamps):
                raise InputError(f"camera {camera} has frames 0 to {len(stamps) - 1}, not {index}; choose one of them.")
            noise = generator(self._seed, Purpose.IMAGE, k, index)
            image = sense(self._expected_image(k, index), self._rig.image_noise, noise)
            yield Frame(
                camera=camera,
                stamp_ns=int(stamps[index]),
                image=image,
                digest=hashlib.sha256(image.tobytes()).hexdigest(),
                depth_m=self._depth(k, index) if depth and self._rig.depth else None,
            )

    def _known(self, camera: str) -> int:
        try:
            return self._index[camera]
        except KeyError:
            raise InputError(f"{camera}: no such camera; known: {', '.join(self._index)}.") from None

    def _scene(self, frame: int) -> Scene:
        return Scene(panels=(*self._room, *target_panels(self._target, self._T_world_target[frame])))

    def _expected_image(self, k: int, frame: int) -> NDArray[np.float32]:
        if k in self._expected:
            return self._expected[k]
        brightness = render_image(self._scene(frame), self._cameras[k], self._T_world_cam[k])
        expected = expose(brightness, self._rig.image_noise)
        if not self._rig.moving:
            self._expected[k] = expected
        return expected

    def _grown_depth(self, k: int, frame: int) -> NDArray[np.float32]:
        if k in self._grown:
            return self._grown[k]
        exact = render_depth(self._scene(frame), self._cameras[k], self._T_world_cam[k])
        grown = grow_edges(exact, self._rig.depth_noise, focal_baseline(self._cameras[k]))
        if not self._rig.moving:
            self._grown[k] = grown
        return grown

    def _depth(self, k: int, frame: int) -> NDArray[np.float32]:
        noise, camera = self._rig.depth_noise, self._cameras[k]
        if k not in self._fixed:
            rng = generator(self._seed, Purpose.FIXED_DEPTH, k)
            self._fixed[k] = fixed_error((camera.height, camera.width), noise, rng)
        rng = generator(self._seed, Purpose.DEPTH, k, frame)
        grown = self._grown_depth(k, frame)
        return measure_depth(grown, self._fixed[k], noise, self._depth_bias[k], focal_baseline(camera), rng)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Simulation:
    """A recording, and everything true about it."""

    rig: Rig
    seed: int
    recording: SimulatedRecording
    T_world_cam: dict[str, Pose]
    T_world_target: tuple[Pose, ...]  # one a frame
    target: Target
    depth_bias: dict[str, DepthBias]

    @property
    def faces(self) -> tuple[Face, ...]:
        """The target's faces and their markers, target frame."""
        return self.target.faces

    @property
    def dictionary(self) -> str:
        """The OpenCV name of the markers' dictionary."""
        return self.target.dictionary

    def truth_document(self) -> dict[str, Any]:
        """The truth in the layout of an extrinsics file."""
        biases: dict[str, dict[str, float]] = {}
        if self.rig.depth:
            for camera in self.recording.cameras:
                bias = self.depth_bias[camera.name]
                biases[camera.name] = {
                    "scale": bias.scale,
                    "disparity_px": bias.disparity_px,
                    "focal_baseline": focal_baseline(camera),
                }
        truth = {
            "rig": self.rig.name,
            "seed": self.seed,
            "dictionary": self.dictionary,
            **({} if self.target.board is None else {"board": board_text(self.target.board)}),
            "T_world_target": [pose_text(T) for T in self.T_world_target],
            "depth_bias": biases,
        }
        meta = {
            "format": "rigcal.extrinsics",
            "version": 1,
            "world": {"up": [0, 1, 0], "origin": "floor"},
            "truth": truth,
        }
        return {**{name: {"pose": pose_text(T)} for name, T in self.T_world_cam.items()}, "_meta": meta}


def focal_baseline(camera: Camera) -> float:
    """Focal length times baseline of a stereo camera [px m]; 0 for a camera that is none."""
    K = camera.K_depth
    return float(K[0, 0]) * (camera.baseline_m or 0.0)


def simulate(
    name: str,
    *,
    seed: int = 0,
    n_cameras: int | None = None,
    n_frames: int | None = None,
    resting_face: str | None = None,
    distortion: bool | None = None,
    depth: bool | None = None,
    depth_bias: bool = True,
    image_noise: ImageNoise | None = None,
    depth_noise: DepthNoise | None = None,
) -> Simulation:
    """Simulate one of the named rigs.

    Args:
        name: A name of rigs.RIGS.
        seed: Decides places, biases and noise; the same seed gives the same bytes.
        n_cameras: Instead of the rig's own number, like all that follow.
        n_frames: How many frames each camera records.
        resting_face: Which face or side of the target lies on the floor.
        distortion: Whether the lenses distort.
        depth: Whether the cameras measure depth.
        depth_bias: False makes the depth right on average.
        image_noise: The sensors.
        depth_noise: The stereo matchers.

    Raises:
        InputError: The rig or face is unknown, or a number is impossible.
    """
    given: Mapping[str, Any] = {
        "n_cameras": n_cameras,
        "n_frames": n_frames,
        "resting_face": resting_face,
        "distortion": distortion,
        "depth": depth,
        "image_noise": image_noise,
        "depth_noise": depth_noise,
        "bias_scale": None if depth_bias else 0.0,
        "bias_disparity_px": None if depth_bias else 0.0,
    }
    rig = replace(named_rig(name), **{key: value for key, value in given.items() if value is not None})
    return simulate_rig(rig, seed=seed)


def simulate_rig(rig: Rig, *, seed: int = 0) -> Simulation:
    """Simulate any rig; see simulate."""
    target = _target(rig)
    placed = arrange(rig, target, generator(seed, Purpose.PLACEMENT))
    room = [floor_panel(), *wall_panels()]
    if rig.furniture:
        centres = [T[:3, 3] for T in placed.T_world_cam]
        places = [transform_points(T, target.centre_m) for T in placed.T_world_target]
        room += furniture_panels(centres, places, generator(seed, Purpose.FURNITURE))
    biases = tuple(_draw_bias(rig, seed, k) for k in range(rig.n_cameras))
    names = [camera.name for camera in placed.cameras]
    recording = SimulatedRecording(
        rig, seed, placed.cameras, placed.T_world_cam, target, placed.T_world_target, tuple(room), biases
    )
    return Simulation(
        rig=rig,
        seed=seed,
        recording=recording,
        T_world_cam=dict(zip(names, placed.T_world_cam)),
        T_world_target=placed.T_world_target,
        target=target,
        depth_bias=dict(zip(names, biases)),
    )


def _target(rig: Rig) -> Target:
    if rig.target == "board":
        board = parse_board(rig.board)
        return Target(faces=(board_face(board),), dictionary=board.dictionary, closed=False, board=board)
    file, closed = _TARGETS[rig.target]
    return Target(faces=tuple(load_faces(SHIPPED_MAPS / file)), dictionary=rig.dictionary, closed=closed)


def _draw_bias(rig: Rig, seed: int, camera: int) -> DepthBias:
    scale, disparity_px = generator(seed, Purpose.BIAS, camera).standard_normal(2)
    return DepthBias(scale=float(scale * rig.bias_scale), disparity_px=float(disparity_px * rig.bias_disparity_px))
