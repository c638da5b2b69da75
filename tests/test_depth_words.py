"""What is said of a camera's depth does not call right what is right on average alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from depth_boards import KNOWN, NOISY, PLACES, pose, rig, shown

from aruco.depth_bias import DepthBias
from aruco.depth_verify import verify_depth

POSES = [pose(place, about_rad=k) for k, place in enumerate(PLACES)]


def said(off_m: float, bias: DepthBias | None = None) -> str:
    """Of markers that are measured too near, right, and too far by turns."""
    faces = [replace(f, measured_m=f.measured_m + off_m * (k % 3 - 1)) for k, f in enumerate(shown(POSES, NOISY))]
    return verify_depth({"a": faces}, rig(POSES), KNOWN, None if bias is None else {"a": bias})["a"].judgement


def test_depth_that_is_right_on_average_alone_does_not_agree() -> None:
    for bias in (None, DepthBias()):
        judged = said(0.3, bias)
        assert "agrees" not in judged
        assert "RMSE" in judged
        assert "not mirrored" in judged
    # Noise alone is not called that, nor a print that is a millimetre off.
    assert "RMSE" not in said(0.0)
    assert "depth agrees with the target" in said(0.001)


def test_a_bias_is_not_called_a_fault() -> None:
    faces = [replace(f, measured_m=1.01 * f.measured_m) for f in shown(POSES, NOISY)]
    judged = verify_depth({"a": faces}, rig(POSES), KNOWN)["a"].judgement
    assert "like a wrong baseline" in judged
    assert "RMSE" not in judged


def test_a_few_pixels_on_something_else_are_told_but_blame_nobody() -> None:
    faces = shown(POSES, NOISY)
    stained = [np.where(np.arange(len(f.measured_m)) % 20 == 0, 0.6, 1.0) * f.measured_m for f in faces]
    faces = [replace(f, measured_m=m) for f, m in zip(faces, stained)]
    judged = verify_depth({"a": faces}, rig(POSES), KNOWN)["a"].judgement
    assert "most of depth agrees" in judged
    assert "some pixels are far off (RMSE" in judged
    assert "mirrored" not in judged
