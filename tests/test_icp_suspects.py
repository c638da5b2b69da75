"""Who looks bumped: as few cameras as explain all contradictions, and never the reference while that may stand well."""

from __future__ import annotations

import math

import numpy as np
import pytest
from floor_rooms import ROOM, cameras, depth_image, zoomed
from icp_rooms import box

from aruco.floor_plane import FloorPlane
from aruco.icp_agreement import Witness, witness
from aruco.icp_cloud import cloud_of
from aruco.icp_prior import Prior
from aruco.icp_suspects import Meeting, agreeing, meetings
from aruco.icp_types import ICPConfig
from aruco.pose_math import Pose, exp_so3, make_pose

UP = np.array([0.0, 1.0, 0.0])
WELL, BAD, SILENT = Meeting(met=100, against=5), Meeting(met=20, against=280), Meeting(met=3, against=10)


def _met(names: str, bad: str, silent: str = "") -> dict[tuple[str, str], Meeting]:
    """Every pair of cameras of one letter, of which some contradict each other and some share too little."""
    pairs = [(a, b) for a in names for b in names if a < b]
    return {(a, b): BAD if a + b in bad.split() else SILENT if a + b in silent.split() else WELL for a, b in pairs}


@pytest.mark.parametrize(
    ("names", "bad", "well"),
    [
        ("abcd", "", "abcd"),
        ("abcd", "ac bc cd", "abd"),  # c
        ("abcd", "ab ac ad", "bcd"),  # the reference
        ("ab", "ab", "a"),  # either; a cannot move
        ("abcd", "ac bc ad bd", "ab"),  # c and d in unison, or a and b
        ("abcd", "ab ac ad bc bd", "cd"),  # a and b each for itself: two that agree are more than one
        ("abc", "ab ac bc", "a"),
        ("abcde", "ad bd cd ae be ce de", "abc"),
    ],
)
def test_the_most_cameras_that_agree_stand_well(names: str, bad: str, well: str) -> None:
    assert agreeing(frozenset(names), _met(names, bad), "a") == frozenset(well)


def test_few_samples_and_few_contradictions_say_nothing() -> None:
    assert not SILENT.contradicts
    assert not Meeting(met=0, against=0).contradicts
    # What edges leave between cameras that stand well.
    assert not Meeting(met=84, against=16).contradicts
    assert agreeing(frozenset("abc"), _met("abc", "", "ab ac"), "a") == frozenset("abc")
    assert agreeing(frozenset(), {}, "") == frozenset()


def test_of_two_that_may_be_bumped_it_is_the_one_that_contradicts_others_too() -> None:
    met = {("a", "b"): Meeting(met=130, against=40), ("a", "c"): Meeting(met=33, against=0), ("b", "c"): BAD}
    assert agreeing(frozenset("abc"), met, "a") == frozenset("ac")


def test_one_pair_of_many_that_contradicts_is_no_bump() -> None:
    # Facing cameras may see little more of each other's surroundings than edges.
    met = {**_met("abcd", ""), ("b", "d"): Meeting(met=16, against=39)}
    assert agreeing(frozenset("abcd"), met, "a") == frozenset("abcd")


def test_twenty_cameras_that_all_contradict_are_no_burden() -> None:
    names = "abcdefghijklmnopqrst"
    pairs = {(a, b): BAD for a in names for b in names if a < b}
    assert agreeing(frozenset(names), pairs, "a") == {"a"}


# ---------------------------------------------------------------------------------------------------------- in a room


class Furnished:
    """Three cameras around two boxes."""

    def __init__(self) -> None:
        walls = (*ROOM, *box((-0.5, 0.0, -0.2), (0.3, 0.7, 0.4)), *box((0.7, 0.0, -1.3), (1.2, 0.5, -0.6)))
        self.truth = cameras(3)
        self.depth = {name: depth_image(T, walls, seed=k, zoom=2) for k, (name, T) in enumerate(self.truth.items())}

    def clouds(self, T_world_cam: dict[str, Pose]) -> dict[str, Witness]:
        config, floor = ICPConfig(region="full"), FloorPlane(UP, 0.0)
        out = {}
        for name, T in T_world_cam.items():
            data = {"depth": self.depth[name], "K": zoomed(2), "baseline": 0.24, "n_frames": 20}
            out[name] = witness(cloud_of(name, data, config, T_world_cam=T, floor=floor))
        return out

    def well(self, turn_deg: float, shift_m: float, sigma_deg: float | None = None) -> frozenset[str]:
        """Who agrees where cam1 is turned and shifted, and its pose known so well."""
        T = self.truth["cam1"]
        start = {
            **self.truth,
            "cam1": make_pose(exp_so3(math.radians(turn_deg) * UP) @ T[:3, :3], T[:3, 3] + [shift_m, 0.0, 0.0]),
        }
        S = None if sigma_deg is None else math.radians(sigma_deg) ** 2 * np.eye(6)
        priors = {name: Prior(T_world_cam=T, covariance=S) for name, T in start.items()}
        return agreeing(frozenset(start), meetings(self.clouds(start), start, priors), "cam0")


@pytest.fixture(scope="module")
def furnished() -> Furnished:
    return Furnished()


def test_a_bump_shows(furnished: Furnished) -> None:
    assert furnished.well(0.0, 0.0) == {"cam0", "cam1", "cam2"}
    assert furnished.well(12.0, 0.2) == {"cam0", "cam2"}
    assert furnished.well(20.0, 0.4) == {"cam0", "cam2"}


def test_what_poses_are_uncertain_by_is_no_bump(furnished: Furnished) -> None:
    # Rough marker poses, and what nobody has said anything of.
    assert furnished.well(0.6, 0.012, 0.6) == {"cam0", "cam1", "cam2"}
    assert furnished.well(0.6, 0.012) == {"cam0", "cam1", "cam2"}
    assert furnished.well(12.0, 0.2, 10.0) == {"cam0", "cam1", "cam2"}
