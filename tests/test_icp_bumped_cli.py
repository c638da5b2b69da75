"""A tripod that was knocked against, by the command: found again without any further option."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from floor_rooms import ROOM, depth_of
from icp_rooms import box
from level_runs import TRUE, document, given_poses, level, store_of

from aruco.pose_math import Pose, exp_so3, invert_transform, make_pose, pose_distance
from rigcal.formats.native import read_poses, write_json

# Of 960 x 540: errors of depth that neighbours share reach over so many pixels that smaller images hold little.
ZOOM = 3
FURNISHED = (
    *ROOM,
    *box((-0.5, 0.0, -0.2), (0.3, 0.7, 0.4)),
    *box((0.7, 0.0, -1.3), (1.2, 0.5, -0.6)),
    *box((-1.4, 0.0, 0.8), (-0.9, 0.9, 1.5)),
    *box((0.4, 0.0, 1.0), (1.0, 0.4, 1.4)),
)
# What markers say of each camera, about its centre.
MARKERS = np.diag([np.radians(0.1) ** 2] * 3 + [0.004**2] * 3)


def _knocked(T: Pose) -> Pose:
    """Turned by 20 degrees, 8 of them tilt, which levelling does not mend, and shifted by half a metre."""
    return make_pose(exp_so3(np.radians([6.0, 18.0, -5.5])) @ T[:3, :3], T[:3, 3] + [0.3, 0.05, -0.4])


def test_a_knocked_camera_is_found_by_the_command(tmp_path: Path) -> None:
    rig, store, out = tmp_path / "rig.json", tmp_path / "depth.h5", tmp_path / "out.json"
    store_of(store, depth_of(TRUE, FURNISHED, zoom=ZOOM))
    given = given_poses({**TRUE, "cam2": _knocked(TRUE["cam2"])})
    write_json(rig, document(given, MARKERS))
    done = level(rig, store, out, "--icp", "--icp-global-init")
    # 3: levelling doubts the camera, and says so.
    assert done.exit_code in (0, 3), done.output
    said = " ".join(done.output.split())
    assert "camera cam2 looks bumped; looking where it fits the clouds of cam0, cam1, cam3" in said
    assert "Found elsewhere than they were said to stand, and moved there: cam2" in said
    assert json.loads(out.read_text())["_meta"]["icp_refined"]["cameras"]["cam2"]["accepted"]
    found = read_poses(out)
    for name in TRUE:
        turn, shift = pose_distance(invert_transform(found["cam0"]) @ found[name], _beside_cam0(name))
        # 0.3 mm where depth is as good as this; the noise of its normals alone makes millimetres.
        assert np.degrees(turn) < 0.2
        assert shift < 0.008


def _beside_cam0(name: str) -> Pose:
    return invert_transform(TRUE["cam0"]) @ TRUE[name]
