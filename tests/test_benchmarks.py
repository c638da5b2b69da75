"""A regression is seen, an improvement is not blamed, and what is committed is what is claimed."""

from __future__ import annotations

import inspect
import math
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from aruco.model import Camera
from benchmarks import baseline, run
from benchmarks.child import run_child
from benchmarks.furnished_rooms import FARTHEST_M, NEAREST_M, things_amid_cameras
from benchmarks.icp_outcomes import Outcome, Room
from benchmarks.metric import Better, Metric, Skipped, faults
from benchmarks.tag_wall import TagWall, corner_errors
from benchmarks.tone_curve import srgb


def metric(value: float, better: Better = "lower", **other: object) -> Metric:
    return replace(Metric(key="b.m", value=value, unit="mm", about="a figure", better=better), **other)  # pyright: ignore[reportArgumentType]


# --- judgement ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("better", "value", "worse"),
    [
        ("lower", 10.9, False),
        ("lower", 11.1, True),
        ("lower", 1.0, False),
        ("higher", 9.1, False),
        ("higher", 8.9, True),
        ("higher", 99.0, False),
    ],
)
def test_a_figure_is_worse_beyond_its_share_of_the_baseline_and_in_its_bad_direction_only(
    better: Better, value: float, worse: bool
) -> None:
    assert metric(value, better, rel_tol=0.1).worse_than(metric(10.0, better)) is worse


def test_the_larger_tolerance_counts() -> None:
    small = metric(0.002, abs_tol=0.005)
    assert not small.worse_than(metric(0.0))
    assert replace(small, abs_tol=0.001).worse_than(metric(0.0))


def test_a_negative_baseline_has_a_tolerance_too() -> None:
    assert not metric(-9.5, rel_tol=0.1).worse_than(metric(-10.0))
    assert metric(-8.5, rel_tol=0.1).worse_than(metric(-10.0))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_no_number_is_never_good(value: float) -> None:
    assert metric(value).breaks_limit()
    assert metric(value, rel_tol=None).worse_than(metric(1.0))


def test_a_limit_has_no_tolerance() -> None:
    assert not metric(2.5, limit=2.5).breaks_limit()
    assert metric(2.5001, limit=2.5, rel_tol=1.0).breaks_limit()
    assert metric(0.99, "higher", limit=1.0).breaks_limit()


def test_a_figure_to_compare_with_never_regresses() -> None:
    assert not metric(100.0, rel_tol=None).worse_than(metric(1.0))


def test_faults_name_limits_regressions_and_figures_that_are_gone() -> None:
    before = {"b.m": metric(1.0), "b.gone": replace(metric(1.0), key="b.gone")}
    assert faults([metric(1.0)], before) == {"b.gone": "in the baseline, but no longer measured"}
    assert "was 1" in faults([metric(2.0)], before)["b.m"]
    assert "limit 1.5" in faults([metric(2.0, limit=1.5)], before)["b.m"]
    assert faults([metric(2.0)], None) == {}
    assert faults([metric(2.0)], {}) == {}


# --- the runner -----------------------------------------------------------------------------------------------------


class FakeSuite:
    """One benchmark, whose figures and files a test decides."""

    def __init__(self, folder: Path) -> None:
        self.figures: list[Metric] = [replace(metric(1.0), key="m")]
        self.skip = ""
        self.baseline = folder / "baseline.json"
        self.readme = folder / "README.md"
        self.readme.write_text(f"above\n{baseline.BEGIN}\n{baseline.END}\nbelow\n", encoding="utf-8")

    def measure(self, name: str, quick: bool) -> list[Metric]:
        if self.skip:
            raise Skipped(self.skip)
        return [replace(figure, key=f"{name}.{figure.key}") for figure in self.figures]

    def run(self, *arguments: str) -> tuple[int, str]:
        result = CliRunner().invoke(run.main, ["help_time", *arguments])
        return result.exit_code, result.output


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeSuite:
    suite = FakeSuite(tmp_path)
    monkeypatch.setattr(run, "_measure", suite.measure)
    load, save = baseline.load, baseline.save
    monkeypatch.setattr(baseline, "load", lambda: load(suite.baseline))
    monkeypatch.setattr(baseline, "save", lambda figures: save(figures, suite.baseline, suite.readme))
    return suite


def test_a_regression_fails_the_run_and_names_the_figure(fake: FakeSuite) -> None:
    assert fake.run("--update-baseline")[0] == 0
    assert fake.run()[0] == 0
    fake.figures = [replace(metric(1.2), key="m")]
    code, output = fake.run()
    assert code == 1
    assert "help_time.m" in output.split("WORSE")[1]
    assert fake.run("--no-compare")[0] == fake.run("--quick")[0] == 0


def test_a_broken_limit_fails_every_run_and_never_becomes_the_baseline(fake: FakeSuite) -> None:
    fake.run("--update-baseline")
    before = fake.baseline.read_bytes()
    fake.figures = [replace(metric(1.0, limit=0.5), key="m")]
    assert [fake.run(flag)[0] for flag in ("--compare", "--no-compare", "--quick", "--update-baseline")] == [1, 1, 1, 1]
    assert fake.baseline.read_bytes() == before


def test_a_skipped_benchmark_fails_nothing_and_keeps_its_figures(fake: FakeSuite) -> None:
    fake.run("--update-baseline")
    before = fake.baseline.read_bytes()
    fake.skip = "no recording here"
    code, output = fake.run("--update-baseline")
    assert code == 0
    assert "skipped: no recording here" in output
    assert fake.baseline.read_bytes() == before


def test_an_update_renews_the_table_and_nothing_around_it(fake: FakeSuite) -> None:
    fake.run("--update-baseline")
    first = fake.readme.read_text(encoding="utf-8")
    assert first.startswith("above\n")
    assert first.endswith("below\n")
    fake.figures = [replace(metric(0.5), key="m")]
    fake.run("--update-baseline")
    assert fake.readme.read_text(encoding="utf-8") == first.replace("| 1 mm |", "| 0.5 mm |") != first


def test_an_update_replaces_the_benchmark_that_ran_and_no_other() -> None:
    old = {key: replace(metric(1.0), key=key) for key in ("a.m", "b.m", "b.gone")}
    new = baseline.updated(old, [replace(metric(1 / 3), key="b.m")])
    assert list(new) == ["a.m", "b.m"]
    assert new["b.m"].value == 0.3333


def test_quick_figures_cannot_become_the_baseline(fake: FakeSuite) -> None:
    assert fake.run("--quick", "--update-baseline")[0] == 2


def test_every_benchmark_says_what_it_measures_and_can_be_run() -> None:
    for name in run.NAMES:
        module = import_module(f"benchmarks.suite.{name}")
        assert (module.__doc__ or "").splitlines()[0].endswith(".")
        assert list(inspect.signature(module.run).parameters) == ["quick"]


# --- what is committed ----------------------------------------------------------------------------------------------


def test_every_benchmark_has_committed_figures_and_the_other_way_round() -> None:
    assert {baseline.benchmark_of(key) for key in baseline.load()} == set(run.NAMES)


def test_the_committed_figures_keep_their_limits() -> None:
    committed = baseline.load()
    assert faults(list(committed.values()), None) == {}
    assert sum(metric.limit is not None for metric in committed.values()) >= 15


def test_the_table_shows_the_committed_figures() -> None:
    page = baseline.README.read_text(encoding="utf-8")
    assert baseline.with_table(page, baseline.load()) == page


# --- how is measured ------------------------------------------------------------------------------------------------


def test_a_child_is_weighed_without_its_parent() -> None:
    ballast = np.ones(200_000_000, dtype=np.uint8)  # 200 MB that belong to this process only
    small = run_child(["-c", "print('hello')"])
    assert small.output == "hello"
    # An idle Python holds about 10 MB; the ballast would show.
    assert small.peak_mb < 60 < ballast.nbytes / 1e6
    large = run_child(["-c", "x = bytearray(200_000_000)"])
    assert large.peak_mb > 200


def test_a_child_that_fails_is_told_with_what_it_said() -> None:
    with pytest.raises(RuntimeError, match=r"exit code 3\nno rig"):
        run_child(["-c", "import sys; sys.exit(print('no rig') or 3)"])


@pytest.mark.skipif(sys.platform != "linux", reason="cores are limited on Linux only")
def test_a_child_is_kept_to_its_cores() -> None:
    assert run_child(["-c", "import os; print(len(os.sched_getaffinity(0)))"], cores=1).output == "1"


def test_corner_errors_measure_shift_shrinkage_and_strangers() -> None:
    square = np.array([[100.0, 100.0], [180.0, 100.0], [180.0, 180.0], [100.0, 180.0]])
    corners_px = np.array([square, square + 200, square + 400])
    view = Camera(name="a", width=640, height=640, K=np.array([[500.0, 0, 320], [0, 500, 320], [0, 0, 1]]))
    dark = np.zeros((640, 640), dtype=np.float32)
    wall = TagWall(camera=view, ids=np.arange(3), corners_px=corners_px, brightness=dark)
    centre = wall.corners_px.mean(axis=1, keepdims=True)
    inward = (centre - wall.corners_px) / np.linalg.norm(centre - wall.corners_px, axis=2, keepdims=True)
    strange = (wall.ids + 1000, wall.corners_px)
    found = (np.concatenate([wall.ids, strange[0]]), np.concatenate([wall.corners_px + 0.3 * inward, strange[1]]))
    shrunk = corner_errors([wall], [found])
    assert shrunk.inward_px == pytest.approx(0.3)
    assert shrunk.rms_px == pytest.approx(0.3)
    assert (shrunk.share, shrunk.false) == (1.0, 3)
    shifted = corner_errors([wall], [(wall.ids[:2], wall.corners_px[:2] + np.array([0.3, 0.4]))])
    assert shifted.offset_px == pytest.approx(0.5)
    assert shifted.median_px == pytest.approx(0.5)
    assert shifted.rms_centred_px == pytest.approx(0.0, abs=1e-9)
    assert shifted.share == pytest.approx(2 / 3)


def test_the_tone_curve_keeps_its_ends_and_lifts_what_is_dark() -> None:
    # 0.214 of the light is the middle of the sRGB scale.
    levels = srgb(np.array([0.0, 0.21404 * 255, 255.0], dtype=np.float32))
    np.testing.assert_allclose(levels, [0.0, 127.5, 255.0], atol=0.01)  # five digits of 0.21404


def test_things_stand_on_the_floor_around_the_target_and_repeat() -> None:
    target_m = np.array([0.7, 0.4, -0.3])
    panels = things_amid_cameras(target_m, np.random.default_rng(5))
    corners = np.concatenate([panel.vertices for panel in panels])
    assert corners[:, 1].min() == pytest.approx(0.0, abs=1e-9)
    away = np.linalg.norm(corners[:, [0, 2]] - target_m[[0, 2]], axis=1)
    # A table is 1 m by 0.7 m at most: its corners are 0.61 m from its middle.
    assert away.max() < FARTHEST_M + 0.62
    assert np.median(away) > NEAREST_M
    again = things_amid_cameras(target_m, np.random.default_rng(5))
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(panels, again))


def test_harm_is_five_percent_or_a_millimetre_whichever_is_larger() -> None:
    room = Room(seed=0, furnished=True)
    rough = Outcome(room=room, start="rough", biased=True, before_mm=40.0, after_mm={"a": 42.0, "b": 30.0})
    good = Outcome(room=room, start="good", biased=True, before_mm=5.0, levelled_mm={"a": 4.0}, after_mm={"a": 5.5})
    assert rough.growth("a") == pytest.approx(1.0)
    assert rough.growth("b") == pytest.approx(-5.0)
    assert good.growth("a") == pytest.approx(0.5)
    assert good.growth_by_icp("a") == pytest.approx(1.5)
    assert good.ratio_by_icp("a") == pytest.approx(1.375)
