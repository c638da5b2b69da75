"""Which cameras' moves are kept: those that bring clouds together where they were not fitted, with nothing against it.

Owns      the rounds of refusing, setting clouds aside and registering again; what is told of each camera.
Leaves    held-out distances to icp_heldout, what else speaks against a move to icp_objections.

Where something besides held-out distances speaks against a move, the camera has no say any more: its cloud is set
aside, for it would pull the others to where it was not allowed to go. One whose move these distances do not prove keeps
its pose, and stays free in the estimate: held where it was it would pull the others to its own error. See icp_placing
for where the others then go; what may be said against a pose is asked once more of that place.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from loguru import logger

from aruco import icp_words as words
from aruco.floor_plane import FloorPlane
from aruco.icp_cloud import Cloud
from aruco.icp_heldout import HeldOut, held_out
from aruco.icp_objections import Case, Objection, objection_to_places, prior_sigmas, worst_objection
from aruco.icp_placing import placed
from aruco.icp_prior import Prior
from aruco.icp_solve import Pair, Registration
from aruco.icp_types import CameraMove, ICPConfig, Refusal
from aruco.pose_math import Pose, pose_distance

# A move of a millimetre or two, which is what clouds can add to a good pose, is hardly ever proved by itself, and it is
# only right beside the moves of the others. So those of a camera and of all that overlap it are proved together, which
# chance does in 2 of a hundred cases in which half of them would be as good.
JOINT_SIGMAS = 2.0
# Its own move must not be spoken against: squared distances, in their variances, must not grow by more than the one,
# which is as little as one more stray cell, unless that is less than the other of their standard errors. What is asked
# for proof is asked for this too: at one standard error chance would refuse right moves now and then.
MAX_GROWTH = 2.0
MAX_GROWTH_SIGMAS = 2.0


class Register(Protocol):
    """The same registration once more."""

    def __call__(self, silent: Collection[str]) -> Registration:
        """With the clouds of some cameras set aside (see ``set_aside``)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Verdict:
    """What is left of a registration."""

    registration: Registration  # in which only cameras move whose moves are kept
    moves: dict[str, CameraMove]  # of all cameras
    left_out: tuple[str, ...]  # cameras whose clouds were set aside


def set_aside(
    clouds: Mapping[str, Cloud], pairs: Mapping[Pair, float], left_out: Collection[str]
) -> tuple[dict[str, Cloud], dict[Pair, float]]:
    """Clouds and pairs of a registration in which some clouds have no say, not even about the floor."""
    silent = {name: replace(clouds[name], is_floor=np.zeros_like(clouds[name].is_floor)) for name in left_out}
    return {**clouds, **silent}, {pair: area for pair, area in pairs.items() if not {*pair} & {*left_out}}


def judge(
    registration: Registration,
    clouds: Mapping[str, Cloud],
    start: Mapping[str, Pose],
    priors: Mapping[str, Prior],
    config: ICPConfig,
    *,
    floor: FloorPlane | None,
    register: Register,
    alone: Collection[str] = (),
) -> Verdict:
    """Register again without clouds that something speaks against, and keep those of the moves left that are proved.

    Args:
        registration: With all cameras free but the reference.
        clouds: Camera -> what it sees.
        start: Camera -> T_world_cam before.
        priors: Camera -> what is known of its pose.
        config: Bounds and seed.
        floor: Common floor in the world of ``start``; None: there is none.
        register: Does it again.
        alone: Cameras whose moves are so large that they would prove any others': each is proved by itself.
    """
    case = Case(clouds=clouds, start=start, priors=priors, config=config, floor=floor)
    moves: dict[str, CameraMove] = {}
    left_out: list[str] = []
    # Each round refuses at least one camera; the reference's cloud may be set aside too.
    for rounds in range(1, len(start) + 2):
        for name in sorted({*registration.unlinked} - moves.keys()):
            moves[name] = CameraMove(accepted=False, reason=words.meets_nothing(tuple(left_out)), refusal="unlinked")
        still = {registration.reference, *registration.unlinked}
        moving = [name for name in registration.layout.cameras if name not in still]
        trial = _Trial(case=case, held=held_out(registration, seed=config.seed), alone=frozenset(alone))
        objection = worst_objection(case, registration, moving)
        if objection is None:
            break
        moves[objection.camera] = trial.objected(objection, moving)
        logger.debug("round {}: {}: {}", rounds, objection.camera, objection.reason)
        left_out.append(objection.camera)
        registration = register(tuple(left_out))
    else:
        raise AssertionError("a round refused nothing and went on")
    moves.update(trial.unproved(moving))
    believed = [name for name in moving if name not in moves]
    registration = placed(registration, [name for name in moving if name not in believed])
    while objection := objection_to_places(case, registration, believed):
        believed.remove(objection.camera)
        moves[objection.camera] = trial.objected(objection, believed)
        registration = placed(registration, [name for name in moving if name not in believed])
    moves.update({name: trial.accepted(name, believed, registration) for name in believed})
    if registration.reference not in moves:
        moves[registration.reference] = CameraMove(accepted=False, reason=words.is_reference())
    return Verdict(registration=registration, moves=dict(sorted(moves.items())), left_out=tuple(left_out))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Trial:
    """One registration's moves and what was held out."""

    case: Case
    held: HeldOut
    alone: frozenset[str]

    def unproved(self, moving: Sequence[str]) -> dict[str, CameraMove]:
        """Cameras to keep until held-out distances ask for all moves that are left."""
        refused: dict[str, CameraMove] = {}
        asked = left = list(moving)
        # A refusal tells most on cameras that overlap it: first these are asked again, at the end all that are left.
        while (failing := self._failing(asked, left)) or len(asked) < len(left):
            # Those that are spoken against may be why the others are not proved: half of them at once, the worst.
            worse = sorted((n for n in failing if failing[n].refusal == "worse"), key=lambda n: failing[n].gain_sigmas)
            # Moves that were not proved together are not asked about once more in ever smaller groups, until chance
            # proves one of them.
            worst = worse[: max(1, len(worse) // 2)] or sorted(failing)
            refused |= {name: failing[name] for name in worst}
            left = [name for name in left if name not in worst]
            near = {name for gone in worst for name in self._beside(gone, left)}
            asked = [name for name in left if not failing or name in failing or name in near]
        return refused

    def _failing(self, asked: Sequence[str], left: Sequence[str]) -> dict[str, CameraMove]:
        """Cameras whose move is not proved, of those asked about, by itself and with those left that overlap it."""
        failing: dict[str, CameraMove] = {}
        for name in asked:
            own = self.held.compared((name,))
            together = self._beside(name, left)
            joint = self.held.compared(together).sigmas
            if own.gain < -MAX_GROWTH and own.sigmas < -MAX_GROWTH_SIGMAS:
                reason = words.speaks_against(*self._size(name), -own.sigmas)
                failing[name] = self.move(name, (name,), reason, "worse")
            elif joint < JOINT_SIGMAS:
                reason = words.not_proved(*self._size(name), joint, len(together) - 1, JOINT_SIGMAS)
                failing[name] = self.move(name, together, reason, "unproved")
        return failing

    def _beside(self, camera: str, moving: Sequence[str]) -> list[str]:
        """A camera, and those that move and overlap it, but for cameras to be proved alone."""
        pairs = self.held.registration.pairs
        beside = {name for name in moving if (min(name, camera), max(name, camera)) in pairs} - self.alone
        return [name for name in moving if name == camera or (name in beside and camera not in self.alone)]

    def objected(self, objection: Objection, moving: Sequence[str]) -> CameraMove:
        """A move that something speaks against; of the reference, that all others are moved against it."""
        camera = objection.camera
        if camera != self.held.registration.reference:
            return self.move(camera, (camera,), objection.reason, objection.kind)
        move = self.move(camera, moving, objection.reason, objection.kind)
        turn_deg, shift_m = objection.wish or (0.0, 0.0)
        return replace(move, rotation_deg=turn_deg, translation_mm=1e3 * shift_m)

    def accepted(self, camera: str, moving: Sequence[str], result: Registration) -> CameraMove:
        """A move that is kept, to where the camera has been put in the end."""
        together = self._beside(camera, moving)
        move = self.move(camera, together, "", "")
        gaps = (move.held_out_before_mm, move.held_out_after_mm)
        turn_deg, shift_m = _size(self.case.start[camera], result.T_world_cam[camera])
        return replace(
            move,
            accepted=True,
            reason=words.gained(turn_deg, shift_m, gaps, move.gain_sigmas, len(together) - 1, move.prior_sigmas),
            rotation_deg=turn_deg,
            translation_mm=1e3 * shift_m,
        )

    def move(self, camera: str, together: Sequence[str], reason: str, refusal: Refusal) -> CameraMove:
        """What is told of a refused move.

        Args:
            camera: Which.
            together: Cameras, this among them, with and without whose moves distances are compared.
            reason: Why it is refused.
            refusal: The kind of that.
        """
        reg = self.held.registration
        turn_deg, shift_m = self._size(camera)
        return CameraMove(
            accepted=False,
            reason=reason,
            refusal=refusal,
            rotation_deg=turn_deg,
            translation_mm=1e3 * shift_m,
            held_out_before_mm=self.held.median_mm(camera, together),
            held_out_after_mm=self.held.median_mm(camera),
            gain_sigmas=self.held.compared(together).sigmas,
            prior_sigmas=prior_sigmas(self.case, reg, camera),
            unobservable=reg.unobservable.get(camera, ()),
        )

    def _size(self, camera: str) -> tuple[float, float]:
        return _size(self.case.start[camera], self.held.registration.T_world_cam[camera])


def _size(before: Pose, after: Pose) -> tuple[float, float]:
    """Turn [deg] and shift [m] of a camera's move."""
    turn, shift = pose_distance(before, after)
    return math.degrees(turn), shift
