"""Several recordings, one clock: which frames of which cameras show the same moment.

Owns      grouping time stamps, the tolerance, what to say about skew, thinning out groups.
Leaves    reading stamps and images to the recordings.

Two frames are linked if each is the other camera's nearest in time. Links join into groups, the closest first, as
long as a group has one frame a camera and spans no more than the tolerance. So a dropped frame leaves a gap instead
of shifting what follows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aruco.errors import InputError

Stamps = NDArray[np.int64]  # (n,) nanoseconds

# Static cameras forgive a tenth of a second, more is another moment.
MAX_DEFAULT_TOLERANCE_NS = 100_000_000
# With single frames nobody knows the period; 50 ms is half that of a slow camera (10 frames a second).
SINGLE_FRAME_TOLERANCE_NS = 50_000_000
# Differences of stamps up to here fit into 64 bits.
MAX_STAMP_NS = 2**62


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SyncResult:
    """Frames that belong together, and those that belong to nobody."""

    cameras: tuple[str, ...]  # sorted; the columns of groups
    groups: NDArray[np.int64]  # (n_groups, n_cameras) index into the camera's stamps, -1 where it has no frame
    spans_ns: NDArray[np.int64]  # (n_groups,) latest minus earliest frame
    tolerance_ns: int
    unpaired: Mapping[str, int]  # camera -> frames in no group
    closest_ns: int | None  # smallest distance between frames of two cameras; None where fewer than two have frames

    @property
    def median_span_ns(self) -> int:
        """The median over groups of the time between a group's first and last frame; 0 without groups."""
        return int(np.median(self.spans_ns)) if len(self.spans_ns) else 0

    @property
    def worst_span_ns(self) -> int:
        """The longest time between the first and last frame of a group; 0 without groups."""
        return int(self.spans_ns.max(initial=0))


def synchronise(stamps_ns: Mapping[str, ArrayLike], *, tolerance_ns: int | None = None) -> SyncResult:
    """Group the frames of several cameras by time.

    Args:
        stamps_ns: Camera -> (n,) time stamps on one clock; need not be sorted.
        tolerance_ns: How much time a group may span; None: half the slowest camera's median frame period, at most
            100 ms, and 50 ms where no camera has two frames.

    Returns:
        Groups of at least two cameras, in the order of their earliest frames; the frames of a camera ascend in
        time from group to group. Where a single camera has frames, each of them is a group.

    Raises:
        InputError: The tolerance is negative or a time stamp is beyond any clock.
    """
    cameras = tuple(sorted(stamps_ns))
    clocks = {camera: _checked_stamps(camera, stamps_ns[camera]) for camera in cameras}
    if tolerance_ns is None:
        tolerance_ns = default_tolerance_ns(clocks.values())
    if tolerance_ns < 0:
        raise InputError(f"the synchronisation tolerance must be zero or more, got {tolerance_ns / 1e6:g} ms.")
    orders = [np.argsort(clocks[camera], kind="stable") for camera in cameras]
    times = [clocks[camera][order] for camera, order in zip(cameras, orders)]
    links, closest_ns = _links(times, tolerance_ns)
    if sum(len(t) > 0 for t in times) == 1:
        ranks = np.stack([np.arange(max(map(len, times))) if len(t) else _nobody(times) for t in times], axis=1)
    else:
        ranks = _in_time_order(_merged(times, links, tolerance_ns), times)
    groups = np.full_like(ranks, -1)
    for column, order in enumerate(orders):
        seen = ranks[:, column] >= 0
        groups[seen, column] = order[ranks[seen, column]]
    earliest, latest = _ends(ranks, times)
    return SyncResult(
        cameras=cameras,
        groups=groups,
        spans_ns=latest - earliest,
        tolerance_ns=int(tolerance_ns),
        unpaired={c: len(clocks[c]) - int((groups[:, i] >= 0).sum()) for i, c in enumerate(cameras)},
        closest_ns=closest_ns,
    )


def default_tolerance_ns(clocks: Iterable[Stamps]) -> int:
    """Half the slowest median frame period of some cameras' stamps, at most 100 ms; 50 ms for single frames."""
    periods = [int(np.median(np.diff(moments))) for clock in clocks if len(moments := np.unique(clock)) > 1]
    return min(max(periods) // 2, MAX_DEFAULT_TOLERANCE_NS) if periods else SINGLE_FRAME_TOLERANCE_NS


def nearest(times: Stamps, moments: Stamps) -> NDArray[np.int64]:
    """For each moment the index of the nearest of the sorted times (at least one); the earlier of two equals."""
    after = np.clip(np.searchsorted(times, moments), 1, max(1, len(times) - 1))
    before = after - 1
    after = np.minimum(after, len(times) - 1)
    chosen = np.where(moments - times[before] <= times[after] - moments, before, after)
    # Of equal stamps the first, so that only one of them finds a partner.
    return np.searchsorted(times, times[chosen])


def sample(groups: NDArray[np.int64], interval: int = 1, max_samples: int | None = None) -> NDArray[np.int64]:
    """Thin out groups: every ``interval``-th, and of these at most ``max_samples`` spread over the recording.

    Args:
        groups: (n_groups, n_cameras), in time order.
        interval: 1 keeps all.
        max_samples: None: as many as there are.

    Returns:
        The (m, n_cameras) groups kept, in time order.

    Raises:
        InputError: A count is below one.
    """
    if interval < 1 or (max_samples is not None and max_samples < 1):
        raise InputError(f"sample interval and count must be 1 or more, got {interval} and {max_samples}.")
    kept = groups[::interval]
    if max_samples is None or len(kept) <= max_samples:
        return kept
    # The middle of each of max_samples equal parts.
    return kept[(2 * np.arange(max_samples) + 1) * len(kept) // (2 * max_samples)]


def _checked_stamps(camera: str, stamps_ns: ArrayLike) -> Stamps:
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    if stamps.ndim != 1:
        raise InputError(f"camera {camera}: want time stamps of shape (n,), got {stamps.shape}.")
    beyond = (stamps > MAX_STAMP_NS) | (stamps < -MAX_STAMP_NS)
    if beyond.any():
        raise InputError(
            f"camera {camera}: the time stamp {stamps[beyond][0]} ns is beyond any clock; rename the frame."
        )
    return stamps


def _nobody(times: list[Stamps]) -> NDArray[np.int64]:
    return np.full(max(map(len, times)), -1)


def _links(times: list[Stamps], tolerance_ns: int) -> tuple[NDArray[np.int64], int | None]:
    """Mutually nearest frames within the tolerance, closest first: (n_links, 2) nodes; and the smallest distance."""
    starts = np.cumsum([0, *map(len, times)])
    found: list[NDArray[np.int64]] = [np.empty((4, 0), dtype=np.int64)]
    closest: list[int] = []
    for a, b in combinations([c for c, t in enumerate(times) if len(t)], 2):
        a_of_b, b_of_a = nearest(times[a], times[b]), nearest(times[b], times[a])
        here = np.arange(len(times[a]))
        gap = np.abs(times[b][b_of_a] - times[a])
        closest.append(int(gap.min()))
        keep = (a_of_b[b_of_a] == here) & (gap <= tolerance_ns)
        # Equal gaps are taken in time order, then in the order of camera names.
        when = np.minimum(times[a], times[b][b_of_a])
        found.append(np.stack([gap, when, starts[a] + here, starts[b] + b_of_a])[:, keep])
    gap, when, left, right = np.concatenate(found, axis=1)
    order = np.lexsort((right, left, when, gap))
    return np.stack([left[order], right[order]], axis=1), min(closest, default=None)


def _merged(times: list[Stamps], links: NDArray[np.int64], tolerance_ns: int) -> NDArray[np.int64]:
    """Join links into groups: (n_groups, n_cameras) ranks in the sorted times, -1 for none."""
    n_cameras = len(times)
    camera_of = np.repeat(np.arange(n_cameras), [len(t) for t in times])
    rank_of = np.concatenate([np.arange(len(t)) for t in times]) if times else camera_of
    first = np.concatenate(times).tolist() if times else []
    last = list(first)
    members = [1 << c for c in camera_of.tolist()]  # the cameras of the group that a root stands for, as bits
    parent = list(range(len(first)))

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = node = parent[parent[node]]
        return node

    for left, right in links.tolist():
        a, b = root(left), root(right)
        start, end = min(first[a], first[b]), max(last[a], last[b])
        if a == b or members[a] & members[b] or end - start > tolerance_ns:
            continue
        parent[b] = a
        first[a], last[a], members[a] = start, end, members[a] | members[b]

    roots = np.array([root(node) for node in range(len(parent))], dtype=np.int64)
    _, row_of = np.unique(roots, return_inverse=True)
    ranks = np.full((int(row_of.max(initial=-1)) + 1, n_cameras), -1, dtype=np.int64)
    ranks[row_of, camera_of] = rank_of
    return ranks[(ranks >= 0).sum(axis=1) >= 2]


def _in_time_order(ranks: NDArray[np.int64], times: list[Stamps]) -> NDArray[np.int64]:
    """Groups sorted by their earliest frames; a frame that would step back in its camera's time leaves its group."""
    while True:
        earliest, _ = _ends(ranks, times)
        ranks = ranks[np.lexsort((*ranks.T, earliest))]
        # Two mutually nearest pairs never cross, but irregular cameras joined through a third can.
        back = (ranks >= 0) & (ranks < np.maximum.accumulate(ranks, axis=0))
        if not back.any():
            return ranks
        ranks = np.where(back, -1, ranks)
        ranks = ranks[(ranks >= 0).sum(axis=1) >= 2]


def _ends(ranks: NDArray[np.int64], times: list[Stamps]) -> tuple[Stamps, Stamps]:
    """The earliest and latest stamp of each group of ranks (n_groups, n_cameras)."""
    earliest = np.full(len(ranks), np.iinfo(np.int64).max)
    latest = np.full(len(ranks), np.iinfo(np.int64).min)
    for column, clock in enumerate(times):
        seen = ranks[:, column] >= 0
        moments = clock[ranks[seen, column]]
        earliest[seen] = np.minimum(earliest[seen], moments)
        latest[seen] = np.maximum(latest[seen], moments)
    return earliest, latest
