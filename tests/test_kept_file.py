"""What a file of kept cameras may hold, what is refused, and how the closing table shows them."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aruco.errors import CalibrationError, InputError
from aruco.model import Calibration, CameraPose
from aruco.pose_math import pose_text
from rigcal.formats.native import document, write_extrinsics
from rigcal.formats.native_rig import FORMAT
from rigcal.kept import NOTHING_KEPT, KeptRig, kept_from_file
from rigcal.report.terminal import show_calibration

POSE = pose_text(np.eye(4))
NEGATIVE_ZERO = POSE.replace("0.0", "-0.0", 1)


def kept(tmp_path: Path, text: str) -> KeptRig:
    (tmp_path / "old.json").write_text(text)
    return kept_from_file(tmp_path / "old.json")


def entry(**more: Any) -> str:
    return json.dumps({"pose": POSE, **more})


def covariance(numbers: str) -> str:
    return f'{{"x": {entry()}, "_meta": {{"covariance": {{"x": {numbers}}}}}}}'


def skewed() -> str:
    S = np.eye(6)
    S[0, 1] = 0.5
    return json.dumps(S.ravel().tolist())


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (f'{{"x": {{"pose": "{POSE}", "rms_px": NaN}}}}', "old.json: x.rms_px: NaN is not a finite number"),
        (f'{{"x": {{"pose": "{POSE}", "rms_px": -Infinity}}}}', "-Infinity is not a finite number"),
        (f'{{"x": {{"pose": "{POSE}", "rms_px": 1e999}}}}', "1e999 is not a finite number"),
        (covariance(json.dumps([10**400] * 36)), "covariance of camera x is not 36 numbers"),
        (covariance("[1, 2]"), "covariance of camera x is not 36 numbers"),
        (covariance("5"), "covariance of camera x is not 36 numbers"),
        (covariance(skewed()), "covariance of camera x is not symmetric"),
        (covariance(json.dumps((-np.eye(6)).ravel().tolist())), "covariance of camera x is not symmetric"),
        (f'{{"x": {entry()}, "_meta": {{"covariance": [1]}}}}', "_meta.covariance is not an object of cameras"),
        (f'{{"x": {entry()}, "_meta": {{"world": {{"up": [0, 0, 1]}}}}}}', "_meta.world wants up"),
        (f'{{"x": {entry()}, "_meta": {{"world": {{"up": null, "origin": null}}}}}}', "_meta.world wants up"),
        ('{"x": {"pose": 5}}', "camera x has no pose"),
        (f'{{"x": {{"pose": "{"1e400 " * 16}"}}}}', "not the 4 x 4 matrix of a rigid transform"),
        (f'{{"x": {{"pose": "{POSE.replace("1.0", "2.0")}"}}}}', "not the 4 x 4 matrix of a rigid"),
        (f'{{"x": {{"pose": "{POSE.replace("1.0", "1.1", 1)}"}}}}', "not a proper rotation"),
        (f'{{"x": {entry()}, "big": {"9" * 5000}}}', "not a JSON file"),
    ],
)
def test_what_cannot_be_kept_is_refused_in_a_sentence(tmp_path: Path, text: str, why: str) -> None:
    with pytest.raises(InputError, match=r"old\.json") as caught:
        kept(tmp_path, text)
    assert why in str(caught.value)


def test_a_kept_pose_is_written_as_it_was_read(tmp_path: Path) -> None:
    rig = kept(tmp_path, f'{{"x": {{"pose": "{NEGATIVE_ZERO}"}}}}')
    camera = CameraPose(
        camera="x",
        T_world_cam=np.eye(4),
        n_frames=5,
        n_markers=3,
        rms_px=0.2,
        spread_m=0.01,
        spread_rad=0.01,
        kept=True,
    )
    found = Calibration(cameras=(camera,), lost={}, up=None, frames={}, kept=rig.entries)
    assert document(found)["x"]["pose"] == NEGATIVE_ZERO
    # The numbers alone would not do it.
    assert pose_text(np.eye(4) @ rig.T_world_cam["x"]) != NEGATIVE_ZERO
    write_extrinsics(tmp_path / "new.json", found)
    assert json.loads((tmp_path / "new.json").read_text())["x"]["pose"] == NEGATIVE_ZERO


def test_nobody_knows_what_a_world_that_does_not_say_it_is_tied_to(tmp_path: Path) -> None:
    for meta in ("{}", '{"world": null}', '{"world": {}}', '{"world": {"up": null}}'):
        rig = kept(tmp_path, f'{{"x": {entry()}, "_meta": {meta}}}')
        assert (rig.up, rig.origin) == (None, "unknown")
        assert FORMAT.read(tmp_path / "old.json").origin == rig.origin  # whichever command reads it
    assert NOTHING_KEPT.origin == "target"
    rig = kept(tmp_path, f'{{"x": {entry()}, "_meta": {{"world": {{"up": [0.0, -1.0, 0.0], "origin": "floor"}}}}}}')
    assert (rig.up, rig.origin) == ("-y", "floor")


def printed(calibration: Calibration) -> str:
    from rich.console import Console

    text = StringIO()
    show_calibration(Console(file=text, width=140, highlight=False), calibration)
    return text.getvalue()


def test_cells_stand_under_their_heads_without_a_covariance() -> None:
    T = np.eye(4)
    T[:3, 3] = [1.5, 2.5, 3.5]
    figures: dict[str, Any] = {"n_frames": 5, "n_markers": 3, "rms_px": 0.2, "spread_m": 0.01, "spread_rad": 0.01}
    old = CameraPose(camera="old", T_world_cam=np.eye(4), kept=True, **figures)
    new = CameraPose(camera="new", T_world_cam=T, **figures)
    text = printed(Calibration(cameras=(new, old), lost={}, up=None, frames={}, kept={"old": {"pose": POSE}}))
    head = next(line for line in text.splitlines() if "x m" in line)
    row = next(line for line in text.splitlines() if "new" in line)
    assert len(head.split("┃")) == len(row.split("│"))
    assert [cell.strip() for cell in row.split("│")][-4:-1] == ["1.500", "2.500", "3.500"]
    assert [cell.strip() for cell in row.split("│")][-6:-4] == ["-", "-"]
    assert "known to is relative to these" in text


def test_a_kept_camera_that_was_not_there_differs_from_one_that_did_not_fit() -> None:
    stays = {"gone": {"pose": POSE}, "off": {"pose": POSE}}
    idle = {"off": "none of its views fits"}
    found = Calibration(cameras=(), lost={}, up=None, frames={}, kept=stays, idle=idle, stale=frozenset({"off"}))
    text = printed(found)
    assert "kept: camera gone: as its file says; not in this recording" in text
    assert "kept: camera off: as its file says; it took no part: none of its views fits" in text
    # The command ends with another code than 0, verdict or not.
    assert not found.is_whole


def test_a_camera_that_corners_leave_open_is_a_sentence() -> None:
    from joint_rigs import box_rig

    from rigcal.solve.adjust import adjust

    rig = box_rig(np.random.default_rng(0), n_cam=2, n_frame=3)
    blind = rig.sightings().only_views(rig.sightings().view_camera == 0)
    with pytest.raises(CalibrationError, match="leave a camera's pose open"):
        adjust(blind, rig.truth, rig.gauge())
