"""Frames that were not taken at one moment: whole views off along the way that a moved target goes in the image.

Owns      each view's offset in time, whether offsets explain the residuals, the sentence about them.
Leaves    the motion of corners in the image to moving_views, limits to gates.

A view taken a time t too late shows every corner by t times its velocity farther on. The target's pose in a frame
comes from the same views, so all that shows are differences of offsets within a frame: cameras and targets are free
again, in one linear step, beside an offset for every view. Two controls must explain much less. One may shift each view
by the same velocities turned by a right angle: it has as many unknowns, and wrong lenses, maps and poses give it as
much to explain; only time prefers the direction of motion. The other may move all cameras once: a camera that was
bumped in the direction in which the target goes to and fro is late and early by turns.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aruco.pose_math import Array
from rigcal.quality.moving_views import Frame, Seen, frames_of

# Velocities are differences over so many frames to both sides. Short ones follow the motion best; but where neighbours
# are taken too early or late themselves, they are wrong by jitter / (sqrt(2) stride), of which a quarter is borne.
STRIDES = (1, 2, 3, 5)
MAX_JITTER_OF_STRIDE = 0.35
MIN_FRAMES = 8
# Offsets in frame periods are expected about so large, rather too large than too small: where corners move by some
# pixels a frame, a view tells hundredths.
EXPECTED_PERIODS = 1.0
LEAST_EXPECTED_PERIODS = 0.02
# Chance makes the logarithms of two robust variances scatter by sqrt(2 / (0.37 d)) each at d degrees of freedom (0.37:
# the efficiency of a median of squares): four sigmas of their difference. Errors that last for many frames count for
# fewer than they are, hence the least ratio.
MEDIAN_EFFICIENCY = 0.37
MIN_SIGMAS = 4.0
MIN_TIMES_BETTER = 3.0
# Motion is the cause when its errors are at least as large as all others of a view; below this they harm nobody.
MIN_ERROR_PX = 0.25
# A clock is off when a constant offset is surely there, and worth mending beside the scatter of single frames.
MIN_OFFSET_PERIODS = 0.05
# The scale of a t distribution of 5 degrees that fits best, over the standard deviation: 0.857 of normal numbers, 0.93
# of uniform ones.
T_SCALE = 0.88
# At which parts of the recording a camera may have been moved.
N_CUTS = 8
ROUNDS = 12
# Where the target's pose takes up more than the rest of a common motion, a combination of views says nothing.
MIN_LEFT = 0.2
_RCOND = 1e-10


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """What the residuals say about when frames were taken; times in frame periods, positive for too late."""

    offset: Mapping[str, float]  # camera -> its constant part, against the middle of all cameras
    offset_sigma: Mapping[str, float]
    jitter: float  # standard deviation of single frames about it
    apart: Mapping[str, float]  # camera -> what 95 percent of its frames stay within
    error_px: float  # of a view, typically, that this causes
    left_px: float  # of a view beside it
    times_better: float  # squared error that the better control leaves, over what offsets in time leave
    needed: float  # beyond chance
    n_frames: int
    period_s: float  # zero where unknown

    @property
    def is_clear(self) -> bool:
        """Whether frames were surely taken at different moments, and it is what limits the calibration."""
        return self.times_better >= self.needed and self.error_px >= max(MIN_ERROR_PX, self.left_px)

    @property
    def clocks(self) -> dict[str, float]:
        """Cameras that are early or late as a rule, and by how much; of two cameras the late one."""
        least = {n: max(MIN_OFFSET_PERIODS, MIN_SIGMAS * s, self.jitter) for n, s in self.offset_sigma.items()}
        if len(self.offset) == 2:
            late = max(self.offset, key=lambda n: self.offset[n])
            apart = max(self.offset.values()) - min(self.offset.values())
            return {late: apart} if apart > least[late] else {}
        return {n: t for n, t in self.offset.items() if abs(t) > least[n]}

    @property
    def sentence(self) -> str:
        """What it looks like and what to do about it."""
        clocks = self.clocks
        mend = "move it more slowly, put it down now and then (--still), or use hardware synchronisation."
        if not clocks:
            name = max(self.apart, key=lambda n: self.apart[n])
            return (
                f"Frames of camera {name} were taken up to {self._told(self.apart[name])} apart from those of the "
                f"others while the target moved: {mend}"
            )
        order = sorted(clocks, key=lambda n: -abs(clocks[n]))
        listed = " and ".join(
            f"camera {n} about {self._told(abs(clocks[n]))} {'later' if clocks[n] > 0 else 'earlier'}" for n in order
        )
        scatter = f" (single frames scatter by {self._told(self.jitter)})" if self.jitter > MIN_OFFSET_PERIODS else ""
        return (
            f"Frames that count as simultaneous were taken by {listed} than by the others while the target moved"
            f"{scatter}: correct the clock or the stamps, or {mend}"
        )

    def _told(self, periods: float) -> str:
        if self.period_s:
            return f"{1e3 * periods * self.period_s:.0f} ms"
        return f"{periods:.2f} frame periods"


def find_timing(seen: Seen) -> Timing | None:
    """How far apart the frames of one moment were taken; None where too few views of a smooth motion could tell."""
    found: _Fit | None = None
    jitter = 0.0
    for stride in STRIDES:
        frames = frames_of(seen, stride)
        if len(frames) < MIN_FRAMES:
            break
        found = _fit(frames, len(seen.cameras), 0, EXPECTED_PERIODS)
        jitter, _ = _jitter(found)
        if jitter <= MAX_JITTER_OF_STRIDE * stride:
            break
    return None if found is None else _compared(seen, found, jitter)


def _compared(seen: Seen, along: _Fit, jitter: float) -> Timing:
    """The fit of offsets in time beside its control, and once more with offsets as large as they turned out."""
    frames, n_cam = along.frames, len(seen.cameras)
    control = min(_fit(frames, n_cam, 1, EXPECTED_PERIODS).variance, _moved(frames, n_cam))
    mended = _fit(frames, n_cam, 0, max(jitter, LEAST_EXPECTED_PERIODS))
    jitter, n = _jitter(mended)
    offset = mended.offset - np.median(mended.offset)
    names = [camera.name for camera in seen.cameras]
    speed_px = np.sqrt(np.median(np.concatenate([frame.squares for frame in frames])))
    chance = float(np.exp(MIN_SIGMAS * 2 / np.sqrt(MEDIAN_EFFICIENCY * max(n, 1))))
    return Timing(
        offset=dict(zip(names, offset.tolist())),
        offset_sigma=dict(zip(names, mended.offset_sigma.tolist())),
        jitter=jitter,
        apart=dict(zip(names, _apart(mended, offset, jitter))),
        error_px=float(speed_px * np.sqrt(jitter**2 + np.mean(offset**2))),
        left_px=float(np.sqrt(along.variance)),
        times_better=control / along.variance,
        needed=max(MIN_TIMES_BETTER, chance),
        n_frames=len(frames),
        period_s=seen.period_s,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Cameras, targets and offsets at their optimum."""

    frames: Sequence[Frame]
    offset: Array  # (c,)
    offset_sigma: Array  # (c,)
    variance: float  # of a view [px^2], robust: what is left beside offsets
    left: Sequence[Array]  # of every frame, what cameras and constant offsets leave


def _fit(frames: Sequence[Frame], n_cam: int, direction: int | None, expected: float = 1.0) -> _Fit:
    """Constant offsets are free, single ones normally distributed; frames weigh as under a Cauchy loss.

    Args:
        frames: Views.
        n_cam: Cameras, also those that these frames lack.
        direction: 0 for offsets along the motion, 1 across, None for no offsets.
        expected: Standard deviation of single offsets.
    """
    both = [_unknowns(frame, n_cam, direction) for frame in frames]
    n = 6 * n_cam if direction is None else 7 * n_cam
    x = np.zeros(n)
    H = np.eye(n)
    # Begins with all frames and ends with those that agree: a camera that is always late is no outlier.
    variance = max(float(np.mean([f.r @ f.r / len(f.cameras) for f in frames])), 1e-12)
    for _ in range(ROUNDS):
        H, g, off = np.zeros((n, n)), np.zeros(n), []
        for frame, (G, X) in zip(frames, both):
            e = frame.r - G @ x
            V = np.column_stack([G, e])
            P = V.T @ _whitened(X, variance / expected**2, V)
            off.append(float(P[-1, -1]) / len(frame.cameras))
            weight = 1 / (1 + off[-1] / (2.385**2 * variance))
            H += weight * P[:-1, :-1]
            g += weight * P[:-1, -1]
        x = x + np.linalg.pinv(H, rcond=_RCOND, hermitian=True) @ g
        variance = max(float(np.median(off)), 1e-8)
    own = slice(6 * n_cam, None)
    # What all cameras have in common is not known, nor does it matter.
    centred = np.eye(n - 6 * n_cam) - 1 / n_cam
    covariance = variance * centred @ np.linalg.pinv(H, rcond=_RCOND, hermitian=True)[own, own] @ centred
    return _Fit(
        frames=frames,
        offset=x[own],
        offset_sigma=np.sqrt(np.maximum(np.diag(covariance), 0.0)),
        variance=variance,
        left=[frame.r - G @ x for frame, (G, _) in zip(frames, both)],
    )


def _unknowns(frame: Frame, n_cam: int, direction: int | None) -> tuple[Array, Array]:
    """Derivatives by the cameras' twists and constant offsets (n, 7 c), and by the offset of every view (n, m)."""
    if direction is None:
        return frame.by_camera, np.zeros((len(frame.r), 0))
    X = frame.by_time[direction]
    return np.concatenate([frame.by_camera, X @ np.eye(n_cam)[frame.cameras]], axis=1), X


def _moved(frames: Sequence[Frame], n_cam: int) -> float:
    """The variance left of a view [px^2] when cameras are moved once, at whichever moment explains most."""
    cuts = {k * len(frames) // N_CUTS for k in range(1, N_CUTS)}
    parts = [(frames[:k], frames[k:]) for k in cuts if 3 <= k <= len(frames) - 3]
    return min(
        (sum(len(part) * _fit(part, n_cam, None).variance for part in pair) / len(frames) for pair in parts),
        default=np.inf,
    )


def _whitened(X: Array, ratio: float, k: Array) -> Array:
    """``(I + X X^T / ratio)^-1 k``: offsets of single views, of variance 1 / ratio, taken out as far as expected."""
    return k - X @ np.linalg.solve(X.T @ X + ratio * np.eye(X.shape[1]), X.T @ k)


def _jitter(fit: _Fit) -> tuple[float, int]:
    """The standard deviation of single offsets [periods], and of how many independent numbers."""
    z, speed2 = [np.empty(0)], [np.empty(0)]
    for frame, e in zip(fit.frames, fit.left):
        # Combinations of views that the target's pose cannot mimic: z has the variance noise^2 + jitter^2 speed2.
        X = frame.by_time[0]
        values, U = np.linalg.eigh(X.T @ X)
        good = values > max(MIN_LEFT * float(frame.squares.min()), 1e-4)
        z.append((U.T @ (X.T @ e))[good] / np.sqrt(values[good]))
        speed2.append(values[good])
    z, speed2 = np.concatenate(z), np.concatenate(speed2)
    return (_components(z, speed2) if len(z) else 0.0), len(z)


def _components(z: Array, speed2: Array) -> float:
    """The jitter, by expectation and maximisation under a t distribution: exchanged frames are not jitter."""
    noise = max(float(np.median(z**2)), 1e-12) / 2
    jitter = noise / float(np.median(speed2))
    for _ in range(200):
        total = noise + jitter * speed2
        w = 6 / (5 + z**2 / total)
        share = jitter * speed2 / total
        jitter, noise = (
            float(np.mean(jitter * (w * share * z**2 / total + 1 - share))),
            max(float(np.mean(w * ((1 - share) * z) ** 2 + noise * share)), 1e-12),
        )
    return float(np.sqrt(jitter)) / T_SCALE


def _apart(fit: _Fit, offset: Array, jitter: float) -> list[float]:
    """Of every camera, what 95 percent of its frames stay within; offsets of single frames at their likeliest."""
    by_camera: list[list[float]] = [[] for _ in offset]
    for frame, e in zip(fit.frames, fit.left):
        X = frame.by_time[0]
        ratio = fit.variance / max(jitter, 1e-6) ** 2
        single = np.linalg.solve(X.T @ X + ratio * np.eye(X.shape[1]), X.T @ e)
        for c, t in zip(frame.cameras, single):
            by_camera[c].append(abs(float(offset[c] + t)))
    return [float(np.quantile(t, 0.95)) if t else 0.0 for t in by_camera]
