"""Registration gives the same bytes whatever the number of threads and the order of hashes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
PROGRAM = """
import hashlib
import numpy as np
from floor_rooms import BASELINE_M, cameras, depth_image, zoomed
from icp_rooms import FURNISHED, LEVEL
from aruco.icp_registration import ICPConfig, refine_with_icp
from aruco.pose_math import exp_so3, make_pose

truth = cameras(3)
data = {
    name: {"depth": depth_image(T, FURNISHED, seed=k, zoom=2), "K": zoomed(2), "baseline": BASELINE_M / 2}
    for k, (name, T) in enumerate(truth.items())
}
turn = exp_so3(np.array([0, 0.01, 0]))
start = {**truth, "cam1": make_pose(turn @ truth["cam1"][:3, :3], truth["cam1"][:3, 3] + [0.02, 0, 0.01])}
covariance = np.diag([1e-4] * 3 + [4e-4] * 3)
floors = dict.fromkeys(truth, LEVEL)
poses, metrics = refine_with_icp(data, start, floors, ICPConfig(), covariances={"cam0": covariance})
told = [*poses.values(), *metrics.covariances.values()]
print(metrics.num_pairs_converged, hashlib.sha256(b"".join(x.tobytes() for x in told)).hexdigest())
"""


def _answer(threads: int, seed: int) -> str:
    chance = {"OMP_NUM_THREADS": str(threads), "OPENBLAS_NUM_THREADS": str(threads), "PYTHONHASHSEED": str(seed)}
    path = os.pathsep.join([str(HERE), str(HERE.parent)])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**os.environ, **chance, "PYTHONPATH": path, "LOGURU_LEVEL": "ERROR"},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def test_threads_and_hashes_do_not_change_a_bit():
    one, two = _answer(1, 1), _answer(2, 2)
    assert one.startswith("3 ")
    assert one == two
