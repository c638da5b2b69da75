"""Gates: limits decide, one bad number is enough, residuals alone are not, and the file's layout is kept."""

from __future__ import annotations

import json
import math

import pytest

from rigcal.quality.gates import GATES, Check, Measured, Quality, Reading, judge
from rigcal.quality.patterns import Pattern

BEST = {
    "camera position sigma": 1.0,
    "camera rotation sigma": 0.02,
    "reprojection": 0.05,
    "residual scale": 1.0,
    "held-out reprojection": 0.1,
    "length scale error": 0.05,
    "length error": 0.3,
    "views of a camera": 20.0,
}


def verdict_of(
    values: dict[str, float],
    *,
    checked: str = "ab",
    lost: dict[str, str] | None = None,
    pattern: Pattern | None = None,
    remarks: tuple[str, ...] = (),
) -> Quality:
    readings = [Reading(gate=name, value=value, sentence=f"{name} is off.") for name, value in values.items()]
    return judge(
        Measured(
            readings=readings,
            cameras=("a", "b"),
            lost=lost or {},
            checked=frozenset(checked),
            to_get_checked="move the target",
            pattern=pattern,
            remarks=remarks,
        )
    )


def test_all_within_limits_is_good_without_reasons() -> None:
    quality = verdict_of(BEST)
    assert quality.verdict == "good"
    assert quality.reasons == ()
    assert all(check.passed for check in quality.checks)


@pytest.mark.parametrize("name", BEST)
def test_beyond_the_first_limit_is_usable_beyond_the_second_bad(name: str) -> None:
    gate = GATES[name]
    middle = (gate.good + gate.bad) / 2
    beyond = gate.bad / 2 if gate.at_least else 2 * gate.bad
    assert verdict_of(BEST | {name: gate.good}).verdict == "good"
    assert verdict_of(BEST | {name: middle}).verdict == "usable"
    quality = verdict_of(BEST | {name: beyond})
    assert quality.verdict == "bad"
    assert quality.reasons == (f"{name} is off.",)
    assert [check.name for check in quality.checks if not check.passed] == [name]


def test_small_residuals_without_an_independent_check_are_only_usable() -> None:
    for checked in ("", "a"):
        quality = verdict_of(BEST | {"reprojection": 1e-6, "residual scale": 1e-3}, checked=checked)
        assert quality.verdict == "usable"
        assert "Nothing independent checks" in quality.reasons[0]
        assert quality.reasons[0].endswith("move the target.")


def test_a_number_that_could_not_be_measured_is_not_good() -> None:
    quality = verdict_of(BEST | {"held-out reprojection": math.nan})
    assert quality.verdict != "good"
    # A file may hold no NaN.
    json.dumps(quality.as_dict(), allow_nan=False)


def test_a_lost_camera_is_named_and_half_of_them_is_bad() -> None:
    quality = verdict_of(BEST, lost={"c": "never sees the target"})
    assert quality.verdict == "usable"
    assert quality.reasons == ("Without a pose: camera c (never sees the target).",)
    assert verdict_of(BEST, lost=dict.fromkeys("cde", "never sees the target")).verdict == "bad"


def test_a_pattern_is_told_and_a_large_one_is_bad() -> None:
    mild = Pattern(kind="focal", camera="a", value=-0.008, sigma=1e-3, explained=0.5)
    assert mild.sentence.startswith(
        "The residuals look like a focal length of camera a that is about 0.8 percent too l"
    )
    quality = verdict_of(BEST, pattern=mild)
    assert quality.verdict == "usable"
    assert quality.reasons == (mild.sentence,)
    large = Pattern(kind="focal", camera="a", value=-0.03, sigma=1e-3, explained=0.5)
    assert verdict_of(BEST, pattern=large).verdict == "bad"


def test_what_makes_it_bad_is_told_first_and_nothing_twice() -> None:
    quality = verdict_of(BEST | {"camera position sigma": 6.0, "length error": 100.0}, remarks=("By the way.",))
    assert quality.reasons == ("length error is off.", "camera position sigma is off.", "By the way.")


def test_the_layout_is_that_of_the_format() -> None:
    document = Quality("usable", ("Do this.",), (Check("reprojection", 2.0, "px", 1.0, False),)).as_dict()
    assert document == {
        "verdict": "usable",
        "reasons": ["Do this."],
        "checks": [{"name": "reprojection", "value": 2.0, "unit": "px", "limit": 1.0, "passed": False}],
    }


def test_every_gate_has_limits_in_order() -> None:
    for name, gate in GATES.items():
        assert name == gate.name
        assert gate.good >= gate.bad if gate.at_least else gate.good <= gate.bad
