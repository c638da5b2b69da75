"""A marker box whose map is only roughly known, calibrated from images together with its map."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from aruco.marker_geometry import Face, load_marker_geometry, save_faces
from aruco.pose_math import Array, exp_so3
from calibrate_extrinsics import main
from rigcal.formats.native import read_poses
from rigcal.quality.truth import pair_errors
from rigcal.sim import Simulation, simulate
from rigcal.solve.target_shape import rigid_fit
from rigcal.sources.rgbd_folder import write_recording


def rough(faces: list[Face], rng: np.random.Generator) -> list[Face]:
    """The same markers, each 3 mm a coordinate and 1 degree off."""

    def off(corners: Array) -> Array:
        middle = corners.mean(axis=0)
        R = exp_so3(np.radians(1.0) * rng.standard_normal((1, 3)))[0]
        return (corners - middle) @ R.T + middle + 3e-3 * rng.standard_normal(3)

    return [replace(face, corners=np.array([off(c) for c in face.corners])) for face in faces]


@pytest.fixture(scope="module")
def moved() -> Simulation:
    return simulate("box-moved", seed=4, n_frames=10, depth=False)


@pytest.fixture(scope="module")
def folder(moved: Simulation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("rough") / "recording"
    write_recording(moved.recording, where, depth=False)
    save_faces(where / "rough.parquet", rough(list(moved.faces), np.random.default_rng(0)))
    return where


def calibrate(folder: Path, out: Path, *more: str) -> Result:
    words = ["-i", folder, "--markers", folder / "rough.parquet", "--moving-target", "-o", out, *more]
    return CliRunner().invoke(main, [str(word) for word in words])


def worst_mm(moved: Simulation, out: Path) -> float:
    return 1e3 * max(shift for _, shift in pair_errors(read_poses(out), moved.T_world_cam).values())


def test_cameras_and_map_come_out_as_with_the_exact_map(moved: Simulation, folder: Path, tmp_path: Path) -> None:
    result = calibrate(folder, tmp_path / "out.json", "--refine-target")
    assert result.exit_code == 0, result.output
    # The exact map gives 0.1 mm with 16 frames; ten frames, and six unknown markers.
    assert worst_mm(moved, tmp_path / "out.json") < 0.4
    found = load_marker_geometry(tmp_path / "out_markers.parquet")
    true = {marker: corners for face in moved.faces for marker, corners in zip(face.ids, face.corners)}
    a, b = (np.concatenate([g[marker] for marker in sorted(true)]) for g in (true, found))
    T = rigid_fit(a, b)
    # A corner error of 0.02 px is 0.05 mm at 2 m, and ten frames of four cameras see each marker.
    assert np.linalg.norm(b @ T[:3, :3].T + T[:3, 3] - a, axis=1).max() < 0.2e-3
    note = json.loads((tmp_path / "out.json").read_text())["_meta"]["target_refined"]
    assert set(note["moved_mm"]) == {str(marker) for marker in true}
    assert "Marker map: 6 markers moved" in result.output
    # The tolerance bites: with the rough map as it is the cameras are millimetres off, and it is called bad.
    plain = calibrate(folder, tmp_path / "plain.json")
    assert plain.exit_code == 3
    assert worst_mm(moved, tmp_path / "plain.json") > 2.0
    assert "--refine-target" in plain.output


def test_the_given_map_is_never_replaced(folder: Path, tmp_path: Path) -> None:
    before = (folder / "rough.parquet").read_bytes()
    result = calibrate(folder, tmp_path / "out.json", "--refine-target", "--no-joint")
    assert result.exit_code == 2
    own = tmp_path / "rough_markers.parquet"
    own.write_bytes(before)
    words = ["-i", str(folder), "--markers", str(own), "--moving-target", "--refine-target"]
    result = CliRunner().invoke(main, [*words, "-o", str(tmp_path / "rough.json")])
    assert result.exit_code == 1
    assert "is the marker map, an input" in result.output
    assert own.read_bytes() == before
