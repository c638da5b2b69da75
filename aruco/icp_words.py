"""What registration did to a camera, and why, in one sentence each.

Owns      the sentences.
Leaves    their figures to icp_objections, icp_gates, icp_suspects and icp_bumped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

Way = tuple[float, float]  # [deg], [m]
_KEEPS = "It keeps its pose: "


def is_reference() -> str:
    """Of the camera that all others are moved against."""
    return "It is the reference, which does not move."


def meets_nothing(without: tuple[str, ...] = ()) -> str:
    """Of a camera whose cloud leads to the reference by no chain of overlaps."""
    less = f", the clouds of {', '.join(without)} being set aside" if without else ""
    return f"{_KEEPS}no chain of overlaps leads from its cloud to the reference's{less}."


def gained(
    turn_deg: float, shift_m: float, gaps_mm: tuple[float, float], sigmas: float, n_others: int, prior_sigmas: float
) -> str:
    """Of a camera that was moved, proved together with others that overlap it."""
    before, after = gaps_mm
    known = "" if prior_sigmas != prior_sigmas else f" (estimated {prior_sigmas:.1f} sigma from its given pose)"
    return (
        f"It was moved by {move(turn_deg, shift_m)}{known}: held-out distances to other clouds went from {before:.2f} "
        f"to {after:.2f} mm, and shrank by {sigmas:.1f} standard errors {_together(n_others)}."
    )


def speaks_against(turn_deg: float, shift_m: float, sigmas: float) -> str:
    """Of a move by which held-out distances grow, all else being as good as it can."""
    return (
        f"{_KEEPS}by its move of {move(turn_deg, shift_m)} held-out distances to other clouds grow, by {sigmas:.1f} "
        "standard errors."
    )


def not_proved(turn_deg: float, shift_m: float, sigmas: float, n_others: int, asked: float) -> str:
    """Of a move that is as good as chance, together with those around."""
    # Rounded down: what fell short of a limit must not read as if it reached it.
    told = math.floor(10 * sigmas) / 10
    gain = f"shrink by {told:.1f} standard errors, want {asked:g}" if sigmas > 0 else "do not shrink"
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
    """Of a camera that clouds place away from its given pose, farther than that is known to."""
    return (
        f"{_KEEPS}clouds place it {move(turn_deg, shift_m)} from its given pose, {sigmas:.1f} sigma of what that is "
        f"known to, {most:.1f} are allowed; if the camera was bumped, calibrate it again."
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


# ------------------------------------------------------------------------------------------- cameras that look bumped


def found(turn_deg: float, shift_m: float, before_mm: float, after_mm: float, sigmas: float, known: Way | None) -> str:
    """Of a camera that was moved to where its surroundings place it, known to so much [deg], [m], one sigma."""
    to = "" if known is None else f" Its new one is known to {move(*known)}, one sigma: calibrate it again for more."
    return (
        f"It was moved, as its surroundings place it {move(turn_deg, shift_m)} from where it was said to stand: "
        f"distances to other clouds that were not fitted went from {before_mm:.1f} to {after_mm:.1f} mm ({sigmas:.1f} "
        f"standard errors). What was known of its pose before was forgotten.{to}"
    )


def found_and_refused(reason: str, *, way: Way, why: str) -> str:
    """Of a camera for which a place was found and refused: what became of it without, and why."""
    return (
        f"{reason} A place {move(*way)} from where it was said to stand, which its surroundings propose, "
        f'was refused ("{why}").'
    )


def found_nowhere(reason: str, *, others: Sequence[str], within: Way) -> str:
    """Of a camera that looks bumped, and of which nobody knows where to."""
    return (
        f"{reason} Its cloud contradicts {_of(others)}, and within {within[0]:g} degrees and {within[1]:g} m no place "
        "was found that would be better; calibrate it again, or raise --max-rotation-deg and --max-translation-m if "
        "it went farther."
    )


def reference_bumped(reason: str, *, others: Sequence[str], way: Way | None) -> str:
    """Of the reference where it contradicts the others, which agree; its way [deg], [m] to where they place it."""
    seen = "" if way is None else f", and they place it {move(*way)} from where it is said to stand"
    return (
        f"{reason} But its cloud contradicts {_of(others)}, which agree among themselves{seen}. It cannot be moved, "
        "for it holds the world in place: calibrate it again, or rename it so that another camera comes first."
    )


def unclear(directions: Sequence[str]) -> str:
    """Of a place that clouds do not tell in every direction."""
    return f"the clouds that it meets there do not tell its {', '.join(directions)}"


def contradicts_there(share: float, most: float) -> str:
    """Of a place where a camera's cloud contradicts the others more than clouds do of cameras that stand well."""
    return f"there {100 * share:.0f} % of what could meet other clouds contradicts them, {100 * most:.0f} % are allowed"


def summary_of_bumped(
    moved: Mapping[str, Way], refused: Sequence[str], nowhere: Sequence[str], reference: str | None
) -> list[str]:
    """Of all cameras that look bumped; the reference, if that is one."""
    told = []
    if moved:
        far = ", ".join(f"{name} (by {move(*way)})" for name, way in moved.items())
        told.append(f"Found elsewhere than they were said to stand, and moved there: {far}.")
    if refused:
        told.append(f"Found elsewhere, but kept where they were said to stand: {', '.join(refused)}.")
    if nowhere:
        told.append(f"Not where they are said to stand, and found nowhere else: {', '.join(nowhere)}.")
    if reference is not None:
        told.append(
            f"The reference, {reference}, contradicts the others, which agree, and looks bumped; it cannot be moved: "
            "calibrate it again, or rename it so that another camera comes first."
        )
    return told


def _of(others: Sequence[str]) -> str:
    return f"th{'at' if len(others) == 1 else 'ose'} of {', '.join(others)}"


# ----------------------------------------------------------------------------------------------------- parts of these


def move(turn_deg: float, shift_m: float) -> str:
    """How far something is moved."""
    return f"{turn_deg:.2f} degrees and {1e3 * shift_m:.1f} mm"


def untold(directions: tuple[str, ...]) -> str:
    """Directions in which clouds say less than the given pose, of the six that there are."""
    return "all" if len(directions) == 6 else ", ".join(directions) or "-"
