"""The rigs that can be simulated by name.

Owns      a rig's parameters and the named rigs.
Leaves    drawing places from them to placement, pictures to simulation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from aruco.errors import InputError
from rigcal.sim.noise import DepthNoise, ImageNoise

TargetKind = Literal["box", "corner", "board"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rig:
    """How many cameras of what kind stand how far from what target, and what they record."""

    name: str
    summary: str
    target: TargetKind = "box"
    dictionary: str = "DICT_APRILTAG_36h11"
    board: str = ""  # a target of kind board: its description (aruco.board)
    # A face of the target or a side of its body that lies on the floor.
    resting_face: str = "bottom"
    moving: bool = False  # the target is somewhere else in every frame
    n_cameras: int = 4
    n_frames: int = 3
    width: int = 1280
    height: int = 720
    focal_px: float = 700.0  # each camera's own differs by up to 1 %
    arc_deg: float = 360.0  # the part of a circle around the target on which the cameras stand
    distance_m: tuple[float, float] = (2.0, 3.0)  # from camera to target
    camera_height_m: tuple[float, float] = (1.0, 2.2)
    distortion: bool = False
    depth: bool = True
    baseline_m: float = 0.12
    # Standard deviations of the cameras' depth bias; both 0 for unbiased depth.
    bias_scale: float = 0.003
    bias_disparity_px: float = 0.15
    furniture: bool = True
    image_noise: ImageNoise = field(default_factory=ImageNoise)
    depth_noise: DepthNoise = field(default_factory=DepthNoise)

    def __post_init__(self) -> None:
        """Refuse numbers that no rig can have."""
        if self.n_cameras < 1 or self.n_frames < 1:
            raise InputError(
                f"rig {self.name}: needs at least one camera and one frame, got {self.n_cameras} and {self.n_frames}."
            )
        if min(self.width, self.height, self.focal_px, self.distance_m[0], self.baseline_m) <= 0:
            raise InputError(f"rig {self.name}: image size, focal length, distance and baseline must be positive.")


RIGS: dict[str, Rig] = {
    rig.name: rig
    for rig in (
        Rig(name="box-static", summary="a closed box on the floor, 4 cameras around it"),
        Rig(name="box-moved", summary="the box carried through the room, 4 cameras", moving=True, n_frames=16),
        Rig(
            name="corner-static",
            summary="an open corner of three printed sides on the floor, 4 cameras",
            target="corner",
            resting_face="b",
        ),
        Rig(
            name="board-moved",
            summary="a ChArUco board of 7 x 5 squares carried before 4 cameras on an arc",
            target="board",
            board="charuco:7x5:0.1:0.075:DICT_4X4_50",
            dictionary="DICT_4X4_50",
            moving=True,
            n_frames=25,
            arc_deg=160.0,
            distance_m=(1.8, 2.3),
            camera_height_m=(0.8, 1.9),
        ),
        Rig(
            name="demo",
            summary="a small quick rig: the box and 4 cameras of 640 x 480",
            width=640,
            height=480,
            focal_px=380.0,
            distance_m=(1.6, 2.2),
            camera_height_m=(1.0, 1.8),
        ),
        Rig(
            name="hd",
            summary="100 frames of 1920 x 1080 from 4 cameras, to measure speed",
            width=1920,
            height=1080,
            focal_px=1050.0,
            n_frames=100,
        ),
    )
}


def named_rig(name: str) -> Rig:
    """One of the rigs above.

    Raises:
        InputError: There is no rig of this name.
    """
    try:
        return RIGS[name]
    except KeyError:
        raise InputError(f"{name}: no such rig; known: {', '.join(RIGS)}.") from None
