"""What registration makes of simulated rigs, ours and the plain recipe, against the truth.

Owns      one rig registered in several ways, errors before and after, what the pairs' information promises.
Leaves    rigs and starts to icp_rigs, figures from many of them to the suite.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from typing import NamedTuple, TypeVar

import numpy as np
from loguru import logger

from aruco.icp_types import ICPConfig, ICPMetrics, Method
from aruco.pose_math import Array, Pose, adjoint, invert_transform, skew
from benchmarks.child import ONE_THREAD
from benchmarks.icp_rigs import STARTS, commanded, floors_seen, start_poses
from benchmarks.levelled_rigs import DepthRig, depth_rig, median_mm
from benchmarks.plain_icp import plain_icp
from rigcal.icp_note import Registration

CORES = 2
PLAIN: dict[str, Method] = {"plain": "point_to_plane", "plain_gicp": "gicp"}
# A rig is harmed when its median pair error grows by more than either.
HARM_SHARE, HARM_MM = 0.05, 1.0
Key = TypeVar("Key")
Value = TypeVar("Value")


class Room(NamedTuple):
    """Which rig, and whether things stand amid its cameras."""

    seed: int
    furnished: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """One rig, from one start."""

    room: Room
    start: str
    biased: bool
    before_mm: float  # median error of relative poses, as given
    levelled_mm: dict[str, float] = field(default_factory=dict)  # after levelling, before registration
    after_mm: dict[str, float] = field(default_factory=dict)  # by way
    promised_mm: float = float("nan")  # median over pairs of what information and covariances say of "known"
    moved: dict[str, int] = field(default_factory=dict)  # cameras, by way
    seconds: dict[str, float] = field(default_factory=dict)

    def ratio(self, way: str) -> float:
        """Its error as a way has left it over what it was given with."""
        return self.after_mm[way] / self.before_mm

    def ratio_by_icp(self, way: str) -> float:
        """The same over what levelling had left."""
        return self.after_mm[way] / self.levelled_mm[way]

    def growth(self, way: str) -> float:
        """How much worse a way has made it than it was given, in units of what counts as harm; below 0 is better."""
        return harm(self.before_mm, self.after_mm[way])

    def growth_by_icp(self, way: str) -> float:
        """The same against what levelling had left."""
        return harm(self.levelled_mm[way], self.after_mm[way])


def harm(before_mm: float, after_mm: float) -> float:
    """How much an error has grown, in units of what counts as harm."""
    return (after_mm - before_mm) / max(HARM_SHARE * before_mm, HARM_MM)


def spread(measure: Callable[[Key], Value], keys: Sequence[Key]) -> list[Value]:
    """A measurement of each key, in processes of one thread each; the order of keys is kept."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        with ProcessPoolExecutor(CORES, mp_context=get_context("spawn"), initializer=_be_silent) as pool:
            return list(pool.map(measure, keys))
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)


def _be_silent() -> None:
    # Handed over itself, logger.remove would arrive as that of a copy.
    logger.remove()


def outcomes(room: Room) -> list[Outcome]:
    """One rig from every start, its depth biased and not, by the command's way, with covariances and without."""
    return [_commanded(*case) for case in _cases(room)]


def plain_outcomes(room: Room) -> list[Outcome]:
    """The same by the plain recipe."""
    return [_plain(*case) for case in _cases(room)]


def _cases(room: Room) -> Iterator[tuple[Outcome, DepthRig, dict[str, Pose], dict[str, Array]]]:
    """What has happened to a rig so far, which is nothing; the rig, poses to start from and their covariances."""
    for biased in (False, True):
        rig = depth_rig(room.seed, biased=biased, furnished=room.furnished)
        for start in STARTS:
            poses, covariances = start_poses(rig, start, room.seed)
            nothing = Outcome(room=room, start=start, biased=biased, before_mm=median_mm(poses, rig.T_world_cam))
            yield nothing, rig, poses, covariances


def _commanded(outcome: Outcome, rig: DepthRig, poses: dict[str, Pose], covariances: dict[str, Array]) -> Outcome:
    found: dict[str, Registration] = {}
    seconds: dict[str, float] = {}
    for way, known in (("known", covariances), ("unknown", None)):
        begin = time.perf_counter()
        found[way] = commanded(rig, poses, known, ICPConfig())
        seconds[way] = time.perf_counter() - begin
    return replace(
        outcome,
        levelled_mm={way: median_mm(f.T_start_cam, rig.T_world_cam) for way, f in found.items()},
        after_mm={way: median_mm(f.T_world_cam, rig.T_world_cam) for way, f in found.items()},
        promised_mm=promised_mm(found["known"].metrics, found["known"].T_world_cam, covariances),
        moved={way: len(f.moved) for way, f in found.items()},
        seconds=seconds,
    )


def _plain(outcome: Outcome, rig: DepthRig, poses: dict[str, Pose], covariances: dict[str, Array]) -> Outcome:
    del covariances  # of which the recipe knows nothing
    floors = floors_seen(rig, poses)
    found: dict[str, dict[str, Pose]] = {}
    for way, method in PLAIN.items():
        found[way], found[f"{way}_gated"] = plain_icp(rig.camera_data, poses, floors, ICPConfig(method=method))
    return replace(outcome, after_mm={way: median_mm(T, rig.T_world_cam) for way, T in found.items()})


def promised_mm(metrics: ICPMetrics, T_world_cam: Mapping[str, Pose], covariances: Mapping[str, Array]) -> float:
    """Median over pairs of the root mean square error of relative positions that pairs and given poses promise.

    Every pair's information is about a left twist of T_target_source in the target's frame, which is
    ``Ad(T_target_world) (xi_source - xi_target)`` for left twists xi of both poses in the world. All pairs and given
    covariances count together, as if pairs knew nothing of each other.
    """
    names = sorted(T_world_cam)
    at = {name: slice(6 * k, 6 * k + 6) for k, name in enumerate(names)}
    A = np.zeros((6 * len(names), 6 * len(names)))
    for name in names:
        A[at[name], at[name]] += np.linalg.inv(covariances[name])
    for (source, target), result in metrics.per_pair_results.items():
        if result.converged:
            J = _relative(T_world_cam[target], at[source], at[target], len(A))
            A += J.T @ result.information_matrix @ J
    S = np.linalg.inv(A)
    found: list[float] = []
    for k, a in enumerate(names):
        for b in names[k + 1 :]:
            t = (invert_transform(T_world_cam[a]) @ T_world_cam[b])[:3, 3]
            J = np.hstack([-skew(t), np.eye(3)]) @ _relative(T_world_cam[a], at[b], at[a], len(A))
            found.append(1e3 * float(np.sqrt(np.trace(J @ S @ J.T))))
    return float(np.median(found))


def _relative(T_world_target: Pose, source: slice, target: slice, size: int) -> Array:
    """(6, size) of the twist of T_target_source by the twists of all poses."""
    J = np.zeros((6, size))
    J[:, source] = adjoint(invert_transform(T_world_target))
    J[:, target] = -J[:, source]
    return J
