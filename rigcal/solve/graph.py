"""The health of a rig before it is solved: which cameras see the target together, and where that hangs by a thread.

Owns      counts of shared frames, connected parts, the weakest link, a suggestion in words.

Cameras that stay where an earlier calibration put them hang together, whatever they see.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any

# A relative pose from fewer shared frames cannot be checked against itself.
FEW_FRAMES = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class WeakestLink:
    """The pair of cameras whose shared frames hold two groups of the rig together, and nothing else as well."""

    i: str
    j: str
    frames: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraphHealth:
    """Who sees the target together with whom."""

    shared: Mapping[tuple[str, str], int]  # pairs with at least one frame in common
    parts: tuple[tuple[str, ...], ...]  # groups of cameras that hang together, that of kept ones or the largest first
    weakest: WeakestLink | None  # of the best tree of the first part; None where that needs no frames

    @property
    def summary(self) -> str:
        """One line: how many cameras hang together, and where the rig is weakest."""
        groups = " | ".join(_listed(part) for part in self.parts)
        if len(self.parts) > 1:
            return f"cameras that see the target together: {groups}"
        n = sum(map(len, self.parts))
        if self.weakest is None:
            return f"one camera sees the target: {groups}" if n == 1 else f"{n} cameras that are kept see the target"
        link = self.weakest
        return f"{n} cameras hang together; weakest link: {link.i} and {link.j}, {link.frames} shared frames"

    @property
    def suggestion(self) -> str:
        """What to record to make the rig stronger; empty where nothing is needed."""
        if len(self.parts) > 1:
            one, other = self.parts[0], self.parts[1]
            return (
                f"cameras {_listed(one)} and {_listed(other)} never see the target together: put the target where "
                f"{one[0]} and {other[0]}, or others of both groups, both see it"
            )
        if self.weakest is not None and self.weakest.frames < FEW_FRAMES:
            return (
                f"the rig hangs on {self.weakest.frames} shared frame{'s' * (self.weakest.frames > 1)} of cameras "
                f"{self.weakest.i} and {self.weakest.j}: put the target where both see it"
            )
        return ""

    def as_dict(self) -> dict[str, Any]:
        """For the file: pairs as a list."""
        return {
            "shared_frames": [{"cameras": [i, j], "frames": n} for (i, j), n in self.shared.items()],
            "parts": [list(part) for part in self.parts],
            "weakest_link": None
            if self.weakest is None
            else {"cameras": [self.weakest.i, self.weakest.j], "frames": self.weakest.frames},
            "suggestion": self.suggestion,
        }


def _listed(names: Collection[str]) -> str:
    return ", ".join(names)


def graph_health(frames_of: Mapping[str, Collection[int]], tied: Collection[str] = ()) -> GraphHealth:
    """Who sees the target together with whom.

    Args:
        frames_of: Camera -> frames in which it sees the target.
        tied: Cameras that hang together without a frame.
    """
    seen = {name: set(frames_of[name]) for name in sorted(frames_of)}
    shared = {(i, j): n for i, j in combinations(seen, 2) if (n := len(seen[i] & seen[j]))}
    together = {name for name in seen if name in tied}
    part = {name: together if name in together else {name} for name in seen}
    tree: list[WeakestLink] = []
    # Kruskal from the strongest link on: the last one of a part is the strongest that its weakest place has.
    for (i, j), n in sorted(shared.items(), key=lambda item: (-item[1], item[0])):
        if part[i] is not part[j]:
            merged = part[i] | part[j]
            part.update(dict.fromkeys(merged, merged))
            tree.append(WeakestLink(i=i, j=j, frames=n))
    parts = sorted({tuple(sorted(names)) for names in part.values()}, key=lambda names: (-len(names), names))
    parts.sort(key=lambda names: together.isdisjoint(names))
    in_first = [link for link in tree if parts and link.i in parts[0]]
    return GraphHealth(shared=shared, parts=tuple(parts), weakest=in_first[-1] if in_first else None)
