"""What registration answers where clouds have little to say: pairs that do not meet, and why."""

from __future__ import annotations

import numpy as np
import pytest
from floor_rooms import cameras, depth_image
from icp_rooms import FURNISHED, LEVEL, camera_data

from aruco.icp_answer import pairs_apart
from aruco.icp_registration import refine_with_icp
from aruco.icp_types import ICPConfig, ICPMetrics
from aruco.pose_math import Pose

RIG = {name: T for name, T in cameras().items() if name != "cam3"}


def refined(nearer: float) -> tuple[dict[str, Pose], ICPMetrics]:
    """A rig each of whose cameras sees a third of its image nearer by a share, all of them elsewhere."""
    data = {}
    for k, (name, T) in enumerate(RIG.items()):
        depth = depth_image(T, FURNISHED, seed=k)
        third = np.arange(depth.shape[1]) * 9 // depth.shape[1] % 3 == k
        data[name] = camera_data(np.where(third, (1 - nearer) * depth, depth))
    config = ICPConfig(region="full", stride=2, min_fitness=0.95)
    return refine_with_icp(data, RIG, dict.fromkeys(RIG, LEVEL), config)


def test_that_no_pair_meets_well_enough_is_a_success_with_a_warning() -> None:
    poses, metrics = refined(0.2)
    assert metrics.success
    assert (metrics.num_pairs_attempted, metrics.num_pairs_converged) == (3, 0)
    assert "every camera keeps its pose" in metrics.message
    assert any("95 % of the points" in warning for warning in metrics.warnings)
    assert all(np.array_equal(T, RIG[name]) for name, T in poses.items())
    assert all(result.verdict.startswith("not used") for result in metrics.per_pair_results.values())
    # Else they do.
    assert refined(0.0)[1].num_pairs_converged == 3


def test_pairs_that_were_not_looked_at_tell_what_they_share() -> None:
    areas = {("cam0", "cam1"): 0.4, ("cam0", "cam2"): 7.25, ("cam1", "cam2"): 9.0}
    apart = pairs_apart({("cam1", "cam2")}, areas, RIG, ICPConfig())
    assert apart.keys() == areas.keys() - {("cam1", "cam2")}
    little, no_surface = apart["cam0", "cam1"], apart["cam0", "cam2"]
    assert little.verdict == "do not overlap: seen from above they share less than 1 m2 (0.4)"
    assert no_surface.verdict.startswith("do not meet: ")
    assert (little.overlap_m2, no_surface.overlap_m2) == (0.4, 7.25)
    for result in (little, no_surface):
        assert not result.overlaps
        assert not result.converged
        assert len(result.unobservable) == 6


@pytest.mark.parametrize("least", [0.0, 1.0])
def test_pairs_that_share_nothing_do_not_overlap_whatever_is_asked(least: float) -> None:
    apart = pairs_apart((), {("cam0", "cam1"): 0.0}, RIG, ICPConfig(min_overlap_area=least))
    assert apart["cam0", "cam1"].verdict.startswith("do not overlap")
