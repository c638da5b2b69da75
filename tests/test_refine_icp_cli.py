"""Registration of clouds as a user of the levelling command meets it: files, tables, page, exit codes, bad input."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from floor_rooms import FOCAL_BASELINE, depth_of, nudged
from level_runs import TRUE, TURN, change, document, failed, given_poses, level, registered, store_of

from aruco import icp_registration
from aruco.depth_bias import DepthBias
from aruco.errors import CalibrationError
from aruco.ground_plane import FloorPlane
from aruco.icp_types import METHODS, REGIONS, CameraMove, ICPConfig, ICPMetrics, ICPResult
from aruco.pose_math import Pose, exp_so3, make_pose
from aruco.uncertainty import carried
from refine_ground_plane import main
from rigcal.formats.native import read_poses, write_json
from rigcal.icp_options import icp_config

RECORDED = Path(__file__).parent / "recorded" / "levelled_without_icp.json"
# A camera that the fake registration turns and shifts, and one that its gates keep.
MOVED, KEPT, REFERENCE = "cam1", "cam2", "cam0"
MOTION = make_pose(exp_so3(np.radians([0.0, 0.3, 0.0])), np.array([0.004, 0.0, -0.003]))
NEW_BIAS = DepthBias(
    scale=0.002,
    inverse_depth=0.1 / FOCAL_BASELINE,
    focal_baseline=FOCAL_BASELINE,
    covariance=np.diag([1e-6, (0.05 / FOCAL_BASELINE) ** 2]),
)


@dataclasses.dataclass
class Fake:
    """Stands in for the registration, moves one camera, and remembers what it was told."""

    metrics: ICPMetrics = dataclasses.field(default_factory=lambda: some_metrics())
    error: Exception | None = None
    calls: list[dict[str, Any]] = dataclasses.field(default_factory=list)

    def __call__(
        self,
        camera_data: Mapping[str, Mapping[str, Any]],
        extrinsics: Mapping[str, Pose],
        floor_planes: Mapping[str, FloorPlane],
        config: ICPConfig,
        **known: Any,
    ) -> tuple[dict[str, Pose], ICPMetrics]:
        given = {"data": camera_data, "start": dict(extrinsics), "floor": floor_planes, "config": config, **known}
        self.calls.append(given)
        if self.error is not None:
            raise self.error
        return {n: MOTION @ T if n in self.metrics.moved else T for n, T in extrinsics.items()}, self.metrics


def some_metrics(**other: Any) -> ICPMetrics:
    """One camera moved, one kept, the reference, and one that took no part."""
    pair = ICPResult(
        transformation=np.eye(4),
        fitness=0.61,
        inlier_rmse=0.0071,
        information_matrix=np.diag([1e6, math.nan, 1e6, 1e5, 1e5, 1e5]),
        converged=True,
        overlap_m2=7.4,
        n_points=3120,
        rotation_deg=0.31,
        translation_mm=5.0,
        unobservable=("shift along z",),
        verdict="used",
    )
    moves = {
        REFERENCE: CameraMove(accepted=False, reason="it is the reference"),
        MOVED: CameraMove(accepted=True, reason="its gaps shrank", rotation_deg=0.3, translation_mm=5.0,
                          held_out_before_mm=9.1, held_out_after_mm=6.2, gain_sigmas=8.3, prior_sigmas=1.1),
        KEPT: CameraMove(accepted=False, reason="its gaps did not shrink", rotation_deg=0.2, unobservable=("yaw",)),
    }  # fmt: skip
    values = {
        "success": True,
        "message": "1 of 3 cameras was moved",
        "num_pairs_attempted": 2,
        "num_pairs_converged": 2,
        "num_cameras_optimized": 3,
        "num_disconnected": 1,
        "per_pair_results": {(REFERENCE, MOVED): pair, (REFERENCE, KEPT): pair},
        "reference_camera": REFERENCE,
        "cameras": moves,
        "covariances": {name: 1e-6 * np.eye(6) for name in moves},
        "biases": {MOVED: NEW_BIAS},
        "floor_tilt_deg": 0.01,
        "floor_rise_m": 0.0004,
        "floor_sigmas": 1.5,
    }
    return ICPMetrics(**{**values, **other})


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Fake:
    made = Fake()
    monkeypatch.setattr(icp_registration, "refine_with_icp", made)
    return made


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Unbiased depth of the whole rig; never to be changed."""
    return store_of(tmp_path_factory.mktemp("store") / "depth.h5", depth_of(TRUE))


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """The extrinsics of the rough rig; to be changed at will."""
    path = tmp_path / "rig.json"
    write_json(path, document(given_poses()))
    return path


# -- off is as before


def test_without_icp_the_file_is_what_it_was_before_there_was_any(rig: Path, store: Path, tmp_path: Path) -> None:
    assert level(rig, store, tmp_path / "level.json").exit_code == 0
    content = json.loads((tmp_path / "level.json").read_text())
    # Bytes of a store and numbers of a version are not what is compared.
    for key in ("inputs_sha256", "rigcal"):
        content["_meta"]["ground_refined"]["provenance"].pop(key)
    now, before = leaves(content), leaves(json.loads(RECORDED.read_text()))
    assert [path for path, _ in now] == [path for path, _ in before]
    for (path, value), (_, was) in zip(now, before):
        # Other machines add in another order: digits beyond the ninth may differ, nothing else.
        same = value == pytest.approx(was, rel=1e-8, abs=1e-12) if isinstance(was, float) else value == was
        assert same, f"{path}: {value} is not {was}"


def leaves(node: Any, path: str = "") -> list[tuple[str, Any]]:
    """Every value of a document in its order, with its place; the numbers of a pose one by one."""
    if isinstance(node, str) and re.fullmatch(r"[-+.e0-9]+( [-+.e0-9]+){15}", node):
        node = [float(x) for x in node.split()]
    if isinstance(node, dict):
        return [leaf for key, value in node.items() for leaf in leaves(value, f"{path}/{key}")]
    if isinstance(node, list):
        return [leaf for k, value in enumerate(node) for leaf in leaves(value, f"{path}/{k}")]
    return [(path, node)]


def test_no_icp_is_the_default_to_the_byte(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    said = []
    for name, flag in (("a", ()), ("b", ("--no-icp",))):
        outputs = ("--metrics-json", tmp_path / f"{name}_m.json", "--plot-output", tmp_path / f"{name}.html")
        said.append(level(rig, store, tmp_path / f"{name}.json", *outputs, *flag).output.replace(f"{name}.", "x."))
    for ending in (".json", "_m.json", ".html"):
        data = (tmp_path / f"a{ending}").read_bytes()
        assert data == (tmp_path / f"b{ending}").read_bytes()
        assert b"icp_refined" not in data
        assert b"Clouds against clouds" not in data
    assert "ICP" not in said[0]
    assert fake.calls == []


@pytest.mark.parametrize(
    "more",
    [
        ("--icp-method", "gicp"),
        ("--icp-voxel-size", "0.02"),  # the default, but somebody thought that it would do something
        ("--icp-region", "full"),
        ("--no-icp-depth-bias",),
        ("--icp-global-init",),
        ("--no-icp", "--icp-method", "gicp"),
    ],
)
def test_options_of_a_registration_that_is_not_asked_for(
    more: tuple[str, ...], rig: Path, store: Path, tmp_path: Path
) -> None:
    result = level(rig, store, tmp_path / "out.json", *more)
    assert result.exit_code == 2
    assert "--icp too" in result.output
    assert not (tmp_path / "out.json").exists()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--icp-voxel-size", "0"),
        ("--icp-voxel-size", "nan"),
        ("--icp-voxel-size", "20"),
        ("--icp-method", "colour"),
        ("--icp-region", "roof"),
    ],
)
def test_options_that_mean_nothing(option: str, value: str, rig: Path, store: Path, tmp_path: Path) -> None:
    result = level(rig, store, tmp_path / "out.json", "--icp", option, value)
    assert result.exit_code == 2
    assert option in result.output
    assert not (tmp_path / "out.json").exists()


def test_options_default_to_those_of_the_library() -> None:
    context = main.make_context("refine-ground-plane", ["-i", "a.json", "-d", "b.h5", "-o", "c.json"])
    assert icp_config(context.params) == ICPConfig()
    choices = {p.name: tuple(p.type.choices) for p in main.params if isinstance(p.type, click.Choice)}
    assert choices == {"icp_method": METHODS, "icp_region": REGIONS}


def test_help_is_quick_and_tells_the_options() -> None:
    script = "import sys; from refine_ground_plane import main\ntry: main(['--help'])\nexcept SystemExit: pass\n"
    script += "print({'numpy', 'open3d', 'plotly', 'aruco.icp_registration'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.rstrip().endswith("set()")
    assert all(flag in done.stdout for flag in ("--icp / --no-icp", "--icp-region", "--icp-global-init"))


# -- what the registration is told


def test_every_option_arrives(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    method = ("--icp-method", "gicp", "--icp-voxel-size", 0.03, "--icp-region", "full")
    more = ("--no-icp-depth-bias", "--icp-global-init", "--max-rotation-deg", 7, "--max-translation-m", 0.2)
    content, _ = registered(rig, store, tmp_path / "out.json", *method, *more, "--seed", 5, "--stride", 3)
    wanted = ICPConfig(
        method="gicp", voxel_size=0.03, region="full", depth_bias=False, global_init=True,
        max_rotation_deg=7, max_translation_m=0.2, seed=5, stride=3,
    )  # fmt: skip
    assert fake.calls[0]["config"] == wanted
    options = content["_meta"]["icp_refined"]["provenance"]["options"]
    assert options == {**dataclasses.asdict(wanted), "up": [0, 1, 0]}


def test_it_starts_from_levelled_poses_and_believes_the_markers_once(
    rig: Path, store: Path, tmp_path: Path, fake: Fake
) -> None:
    change(rig, lambda content: content["_meta"]["covariance"].pop("cam3"))
    level(rig, store, tmp_path / "level.json")
    registered(rig, store, tmp_path / "out.json")
    call, levelled = fake.calls[0], read_poses(tmp_path / "level.json")
    assert all(np.array_equal(call["start"][name], T) for name, T in levelled.items())
    assert call["floor"].keys() == TRUE.keys()
    assert all(abs(np.degrees(np.arccos(plane.normal[1]))) < 0.2 for plane in call["floor"].values())
    note = json.loads((tmp_path / "level.json").read_text())["_meta"]["ground_refined"]
    T_level_world = np.array([float(x) for x in note["common_motion"]["T_level_world"].split()]).reshape(4, 4)
    given = json.loads(rig.read_text())["_meta"]["covariance"]
    for name, T in given_poses().items():
        # Not the levelled poses: the floor, which takes part in the registration, would count twice.
        assert np.allclose(call["priors"][name], T_level_world @ T, atol=1e-12)
        scale = note["pose_scales"][name]
        # Floors that agree say nothing of yaw, x and z where the file is silent.
        assert (name in call["covariances"]) == (name in given)
        if name in given:
            alone = carried(np.array(given[name]).reshape(6, 6), T_level_world)
            wanted = max(1.0, scale) ** 2 * alone
            assert np.allclose(call["covariances"][name], wanted, rtol=1e-9, atol=1e-15)


def test_what_was_known_of_a_camera_that_the_floor_contradicts_is_forgotten(
    rig: Path, store: Path, tmp_path: Path, fake: Fake
) -> None:
    # 0.03 degrees and 2 mm, but for one that was bumped by 3 degrees.
    good = nudged(TRUE, degrees=0.03, mm=2.0, seed=4)
    aslant = make_pose(exp_so3(np.radians([0.0, 0.0, 3.0])) @ good[KEPT][:3, :3], good[KEPT][:3, 3])
    covariance = np.diag([0.0005**2] * 3 + [0.002**2] * 3)
    write_json(rig, document(given_poses({**good, KEPT: aslant}), covariance))
    content, said = registered(rig, store, tmp_path / "out.json", code=3)
    assert list(content["_meta"]["ground_refined"]["contradicted"]["cameras"]) == [KEPT]
    assert fake.calls[0]["covariances"].keys() == TRUE.keys() - {KEPT}
    (remark,) = content["_meta"]["icp_refined"]["remarks"]
    assert remark.startswith(f"The floor contradicts the given pose of {KEPT} by far more")
    assert remark in said


def test_of_a_camera_that_nobody_says_anything_of_nothing_is_said(rig: Path, tmp_path: Path, fake: Fake) -> None:
    change(rig, lambda content: content["_meta"].pop("covariance"))
    three = store_of(tmp_path / "three.h5", {n: d for n, d in depth_of(TRUE).items() if n != "cam3"})
    registered(rig, three, tmp_path / "out.json", code=3)  # a camera without depth is not levelled
    assert not fake.calls[0]["covariances"]
    assert fake.calls[0]["data"].keys() == TRUE.keys() - {"cam3"}


def test_up_and_bias_are_those_of_the_file(store: Path, tmp_path: Path, fake: Fake) -> None:
    down = {name: TURN @ T for name, T in given_poses().items()}
    bias = DepthBias(scale=0.001, inverse_depth=0.0, focal_baseline=FOCAL_BASELINE)
    known = {"world": {"up": [0, -1, 0], "origin": "target"}, "depth_bias": {"cam0": bias.as_dict()}}
    write_json(tmp_path / "down.json", document(down, **known))
    registered(tmp_path / "down.json", store, tmp_path / "out.json")
    assert fake.calls[0]["config"].up == (0.0, -1.0, 0.0)
    assert fake.calls[0]["data"]["cam0"]["bias"] == bias
    assert "bias" not in fake.calls[0]["data"]["cam1"]


# -- what the file says


@pytest.mark.parametrize(("refusal", "verdict"), [("prior", "bad"), ("unproved", "good")])
def test_a_camera_that_clouds_place_elsewhere_makes_the_verdict_bad(
    refusal: str, verdict: str, rig: Path, store: Path, tmp_path: Path, fake: Fake
) -> None:
    change(rig, lambda content: content["_meta"].update(quality={"verdict": "good", "reasons": ["All is well."]}))
    moves = {**fake.metrics.cameras}
    moves[KEPT] = dataclasses.replace(moves[KEPT], refusal=refusal)
    fake.metrics = some_metrics(cameras=moves)
    content, _ = registered(rig, store, tmp_path / "out.json")
    quality = content["_meta"]["quality"]
    assert quality["verdict"] == verdict
    assert (f"The cloud of {KEPT}" in quality["reasons"][0]) == (verdict == "bad")
    assert quality.get("verdict_before_icp") == ("good" if verdict == "bad" else None)


def test_only_what_was_accepted_is_moved(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    level(rig, store, tmp_path / "level.json")
    content, said = registered(rig, store, tmp_path / "out.json")
    before, after = read_poses(tmp_path / "level.json"), read_poses(tmp_path / "out.json")
    assert np.array_equal(after[MOVED], MOTION @ before[MOVED])
    levelled = json.loads((tmp_path / "level.json").read_text())
    assert all(content[name]["pose"] == levelled[name]["pose"] for name in TRUE if name != MOVED)
    assert said.count("ICP refinement: 1 of 3 cameras was moved.") == 1
    assert content["_meta"]["world"] == {"up": [0, 1, 0], "origin": "floor"}
    assert content["_meta"]["ground_refined"] == levelled["_meta"]["ground_refined"]


def test_what_gates_keep_is_kept_whatever_is_returned(
    rig: Path, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def careless(data: Any, extrinsics: Mapping[str, Pose], *_: Any, **__: Any) -> Any:
        return {n: MOTION @ T for n, T in extrinsics.items()}, some_metrics()

    monkeypatch.setattr(icp_registration, "refine_with_icp", careless)
    level(rig, store, tmp_path / "level.json")
    registered(rig, store, tmp_path / "out.json")
    before, after = read_poses(tmp_path / "level.json"), read_poses(tmp_path / "out.json")
    assert [name for name in TRUE if not np.array_equal(before[name], after[name])] == [MOVED]


def test_what_moving_makes_untrue_goes(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    def more(content: dict[str, Any]) -> None:
        content[MOVED] |= {"frames": 7, "kept": True, "least_known": "its yaw", "rms_px": 0.1, "spread_mm": 0.2}
        content["_meta"]["aligned"] = {"is_guess": False, "camera_up": {}}
        content["_meta"]["covariance"].pop("cam3")

    change(rig, more)
    content, _ = registered(rig, store, tmp_path / "out.json")
    entry = content[MOVED]
    assert not entry.keys() & {"kept", "least_known", "rms_px", "spread_mm"}
    assert entry["before_levelling"] == {"rms_px": 0.1, "spread_mm": 0.2}
    assert entry["frames"] == 7
    T = read_poses(tmp_path / "out.json")[MOVED]
    assert np.allclose(content["_meta"]["aligned"]["camera_up"][MOVED], -T[:3, 1], atol=1e-12)
    # Of the poses as they are now, and only where the file had one.
    assert content["_meta"]["covariance"].keys() == TRUE.keys() - {"cam3"}
    assert np.allclose(np.array(content["_meta"]["covariance"][MOVED]).reshape(6, 6), 1e-6 * np.eye(6))


def test_figures_of_markers_stand_under_the_step_that_moved_the_camera_first(
    rig: Path, store: Path, tmp_path: Path, fake: Fake
) -> None:
    change(rig, lambda content: [content[name].update(rms_px=0.1) for name in TRUE])
    content, _ = registered(rig, store, tmp_path / "both.json")
    assert all(content[name]["before_levelling"] == {"rms_px": 0.1} for name in TRUE)
    # Bounds that no correction by the floor keeps.
    content, _ = registered(rig, store, tmp_path / "clouds.json", "--max-rotation-deg", 1e-6, code=3)
    assert content[MOVED]["before_icp"] == {"rms_px": 0.1}
    assert not content[MOVED].keys() & {"rms_px", "before_levelling"}
    assert content[KEPT]["rms_px"] == 0.1
    assert not content[KEPT].keys() & {"before_icp", "before_levelling"}


def test_where_nothing_moved_the_levelled_covariances_stay(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    kept = {n: dataclasses.replace(move, accepted=False) for n, move in fake.metrics.cameras.items()}
    fake.metrics = some_metrics(cameras=kept, message="every camera keeps its pose: no gap shrank")
    level(rig, store, tmp_path / "level.json")
    content, said = registered(rig, store, tmp_path / "out.json")  # exit 0: to keep poses is a success
    levelled = json.loads((tmp_path / "level.json").read_text())
    assert all(content[name] == levelled[name] for name in TRUE)
    assert content["_meta"]["covariance"] == levelled["_meta"]["covariance"]
    assert "ICP refinement: every camera keeps its pose: no gap shrank." in said
    assert content["_meta"]["icp_refined"]["success"] is True
    assert content["_meta"]["icp_refined"]["moved"] == []


def test_biases_are_replaced_and_the_old_ones_told(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    old = DepthBias(scale=0.001, inverse_depth=0.0, focal_baseline=FOCAL_BASELINE).as_dict()
    change(rig, lambda content: content["_meta"].update(depth_bias={MOVED: old, KEPT: old}))
    content, said = registered(rig, store, tmp_path / "out.json")
    assert content["_meta"]["depth_bias"] == {MOVED: NEW_BIAS.as_dict(), KEPT: old}
    assert content["_meta"]["icp_refined"]["depth_bias"] == {
        MOVED: {"before": old, "after": NEW_BIAS.as_dict(), "written": True}
    }
    assert NEW_BIAS.as_dict()["sigma_disparity_px"] == pytest.approx(0.05)
    assert "+0.10 px" in said


def test_a_file_without_bias_gets_what_was_estimated(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    content, _ = registered(rig, store, tmp_path / "out.json")
    assert content["_meta"]["depth_bias"] == {MOVED: NEW_BIAS.as_dict()}
    fake.metrics = some_metrics(biases={})
    content, said = registered(rig, store, tmp_path / "out.json")
    assert "depth_bias" not in content["_meta"]
    assert "Depth bias" not in said


def test_a_bias_goes_only_with_the_pose_that_it_was_estimated_with(
    rig: Path, store: Path, tmp_path: Path, fake: Fake
) -> None:
    old = DepthBias(scale=0.001, inverse_depth=0.0, focal_baseline=FOCAL_BASELINE).as_dict()
    change(rig, lambda content: content["_meta"].update(depth_bias={KEPT: old}))
    fake.metrics = some_metrics(biases=dict.fromkeys((REFERENCE, MOVED, KEPT), NEW_BIAS))
    content, said = registered(rig, store, tmp_path / "out.json")
    new = NEW_BIAS.as_dict()
    assert content["_meta"]["depth_bias"] == {REFERENCE: new, MOVED: new, KEPT: old}
    told = content["_meta"]["icp_refined"]["depth_bias"]
    assert {name: bias["written"] for name, bias in told.items()} == {REFERENCE: True, MOVED: True, KEPT: False}
    assert told[KEPT]["after"] == new
    assert "no, pose kept" in said
    # Where nothing moved, biases estimated beside refused poses are none to go by.
    kept = {n: dataclasses.replace(move, accepted=False) for n, move in fake.metrics.cameras.items()}
    fake.metrics = dataclasses.replace(fake.metrics, cameras=kept)
    content, _ = registered(rig, store, tmp_path / "out.json")
    assert content["_meta"]["depth_bias"] == {KEPT: old}


def test_the_reference_of_a_part_in_which_nobody_moved_keeps_its_bias(
    rig: Path, store: Path, tmp_path: Path, fake: Fake
) -> None:
    moves, pair = fake.metrics.cameras, fake.metrics.per_pair_results[REFERENCE, MOVED]
    of_part = CameraMove(accepted=False, reason="it is the reference of its part", refusal="reference")
    apart = dataclasses.replace(pair, converged=False, overlaps=False)
    fake.metrics = some_metrics(
        cameras={**moves, KEPT: of_part, "cam3": moves[KEPT]},
        per_pair_results={(REFERENCE, MOVED): pair, (KEPT, "cam3"): pair, (REFERENCE, KEPT): apart},
        biases=dict.fromkeys(TRUE, NEW_BIAS),
    )
    content, _ = registered(rig, store, tmp_path / "out.json")
    assert content["_meta"]["depth_bias"].keys() == {REFERENCE, MOVED}


def test_covariances_of_cameras_that_stay_stay(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    level(rig, store, tmp_path / "level.json")
    content, _ = registered(rig, store, tmp_path / "out.json")
    levelled = json.loads((tmp_path / "level.json").read_text())["_meta"]["covariance"]
    assert [name for name in TRUE if content["_meta"]["covariance"][name] != levelled[name]] == [MOVED]


def test_warnings_and_remarks_are_told_everywhere(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    fake.metrics = some_metrics(warnings=("Look at cam2 <now>.",), remarks=("The floor leans.",), settled=False)
    content, said = registered(rig, store, tmp_path / "out.json", "--plot")
    assert said.count("WARNING Look at cam2 <now>.") == 1
    assert said.count("The floor leans.") == 1
    note = content["_meta"]["icp_refined"]
    assert (note["warnings"], note["remarks"], note["settled"]) == (
        ["Look at cam2 <now>."],
        ["The floor leans."],
        False,
    )
    page = (tmp_path / "out.html").read_text()
    assert "Look at cam2 &lt;now&gt;." in page
    assert "The floor leans." in page


def test_the_note_tells_every_pair_and_camera(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    metrics = tmp_path / "m.json"
    content, _ = registered(rig, store, tmp_path / "out.json", "--metrics-json", metrics)
    note = content["_meta"]["icp_refined"]
    assert json.loads(metrics.read_text())["icp_refined"] == note
    assert note["reference"] == REFERENCE
    assert note["moved"] == [MOVED]
    assert [(pair["source"], pair["target"]) for pair in note["pairs"]] == [(REFERENCE, MOVED), (REFERENCE, KEPT)]
    pair = note["pairs"][0]
    assert pair["rmse_mm"] == pytest.approx(7.1)
    assert pair["unobservable"] == ["shift along z"]
    assert len(pair["information"]) == 36
    assert pair["information"][7] is None  # JSON has no NaN
    assert note["cameras"][MOVED]["gain_sigmas"] == 8.3
    assert note["cameras"][KEPT]["held_out_before_mm"] is None
    T = np.array([float(x) for x in note["cameras"][MOVED]["T_world_new_old"].split()]).reshape(4, 4)
    assert np.allclose(T, MOTION, atol=1e-12)
    assert np.allclose([float(x) for x in note["cameras"][KEPT]["T_world_new_old"].split()], np.eye(4).ravel())
    assert note["floor"] == {"tilt_deg": 0.01, "rise_m": 0.0004, "sigmas": 1.5}
    assert (note["pairs_attempted"], note["cameras_disconnected"]) == (2, 1)
    assert all(len(digest) == 64 for digest in note["provenance"]["inputs_sha256"].values())


def test_tables_tell_every_camera_and_pair(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    _, said = registered(rig, store, tmp_path / "out.json")
    rows = [row for row in re.findall(r"│ (cam\d [^┃└]*?) │(?= │| └)", said) if "moved" in row or "took no" in row]
    assert rows, said
    for outcome in ("cam0 │ reference", "cam1 │ moved", "cam2 │ kept", "cam3 │ took no part"):
        assert outcome in said
    assert "cam0 │ cam1 │" in said
    assert "camera cam1: its gaps shrank" in said
    assert "camera cam2: its gaps did not shrink" in said


def test_the_same_clouds_twice_are_remarked(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    _, said = registered(rig, store, tmp_path / "once.json")
    assert "registered with this depth before" not in said
    _, said = registered(tmp_path / "once.json", store, tmp_path / "twice.json")
    assert "registered with this depth before" in said
    # What moved nothing has told the covariances nothing.
    fake.metrics = some_metrics(cameras={KEPT: fake.metrics.cameras[KEPT]})
    registered(rig, store, tmp_path / "kept.json")
    _, said = registered(tmp_path / "kept.json", store, tmp_path / "kept_twice.json")
    assert "registered with this depth before" not in said
    other = store_of(tmp_path / "other.h5", depth_of(TRUE, disparity_px=0.01))
    _, said = registered(tmp_path / "once.json", other, tmp_path / "twice.json")
    assert "registered with this depth before" not in said


def test_levelling_alone_keeps_what_was_said_of_clouds(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    content, _ = registered(rig, store, tmp_path / "once.json")
    assert level(tmp_path / "once.json", store, tmp_path / "again.json").exit_code == 0
    assert json.loads((tmp_path / "again.json").read_text())["_meta"]["icp_refined"] == content["_meta"]["icp_refined"]


# -- the page


def test_the_page_shows_clouds_before_and_after(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    registered(rig, store, tmp_path / "out.json", "--plot")
    page = (tmp_path / "out.html").read_text()
    assert page.count('class="plotly-graph-div"') == 5
    assert '<script src="' not in page
    assert len(page) < 20e6
    for told in ("Clouds against clouds", "1 of 3 cameras was moved", "Clouds from above", "its gaps did not shrink"):
        assert told in page
    assert page.rstrip().endswith("</html>")


def test_names_cannot_break_the_page(tmp_path: Path, fake: Fake) -> None:
    names = dict(zip(TRUE, ("<b>", "a&b", "x'y", 'q"r')))
    write_json(tmp_path / "rig.json", document({names[n]: T for n, T in given_poses().items()}))
    odd = store_of(tmp_path / "odd.h5", {names[n]: d for n, d in depth_of(TRUE).items()})
    reason = CameraMove(accepted=True, reason="<i>because</i>")
    pairs = {("<b>", "a&b"): some_metrics().per_pair_results[REFERENCE, MOVED]}
    fake.metrics = some_metrics(
        cameras={"<b>": reason}, reference_camera="a&b", covariances={}, biases={}, per_pair_results=pairs
    )
    registered(tmp_path / "rig.json", odd, tmp_path / "out.json", "--plot")
    page = (tmp_path / "out.html").read_text()
    assert "<b>" not in page
    assert "<i>because" not in page
    assert "&lt;b&gt;" in page


# -- what goes wrong


def test_a_registration_that_gives_up_leaves_the_levelled_rig(
    rig: Path, store: Path, tmp_path: Path, fake: Fake
) -> None:
    fake.metrics = ICPMetrics(success=False, message="no two clouds overlap.")
    failed(rig, store, tmp_path, "no two clouds overlap")


def test_an_error_of_the_registration_leaves_the_levelled_rig(
    rig: Path, store: Path, tmp_path: Path, fake: Fake
) -> None:
    fake.error = CalibrationError("The clouds contradict each other.")
    failed(rig, store, tmp_path, "contradict each other")


def test_a_failure_moves_nothing_whatever_it_returns(rig: Path, store: Path, tmp_path: Path, fake: Fake) -> None:
    fake.metrics = some_metrics(success=False, message="the graph did not converge")
    failed(rig, store, tmp_path, "did not converge")
