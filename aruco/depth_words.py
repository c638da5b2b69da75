"""What a comparison of depth with the target means, in words.

Owns      sentences about the level of the error, its trends, their likely cause and what to do.
Leaves    the figures to depth_verify and depth_trends.
"""

from __future__ import annotations

from aruco.depth_trends import Cause, Trend, Trends

# Calibrations of focal length and baseline hold to a few tenths of a percent: less than this is what a good camera has.
AGREES_SHARE = 0.002
AGREES_SIGMAS = 3.0
# Bias is a percent or two; what is off by more has another unit, another map, or another target.
GROSS_SHARE = 0.05
# Residuals this many times the promised noise are no noise.
ROUGH_SCATTER = 3.0
# Pixels on faces this many times the promised noise off, root mean square, do not agree, whatever they are on average:
# a mirrored image is right in its middle. Beyond this many times their average it is no bias that they are off by.
MAX_RMSE_SIGMAS = 5.0
MAX_RMSE_OF_LEVEL = 3.0
_NOT_ITS_OWN = "check that the depth images are this camera's own and not mirrored, and the depth's intrinsics"
_DISTORTED = "intrinsics or rectification that are off"
_TURNED = "a pose that is turned, or intrinsics that are off"
_CAUSES: dict[Cause, str] = {
    "scale": "it grows in proportion to range, like a wrong baseline or focal length",
    "disparity": "it grows with the square of range, like an error of disparity",
    "offset": "it is the same at all ranges, like a constant offset",
    "mixed": "scale and disparity (or offset) seem to be wrong together",
    "unknown": "the ranges seen are too alike to say whether scale, disparity or an offset is wrong",
}
_DIRECTIONS = {
    "right": ("to the right of the image", "to the left of the image", _TURNED),
    "down": ("to the bottom of the image", "to the top of the image", _TURNED),
    "outwards": ("to the edges of the image", "to the middle of the image", _DISTORTED),
}


def findings(trends: Trends | None) -> tuple[str, ...]:
    """One sentence for every trend that is there for sure and large enough to matter."""
    return tuple(_finding(name, trend) for name, trend in _there(trends).items())


def _there(trends: Trends | None) -> dict[str, Trend]:
    return {} if trends is None else {name: t for name, t in trends.slopes.items() if t.is_significant}


def _finding(name: str, trend: Trend) -> str:
    size = f"{1e3 * abs(trend.effect_m):.1f} mm over what was seen"
    if name == "range":
        way = "farther" if trend.slope > 0 else "nearer"
        per_metre = f"{1e3 * abs(trend.slope):.1f} +- {1e3 * trend.sigma:.1f} mm"
        return f"with every metre of range depth is measured {per_metre} {way}, {size}{_shared(trend)}."
    where, meaning = _towards(name, trend), _DIRECTIONS[name][2]
    return f"depth is measured ever farther {where}, {size}{_shared(trend) or f': {meaning}'}."


def _towards(name: str, trend: Trend) -> str:
    up, down, _ = _DIRECTIONS[name]
    return up if trend.slope > 0 else down


def _shared(trend: Trend) -> str:
    return "" if trend.is_own else "; range and place in the image explain it alike, because they went together"


def judgement(
    level: tuple[float, float],
    rmse: tuple[float, float, float],
    range_m: tuple[float, float],
    trends: Trends | None,
    *,
    corrected: bool,
) -> str:
    """What a user should think, and do, in one sentence.

    Args:
        level: Typical error [m], and its share of the range; positive: too far.
        rmse: Root mean square error [m], in what noise and prints that are not flat explain, and that of most pixels.
        range_m: Nearest and farthest that was seen.
        trends: How the error goes with range and over the image.
        corrected: Whether a bias was taken out before.
    """
    level_m, share = level
    where = f"at {range_m[0]:.1f} to {range_m[1]:.1f} m"
    way = "far" if level_m > 0 else "near"
    amount = f"{1e3 * abs(level_m):.1f} mm ({100 * abs(share):.2f} %) too {way} {where}"
    if abs(share) > GROSS_SHARE:
        return (
            f"depth is {amount}, far more than the bias of a camera: check depth_scale, the depth's intrinsics and "
            "the size of the printed markers."
        )
    noise_m = 0.0 if trends is None else AGREES_SIGMAS * trends.level_sigma_m
    agrees = abs(share) <= AGREES_SHARE or abs(level_m) <= noise_m
    growth = _growth(trends)
    stray = _stray(level_m, rmse, alike=agrees or corrected)
    if growth and agrees:
        parts = [f"depth is {amount} on average", *growth]
    elif agrees and stray:
        parts = [f"depth does not agree with the target, though it is {amount} on average"]
    elif agrees:
        said = f"agrees with the target{'' if abs(share) <= AGREES_SHARE else ' within its noise'}, {amount}"
        parts = [f"most of depth {said}", _few(rmse)] if rmse[1] > MAX_RMSE_SIGMAS else [f"depth {said}"]
    else:
        parts = [f"depth is {amount}", *_cause(trends), *growth]
    parts += [*_scatter(trends), *stray]
    if (growth or not agrees) and not corrected:
        parts.append(f"--refine-depth {'corrects poses' if _turned(trends) else 'estimates the bias'}")
    return "; ".join(parts) + "."


def _turned(trends: Trends | None) -> list[str]:
    """The directions of the image in which the error grows, and nothing else explains it."""
    return [_towards(n, t) for n, t in _there(trends).items() if n in ("right", "down") and t.is_own]


def _cause(trends: Trends | None) -> list[str]:
    """What the level looks like over range; of a pose that is turned it looks like anything."""
    return [] if trends is None or not trends.cause or _turned(trends) else [_CAUSES[trends.cause]]


def _growth(trends: Trends | None) -> list[str]:
    """The trends in a few words."""
    there = _there(trends)
    if trends is None or not there:
        return []
    if not any(trend.is_own for trend in there.values()):
        return ["it differs over the image and with range, which went together: show the target in more places"]
    said = [_with_range(there["range"], trends.level_m)] if "range" in there and there["range"].is_own else []
    turned = _turned(trends)
    if turned:
        said.append(f"ever farther {' and '.join(turned)}, which looks like {_TURNED}")
    elif "outwards" in there:
        said.append(f"ever farther {_towards('outwards', there['outwards'])}, which looks like {_DISTORTED}")
    return said


def _with_range(trend: Trend, level_m: float) -> str:
    if abs(level_m) < 0.1 * abs(trend.effect_m):
        return f"ever {'farther' if trend.slope > 0 else 'nearer'} with growing range"
    return f"{'more' if trend.slope * level_m > 0 else 'less'} so far away"


def _few(rmse: tuple[float, float, float]) -> str:
    return f"but some pixels are far off (RMSE {1e3 * rmse[0]:.0f} mm, {rmse[1]:.0f} sigmas), as beside edges"


def _stray(level_m: float, rmse: tuple[float, float, float], *, alike: bool) -> list[str]:
    """Errors that are far larger than noise, and neither what is typical; alike: those that are typical are small."""
    rmse_m, sigmas, of_most = rmse
    if not of_most > MAX_RMSE_SIGMAS or not (alike or rmse_m > MAX_RMSE_OF_LEVEL * abs(level_m)):
        return []
    return [f"pixels are {1e3 * rmse_m:.0f} mm off (RMSE), {sigmas:.0f} sigmas: {_NOT_ITS_OWN}"]


def _scatter(trends: Trends | None) -> list[str]:
    if trends is None or trends.scatter <= ROUGH_SCATTER:
        return []
    return [f"markers differ by {trends.scatter:.0f} times the noise, so a pose or the marker map may be off"]
