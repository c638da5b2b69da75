"""What a calibration has begun to write is gone when it is interrupted or fails; what was there before is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aruco.errors import InputError, OutputError
from aruco.marker_geometry import SHIPPED_MAPS, load_faces
from aruco.model import Calibration
from rigcal import calibrate_outputs, pipeline
from rigcal.calibrate_outputs import CalibrateOutputs
from rigcal.config import CalibrateConfig
from rigcal.preview_writer import PreviewWriter

BOX = SHIPPED_MAPS / "standard_box_markers.parquet"
NOTHING = Calibration(cameras=(), lost={}, up=None, frames={})


class Ends:
    """A run that ends at its n-th image."""

    def __init__(self, after: int, error: BaseException) -> None:
        self.after, self.error = after, error

    def step(self, name: str, done: int, total: int) -> None:
        if done == self.after:
            raise self.error


def contents(folder: Path) -> dict[Path, bytes | None]:
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def calibrate(recording: Path, preview: Path, **more: Any) -> Calibration:
    return pipeline.calibrate_files([recording], BOX, CalibrateConfig(), preview=preview, jobs=2, **more)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OutputError("full"), ZeroDivisionError()])
@pytest.mark.parametrize("after", [1, 7])
def test_half_the_previews_are_removed(demo_folder: Path, tmp_path: Path, after: int, error: BaseException) -> None:
    with pytest.raises(type(error)):
        calibrate(demo_folder, tmp_path / "new" / "e_preview", progress=Ends(after, error))
    assert not list(tmp_path.iterdir())


def test_previews_of_an_earlier_run_and_other_files_stay(demo_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "e_preview"
    calibrate(demo_folder, folder)
    pictures = sorted(folder.rglob("*.jpg"))
    assert len(pictures) == 12
    assert not list(folder.rglob("*.half"))
    for path in pictures[::2]:
        path.unlink()
    (folder / "41000001" / "mine.txt").write_text("dear")
    before = contents(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        calibrate(demo_folder, folder, progress=Ends(11, KeyboardInterrupt()))
    assert contents(tmp_path) == before


def test_whole_previews_stay_where_they_may_show_what_is_wrong(
    demo_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(error: BaseException) -> Any:
        def solve(*given: Any, **more: Any) -> None:
            raise error

        return solve

    monkeypatch.setattr(pipeline, "calibrate_seen", fails(InputError("no camera sees the target")))
    with pytest.raises(InputError, match="no camera"):
        calibrate(demo_folder, tmp_path / "wrong")
    assert len(list((tmp_path / "wrong").rglob("*.jpg"))) == 12
    monkeypatch.setattr(pipeline, "calibrate_seen", fails(KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        calibrate(demo_folder, tmp_path / "interrupted")
    assert not (tmp_path / "interrupted").exists()


def test_a_preview_folder_that_cannot_be_made_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("dear")
    with pytest.raises(OutputError, match="cannot be made"):
        PreviewWriter(tmp_path / "file" / "e_preview", {1: np.eye(4)[:, :3]})
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OutputError("full")])
def test_outputs_appear_together_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def fails(path: Path, calibration: Calibration) -> None:
        raise error

    monkeypatch.setattr(calibrate_outputs, "write_extrinsics", fails)
    outputs = CalibrateOutputs(
        poses=tmp_path / "e.json",
        marker_map=tmp_path / "e_markers.parquet",
        report=tmp_path / "c.csv",
        faces=load_faces(BOX),
    )
    with pytest.raises(type(error)):
        outputs.write(NOTHING)
    assert not list(tmp_path.iterdir())
    # What was there before is replaced or stays, and a link to what was not is still a link.
    (tmp_path / "c.csv").write_text("old")
    link = tmp_path / "link.parquet"
    link.symlink_to(tmp_path / "map.parquet")
    with pytest.raises(type(error)):
        replace(outputs, marker_map=link).write(NOTHING)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.csv", "link.parquet"]
