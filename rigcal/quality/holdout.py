"""Which frames to keep for checking: spread over the recording, and never at the cost of the solve.

Owns      the choice of held-out frames and of halves, and the links that cameras have through shared frames.
Leaves    solving and measuring to rigcal.validation.

Cameras that an earlier calibration placed are ``tied``: they hang together without a frame.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# What every camera and every link of the rig keeps: with two shared frames one wrong view cannot be told from the
# right one, with three it can.
MIN_VIEWS_KEPT = 4
MIN_SHARED_KEPT = 3
MIN_SHARED_IN_A_HALF = 2


@dataclass(frozen=True, slots=True)
class Link:
    """Two cameras and the number of frames in which both see the target."""

    i: str
    j: str
    n_shared: int


def frames_to_hold_out(
    seen: Mapping[str, Collection[int]], share: float, *, never: Collection[int] = (), tied: Collection[str] = ()
) -> tuple[int, ...]:
    """Frames of a moved target that the solve can spare.

    Args:
        seen: Camera -> frames in which it sees the target.
        share: Of the frames that two or more cameras see.
        never: Frames that must stay.
        tied: Cameras that hang together without a frame.

    Returns:
        Frames, ascending; fewer than the share where a camera would keep too few views or lose its link to the rest,
        none when not even all frames are enough.
    """
    frames, members = _table(seen)
    useful = [k for k, frame in enumerate(frames) if members[k].sum() > 1 and frame not in set(never)]
    wanted = round(share * len(useful))
    kept, roots = members.astype(np.int64), _mask(seen, tied)
    held: list[int] = []
    for k in _spread(useful, wanted):
        if len(held) == wanted:
            break
        row, kept[k] = kept[k].copy(), 0
        if kept.sum(axis=0).min() >= MIN_VIEWS_KEPT and is_connected(kept.T @ kept, MIN_SHARED_KEPT, roots):
            held.append(frames[k])
        else:
            kept[k] = row
    return tuple(sorted(held))


def _table(seen: Mapping[str, Collection[int]]) -> tuple[list[int], NDArray[np.bool_]]:
    """Frames, and which camera sees the target in which (f, c)."""
    frames = sorted({frame for mine in seen.values() for frame in mine})
    sets = [set(mine) for mine in seen.values()]
    return frames, np.array([[frame in mine for mine in sets] for frame in frames], dtype=bool).reshape(-1, len(sets))


def _mask(seen: Mapping[str, Collection[int]], tied: Collection[str]) -> NDArray[np.bool_]:
    return np.array([name in tied for name in seen], dtype=bool)


def _spread(values: Sequence[int], n: int) -> list[int]:
    """``n`` values spread evenly, then the others in case some of these cannot be spared."""
    if not n:
        return []
    first = [values[int((k + 0.5) * len(values) / n)] for k in range(n)]
    return first + [value for value in values if value not in set(first)]


def every_nth(frames: Sequence[int], share: float) -> tuple[int, ...]:
    """A share of one camera's frames of a resting target, spread evenly; two frames always stay."""
    n = min(max(round(share * len(frames)), 1), len(frames) - 2)
    return tuple(sorted(_spread(sorted(frames), n)[:n])) if n > 0 else ()


def is_connected(shared: NDArray[np.int64], at_least: int, tied: NDArray[np.bool_] | None = None) -> bool:
    """Whether cameras hang together by links of so many shared frames (c, c), some of them (c,) without."""
    reached = np.zeros(len(shared), dtype=bool) if tied is None else tied.copy()
    reached[:1] |= not reached.any()
    for _ in range(len(shared)):
        reached |= (shared[reached] >= at_least).any(axis=0)
    return bool(reached.all())


def halves_hang_together(
    seen: Mapping[str, Collection[int]], halves: Sequence[Collection[int]], tied: Collection[str] = ()
) -> bool:
    """Whether each half of the frames of a moved target connects all cameras by itself."""
    frames, members = _table(seen)
    for half in halves:
        inside = set(half)
        part = members[[frame in inside for frame in frames]].astype(np.int64)
        if not len(part) or not is_connected(part.T @ part, MIN_SHARED_IN_A_HALF, _mask(seen, tied)):
            return False
    return True


def shared_frames(seen: Mapping[str, Collection[int]]) -> list[int]:
    """The frames that two or more cameras see, ascending."""
    frames, members = _table(seen)
    return [frame for frame, row in zip(frames, members) if row.sum() > 1]


def weakest_link(seen: Mapping[str, Collection[int]], tied: Collection[str] = ()) -> Link | None:
    """The link that the rig hangs on: the weakest of the tree of strongest links; None where it needs no link."""
    names = list(seen)
    _, members = _table(seen)
    shared = members.astype(np.int64).T @ members.astype(np.int64)
    part = [-1 if name in tied else k for k, name in enumerate(names)]
    weakest: Link | None = None
    pairs = [(i, j) for i in range(len(names)) for j in range(i + 1, len(names))]
    for i, j in sorted(pairs, key=lambda pair: -int(shared[pair])):
        if part[i] != part[j]:
            part = [part[i] if p == part[j] else p for p in part]
            weakest = Link(names[i], names[j], int(shared[i, j]))
    return weakest
