"""Depth is compared with the target: sizes, signs, trends with range and over the image, and the words for them."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from depth_boards import EXACT, FOCAL_BASELINE, KNOWN, NOISY, PLACES, plane_depth, pose, rig, shown
from rich.console import Console

from aruco.depth_bias import DepthBias
from aruco.depth_patches import FaceDepth
from aruco.depth_tiles import face_tiles
from aruco.depth_trends import SIGNIFICANT, TileErrors, Trends, trends
from aruco.depth_verify import DepthAgreement, verify_depth
from aruco.errors import OutputError
from aruco.pose_math import Array, Pose, exp_se3
from rigcal.report.depth_table import HEADER, csv_rows, show_depth, write_report
from rigcal.sim.noise import DepthBias as SimulatedBias
from rigcal.sim.noise import DepthNoise as SimulatedNoise

POSES = [pose(place, about_rad=k) for k, place in enumerate(PLACES)]


def verified(
    faces: Sequence[FaceDepth],
    poses: Sequence[Pose] = POSES,
    T_world_cam: Pose | None = None,
    bias: DepthBias | None = None,
) -> DepthAgreement:
    biases = None if bias is None else {"a": bias}
    return verify_depth({"a": faces}, rig(poses, T_world_cam), KNOWN, biases)["a"]


def significant(found: DepthAgreement) -> set[str]:
    assert found.trends is not None
    return {name for name, trend in found.trends.slopes.items() if trend.is_significant}


# --- sizes and signs ------------------------------------------------------------------------------------------------


def test_exact_depth_has_no_error_on_faces_and_at_corners() -> None:
    found = verified(shown(POSES))
    assert len(found.corners) == 4 * len(POSES)
    # Single precision of depth images: a micrometre at 4 m; at corners half a pixel of rounding on a tilted print.
    assert np.abs(found.faces.errors_m).max() < 5e-6
    assert np.abs(found.corners.errors_m).max() < 3e-3
    assert "depth agrees with the target" in found.judgement
    assert found.findings == ()
    assert "--refine-depth" not in found.judgement


@pytest.mark.parametrize(("disparity_px", "way"), [(0.3, "near"), (-0.3, "far")])
def test_disparity_bias_shows_with_its_sign_its_size_and_its_law(disparity_px: float, way: str) -> None:
    found = verified(shown(POSES, NOISY, SimulatedBias(disparity_px=disparity_px)))
    # Most pixels are of the near markers, where noise is 5 mm a pixel, and shared by many.
    for errors, tolerance_m in ((found.faces, 3e-3), (found.corners, 5e-3)):
        expected = -np.median(errors.predicted_m**2) * disparity_px / FOCAL_BASELINE
        assert errors.median_m == pytest.approx(expected, abs=tolerance_m)
        assert abs(expected) > 2 * tolerance_m  # no error at all would miss it
    assert f"too {way} at 1." in found.judgement
    assert "like an error of disparity; more so far away; --refine-depth estimates the bias." in found.judgement
    assert found.trends is not None
    assert np.sign(found.trends.slopes["range"].slope) == -np.sign(disparity_px)
    assert significant(found) == {"range"}


def test_a_known_bias_is_taken_out_and_one_of_the_wrong_sign_is_not_believed() -> None:
    faces = shown(POSES, NOISY, SimulatedBias(scale=-0.003, disparity_px=0.15))
    right = DepthBias(scale=-0.003, inverse_depth=0.15 / FOCAL_BASELINE)
    wrong = DepthBias(scale=0.003, inverse_depth=-0.15 / FOCAL_BASELINE)
    # Noise of 12 faces at 1.5 to 4 m leaves a millimetre.
    assert abs(verified(faces, bias=right).faces.median_m) < 2e-3
    assert "agrees" in verified(faces, bias=right).judgement
    assert abs(verified(faces).faces.median_m) > 4e-3
    assert abs(verified(faces, bias=wrong).faces.median_m) > abs(verified(faces).faces.median_m)
    assert "--refine-depth" not in verified(faces, bias=wrong).judgement  # it was estimated already


@pytest.mark.parametrize(
    ("law", "cause"),
    [
        (lambda z: 1.02 * z, "scale"),
        (lambda z: z + 0.03, "offset"),
        (lambda z: 1 / (1 / z - 0.005), "disparity"),
        (lambda z: 0.96 / (1 / z - 0.015), "mixed"),
    ],
)
def test_laws_of_range_are_told_apart_by_range_alone(law: Callable[[Array], Array], cause: str) -> None:
    def bent(face: FaceDepth) -> FaceDepth:
        return replace(face, measured_m=law(face.measured_m))

    faces = [bent(face) for face in shown(POSES, NOISY)]
    found = verified(faces)
    assert found.as_dict()["looks_like"] == cause
    # From one range nobody can tell, and it is said.
    flat = [pose((x, 0.0, 2.2), tilt_deg=0.0) for x in (-0.8, -0.4, 0.0, 0.4, 0.8)]
    alone = verified([bent(face) for face in shown(flat, NOISY)], flat)
    assert alone.as_dict()["looks_like"] in ("unknown", None)


def test_normalised_errors_are_one_with_the_noise_that_the_model_knows() -> None:
    found = verified(shown(POSES, NOISY))
    # The same 0.12 and 0.06 px as the model's; correlated pixels of 16 faces leave a tenth.
    assert found.faces.normalised == pytest.approx(1.0, abs=0.15)
    assert found.corners.normalised == pytest.approx(0.9, abs=0.3)
    biased = verified(shown(POSES, NOISY, SimulatedBias(disparity_px=0.3)))
    assert biased.faces.normalised > 1.8


# --- trends ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("axis", "name", "sign", "words"), [(0, "down", 1, "to the bottom"), (1, "right", -1, "to the left")]
)
def test_a_turned_pose_shows_as_dependence_on_the_place_in_the_image(
    axis: int, name: str, sign: int, words: str
) -> None:
    xi = np.zeros(6)
    xi[axis] = np.radians(0.5)
    flat = [pose(place, tilt_deg=0.0) for place in PLACES]
    found = verified(shown(flat, NOISY), flat, exp_se3(xi))
    assert found.trends is not None
    trend = found.trends.slopes[name]
    assert trend.is_significant
    assert trend.is_own
    # A turn by w about x makes the prediction z (1 - w y): the error grows by w z a unit of y, z from 1.5 to 4 m.
    assert 1.4 < sign * trend.slope / np.radians(0.5) < 4.0
    assert f"ever farther {words} of the image, which looks like a pose that is turned" in found.judgement
    assert "like an error of disparity" not in found.judgement
    # It bites: the pose as it was shows nothing.
    assert significant(verified(shown(flat, NOISY), flat)) == set()


def test_noise_alone_is_no_trend() -> None:
    flagged = [significant(verified(shown(POSES, NOISY, seed=seed))) for seed in range(8)]
    assert flagged == [set()] * 8


def test_range_and_place_that_go_together_are_not_told_apart() -> None:
    # Every marker that is farther is seen higher, as on a floor.
    floor = [pose((0.0, 0.9 - 0.25 * z, z), tilt_deg=0.0) for z in np.linspace(1.5, 2.5, 6)]

    def bent(slope: float) -> DepthAgreement:
        faces = shown(floor, EXACT)
        return verified([replace(f, measured_m=f.measured_m + slope * (f.measured_m - 2.0)) for f in faces], floor)

    found = bent(0.02)
    assert found.trends is not None
    assert {"range", "down"} <= significant(found)
    assert not found.trends.slopes["range"].is_own
    assert "which went together" in found.judgement
    # A law that is far larger than noise fits, and the other does not.
    clear = bent(0.2).trends
    assert clear is not None
    assert clear.slopes["range"].is_own


def lattice() -> TileErrors:
    x, y, z = (g.ravel() for g in np.meshgrid([-0.4, 0.0, 0.4], [-0.3, 0.1, 0.3], [1.5, 2.0, 3.0]))
    n = len(x)
    return of_tiles(np.stack([x, y], axis=1), z, np.zeros(n), np.full(n, 0.004))


def of_tiles(places: Array, range_m: Array, errors_m: Array, sigma_m: Array) -> TileErrors:
    return TileErrors(places=places, range_m=range_m, errors_m=errors_m, sigma_m=sigma_m, alone_m=sigma_m)


def of(tiles: TileErrors, errors_m: Array) -> Trends:
    found = trends(replace(tiles, errors_m=errors_m))
    assert found is not None
    return found


def test_slopes_are_recovered_and_torn_tiles_do_not_matter() -> None:
    tiles = lattice()
    x, y = tiles.places.T
    exact = 0.01 + 0.02 * tiles.range_m - 0.03 * x + 0.015 * y
    for name, slope in {"range": 0.02, "right": -0.03, "down": 0.015}.items():
        assert of(tiles, exact).slopes[name].slope == pytest.approx(slope, abs=1e-9)
    torn = exact.copy()
    torn[[2, 11]] += 1.0
    # Cauchy's loss leaves of a metre about what noise of 4 mm would do to 27 tiles: 1.2e-3.
    assert of(tiles, torn).slopes["range"].slope == pytest.approx(0.02, abs=3e-3)
    plain = np.polyfit(tiles.range_m, torn, 1)[0]
    assert abs(plain - 0.02) > 2e-2


def test_standard_errors_are_honest() -> None:
    tiles, rng = lattice(), np.random.default_rng(5)
    drawn = [of(tiles, tiles.sigma_m * rng.standard_normal(len(tiles))) for _ in range(100)]
    for name in ("range", "right", "down", "outwards"):
        ratio = np.array([d.slopes[name].slope / d.slopes[name].sigma for d in drawn])
        # 100 draws know a deviation to 7 percent; Cauchy's loss and a scale that only widens make it a little smaller.
        assert 0.75 < ratio.std() < 1.2
        assert np.abs(ratio).max() < SIGNIFICANT + 0.5


def test_few_tiles_make_no_trend() -> None:
    tiles = lattice()
    few = of_tiles(tiles.places[:2], tiles.range_m[:2], np.ones(2), np.ones(2))
    assert trends(few) is None
    some = of_tiles(tiles.places[:6], tiles.range_m[:6], np.ones(6), np.ones(6))
    level = trends(some)
    assert level is not None
    assert level.level_m == pytest.approx(1.0)
    assert level.slopes == {}


# A board of 45 cm that is waved in one place: a tenth of the image, in twelve frames.
WAVED = [pose((0.02 * (-1) ** k, 0.01, 1.8 + 0.05 * k), tilt_deg=25.0, about_rad=k / 2) for k in range(12)]
# Nothing but what is the same in all frames, and rough enough to be there in 20 recordings.
FIXED_ONLY = SimulatedNoise(sigma_px=0.0, fixed_sigma_px=0.06, dropout=0.0)


def levels_in_sigmas(errors: Callable[[TileErrors], TileErrors], monkeypatch: pytest.MonkeyPatch) -> Array:
    """The level of the errors of 20 recordings of the waved board, in its standard errors."""
    monkeypatch.setattr("aruco.depth_verify.trends", lambda tiles: trends(errors(tiles)))
    found = [verified(shown(WAVED, FIXED_ONLY, seed=seed), WAVED).trends for seed in range(20)]
    return np.array([t.level_m / t.level_sigma_m for t in found if t is not None])


def test_frames_of_one_part_of_the_image_are_not_independent(monkeypatch: pytest.MonkeyPatch) -> None:
    levels = levels_in_sigmas(lambda tiles: tiles, monkeypatch)
    # 20 draws know a root mean square to a sixth; three of those, and corners of the board that wander.
    assert 0.4 < np.sqrt(np.mean(levels**2)) < 1.5
    # It bites: as if each frame had fixed errors of its own, it is more than twice what is promised.
    naive = levels_in_sigmas(lambda tiles: replace(tiles, sigma_m=tiles.alone_m), monkeypatch)
    assert np.sqrt(np.mean(naive**2)) > 2.0


def test_a_resting_face_is_not_doubted_and_scatter_is_that_of_tiles_alone() -> None:
    faces = shown(WAVED, FIXED_ONLY)
    known = (range(len(WAVED)), WAVED, KNOWN["a"].K, KNOWN["a"].noise)
    one = face_tiles(faces[:1], 0, *known)
    many = face_tiles(faces, 0, *known)
    # The first frame's tiles come first; the middle of the board is there in all twelve frames.
    growth = (many.sigma[: len(one)] / one.sigma) ** 2
    assert growth.max() > 4
    assert growth.min() >= 1.0 - 1e-9
    # Faces in different parts of the image share nothing.
    apart = face_tiles(shown(POSES[:4], FIXED_ONLY), 0, range(4), POSES[:4], *known[2:])
    alone = [face_tiles([f], 0, range(4), POSES[:4], *known[2:]) for f in shown(POSES[:4], FIXED_ONLY)]
    np.testing.assert_allclose(apart.sigma, np.concatenate([a.sigma for a in alone]))
    found = verified(shown(WAVED, NOISY), WAVED)
    assert found.trends is not None
    # Sixty full tiles, of noise as promised; in sigmas that know of sharing it would be below a half.
    assert 0.6 < found.trends.scatter < 1.4


def test_part_of_a_tile_weighs_less_than_a_whole_one() -> None:
    (face,) = shown([pose((0.0, 0.0, 1.8), tilt_deg=0.0)], FIXED_ONLY)
    T = [pose((0.0, 0.0, 1.8), tilt_deg=0.0)]
    sides = np.ptp(face.pixels, axis=0) + 1
    noise = replace(KNOWN["a"].noise, sigma_px=0.0, floor_m=0.0)
    tiles = face_tiles([face], 0, [0], T, KNOWN["a"].K, noise)
    # What all tiles know together is what the area knows: rims make no measurements of their own.
    fixed = 0.06 / FOCAL_BASELINE * 28 / np.sqrt(sides.prod())
    # A millimetre of unevenness beside 3 mm of fixed errors: a twentieth.
    assert np.sum(tiles.sigma**-2.0) ** -0.5 == pytest.approx(fixed, rel=0.15)
    assert tiles.sigma.max() > 1.5 * tiles.sigma.min()


def test_sigma_of_a_face_is_that_of_its_error() -> None:
    rows = [row for seed in range(6) for row in verified(shown(POSES, NOISY, seed=seed)).rows if row.corner is None]
    ratio = np.array([row.error_m / row.sigma_m for row in rows])
    # 72 faces know it to a twelfth; three of those.
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.25)


# --- what is left out -----------------------------------------------------------------------------------------------


def test_what_the_camera_does_not_trust_is_left_out_and_counted() -> None:
    confidence = np.full((480, 640), 10.0)
    confidence[:, ::3] = 100.0
    faces = shown(POSES, confidence=confidence)
    spoilt = [replace(f, measured_m=np.where(f.trusted, f.measured_m, 1.04 * f.measured_m)) for f in faces]
    found = verified(spoilt)
    assert found.faces.rmse_m < 1e-5
    assert found.untrusted_share == pytest.approx(1 / 3, abs=0.02)
    # It bites: without the map the wrong third counts.
    assert verified([replace(f, confidence=None) for f in spoilt]).faces.rmse_m > 0.02


def test_a_marker_of_several_surfaces_is_left_out_and_a_camera_without_any_is_told() -> None:
    faces = shown(POSES)
    mixed = [replace(f, measured_m=f.measured_m * np.where(np.arange(len(f.pixels)) % 2, 1.0, 0.8)) for f in faces]
    found = verified([*mixed[:3], *faces[3:]])
    assert (found.n_left_out, found.n_faces) == (3, len(faces) - 3)
    nothing = verified(mixed)
    assert nothing.n_faces == 0
    assert "no marker has enough trusted depth of a single surface" in nothing.judgement
    assert nothing.as_dict()["faces"]["median_mm"] is None
    json.dumps(nothing.as_dict(), allow_nan=False)


def test_cameras_and_frames_that_the_rig_lacks_are_passed_over() -> None:
    faces = shown(POSES)
    short = rig(POSES[:5])
    assert verify_depth({"b": faces, "a": []}, short, KNOWN) == {}
    assert verify_depth({"a": faces}, short, KNOWN)["a"].n_frames == 5


def test_another_unit_is_recognised() -> None:
    said = verified([replace(f, measured_m=1.12 * f.measured_m) for f in shown(POSES)]).judgement
    assert "far more than the bias of a camera: check depth_scale" in said


def test_markers_that_contradict_each_other_are_told() -> None:
    shaken = [exp_se3(np.r_[0, 0, 0, 0, 0, 0.05 * (-1) ** (k + k // 2)]) @ T for k, T in enumerate(POSES)]
    assert "times the noise, so a pose or the marker map may be off" in verified(shown(POSES, NOISY), shaken).judgement


# --- in files and tables --------------------------------------------------------------------------------------------


def test_the_note_is_plain_and_complete() -> None:
    found = verified(shown(POSES, NOISY, SimulatedBias(disparity_px=0.3)))
    note = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert note["judgement"] == found.judgement
    assert note["faces"]["n"] == len(found.faces)
    assert note["faces"]["markers"] == note["faces"]["frames"] == len(POSES)
    assert note["faces"]["median_mm"] == pytest.approx(1e3 * found.faces.median_m)
    assert note["corners"].keys() == {"n", "median_mm", "median_percent", "rmse_mm", "normalised"}
    assert note["trends"]["range"]["significant"] is True
    assert note["trends"].keys() == {"range", "right", "down", "outwards"}
    assert note["bias_applied"] is False


def test_the_report_has_a_line_for_every_face_and_corner(tmp_path: Path) -> None:
    found = {"a": verified(shown(POSES, NOISY, SimulatedBias(disparity_px=0.3)))}
    path = tmp_path / "depth.csv"
    write_report(path, found)
    rows = list(csv.DictReader(io.StringIO(path.read_text())))
    assert tuple(rows[0]) == HEADER
    assert len(rows) == len(csv_rows(found)) == len(found["a"].corners) + len(POSES)
    whole = [row for row in rows if row["corner"] == ""]
    assert [int(row["frame"]) for row in whole] == list(range(len(POSES)))
    for row in rows:
        off = float(row["recorded_m"]) - float(row["predicted_m"])
        assert off == pytest.approx(float(row["error_m"]), abs=2e-6)  # six digits are written
    before = path.read_bytes()
    write_report(path, found)
    assert path.read_bytes() == before
    with pytest.raises(OutputError, match="does not exist"):
        write_report(tmp_path / "nowhere" / "depth.csv", found)


def test_the_table_shows_every_camera_and_its_judgement() -> None:
    text = io.StringIO()
    nothing = verified([replace(f, measured_m=np.full(len(f.pixels), np.nan)) for f in shown(POSES)])
    shown_to = Console(file=text, width=140)
    show_depth(shown_to, {"[red]a": verified(shown(POSES)), "b": nothing})
    assert "[red]a" in text.getvalue()
    assert verified(shown(POSES)).judgement in " ".join(text.getvalue().split())
    assert nothing.judgement in " ".join(text.getvalue().split())
    assert "nan" not in text.getvalue()
    show_depth(shown_to, {})
    assert "no camera has depth on the target" in text.getvalue()


def test_the_plane_of_the_scene_is_where_the_pose_says() -> None:
    # The helper itself: the middle of the marker lies on its plane.
    T = pose((0.2, -0.1, 2.0))
    u, v = (400 * T[:2, 3] / T[2, 3] + [320, 240]).astype(int)
    assert plane_depth(T)[v, u] == pytest.approx(2.0, abs=2e-3)
