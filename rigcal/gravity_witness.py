"""What the cameras' accelerometers say about the world's up.

Owns      asking the recording, comparing its answer with an upright world, the sentences about it.
Leaves    the agreement of cameras to aruco.gravity, turning the world to finishing, limits to rigcal.quality.gates.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from loguru import logger

from aruco.errors import CalibrationError, InputError
from aruco.gravity import UpByAccelerometers, angle_deg, up_by_accelerometers
from aruco.model import KnowsUp, Recording, UpAxis
from aruco.pose_math import Array, Pose
from aruco.rig_estimate import RigEstimate
from rigcal.config import AlignConfig
from rigcal.quality.gates import GATES, Reading

TILT, ODD = "up by accelerometers", "cameras whose accelerometer contradicts the others"
# No target lies so far from level, and no face of a box but the opposite one: beyond it somebody's sign is wrong.
OPPOSITE_DEG = 150.0
# Of a camera that looks straight down nobody can say whether it hangs upside down; nearer to that it has no vote.
STEEP_DEG = 10.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GravityTestimony:
    """The accelerometers' up, beside that of the finished world."""

    heard: UpByAccelerometers
    tilt_deg: float | None  # between the two; None: the world's up is not known, is theirs, or they contradict

    @property
    def confirms(self) -> bool:
        """Whether they bear out an up that was found without them."""
        return self.tilt_deg is not None and self.tilt_deg <= GATES[TILT].good

    def as_dict(self) -> dict[str, Any]:
        """The layout of ``_meta.accelerometers``; without vectors in a world, which later steps may turn."""
        return {
            "up_in_camera": {name: [float(x) for x in up] for name, up in self.heard.up_cam.items()},
            "tilt_deg": self.tilt_deg,
            "disagreement_deg": dict(self.heard.disagreement_deg),
            "odd": list(self.heard.odd),
        }


def require_accelerometers(recording: Recording) -> None:
    """See that a camera has measured gravity.

    Raises:
        InputError: None has.
    """
    names = [camera.name for camera in recording.cameras]
    if not isinstance(recording, KnowsUp) or all(recording.up_in_camera(name) is None for name in names):
        raise InputError(
            "--up-from imu: no camera of this recording comes with an accelerometer (SVO2 files of ZED cameras do); "
            "leave it out, and up is taken from the target."
        )


def hear_gravity(recording: Recording, rig: RigEstimate) -> UpByAccelerometers | None:
    """What the accelerometers say in a rig's world; None where the recording has none of its cameras."""
    if not isinstance(recording, KnowsUp):
        return None
    up_cam = {name: up for name in rig.cameras if (up := recording.up_in_camera(name)) is not None}
    return up_by_accelerometers({name: p.T_world_cam for name, p in rig.cameras.items()}, up_cam)


def trusted_up(heard: UpByAccelerometers | None) -> Array:
    """The accelerometers' up (3,), to turn a world by.

    Raises:
        CalibrationError: There is none, or they contradict each other.
    """
    leave_out = "leave out --up-from imu, and up is taken from the target."
    if heard is None:
        raise CalibrationError(f"No camera that has a pose comes with an accelerometer; {leave_out}")
    if heard.up_world is None:
        raise CalibrationError(f"{_contradiction(heard)}; {leave_out}")
    logger.info(
        "up by the accelerometers of cameras {}: they agree within {:.2f} degrees", _asked(heard), heard.spread_deg
    )
    return heard.up_world


def require_upright(T_world_cam: Mapping[str, Pose], up_world: Array) -> None:
    """See that the accelerometers' up (3,) does not put most cameras upside down: their sign was assumed, not proven.

    A camera's upper side points below the horizon exactly where it is rolled by more than 90 degrees about its axis,
    whatever its pitch.

    Raises:
        CalibrationError: It does.
    """
    heights = np.array([-T[:3, 1] @ up_world for T in T_world_cam.values()])
    sure = np.abs(heights) > np.sin(np.radians(STEEP_DEG))
    if np.count_nonzero(sure & (heights < 0.0)) > np.count_nonzero(sure) / 2:
        raise CalibrationError(
            "The accelerometers say that most cameras hang upside down (rolled over 90 degrees about their axis): "
            "their sign or axes are not what is assumed, or the cameras are mounted so; "
            "calibrate with --up-from target."
        )


def beside_world(
    heard: UpByAccelerometers, R_new_world: Array, config: AlignConfig, kept_up: UpAxis | None
) -> GravityTestimony:
    """Their up beside that of the finished world, which a (3, 3) rotation turns theirs into."""
    up = config.up_axis if config.enabled else kept_up
    theirs = heard.turned(R_new_world).up_world
    if up is None or theirs is None or (config.enabled and config.up_from == "imu"):
        return GravityTestimony(heard=heard, tilt_deg=None)
    tilt_deg = _tilt_deg(theirs, up)
    logger.info(
        "up of the world: {:.2f} degrees from that of the accelerometers of cameras {}", tilt_deg, _asked(heard)
    )
    return GravityTestimony(heard=heard, tilt_deg=tilt_deg)


def heard_again(note: Any, T_world_cam: Mapping[str, Pose], up: UpAxis) -> Any:
    """``_meta.accelerometers`` of a rig whose poses and world have changed since; None if it cannot be read."""
    told = note.get("up_in_camera") if isinstance(note, dict) else None
    try:
        up_cam = {str(name): np.array(v, dtype=np.float64).reshape(3) for name, v in (told or {}).items()}
    except (AttributeError, TypeError, ValueError):
        return None
    heard = up_by_accelerometers(T_world_cam, up_cam)
    if heard is None:
        return None
    tilt_deg = None if heard.up_world is None else _tilt_deg(heard.up_world, up)
    again = GravityTestimony(heard=heard, tilt_deg=tilt_deg)
    for reading in gravity_readings(again):
        if GATES[reading.gate].exceeded(reading.value, GATES[reading.gate].good):
            logger.warning(reading.sentence)
    return again.as_dict()


def _tilt_deg(theirs: Array, up: UpAxis) -> float:
    return float(angle_deg(theirs, np.array([0.0, 1.0 if up == "+y" else -1.0, 0.0])))


def gravity_readings(gravity: GravityTestimony | None) -> Iterator[Reading]:
    """What the verdict reads of it."""
    if gravity is None:
        return
    if gravity.tilt_deg is not None:
        yield Reading(gate=TILT, value=gravity.tilt_deg, sentence=_tilt_sentence(gravity.heard, gravity.tilt_deg))
    if len(gravity.heard.disagreement_deg) > 1:
        sentence = f"{_contradiction(gravity.heard)}: look at the views of such a camera, its pose may be tilted."
        yield Reading(gate=ODD, value=float(len(gravity.heard.odd)), sentence=sentence)


def _tilt_sentence(heard: UpByAccelerometers, tilt_deg: float) -> str:
    told = f"The accelerometers of {_named(heard)} say that up is {tilt_deg:.1f} degrees off: "
    if tilt_deg > OPPOSITE_DEG:
        return (
            f"{told}they point the other way: their sign or axes are not what is assumed, unless this world is upside "
            "down; see in the result whether the cameras stand above the floor."
        )
    return (
        f"{told}the target did not lie level, or the wrong face of it was taken for level; take up from them with "
        "--up-from imu, or from the floor with refine-ground-plane."
    )


def gravity_remarks(gravity: GravityTestimony | None) -> tuple[str, ...]:
    """Said with the verdict where they bear out what was found without them."""
    if gravity is None or gravity.tilt_deg is None or not gravity.confirms:
        return ()
    # Nobody's up is known to a hundredth of a degree, and none to nothing.
    within = "to better than 0.1" if gravity.tilt_deg < 0.1 else f"within {gravity.tilt_deg:.1f}"
    return (f"Up agrees with the accelerometers of {_named(gravity.heard)} {within} degrees.",)


def _contradiction(heard: UpByAccelerometers) -> str:
    worst = ", ".join(f"camera {name} {heard.disagreement_deg[name]:.1f} degrees" for name in heard.odd)
    if heard.up_world is None:
        return f"Accelerometers contradict each other about up (each beside the nearest other: {worst})"
    return f"Accelerometers that contradict those of the other cameras about up: {worst}"


def _asked(heard: UpByAccelerometers) -> str:
    return ", ".join(_agreeing(heard))


def _agreeing(heard: UpByAccelerometers) -> Sequence[str]:
    return [name for name in heard.disagreement_deg if name not in heard.odd]


def _named(heard: UpByAccelerometers) -> str:
    return f"camera{'s' * (len(_agreeing(heard)) > 1)} {_asked(heard)}"
