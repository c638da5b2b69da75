"""Registration of clouds by the levelling command, in rooms of which the truth is known."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from floor_rooms import FLOOR, ROOM, Wall, depth_of
from level_runs import ROUGH, TRUE, TURN, change, document, failed, given_poses, level, registered, store_of

from aruco.pose_math import Pose, exp_so3, invert_transform, make_pose
from rigcal.formats.native import read_poses, write_json
from rigcal.quality.truth import pair_errors
from rigcal.sim.placement import look_at

# Of 1280 x 720: errors of depth that neighbours share reach over so many pixels that smaller images hold little.
ZOOM = 4


def box(x: tuple[float, float], z: tuple[float, float], height: float) -> tuple[Wall, ...]:
    """The five faces of a box on the floor."""
    sides = [Wall(0, side, (0.0, z[0]), (height, z[1])) for side in x]
    sides += [Wall(2, side, (x[0], 0.0), (x[1], height)) for side in z]
    return (*sides, Wall(1, height, (x[0], z[0]), (x[1], z[1])))


FURNISHED = (
    *ROOM,
    *box((-0.5, 0.3), (-0.2, 0.4), 0.7),
    *box((0.7, 1.2), (-1.3, -0.6), 0.5),
    *box((-1.4, -0.9), (0.8, 1.5), 0.9),
    *box((0.4, 1.0), (1.0, 1.4), 0.4),
)
# What levelling cannot mend: yaw, and place on the floor.
SLID = {
    name: make_pose(exp_so3(np.radians([0.0, yaw, 0.0])) @ T[:3, :3], T[:3, 3] + 1e-3 * np.array([x, 0.0, z]))
    for (name, T), (yaw, x, z) in zip(
        ROUGH.items(), ((0.0, 0.0, 0.0), (0.6, 11.0, -5.0), (-0.5, 4.0, 11.0), (0.4, -9.0, 6.0))
    )
}
# What markers say of them: 0.6 degrees and 12 mm.
SLID_COVARIANCE = np.diag([0.0105**2] * 3 + [0.012**2] * 3)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """The files of one run with all outputs."""

    rig: Path
    store: Path
    levelled: Path  # without --icp
    out: Path
    said: str

    @property
    def note(self) -> dict[str, Any]:
        return json.loads(self.out.read_text())["_meta"]["icp_refined"]


def outputs(out: Path) -> tuple[object, ...]:
    return "--metrics-json", out.with_suffix(".m.json"), "--plot-output", out.with_suffix(".html")


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A rough rig in a room with furniture, levelled and with its clouds registered; never to be changed."""
    folder = tmp_path_factory.mktemp("furnished")
    store = store_of(folder / "depth.h5", depth_of(TRUE, FURNISHED, zoom=ZOOM))
    rig, levelled, out = folder / "rig.json", folder / "level.json", folder / "out.json"
    write_json(rig, document(given_poses(SLID), SLID_COVARIANCE))
    assert level(rig, store, levelled).exit_code == 0
    _, said = registered(rig, store, out, *outputs(out))
    return Run(rig=rig, store=store, levelled=levelled, out=out, said=said)


@pytest.fixture
def slid(tmp_path: Path) -> Path:
    """The extrinsics of the same rough rig; to be changed at will."""
    path = tmp_path / "slid.json"
    write_json(path, document(given_poses(SLID), SLID_COVARIANCE))
    return path


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small images of the same room: too coarse to tell much, and quick."""
    return store_of(tmp_path_factory.mktemp("small") / "depth.h5", depth_of(TRUE, FURNISHED))


def pair_errors_mm(T_world_cam: Mapping[str, Pose]) -> list[float]:
    """How far each camera is off where its neighbour puts it."""
    return [1e3 * distance for _, distance in pair_errors(T_world_cam, TRUE).values()]


def test_clouds_of_a_furnished_room_meet(furnished: Run) -> None:
    before, after = (np.median(pair_errors_mm(read_poses(path))) for path in (furnished.levelled, furnished.out))
    # The promise is 6 mm, in the median of many rooms; in this one levelling alone leaves 17 mm.
    assert before > 12
    assert after < 8
    assert "ICP refinement: " in furnished.said
    note = furnished.note
    assert note["moved"] == ["cam1", "cam2", "cam3"]
    assert note["reference"] == "cam0"
    assert note["pairs_attempted"] == len(note["pairs"]) == 6
    assert all(len(pair["information"]) == 36 for pair in note["pairs"])
    # Unbiased depth, as far as its clouds can tell: within 3 standard deviations.
    for bias in note["depth_bias"].values():
        assert abs(bias["after"]["scale"]) < 3 * bias["after"]["sigma_scale"]
        assert abs(bias["after"]["disparity_px"]) < 3 * bias["after"]["sigma_disparity_px"]


def test_the_same_input_gives_the_same_bytes(furnished: Run, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    registered(furnished.rig, furnished.store, out, *outputs(out))
    for ending in (".json", ".m.json", ".html"):
        assert out.with_suffix(ending).read_bytes() == furnished.out.with_suffix(ending).read_bytes()


def test_a_world_whose_y_points_down_gives_the_same_rig(furnished: Run, tmp_path: Path) -> None:
    down = document({n: TURN @ T for n, T in given_poses(SLID).items()}, SLID_COVARIANCE)
    down["_meta"]["world"]["up"] = [0, -1, 0]
    write_json(tmp_path / "down.json", down)
    content, _ = registered(tmp_path / "down.json", furnished.store, tmp_path / "down_out.json")
    a, b = read_poses(furnished.out), read_poses(tmp_path / "down_out.json")
    # Voxels lie elsewhere in another world, so other points take part; both are right to a few millimetres.
    assert all(np.abs((TURN @ a[name] - b[name])[:3, 3]).max() < 4e-3 for name in a)
    assert content["_meta"]["icp_refined"]["moved"] == furnished.note["moved"]


def test_nothing_slides_on_a_bare_floor(slid: Path, tmp_path: Path) -> None:
    bare = store_of(tmp_path / "bare.h5", depth_of(TRUE, (FLOOR,), zoom=ZOOM))
    level(slid, bare, tmp_path / "level.json")
    content, _ = registered(slid, bare, tmp_path / "out.json")
    before, after = read_poses(tmp_path / "level.json"), read_poses(tmp_path / "out.json")
    for name in TRUE:
        D = after[name] @ invert_transform(before[name])
        # The promise of the issue: 1 mm and 0.02 degrees.
        assert np.abs((after[name] - before[name])[[0, 2], 3]).max() <= 1e-3
        assert abs(math.degrees(math.atan2(D[0, 2] - D[2, 0], D[0, 0] + D[2, 2]))) <= 0.02
    told = {word for pair in content["_meta"]["icp_refined"]["pairs"] for word in pair["unobservable"]}
    assert any("yaw" in word for word in told)


def of_some(path: Path, names: Sequence[str]) -> Path:
    """A store with some of the cameras only."""
    return store_of(path, depth_of({name: TRUE[name] for name in names}, FURNISHED))


def test_depth_of_one_camera_registers_nothing(slid: Path, tmp_path: Path) -> None:
    failed(slid, of_some(tmp_path / "one.h5", ["cam1"]), tmp_path)


def test_a_rig_of_one_camera(tmp_path: Path) -> None:
    write_json(tmp_path / "one.json", document({"cam1": given_poses(SLID)["cam1"]}))
    failed(tmp_path / "one.json", of_some(tmp_path / "one.h5", ["cam1"]), tmp_path)


def test_cameras_that_see_nothing_in_common(tmp_path: Path) -> None:
    # Back to back, three metres apart: each sees its own floor.
    apart = {
        name: look_at(np.array([x, 1.6, 0.0]), np.array([3.0 * x, 0.0, 0.0])) for name, x in (("a", 1.5), ("b", -1.5))
    }
    write_json(tmp_path / "rig.json", document(apart))
    content = failed(tmp_path / "rig.json", store_of(tmp_path / "apart.h5", depth_of(apart, (FLOOR,))), tmp_path)
    note = content["_meta"]["icp_refined"]
    assert [(pair["source"], pair["target"], pair["overlap_m2"]) for pair in note["pairs"]] == [("a", "b", 0.0)]
    assert note["cameras"].keys() == {"a", "b"}


def test_too_coarse_a_voxel_is_told_with_what_is_left_of_each_cloud(small: Path, slid: Path, tmp_path: Path) -> None:
    content, said = registered(slid, small, tmp_path / "out.json", "--icp-voxel-size", 1, code=3)
    message = content["_meta"]["icp_refined"]["message"]
    assert all(re.search(rf"{name}: \d+ samples", message) for name in TRUE), message
    assert "--icp-voxel-size" in message
    assert said.count("ICP refinement failed") == 1


def test_a_second_pass_over_its_own_output_changes_little_and_says_so(furnished: Run, tmp_path: Path) -> None:
    _, said = registered(furnished.out, furnished.store, tmp_path / "twice.json")
    assert "were registered with this depth before" in said
    once, twice = read_poses(furnished.out), read_poses(tmp_path / "twice.json")
    # Less than the 5 mm to which the first pass knows them, and no drift away from the truth.
    assert max(float(np.abs((once[n] - twice[n])[:3, 3]).max()) for n in once) < 5e-3
    before, after = (np.median(pair_errors_mm(poses)) for poses in (once, twice))
    assert after < before + 1


def test_biases_that_are_known_are_taken_out_and_told(slid: Path, small: Path, tmp_path: Path) -> None:
    known = {"scale": 0.0, "disparity_px": 0.0, "focal_baseline": 84.0, "sigma_scale": 1e-4}
    known |= {"sigma_disparity_px": 0.005, "correlation": 0.0}
    change(slid, lambda content: content["_meta"].update(depth_bias=dict.fromkeys(TRUE, known)))
    content, _ = registered(slid, small, tmp_path / "out.json")
    for bias in content["_meta"]["icp_refined"]["depth_bias"].values():
        assert bias["before"]["sigma_scale"] == pytest.approx(1e-4)
        # What is known that well clouds of small images cannot correct.
        assert abs(bias["after"]["scale"]) < 3e-4
        assert bias["after"]["sigma_scale"] <= 1.02e-4  # no more than was given, but for the least that is always left


def test_cameras_of_which_no_baseline_is_known_are_registered(slid: Path, tmp_path: Path) -> None:
    depth = {name: dataclasses.replace(d, baseline_m=None) for name, d in depth_of(TRUE, FURNISHED).items()}
    content, _ = registered(slid, store_of(tmp_path / "nobase.h5", depth), tmp_path / "out.json")
    for bias in content["_meta"]["icp_refined"]["depth_bias"].values():
        assert "disparity_px" not in bias["after"]


def test_one_camera_that_measured_nothing_does_not_stop_the_registration(
    slid: Path, small: Path, tmp_path: Path
) -> None:
    blind = Path(shutil.copy(small, tmp_path / "blind.h5"))
    with h5py.File(blind, "r+") as file:
        file["cameras/cam1/depth"].write_direct(np.full(file["cameras/cam1/depth"].shape, np.nan, np.float32))  # pyright: ignore
    content, said = registered(slid, blind, tmp_path / "out.json", code=3)
    note = content["_meta"]["icp_refined"]
    assert note["success"]
    assert note["pairs_attempted"] == 3
    assert note["cameras"]["cam1"]["refusal"] == "no_cloud"
    assert "1 no depth that can be used" in said or "1 kept" in said


def test_a_camera_that_meets_no_other_keeps_its_pose(slid: Path, tmp_path: Path) -> None:
    # cam3 was carried away and looks at a floor of its own.
    far = {**SLID, "cam3": look_at(np.array([20.0, 1.6, 0.0]), np.array([22.0, 0.0, 0.0]))}
    write_json(slid, document(given_poses(far), SLID_COVARIANCE))
    wide = Wall(1, 0.0, (-9.0, -9.0), (29.0, 9.0))
    four = store_of(tmp_path / "four.h5", {**depth_of(TRUE, FURNISHED), **depth_of({"cam3": far["cam3"]}, (wide,))})
    level(slid, four, tmp_path / "level.json")
    content, said = registered(slid, four, tmp_path / "out.json")
    assert np.array_equal(read_poses(tmp_path / "level.json")["cam3"], read_poses(tmp_path / "out.json")["cam3"])
    assert content["_meta"]["icp_refined"]["cameras_disconnected"] == 1
    apart = [pair for pair in content["_meta"]["icp_refined"]["pairs"] if "cam3" in pair.values()]
    assert len(apart) == 3
    for pair in apart:
        assert (pair["overlaps"], pair["overlap_m2"], pair["converged"], pair["n_points"]) == (False, 0.0, False, 0)
        assert "share less than" in pair["verdict"]
    assert "cam3 │ took no part" in said
    assert "WARNING The rig is in 2 parts whose clouds do not overlap: cam0, cam1, cam2; cam3." in said
    assert "camera cam3: " in said


@pytest.mark.parametrize("says_up", [True, False])
def test_files_that_say_little(says_up: bool, small: Path, slid: Path, tmp_path: Path) -> None:
    def poses_only(content: dict[str, Any]) -> None:
        content["_meta"] = {"world": {"up": [0, 1, 0], "origin": "target"}} if says_up else {}

    change(slid, poses_only)
    content, _ = registered(slid, small, tmp_path / "out.json")
    assert "covariance" not in content["_meta"]
    assert content["_meta"]["icp_refined"]["covariance"].keys() == TRUE.keys()


@pytest.mark.parametrize(
    "more",
    [("--icp-method", "gicp"), ("--icp-region", "floor"), ("--icp-region", "full"), ("--no-icp-depth-bias",),
     ("--icp-voxel-size", 0.05), ("--icp-global-init",)],
)  # fmt: skip
def test_every_choice_runs(more: tuple[object, ...], slid: Path, small: Path, tmp_path: Path) -> None:
    content, _ = registered(slid, small, tmp_path / "out.json", *more)
    note = content["_meta"]["icp_refined"]
    assert len(note["pairs"]) == note["pairs_attempted"] > 0
    assert bool(note["depth_bias"]) == (more != ("--no-icp-depth-bias",))
    # Only with the poses that they were estimated with.
    written = {name for name, bias in note["depth_bias"].items() if bias["written"]}
    assert content["_meta"].get("depth_bias", {}).keys() == written
    assert bool(written) == bool(note["moved"] and note["depth_bias"])


def test_holes_and_wrong_depth_do_not_stop_it(slid: Path, tmp_path: Path) -> None:
    depth, rng = depth_of(TRUE, FURNISHED), np.random.default_rng(0)
    z = depth["cam1"].depth.copy()
    z[rng.random(z.shape) < 0.05] = np.nan
    z[rng.random(z.shape) < 0.002] *= 0.5
    depth["cam1"] = dataclasses.replace(depth["cam1"], depth=z)
    registered(slid, store_of(tmp_path / "holes.h5", depth), tmp_path / "out.json")
