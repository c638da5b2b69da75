"""What registration did to a camera, and why, in one sentence each.

Owns      the sentences.
Leaves    their figures to icp_objections and icp_gates.
"""

from __future__ import annotations

_KEEPS = "It keeps its pose: "


def is_reference() -> str:
    """Of the camera that all others are moved against."""
    return "It is the reference, which does not move."


def meets_nothing(without: tuple[str, ...] = ()) -> str:
    """Of a camera whose cloud leads to the reference by no chain of overlaps."""
    less = f" without the clouds of {', '.join(without)}" if without else ""
    return f"{_KEEPS}its cloud does not meet the others in a way that leads to the reference{less}."


def gained(
    turn_deg: float, shift_m: float, gaps_mm: tuple[float, float], sigmas: float, n_others: int, prior_sigmas: float
) -> str:
    """Of a camera that was moved, proved together with others that overlap it."""
    before, after = gaps_mm
    known = "" if prior_sigmas != prior_sigmas else f", {prior_sigmas:.1f} sigma from its given pose"
    return (
        f"It was moved by {move(turn_deg, shift_m)}{known}: held-out distances to other clouds went from {before:.1f} "
        f"to {after:.1f} mm, and shrank by {sigmas:.1f} standard errors {_together(n_others)}."
    )


def speaks_against(turn_deg: float, shift_m: float, sigmas: float) -> str:
    """Of a move by which held-out distances grow, all else being as good as it can."""
    return (
        f"{_KEEPS}by its move of {move(turn_deg, shift_m)} held-out distances to other clouds grow, by {sigmas:.1f} "
        "standard errors."
    )


def not_proved(turn_deg: float, shift_m: float, sigmas: float, n_others: int, asked: float) -> str:
    """Of a move that is as good as chance, together with those around."""
    gain = f"shrink by {sigmas:.1f} standard errors, want {asked:g}" if sigmas > 0 else "do not shrink"
    return (
        f"{_KEEPS}its move of {move(turn_deg, shift_m)} is not proved: {_together(n_others)} held-out distances {gain}."
    )


def _together(n_others: int) -> str:
    """For whose moves together distances were compared."""
    if not n_others:
        return "by its move alone"
    others = "the camera that overlaps it" if n_others == 1 else f"{n_others} cameras that overlap it"
    return f"by its move and that of {others} together"


def too_far(turn_deg: float, shift_m: float, most_deg: float, most_m: float) -> str:
    """Of a move beyond the bounds."""
    return (
        f"{_KEEPS}its move of {move(turn_deg, shift_m)} against what the other cameras do in common is more than the "
        f"{most_deg:g} degrees and {1e3 * most_m:g} mm allowed; if it was bumped, calibrate it again or raise these."
    )


def unbelievable_depth(share: float, sigma: float, surprise: float, most: float) -> str:
    """Of a cloud that meets others only if its depth is wrong beyond belief, by a share of what is measured."""
    return (
        f"{_KEEPS}its cloud meets the others only with depth that is wrong by {100 * share:.1f} % (+- "
        f"{100 * sigma:.1f} %), at {surprise:.1f} sigma of what is usual, {most:.1f} are allowed; check its depth with "
        "--verify-depth, and that nothing moved between the recordings."
    )


def unbelievable_depths(share: float, sigma: float, surprise: float, most: float) -> str:
    """Of the worst of several clouds that meet only if the depth of all of them is wrong beyond belief."""
    return (
        f"{_KEEPS}clouds meet only if the depth of all cameras together is wrong at {surprise:.1f} sigma of what is "
        f"usual, {most:.1f} are allowed, its own by most: {100 * share:.1f} % (+- {100 * sigma:.1f} %); check depth "
        "with --verify-depth."
    )


def does_not_fit(misfit: float, most: float) -> str:
    """Of a cloud that is elsewhere than the others."""
    return (
        f"{_KEEPS}its cloud misses the others by {misfit:.1f} times the noise of depth, {most:g} are allowed; check "
        "that the depth is this camera's own and that nothing moved between the recordings."
    )


def against_prior(turn_deg: float, shift_m: float, sigmas: float, most: float) -> str:
    """Of a move that contradicts the covariance of the given pose."""
    return (
        f"{_KEEPS}its move of {move(turn_deg, shift_m)} is {sigmas:.1f} sigma of what its given pose is known to, "
        f"{most:.1f} are allowed; if the camera was bumped, calibrate it again."
    )


def floor_worse(before: tuple[float, float], after: tuple[float, float]) -> str:
    """Of a move that takes a camera's own floor off the common one; (angle [deg], distance [m]) each."""
    return (
        f"{_KEEPS}its own floor, {before[0]:.2f} degrees and {1e3 * before[1]:.1f} mm off the common one, would be "
        f"{after[0]:.2f} degrees and {1e3 * after[1]:.1f} mm off."
    )


def common_floor_tilts(before_deg: float, after_deg: float) -> str:
    """Of the camera that turns most where the floor of all does not stay level."""
    return (
        f"{_KEEPS}with the moves of all cameras the floor would tilt from {before_deg:.2f} to {after_deg:.2f} degrees, "
        "and this camera turns most."
    )


def move(turn_deg: float, shift_m: float) -> str:
    """How far something is moved."""
    return f"{turn_deg:.2f} degrees and {1e3 * shift_m:.1f} mm"


def untold(directions: tuple[str, ...]) -> str:
    """Directions in which clouds say less than the given pose, of the six that there are."""
    return "all" if len(directions) == 6 else ", ".join(directions) or "-"
