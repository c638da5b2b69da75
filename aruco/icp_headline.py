"""What became of a whole rig whose clouds were registered, in sentences: the headline, warnings, remarks.

Owns      these sentences, and when a warning is due.
Leaves    sentences about single cameras to icp_words, figures to icp_answer.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from aruco.icp_types import CameraMove, ICPConfig, ICPMetrics, Refusal

# Of wishes to be elsewhere the largest is the cause of the others if it is so many times as large: a camera that was
# bumped drags those along whose clouds it meets, while a bumped reference turns and shifts all others alike.
_BY_FAR = 3.0
# At such a distance [m] a turn shifts what is seen.
_LEVER_M = 3.0
# Chi-square with 3 degrees of freedom that chance exceeds once in twenty, as a root.
FLOOR_SIGMAS_95 = 2.80
_REASONS: Mapping[Refusal, str] = {
    "unproved": "not proved to be better",
    "worse": "clouds would meet worse",
    "too_far": "farther than allowed",
    "prior": "against what is known of the given pose",
    "depth": "would need depth that is not to be believed",
    "misfit": "cloud does not fit the others",
    "floor": "floor would not stay level",
    "unlinked": "no overlap that leads to the reference",
    "no_cloud": "no depth that can be used",
    "": "for the reason told of it",
    "reference": "what the others are moved against",
}
NO_OVERLAP = "Its cloud overlaps no other camera's."


@dataclass(frozen=True, slots=True, kw_only=True)
class RigParts:
    """How overlaps of clouds divide a rig."""

    parts: Sequence[tuple[str, ...]]  # cameras that overlaps link
    alone: Sequence[str]  # cameras whose clouds overlap no other


def message_of(metrics: ICPMetrics, elsewhere: Collection[str] = ()) -> str:
    """The headline; how far cameras moved that stood elsewhere than said is told beside it."""
    used, tried = metrics.num_pairs_converged, metrics.num_pairs_attempted
    meet = f"{used} of {tried} overlapping pairs of clouds meet"
    if not used:
        return f"{meet} well enough to be used; every camera keeps its pose."
    kept = [m for m in metrics.cameras.values() if not m.accepted and m.refusal != "reference"]
    why = f" ({_counted(move.refusal for move in kept)})" if kept else ""
    if not metrics.moved:
        return f"{meet}; every camera keeps its pose{why}."
    moved = [metrics.cameras[name] for name in metrics.moved if name not in elsewhere]
    turn = max((move.rotation_deg for move in moved), default=0.0)
    shift = max((move.translation_mm for move in moved), default=0.0)
    by = f", by up to {turn:.2f} degrees and {shift:.1f} mm" if moved else ""
    keeps = "none keeps its pose but the reference" if not kept else f"{len(kept)} kept{why}"
    return (
        f"{meet}; {len(metrics.moved)} of {len(metrics.cameras)} cameras moved{by} against camera "
        f"{metrics.reference_camera}, the reference; {keeps}."
    )


def _counted(refusals: Iterable[Refusal]) -> str:
    return ", ".join(f"{n} {_REASONS[refusal]}" for refusal, n in Counter(refusals).most_common())


def warnings_of(metrics: ICPMetrics, rig: RigParts, config: ICPConfig) -> tuple[str, ...]:
    """What wants to be done about the rig."""
    elsewhere = {n: m for n, m in sorted(metrics.cameras.items()) if is_elsewhere(m, config)}
    told = [_bumped(elsewhere, metrics.reference_camera, config)] if elsewhere else []
    if metrics.num_pairs_attempted and not metrics.num_pairs_converged:
        told.append(_none_meets(config))
    if len(rig.parts) + len(rig.alone) > 1:
        told.append(_in_parts(rig))
    return tuple(told)


def _none_meets(config: ICPConfig) -> str:
    look = "" if config.global_init else ", or look for cameras that were bumped with --icp-global-init"
    return (
        f"Of no two clouds do {100 * config.min_fitness:.0f} % of the points that could meet, so nothing can be learnt "
        f"from them. See that depth and poses are of the same recording, and that depth is good (--verify-depth){look}."
    )


def is_elsewhere(move: CameraMove, config: ICPConfig) -> bool:
    """Whether a camera's cloud asks for a place that the given pose forbids."""
    if move.refusal in ("prior", "too_far"):
        return True
    # Where the cloud does not even fit there, a bump is still likelier than the depth or whatever else was refused.
    far = move.rotation_deg > config.max_rotation_deg or move.translation_mm > 1e3 * config.max_translation_m
    return far and move.refusal in ("depth", "misfit")


def by_far(moves: Mapping[str, CameraMove]) -> str | None:
    """The one camera that asks for a move many times as large as any other of these, if there is one."""
    far = {name: math.radians(m.rotation_deg) * _LEVER_M + 1e-3 * m.translation_mm for name, m in moves.items()}
    first, *others = sorted(far, key=lambda name: (-far[name], name)) or [""]
    return first if others and far[first] > _BY_FAR * far[others[0]] else None


def _bumped(moves: Mapping[str, CameraMove], reference: str, config: ICPConfig) -> str:
    first = by_far(moves)
    if first is not None:
        others = ", ".join(name for name in moves if name != first)
        alone = _bumped({first: moves[first]}, reference, config)
        return f"{alone} {others} would move much less, most likely along with it."
    who, seem, them = ("Camera", "seems", "it") if len(moves) == 1 else ("Cameras", "seem", "them")
    names = ", ".join(f"{name} ({_wish(move)})" for name, move in moves.items())
    do = ["calibrate what was bumped again"]
    if not config.global_init:
        do.append("look for its place with --icp-global-init")
    if any(move.refusal == "too_far" for move in moves.values()):
        do.append("allow more with --max-rotation-deg and --max-translation-m")
    if reference in moves:
        return (
            f"{who} {names} {seem} to stand elsewhere than the file says, by as much as in brackets. {reference} is "
            "the reference, which does not move, so nobody was moved against it; calibrate it again, or rename it so "
            "that another camera comes first."
        )
    return (
        f"{who} {names} {seem} to stand elsewhere than the file says, by as much as in brackets, or else the reference "
        f"{reference} does. To move {them} so far was refused; {', or '.join(do)}."
    )


def _wish(move: CameraMove) -> str:
    """How far a cloud wants its camera."""
    far = f", {move.prior_sigmas:.1f} sigma of its pose" if move.refusal == "prior" else ""
    return f"{move.rotation_deg:.2f} degrees and {move.translation_mm:.0f} mm{far}"


def _in_parts(rig: RigParts) -> str:
    parts = [*(" and ".join(part) if len(part) < 3 else ", ".join(part) for part in rig.parts), *rig.alone]
    return (
        f"The rig is in {len(parts)} parts whose clouds do not overlap: {'; '.join(parts)}. Each was registered by "
        "itself, and nothing was learnt of how they stand to each other: there the given poses hold. If that is not "
        "enough, see that the poses are right, and let cameras of both see the same piece of furniture or wall."
    )


def remarks_of(metrics: ICPMetrics) -> tuple[str, ...]:
    """What is worth knowing of the rig as a whole."""
    told: list[str] = []
    if metrics.moved and metrics.floor_sigmas > FLOOR_SIGMAS_95:
        told.append(
            f"The reference keeps its pose, so the common floor now lies {metrics.floor_tilt_deg:.2f} degrees and "
            f"{1e3 * metrics.floor_rise_m:+.1f} mm off the one the rig was levelled on, more than can be chance "
            f"({metrics.floor_sigmas:.1f} sigma). refine-ground-plane once more, without --icp, levels the poses; with "
            "the same depth, covariances then count its floor twice."
        )
    if not metrics.settled:
        told.append(
            "The estimate did not come to rest within max_iterations; poses may still be off by a part of their "
            "standard deviations."
        )
    return tuple(told)


def reference_of_part(others: Sequence[str]) -> str:
    """Of the camera that stays in a part of the rig whose clouds do not overlap the reference's."""
    return (
        f"It stays as the reference of its part of the rig ({', '.join(others)} besides), which overlaps no camera of "
        "the reference's part."
    )


def too_few(n_samples: int, least: int, config: ICPConfig) -> str:
    """Of a camera whose cloud is too small."""
    return (
        f"{n_samples} samples of its depth can be used in region {config.region} at a voxel size of "
        f"{config.voxel_size:g} m, want {least}: look at its depth, lower --icp-voxel-size, or widen --icp-region."
    )


def why_nothing(poses: int, clouds: int, left_out: Mapping[str, str], config: ICPConfig) -> str:
    """Why nothing can be registered."""
    if poses < 2:
        return f"Clouds of two cameras and more can be brought together, and there is a pose of {poses}."
    if clouds < 2:
        why = "; ".join(f"{name}: {reason.split(': look')[0].rstrip('.')}" for name, reason in sorted(left_out.items()))
        return (
            f"Clouds of two cameras and more can be brought together, and {clouds} can be used ({why}); look at the "
            "depth, and at --icp-voxel-size and --icp-region."
        )
    return (
        "No two cameras' clouds overlap: see that the poses are right and in metres, that cameras share a part of the "
        f"room, and that they see {config.min_overlap_area:g} m2 of it in common (ICPConfig.min_overlap_area)."
    )
