"""What registration did to a camera, and why, in one sentence each.

Owns      the sentences.
Leaves    their figures to icp_objections and icp_gates.
"""

from __future__ import annotations

from collections.abc import Sequence

_KEEPS = "It keeps its pose: "


def is_reference() -> str:
    """Of the camera that all others are moved against."""
    return "It is the reference, which does not move."


def meets_nothing(without: tuple[str, ...] = ()) -> str:
    """Of a camera whose cloud leads to the reference by no chain of overlaps."""
    less = f" without the clouds of {', '.join(without)}" if without else ""
    return f"{_KEEPS}its cloud does not meet the others in a way that leads to the reference{less}."


def gained(before_mm: float, after_mm: float, sigmas: float, prior_sigmas: float) -> str:
    """Of a camera that was moved."""
    known = "" if prior_sigmas != prior_sigmas else f", at {prior_sigmas:.1f} sigma of its given pose"
    return (
        f"It was moved: with it and the cameras that overlap it moved, distances to other clouds that were not fitted "
        f"went from {before_mm:.1f} to {after_mm:.1f} mm ({sigmas:.1f} standard errors){known}."
    )


def speaks_against(turn_deg: float, shift_m: float, sigmas: float) -> str:
    """Of a move by which held-out distances grow."""
    return (
        f"{_KEEPS}by a move of {move(turn_deg, shift_m)} distances to other clouds that were not fitted grow, by "
        f"{sigmas:.1f} standard errors."
    )


def not_proved(turn_deg: float, shift_m: float, sigmas: float, asked: float) -> str:
    """Of a move that is as good as chance, together with those around."""
    gain = f"shrink by {sigmas:.1f} of the {asked:g} standard errors that count as proof"
    return (
        f"{_KEEPS}a move of {move(turn_deg, shift_m)} is not proved, for with it and the cameras that overlap it "
        f"moved distances that were not fitted {gain if sigmas > 0 else 'do not shrink'}."
    )


def too_far(turn_deg: float, shift_m: float, most_deg: float, most_m: float) -> str:
    """Of a move beyond the bounds."""
    return (
        f"{_KEEPS}a move of {move(turn_deg, shift_m)} against the others is more than the {most_deg:g} degrees and "
        f"{1e3 * most_m:g} mm that are allowed; if the camera was bumped, calibrate it again or raise these."
    )


def unbelievable_depth(share: float, sigmas: float, most: float) -> str:
    """Of a cloud that meets others only if its depth is wrong beyond belief, by up to a share of what is measured."""
    return (
        f"{_KEEPS}its cloud meets the others only if its depth is wrong by up to {100 * share:.1f} %, {sigmas:.1f} "
        f"sigma of what is believed of such a camera ({most:.1f} are allowed); look at its depth with --verify-depth."
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
        f"{_KEEPS}a move of {move(turn_deg, shift_m)} is {sigmas:.1f} sigma of what its given pose is known to, "
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
        f"{_KEEPS}with the moves of all cameras the floor would tilt from {before_deg:.2f} to {after_deg:.2f} degrees."
    )


def found(turn_deg: float, shift_m: float, before_mm: float, after_mm: float, sigmas: float) -> str:
    """Of a camera that was moved to about where its surroundings place it."""
    return (
        f"It was moved, as its surroundings place it {move(turn_deg, shift_m)} from where it was said to stand: "
        f"distances to other clouds that were not fitted went from {before_mm:.1f} to {after_mm:.1f} mm ({sigmas:.1f} "
        f"standard errors)."
    )


def found_and_refused(reason: str, turn_deg: float, shift_m: float, why: str) -> str:
    """Of a camera for which a place was found and refused: what became of it without, and why."""
    return (
        f"{reason} A place {move(turn_deg, shift_m)} from where it was said to stand, which its surroundings propose, "
        f'was refused ("{why}").'
    )


def bumped(moved: Sequence[str], refused: Sequence[str]) -> list[str]:
    """Of all cameras that were found elsewhere."""
    told = []
    if moved:
        told.append(f"Found elsewhere than they were said to stand, and moved there: {', '.join(moved)}.")
    if refused:
        told.append(f"Found elsewhere, but kept where they were said to stand: {', '.join(refused)}.")
    return told


def move(turn_deg: float, shift_m: float) -> str:
    """How far something is moved."""
    return f"{turn_deg:.2f} degrees and {1e3 * shift_m:.1f} mm"
