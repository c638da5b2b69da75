"""Intrinsics of another resolution are told from views alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from joint_rigs import board_rig, box_rig

from aruco.model import Camera
from rigcal.intrinsics_check import RATIOS, other_resolution


def written_for(camera: Camera, ratio: float) -> Camera:
    """The camera, its matrix given for images ``1 / ratio`` times as large."""
    return replace(camera, K=np.diag([1 / ratio, 1 / ratio, 1.0]) @ camera.K)


@pytest.mark.parametrize("ratio", [2 / 3, 1.5, 0.5, 2.0])
def test_the_resolution_of_the_matrix_is_named(ratio: float) -> None:
    rig = box_rig(np.random.default_rng(1), n_frame=6)
    camera = rig.cameras[0]
    told = other_resolution(written_for(camera, ratio), rig.detections[camera.name], rig.geometry)
    assert f"about {camera.width / ratio:.0f} x {camera.height / ratio:.0f}" in told
    assert f"multiply fx, fy, cx, cy by {ratio:.4g}" in told


def test_a_tilted_board_is_enough() -> None:
    rig = board_rig(np.random.default_rng(2), n_frame=6)
    camera = rig.cameras[1]
    assert other_resolution(written_for(camera, 0.5), rig.detections[camera.name], rig.geometry)


@pytest.mark.parametrize("wrong", [1.0, 0.98, 1.02, 0.9])
def test_other_faults_are_not_blamed_on_the_resolution(wrong: float) -> None:
    rig = box_rig(np.random.default_rng(3), n_frame=6)
    camera = rig.cameras[0]
    focal = np.diag([wrong, wrong, 1.0]) @ camera.K
    focal[:2, 2] = camera.K[:2, 2]
    assert other_resolution(replace(camera, K=focal), rig.detections[camera.name], rig.geometry) == ""


def test_no_views_no_words() -> None:
    rig = box_rig(np.random.default_rng(4), n_frame=1)
    assert other_resolution(rig.cameras[0], {}, rig.geometry) == ""
    assert all(ratio != 1 for ratio in RATIOS)
