"""USD cameras: read back, and by USD itself."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from format_rigs import format_rig, lens, pixels, points_before, worst_pose_difference
from hypothesis import given, settings
from hypothesis import strategies as st
from loguru import logger

from aruco.errors import InputError
from aruco.model import Camera
from aruco.pose_math import invert_transform
from rigcal.formats.rig import ExportOptions, Rig
from rigcal.formats.usd import FORMAT, camera_name, prim_name
from rigcal.formats.usd_film import film_of
from rigcal.formats.usd_text import UsdTextError, parsed, quoted

KINDS = {"34563472": "pinhole", "left_cam": "pinhole", "z-1": "pinhole"}
# A half turn about x changes signs only, and customData holds doubles.
ROUND_TRIP = 1e-12
# USD's lens is in single precision, which alone would be 1e-5 to 4e-5 px; film_of looks for a better focal length.
PIXEL_TOLERANCE = 1e-6


def written(rig: Rig, folder: Path) -> Path:
    FORMAT.write(rig, folder / "rig.usda", ExportOptions())
    return folder / "rig.usda"


def said(action: Any) -> str:
    told: list[str] = []
    handler = logger.add(lambda message: told.append(str(message)), level="WARNING", format="{message}")
    action()
    logger.remove(handler)
    return "".join(told)


def usd_pixels(path: Path, rig: Rig) -> dict[str, np.ndarray]:
    """Where USD sees every camera's points: its frustum's projection, in pixels from the image's edge."""
    usd, geom, gf = (pytest.importorskip(f"pxr.{part}") for part in ("Usd", "UsdGeom", "Gf"))

    stage = usd.Stage.Open(str(path))
    found = {}
    for prim in stage.Traverse():
        if not prim.IsA(geom.Camera):
            continue
        data = prim.GetCustomData()["rigcal"]
        frustum = geom.Camera(prim).GetCamera(usd.TimeCode.Default()).frustum
        M = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        ndc = np.array([M.Transform(gf.Vec3d(*point)) for point in points_before(rig, data["name"]).tolist()])
        w, h = data["image_width"], data["image_height"]
        found[data["name"]] = np.stack([(1 + ndc[:, 0]) / 2 * w, (1 - ndc[:, 1]) / 2 * h], axis=1)
    assert found.keys() == rig.T_world_cam.keys()
    return found


@pytest.mark.parametrize("up", ["+y", None])
def test_what_was_written_comes_back(up: Any, tmp_path: Path):
    rig = format_rig({**KINDS, "b": "brown", "r": "rational", "f": "fisheye"}, up)
    path = written(rig, tmp_path)
    assert FORMAT.recognises(path, path.read_bytes())
    back = FORMAT.read(path)
    assert back.up == up
    assert worst_pose_difference(rig, back) < ROUND_TRIP
    for name, camera in rig.cameras.items():
        assert np.abs(back.cameras[name].K - camera.K).max() < ROUND_TRIP
        assert back.cameras[name].distortion.tolist() == camera.distortion.tolist()
        assert back.cameras[name].distortion_model == camera.distortion_model


def test_a_world_with_y_down_is_turned(tmp_path: Path):
    back = FORMAT.read(written(format_rig(KINDS, "-y"), tmp_path))
    assert back.up == "+y"
    assert worst_pose_difference(format_rig(KINDS, "+y"), back) < ROUND_TRIP


def test_usd_projects_the_same_points_to_the_same_pixels(tmp_path: Path):
    rig = format_rig(KINDS)
    for name, found in usd_pixels(written(rig, tmp_path), rig).items():
        # USD's image begins at the edge of the first pixel, whose centre is ours.
        assert np.abs(found - 0.5 - pixels(rig, name, points_before(rig, name))).max() < PIXEL_TOLERANCE


def test_usd_takes_the_stage_for_upright_metres(tmp_path: Path):
    usd, geom = (pytest.importorskip(f"pxr.{part}") for part in ("Usd", "UsdGeom"))

    stage = usd.Stage.Open(str(written(format_rig(KINDS), tmp_path)))
    assert geom.GetStageMetersPerUnit(stage) == 1
    assert geom.GetStageUpAxis(stage) == "Y"
    assert stage.GetDefaultPrim().GetName() == "Rig"
    assert [prim.GetName() for prim in stage.GetDefaultPrim().GetChildren()] == [
        "camera_34563472", "camera_left__cam", "camera_z_u2d_1",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("pattern", "change"),
    [
        (r"(horizontalApertureOffset = )(-?)", lambda m: m[1] + ("" if m[2] else "-")),
        (r"(verticalApertureOffset = )(-?)", lambda m: m[1] + ("" if m[2] else "-")),
        (r"(horizontalAperture = )(\S+)", lambda m: f"{m[1]}{float(m[2]) * 1.001}"),
        (r"(xformOp:transform = )(.*)", lambda m: m[1] + "( (1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,3,1) )"),
    ],
)
def test_the_usual_mistakes_would_be_seen(pattern: str, change: Any, tmp_path: Path):
    rig = format_rig(KINDS)
    path = written(rig, tmp_path)
    path.write_text(re.sub(pattern, change, path.read_text()))
    for name, found in usd_pixels(path, rig).items():
        assert np.abs(found - 0.5 - pixels(rig, name, points_before(rig, name))).max() > 0.1


def test_an_inverted_pose_would_be_seen(tmp_path: Path):
    rig = format_rig(KINDS)
    wrong = Rig(T_world_cam={n: invert_transform(T) for n, T in rig.T_world_cam.items()}, up="+y", cameras=rig.cameras)
    for name, found in usd_pixels(written(wrong, tmp_path), rig).items():
        assert np.abs(found - 0.5 - pixels(rig, name, points_before(rig, name))).max() > 10


def test_single_precision_without_a_search_would_miss_the_tolerance():
    fx, fy, cx, cy = 1059.37, 1061.93, 953.11, 548.77
    first = [float(np.float32(v)) for v in (0.25, 0.25 * 1920 / fx, 0.25 * (960 - cx - 0.5) / fx)]
    plain = abs(1920 * first[0] / first[1] / fx - 1) * 960 + abs((960 - 1920 * first[2] / first[1]) - cx - 0.5)
    assert plain > 3 * PIXEL_TOLERANCE
    gx, gy, ox, oy = film_of((fx, fy, cx, cy), 1920, 1080).pinhole(1920, 1080)
    assert abs(gx / fx - 1) * 967 + abs(ox - cx) < PIXEL_TOLERANCE
    assert abs(gy / fy - 1) * 549 + abs(oy - cy) < PIXEL_TOLERANCE


@settings(max_examples=20, deadline=None)  # each looks through a million focal lengths
@given(
    st.floats(200, 5000), st.floats(0.9, 1.1), st.floats(-60, 60), st.floats(-60, 60),
    st.sampled_from([(640, 480), (1280, 720), (1920, 1200)]),
)  # fmt: skip
def test_every_lens_is_held_to_a_millionth_of_a_pixel(f: float, ratio: float, dx: float, dy: float, size: Any):
    width, height = size
    fx, fy, cx, cy = f, f * ratio, width / 2 + dx, height / 2 + dy
    gx, gy, ox, oy = film_of((fx, fy, cx, cy), width, height).pinhole(width, height)
    assert abs(gx / fx - 1) * width / 2 + abs(ox - cx) < PIXEL_TOLERANCE
    assert abs(gy / fy - 1) * height / 2 + abs(oy - cy) < PIXEL_TOLERANCE


@given(st.text(st.characters(max_codepoint=0xFFFFF, exclude_categories=["Cs"]), min_size=1))
def test_prim_names_are_reversible(name: str):
    assert re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", prim_name(name))
    assert camera_name(prim_name(name)) == name


@given(st.text())
def test_strings_survive_quoting(text: str):
    assert parsed(f"#usda 1.0\n(\n comment = {quoted(text)}\n)\n").metadata["comment"] == text


def test_odd_names_come_back_and_usd_reads_them(tmp_path: Path):
    names = ['a "b" c', "ä_1", "1;2"]
    rig = format_rig(dict.fromkeys(names, "pinhole"))
    path = written(rig, tmp_path)
    assert list(FORMAT.read(path).T_world_cam) == sorted(names)
    assert usd_pixels(path, rig).keys() == set(names)


def test_what_usd_cannot_hold_is_said(tmp_path: Path):
    assert "camera b as a pinhole" in said(lambda: written(format_rig({"a": "pinhole", "b": "brown"}), tmp_path))
    assert "--auto-align" in said(lambda: written(format_rig(KINDS, None), tmp_path))
    assert said(lambda: written(format_rig(KINDS), tmp_path)) == ""
    with pytest.raises(InputError, match="--recording"):
        written(Rig(T_world_cam={"a": np.eye(4)}, up="+y"), tmp_path)
    skewed = Camera(name="a", width=64, height=48, K=np.array([[50, 1, 32], [0, 50, 24], [0, 0, 1]]))
    with pytest.raises(InputError, match="skew"):
        written(Rig(T_world_cam={"a": np.eye(4)}, up="+y", cameras={"a": skewed}), tmp_path)


def test_a_lens_that_was_changed_since_counts(tmp_path: Path):
    path = written(format_rig({"a": "pinhole"}), tmp_path)
    text = path.read_text()
    focal = float(re.findall(r"focalLength = (\S+)", text)[0])
    path.write_text(text.replace(f"focalLength = {focal!r}", f"focalLength = {2 * focal!r}"))
    told: list[Rig] = []
    assert "was changed" in said(lambda: told.append(FORMAT.read(path)))
    assert abs(told[0].cameras["a"].K[0, 0] - 2 * lens("a", "pinhole").K[0, 0]) < 1e-5


FOREIGN = """#usda 1.0
( "made elsewhere"
  metersPerUnit = 0.01
  upAxis = "Z" )
def Xform "world" ( kind = "group" ) {
    matrix4d xformOp:transform = ( (2,0,0,0), (0,2,0,0), (0,0,2,0), (100,0,0,1) )
    uniform token[] xformOpOrder = ["xformOp:transform"]
    def Mesh "box" { int[] faceVertexIndices = [0, 1, 2]  # three
        rel material:binding = </m>
        float3[] extent = [(0,0,0), (1,1,1)] ( customData = { string s = '''it's''' } )
        double x.timeSamples = { 0: 1, 1: 2.5, }
    }
    def Camera "cam" {
        matrix4d xformOp:transform = ( (1,0,0,0), (0,1,0,0), (0,0,1,0), (0,50,25,1) )
        uniform token[] xformOpOrder = ["xformOp:transform"]
        custom string note = \"\"\"two
lines\"\"\"
    }
}
"""


def test_stages_of_other_programs_are_read_as_usd_reads_them(tmp_path: Path):
    path = tmp_path / "x.usda"
    path.write_text(FOREIGN)
    rig = FORMAT.read(path)
    assert rig.up == "+y"
    # 100 + 2 * (0, 50, 25) cm with Z up are (1, 1, 0.5) m, and (1, 0.5, -1) m with Y up.
    assert np.allclose(rig.T_world_cam["cam"][:3, 3], [1, 0.5, -1], rtol=0, atol=1e-15)
    usd, geom = (pytest.importorskip(f"pxr.{part}") for part in ("Usd", "UsdGeom"))

    stage = usd.Stage.Open(str(path))
    M = geom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/world/cam"))
    x, y, z = np.array(M.ExtractTranslation()) * 0.01
    assert np.allclose(rig.T_world_cam["cam"][:3, 3], [x, z, -y], rtol=0, atol=1e-15)


@pytest.mark.parametrize("off", ["active = false", "active = 0"])
def test_what_is_switched_off_is_not_there(off: str, tmp_path: Path):
    path = tmp_path / "x.usda"
    path.write_text(
        f'#usda 1.0\ndef Camera "a" ( active = true ) {{}}\ndef Camera "b" ( {off} ) {{}}\n'
        f'def Xform "x" ( {off} ) {{\n def Camera "c" {{}}\n}}\n'
    )
    assert list(FORMAT.read(path).T_world_cam) == ["a"]
    stage = pytest.importorskip("pxr.Usd").Stage.Open(str(path))
    assert [prim.GetName() for prim in stage.Traverse()] == ["a"]


@pytest.mark.parametrize("tail", [".timeSamples = { 0: 0.3 }", ".connect = </x.y>"])
def test_a_lens_that_changes_with_time_is_not_taken_for_usds_fallback(tail: str, tmp_path: Path):
    path = written(format_rig({"a": "pinhole"}), tmp_path)
    text = path.read_text()
    for key in ("focalLength", "verticalApertureOffset"):
        for line in (rf"float {key}{tail}", rf"\g<0>\n        float {key}{tail}"):  # alone, or beside the default value
            path.write_text(re.sub(rf"float {key} = \S+", line, text))
            with pytest.raises(InputError, match=rf"camera_a: its lens is given by {key}\.") as caught:
                FORMAT.read(path)
            assert "bake it" in str(caught.value)


def test_a_place_that_changes_with_time_is_not_taken_for_its_default(tmp_path: Path):
    path = written(format_rig({"a": "pinhole"}), tmp_path)
    samples = "        matrix4d xformOp:transform.timeSamples = { 0: ( (1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,3,1) ) }\n"
    text = path.read_text()
    at = text.index("        uniform token[] xformOpOrder")
    path.write_text(text[:at] + samples + text[at:])
    with pytest.raises(InputError, match="without time samples; bake it"):
        FORMAT.read(path)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("#usda 1.0\n", "holds no camera"),
        ("#usdz", "does not begin"),
        ('#usda 1.0\ndef Camera "a" {', "ends in the middle"),
        ('#usda 1.0\ndef Camera "a" { float x = }', "line 2: '}' stands where a value"),
        ('#usda 1.0\ndef Xform "a" ' + '{ def Xform "a" ' * 100, "nested deeper"),
        ('#usda 1.0\ndef Camera "a" { float x = ' + "[" * 5000, "nested deeper"),
        ('#usda 1.0\ndef Camera "a" { float3 xformOp:translate = (1,2,3)\nuniform token[] xformOpOrder = '
         '["xformOp:translate"] }', "bake it"),
        ('#usda 1.0\ndef Camera "a" {}\ndef Camera "a" {}', "two cameras a"),
        ('#usda 1.0\n(metersPerUnit = -1)\ndef Camera "a" {}', "metersPerUnit"),
        ('#usda 1.0\n(upAxis = "X")\ndef Camera "a" {}', "upAxis"),
        ('#usda 1.0\ndef Camera "a" { variantSet "v" = { "x" { } } }', "flatten"),
        ('#usda 1.0\ndef Camera "a" (customData = {dictionary rigcal = {string name = "../x"}}) {}', "be called"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused_in_one_sentence(text: str, told: str, tmp_path: Path):
    path = tmp_path / "x.usda"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(told)) as caught:
        FORMAT.read(path)
    assert str(path) in str(caught.value)


def test_binary_files_are_recognised_and_the_cure_named(tmp_path: Path):
    path = tmp_path / "x.usdc"
    path.write_bytes(b"PXR-USDC\x00\x00")
    assert FORMAT.recognises(path, path.read_bytes())
    with pytest.raises(InputError, match="usdcat"):
        FORMAT.read(path)


@given(
    st.binary(max_size=200).map(lambda b: b.decode("latin-1")) | st.text("def Xform\"'(){}[]=:#\n<>@1.-", max_size=80)
)
def test_no_text_makes_the_parser_fail_otherwise(text: str):
    try:
        parsed("#usda 1.0\n" + text)
    except UsdTextError:
        return


@pytest.mark.parametrize("suffix", [".usdc", ".usdz", ".txt", ""])
def test_a_name_that_promises_another_layout_is_refused(suffix: str, tmp_path: Path):
    with pytest.raises(InputError, match=r"like rig\.usda"):
        FORMAT.write(format_rig({"a": "pinhole"}), tmp_path / f"rig{suffix}", ExportOptions())
    FORMAT.write(format_rig({"a": "pinhole"}), tmp_path / "rig.usd", ExportOptions())
