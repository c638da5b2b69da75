"""What speaks against a camera's move, whatever distances between clouds say.

Owns      bounds, depth that cannot be as wrong as it would have to be, clouds that do not fit, the marker prior; how
          much each limit is exceeded.
Leaves    floors to icp_floor, held-out distances to icp_heldout, what happens to the camera to icp_gates, sentences to
          icp_words.

A wrong depth, a wrong match or a camera that was bumped after its markers were seen brings clouds nearer to each other
as well as a right move does: where all of a cloud is wrong, so is what was held out of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aruco import icp_words as words
from aruco.floor_model import centre_jacobian
from aruco.floor_plane import FloorPlane
from aruco.icp_cloud import Cloud
from aruco.icp_floor import MAX_COMMON_TILT_DEG, common_tilts_deg, floor_growth
from aruco.icp_prior import Prior
from aruco.icp_solve import Registration
from aruco.icp_types import ICPConfig, Refusal
from aruco.pose_math import (
    Array,
    Pose,
    exp_so3,
    invert_transform,
    log_so3,
    make_pose,
    pose_distance,
)

# Chi-square that is exceeded once in a thousand, by degrees of freedom.
CHI2_999 = {4: 18.47, 6: 22.46}
# Share of what was not known that clouds tell at least before their wish is held against what they tell: of less they
# are not sure enough themselves.
_LEAST_TOLD = 0.25
# Gaps this many times the promised noise are another surface, or no surface. Strangers within reach of a match, spread
# evenly over 28 mm where noise is 6 mm, make it 3.4.
MAX_MISFIT = 3.0
_MEDIAN_SIGMAS = 0.6745  # of a normal distribution


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Case:
    """What moves are judged by, besides the registration that asks for them."""

    clouds: Mapping[str, Cloud]
    start: Mapping[str, Pose]
    priors: Mapping[str, Prior]
    config: ICPConfig
    floor: FloorPlane | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Objection:
    """A limit that a camera's move exceeds."""

    camera: str
    kind: Refusal
    excess: float  # how many times the limit
    reason: str
    wish: tuple[float, float] | None = None  # turn [deg] and shift [m] from the given pose, where that is against it


def worst_objection(case: Case, registration: Registration, moving: Sequence[str]) -> Objection | None:
    """The objection that exceeds its limit most: to what is wrong with a cloud first, then to where cameras are put.

    A cloud that is wrong takes other cameras along, and they are not to be blamed for it. But a camera that was bumped
    makes its cloud look wrong.
    """
    clouds = (registration.reference, *moving) if moving else ()
    to_clouds = [o for name in clouds for o in _to_cloud(case, registration, name)]
    to_clouds = to_clouds or list(to_all_depths(case, registration, clouds))
    to_poses = [*_to_prior(case, registration, moving), *_to_size(case, registration, moving)]
    bumped = [o for o in to_poses if o.camera in {objection.camera for objection in to_clouds}]
    found = [*to_clouds, *bumped] or [
        *to_poses,
        *(o for name in moving for o in _to_floor(case, registration, name)),
        *_to_common_floor(case, registration, moving),
    ]
    return max(found, key=lambda objection: objection.excess) if found else None


def objection_to_places(case: Case, registration: Registration, moving: Sequence[str]) -> Objection | None:
    """The largest to where cameras have been put beside others that stay.

    Priors are counted already where it is weighed who follows whom.
    """
    found = [
        *_to_size(case, registration, moving),
        *(o for name in moving for o in _to_floor(case, registration, name)),
    ]
    return max((o for o in found if o.camera in moving), key=lambda objection: objection.excess, default=None)


def _to_cloud(case: Case, registration: Registration, camera: str) -> Iterator[Objection]:
    yield from _to_depth(case, registration, camera)
    yield from _to_fit(registration, camera)


def _to_size(case: Case, registration: Registration, moving: Sequence[str]) -> Iterator[Objection]:
    """To the camera without which the others agree best, if it went too far; else to such a one of these others.

    How far it went says less: what others do in common is a mean that the one which strayed has a part in, and where
    one turns in place that takes a distant camera along. Of two cameras it is never the reference, which nobody knows.
    """
    left = [registration.reference, *moving]
    while len(left) > 1 and max((excess := _beyond(case, registration, left)).values()) > 1:
        without = {name: _beyond(case, registration, [n for n in left if n != name]) for name in left}
        strayed = min(left, key=lambda name: (max(without[name].values()), name == registration.reference))
        if excess[strayed] > 1:
            turn_deg, shift = _against(case, registration, left, strayed)
            reason = words.too_far(turn_deg, shift, case.config.max_rotation_deg, case.config.max_translation_m)
            yield Objection(camera=strayed, kind="too_far", excess=excess[strayed], reason=reason)
            return
        left.remove(strayed)


def _beyond(case: Case, registration: Registration, cameras: Sequence[str]) -> dict[str, float]:
    """How many times its bounds each of some cameras is off what these do in common."""
    moves = {name: _against(case, registration, cameras, name) for name in cameras}
    most_deg, most_m = case.config.max_rotation_deg, case.config.max_translation_m
    return {name: max(turn_deg / most_deg, shift / most_m) for name, (turn_deg, shift) in moves.items()}


def _against(case: Case, registration: Registration, cameras: Sequence[str], camera: str) -> tuple[float, float]:
    """A camera's turn [deg] and shift [m] beyond what others of some cameras do in common."""
    T_before, T_after = ({name: T[name] for name in cameras} for T in (case.start, registration.T_world_cam))
    turn, shift = against_others(T_before, T_after, camera)
    return math.degrees(turn), shift


def against_others(T_before: Mapping[str, Pose], T_after: Mapping[str, Pose], camera: str) -> tuple[float, float]:
    """How far a camera turns [rad] and its centre moves [m] beyond what the others do in common.

    The reference does not move, so all cameras swing about it when it was turned itself: by centimetres for a degree,
    and none of them is to be blamed for it. By itself a camera goes nowhere.
    """
    others = [name for name in sorted(T_after) if name != camera]
    if not others:
        return 0.0, 0.0
    turns = [log_so3(T_after[name][:3, :3] @ T_before[name][:3, :3].T) for name in others]
    R = exp_so3(np.mean(turns, axis=0))
    old, new = (np.mean([T[name][:3, 3] for name in others], axis=0) for T in (T_before, T_after))
    T_common = make_pose(R, new - R @ old)
    return pose_distance(T_common @ T_before[camera], T_after[camera])


def _to_depth(case: Case, registration: Registration, camera: str) -> Iterator[Objection]:
    chi2 = _depth_surprise(case, registration, [camera])
    if chi2 > CHI2_999[4]:
        error = _depth_error(registration, case.clouds[camera])
        reason = words.unbelievable_depth(*error, math.sqrt(chi2), math.sqrt(CHI2_999[4]))
        yield Objection(camera=camera, kind="depth", excess=math.sqrt(chi2 / CHI2_999[4]), reason=reason)


def to_all_depths(case: Case, registration: Registration, cameras: Sequence[str]) -> Iterator[Objection]:
    """To the camera whose depth is least believable where only that of all together is not.

    Where no camera sees more than the floor, an error that all have in common bends it hardly, and is worth a tilt of
    each: it may grow to three sigma in every camera, which no single one need answer for.
    """
    from scipy.special import chdtri

    heard = sorted({*cameras} & {name for pair in registration.pairs for name in pair})
    if len(heard) < 2:
        return
    chi2, limit = _depth_surprise(case, registration, heard), float(chdtri(4 * len(heard), 0.001))
    if chi2 > limit:
        worst = max(heard, key=lambda name: _depth_surprise(case, registration, [name]))
        error = _depth_error(registration, case.clouds[worst])
        reason = words.unbelievable_depths(*error, math.sqrt(chi2), math.sqrt(limit))
        yield Objection(camera=worst, kind="depth", excess=math.sqrt(chi2 / limit), reason=reason)


def _depth_surprise(case: Case, registration: Registration, cameras: Sequence[str]) -> float:
    """Chi-square of some cameras' depth errors, four numbers each.

    Once by what is believed of any camera, and once by what the estimate takes for it less what clouds leave unknown.
    """
    at = np.concatenate([np.r_[registration.layout.bias(name)] for name in cameras])
    stated = np.zeros((len(at), len(at)))
    believed = stated.copy()
    for k, name in enumerate(cameras):
        cloud, here = case.clouds[name], slice(4 * k, 4 * k + 4)
        measured = cloud.given_bias is not None and cloud.given_bias.covariance is not None
        # Where all cameras' depth seems better than is believed of any, an ordinary one is no fault.
        factors = [1.0 if measured else max(registration.scales.bias, 1.0), max(registration.scales.lean, 1.0)]
        D = np.diag(np.repeat(factors, 2))
        stated[here, here], believed[here, here] = cloud.bias_covariance, D @ cloud.bias_covariance @ D
    b = np.concatenate([registration.bias[name] for name in cameras])
    told = believed - registration.joint[np.ix_(at, at)]
    return max(surprise(b, stated, stated), surprise(b, believed, told))


def _depth_error(registration: Registration, cloud: Cloud) -> tuple[float, float]:
    """What a camera's depth is wrong by where its cloud meets others, and one sigma of that, as shares of depth.

    Elsewhere the estimate goes on as lines do, and says nothing of the camera.
    """
    met = [m.i for (source, _), m in registration.matches.items() if source == cloud.camera]
    here = np.unique(np.concatenate(met)) if met else np.arange(len(cloud))
    slopes = cloud.slopes[:, here] / cloud.depth_m[here]
    covariance = registration.bias_covariance[cloud.camera]
    sigma = np.sqrt(np.einsum("in,ij,jn->n", slopes, covariance, slopes))
    return float(np.median(np.abs(registration.bias[cloud.camera] @ slopes))), float(np.median(sigma))


def _to_fit(registration: Registration, camera: str) -> Iterator[Objection]:
    rows = registration.rows
    gaps = rows.only(rows.of(registration.layout.cameras.index(camera)) & ~rows.is_floor)
    if not len(gaps.gap_m):
        return
    misfit = float(np.median(np.abs(gaps.gap_m) / np.sqrt(gaps.variance))) / _MEDIAN_SIGMAS
    if misfit > MAX_MISFIT:
        reason = words.does_not_fit(misfit, MAX_MISFIT)
        yield Objection(camera=camera, kind="misfit", excess=misfit / MAX_MISFIT, reason=reason)


def _to_prior(case: Case, registration: Registration, moving: Sequence[str]) -> Iterator[Objection]:
    """To the camera whose given pose fits the estimate least, if it is beyond what its covariance allows.

    One wrong pose pulls all others off theirs, each in proportion to what is known of it: those are not to be blamed.
    Of each pose is asked how far the estimate of all is from it, in what that may be by chance (Baarda, A testing
    procedure for use in geodetic networks, 1968). Of two cameras the reference stays, for nobody knows which it is.
    """
    limit = math.sqrt(CHI2_999[6])
    asked = [registration.reference, *moving] if len(moving) > 1 else list(moving)
    given = [name for name in asked if case.priors[name].covariance is not None]
    off = {name: _Off.from_prior(case, registration, name) for name in given}
    beyond = {name: by for name, by in off.items() if by.sigmas > limit}
    if beyond:
        worst = max(beyond, key=lambda name: (beyond[name].by_chance, name != registration.reference))
        by = beyond[worst]
        reason = words.against_prior(*by.size, by.sigmas, limit)
        yield Objection(camera=worst, kind="prior", excess=by.sigmas / limit, reason=reason, wish=by.size)


def prior_sigmas(case: Case, registration: Registration, camera: str) -> float:
    """How far the estimate puts a camera from its given pose, in standard deviations; NaN where nothing was given."""
    known = case.priors[camera].covariance is not None
    return _Off.from_prior(case, registration, camera).sigmas if known else math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class _Off:
    """How far the estimate of all cameras, none of which it takes for a reference, puts one from its given pose."""

    size: tuple[float, float]  # turn [deg] and shift of the centre [m]
    by_stated: float  # root of chi-square (6 numbers together) by the covariance given
    by_chance: float  # by what the estimate takes for it less what clouds leave unknown

    @property
    def sigmas(self) -> float:
        """A wish against the prior is one even where half of it was granted: the larger counts."""
        return max(self.by_stated, self.by_chance)

    @staticmethod
    def from_prior(case: Case, registration: Registration, camera: str) -> _Off:
        """Of a camera whose pose has a covariance."""
        at, prior = registration.layout.pose(camera), case.priors[camera]
        T_own_cam = invert_transform(registration.T_out_own) @ registration.T_world_cam[camera]
        own, given = centre_jacobian(T_own_cam[:3, 3]), centre_jacobian(prior.T_world_cam[:3, 3])
        S = np.linalg.inv(registration.prior.H[at, at])
        off = own @ S @ registration.prior.g[at]
        stated = prior.moved(np.eye(4)).covariance
        assert stated is not None
        stated = given @ stated @ given.T
        told = own @ (S - registration.joint[at, at]) @ own.T
        return _Off(
            size=(math.degrees(float(np.linalg.norm(off[:3]))), float(np.linalg.norm(off[3:]))),
            by_stated=math.sqrt(surprise(off, stated, stated)),
            by_chance=math.sqrt(surprise(off, own @ S @ own.T, told)),
        )


def surprise(wish: Array, before: Array, told: Array) -> float:
    """Chi-square of an estimate (n,) about a prior mean of zero, of which ``told`` (n, n) is what it may be by chance.

    Args:
        wish: The estimate.
        before: (n, n) covariance of the prior.
        told: (n, n) the prior's covariance less the posterior's, which is the estimate's own covariance about the mean
            (both being right). Directions of which clouds tell nearly nothing count as told a little.
    """
    L = np.linalg.cholesky(before + 1e-18 * np.trace(before) * np.eye(len(before)))
    whitened = np.linalg.solve(L, np.linalg.solve(L, told).T)
    values, vectors = np.linalg.eigh((whitened + whitened.T) / 2)
    along = vectors.T @ np.linalg.solve(L, wish)
    return float(np.sum(along**2 / np.clip(values, _LEAST_TOLD, 1.0)))


def _to_floor(case: Case, registration: Registration, camera: str) -> Iterator[Objection]:
    """To a camera that would stand on another floor than all.

    The common floor is that of the estimate. The reference does not move, so when its own depth proves wrong the floor
    lies elsewhere under it, and all cameras with it.
    """
    if case.floor is None or registration.floor is None:
        return
    growth = floor_growth(
        case.clouds[camera],
        registration.bias[camera],
        before=(case.start[camera], case.floor),
        after=(registration.T_world_cam[camera], registration.floor),
    )
    if growth is not None and growth.excess > 1:
        reason = words.floor_worse(growth.before, growth.after)
        yield Objection(camera=camera, kind="floor", excess=growth.excess, reason=reason)


def _to_common_floor(case: Case, registration: Registration, moving: Sequence[str]) -> Iterator[Objection]:
    """To the camera that turns most."""
    if case.floor is None or registration.floor is None or not moving:
        return
    reference, up = registration.reference, np.asarray(case.config.up, dtype=np.float64)
    before, after = common_tilts_deg(
        (case.floor, registration.floor),
        up,
        case.clouds[reference],
        registration.bias[reference],
        case.start[reference],
    )
    excess = (after - before) / MAX_COMMON_TILT_DEG
    if excess > 1:
        turned = {name: pose_distance(case.start[name], registration.T_world_cam[name])[0] for name in moving}
        worst = max(turned, key=lambda name: turned[name])
        reason = words.common_floor_tilts(before, after)
        yield Objection(camera=worst, kind="floor", excess=excess, reason=reason)
