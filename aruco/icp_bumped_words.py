"""What is told of cameras that look bumped, in a sentence each.

Owns      the sentences.
Leaves    their figures to icp_bumped and icp_confirm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from aruco.icp_words import move

Way = tuple[float, float]  # [deg], [m]


def found(turn_deg: float, shift_m: float, before_mm: float, after_mm: float, sigmas: float) -> str:
    """Of a camera that was moved to about where its surroundings place it."""
    return (
        f"It was moved, as its surroundings place it {move(turn_deg, shift_m)} from where it was said to stand: "
        f"distances to other clouds that were not fitted went from {before_mm:.1f} to {after_mm:.1f} mm ({sigmas:.1f} "
        f"standard errors). What was known of its pose before was forgotten."
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


def summary(
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
