"""What speaks against a camera's move, whatever distances between clouds say.

Owns      bounds, depth that cannot be as wrong as it would have to be, clouds that do not fit, the marker prior, the
          floor; how much each limit is exceeded.
Leaves    held-out distances to icp_heldout, what happens to the camera to icp_gates, sentences to icp_words.

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
from aruco.floor_plane import FloorPlane, plane_axes
from aruco.icp_cloud import Cloud
from aruco.icp_prior import Prior
from aruco.icp_solve import Registration
from aruco.icp_types import ICPConfig, Refusal
from aruco.pose_math import Array, Pose, exp_so3, invert_transform, log_se3, log_so3, make_pose, pose_distance

# Chi-square that is exceeded once in a thousand, by degrees of freedom.
CHI2_999 = {4: 18.47, 6: 22.46}
# Share of what was not known that clouds tell at least before their wish is held against what they tell: of less they
# are not sure enough themselves.
_LEAST_TOLD = 0.25
# Gaps this many times the promised noise are another surface, or no surface. Strangers within reach of a match, spread
# evenly over 28 mm where noise is 6 mm, make it 3.4.
MAX_MISFIT = 3.0
_MEDIAN_SIGMAS = 0.6745  # of a normal distribution
# A camera's own floor may be worse by this and three sigma of what it knows of it: a move that is right in all else is
# not refused for what depth cannot tell.
MAX_TILT_GROWTH_DEG = 0.1
MAX_RISE_GROWTH_M = 0.003
FLOOR_SIGMAS = 3.0
# The reference does not move, so where its own tilt was wrong the common floor leans in the world returned. Levelling
# by biased depth leaves up to 0.3 degrees of that on simulated rigs; beyond half a degree no world is level.
MAX_COMMON_TILT_DEG = 0.5


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


def worst_objection(case: Case, registration: Registration, moving: Sequence[str]) -> Objection | None:
    """The objection that exceeds its limit most: to what is wrong with a cloud first, then to where cameras are put.

    A cloud that is wrong takes other cameras along, and they are not to be blamed for it.
    """
    clouds = (registration.reference, *moving) if moving else ()
    to_clouds = [o for name in clouds for o in _to_cloud(case, registration, name, moving)]
    to_clouds = to_clouds or list(to_all_depths(case, registration, clouds))
    found = to_clouds or [
        *(o for name in clouds for o in _to_size(case, registration, name)),
        *(o for name in moving for o in _to_pose(case, registration, name)),
        *_to_common_floor(case, registration, moving),
    ]
    return max(found, key=lambda objection: objection.excess) if found else None


def _to_cloud(case: Case, registration: Registration, camera: str, moving: Sequence[str]) -> Iterator[Objection]:
    yield from _to_depth(case, registration, camera)
    yield from _to_fit(registration, camera, moving)


def _to_pose(case: Case, registration: Registration, camera: str) -> Iterator[Objection]:
    yield from _to_prior(case, registration, camera)
    yield from _to_floor(case, registration, camera)


def _to_size(case: Case, registration: Registration, camera: str) -> Iterator[Objection]:
    turn, shift = against_others(case.start, registration.T_world_cam, camera)
    config, turn_deg = case.config, math.degrees(turn)
    excess = max(turn_deg / config.max_rotation_deg, shift / config.max_translation_m)
    if excess > 1:
        reason = words.too_far(turn_deg, shift, config.max_rotation_deg, config.max_translation_m)
        yield Objection(camera=camera, kind="too_far", excess=excess, reason=reason)


def against_others(T_before: Mapping[str, Pose], T_after: Mapping[str, Pose], camera: str) -> tuple[float, float]:
    """How far a camera turns [rad] and its centre moves [m] beyond what the others do in common.

    The reference does not move, so all cameras swing about it when it was turned itself: by centimetres for a degree,
    and none of them is to be blamed for it.
    """
    others = [name for name in sorted(T_after) if name != camera]
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
    if not case.config.depth_bias:
        return 0.0
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


def _to_fit(registration: Registration, camera: str, moving: Sequence[str]) -> Iterator[Objection]:
    """Over pairs of cameras none of which is kept: a kept one stands where its cloud may not fit."""
    names, rows = registration.layout.cameras, registration.rows
    counts = np.zeros(len(names) + 1, dtype=bool)  # the last is the floor
    counts[[names.index(name) for name in (registration.reference, *moving)]] = True
    gaps = rows.only(rows.of(names.index(camera)) & counts[rows.a] & counts[rows.b])
    if not len(gaps.gap_m):
        return
    misfit = float(np.median(np.abs(gaps.gap_m) / np.sqrt(gaps.variance))) / _MEDIAN_SIGMAS
    if misfit > MAX_MISFIT:
        reason = words.does_not_fit(misfit, MAX_MISFIT)
        yield Objection(camera=camera, kind="misfit", excess=misfit / MAX_MISFIT, reason=reason)


def _to_prior(case: Case, registration: Registration, camera: str) -> Iterator[Objection]:
    size = prior_sigmas(case, registration, camera)
    limit = math.sqrt(CHI2_999[6])
    if size > limit:
        turn, shift = pose_distance(case.start[camera], registration.T_world_cam[camera])
        reason = words.against_prior(math.degrees(turn), shift, size, limit)
        yield Objection(camera=camera, kind="prior", excess=size / limit, reason=reason)


def prior_sigmas(case: Case, registration: Registration, camera: str) -> float:
    """How far a camera is from its given pose, relative to the reference, in standard deviations (6 numbers together).

    Once by the covariance given, and once by what the estimate takes for it less what clouds leave unknown: a wish
    against the prior is one even where half of it was granted. The larger counts; NaN where nothing was given.
    """
    reference = registration.reference
    priors = {name: case.priors[name] for name in (reference, camera)}
    if any(prior.covariance is None for prior in priors.values()):
        return math.nan
    given = {name: _at_centre(prior.moved(np.eye(4)), priors[camera]) for name, prior in priors.items()}
    T_expected = case.start[reference] @ invert_transform(priors[reference].T_world_cam) @ priors[camera].T_world_cam
    twist = log_se3(registration.T_world_cam[camera] @ invert_transform(T_expected))
    off = centre_jacobian(T_expected[:3, 3]) @ twist
    believed = sum((registration.scales.given**2 * S for name, S in given.items()), np.zeros((6, 6)))
    told = believed - registration.pair_covariance(reference, camera)
    stated = given[reference] + given[camera]
    return math.sqrt(max(surprise(off, stated, stated), surprise(off, believed, told)))


def _at_centre(prior: Prior, camera: Prior) -> Array:
    """(6, 6) of a prior, as (turn, shift) of the centre of a camera."""
    J = centre_jacobian(camera.T_world_cam[:3, 3])
    assert prior.covariance is not None
    return J @ prior.covariance @ J.T


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
    """To a camera that would stand on another floor than all: as it sees it, its depth error taken out.

    The common floor is that of the estimate. The reference does not move, so when its own depth proves wrong the floor
    lies elsewhere under it, and all cameras with it.
    """
    after_plane = _own_floor(case.clouds[camera], registration.bias[camera])
    before_plane = _own_floor(case.clouds[camera], np.zeros_like(registration.bias[camera]))
    if case.floor is None or registration.floor is None or after_plane is None or before_plane is None:
        return
    a, noise = after_plane
    after = _off_floor(a, registration.T_world_cam[camera], registration.floor)
    before = _off_floor(before_plane[0], case.start[camera], case.floor)
    sigma_tilt_deg, sigma_m = _floor_sigmas(a, noise)
    limits = (MAX_TILT_GROWTH_DEG + FLOOR_SIGMAS * sigma_tilt_deg, MAX_RISE_GROWTH_M + FLOOR_SIGMAS * sigma_m)
    excess = max((after[k] - before[k]) / limits[k] for k in range(2))
    if excess > 1:
        yield Objection(camera=camera, kind="floor", excess=excess, reason=words.floor_worse(before, after))


def _own_floor(cloud: Cloud, bias: Array) -> tuple[Array, Array] | None:
    """A camera's floor ``1 / z = a . r`` (3,) with a depth error taken out, and the covariance (3, 3) of its noise."""
    here = np.flatnonzero(cloud.is_floor)
    if cloud.floor is None or len(here) < 3:
        return None
    depth = cloud.depth_m[here] + bias @ cloud.slopes[:, here]
    root = depth**2 / cloud.sigma_m[here]  # of the weight of an inverse depth
    a = np.linalg.lstsq(cloud.rays[here] * root[:, None], root / depth, rcond=None)[0]
    return a, cloud.floor.noise


def _off_floor(a: Array, T_world_cam: Pose, floor: FloorPlane) -> tuple[float, float]:
    """Angle [deg] of a camera's plane with a floor, and how far it is off it [m] below the camera."""
    length = float(np.linalg.norm(a))
    tilt_deg = _tilt_deg(-T_world_cam[:3, :3] @ a, floor.normal)
    return tilt_deg, abs(float(floor.distances(T_world_cam[:3, 3])) - 1.0 / length)


def _floor_sigmas(a: Array, noise: Array) -> tuple[float, float]:
    """Standard deviations of a plane's angle [deg] and distance [m]."""
    h = 1.0 / float(np.linalg.norm(a))
    normal = -a * h
    tilt = h**2 * np.trace(plane_axes(normal) @ noise @ plane_axes(normal).T)
    return math.degrees(math.sqrt(float(tilt))), h**2 * math.sqrt(float(normal @ noise @ normal))


def _to_common_floor(case: Case, registration: Registration, moving: Sequence[str]) -> Iterator[Objection]:
    """To the camera that turns most."""
    if case.floor is None or registration.floor is None or not moving:
        return
    up = np.asarray(case.config.up, dtype=np.float64)
    before, after = (_tilt_deg(plane.normal, up) for plane in (case.floor, registration.floor))
    # Where the reference was not level itself the world cannot be: it stays.
    reference = registration.reference
    seen = _own_floor(case.clouds[reference], registration.bias[reference])
    if seen is not None:
        before = max(before, _tilt_deg(-case.start[reference][:3, :3] @ seen[0], up))
    excess = (after - before) / MAX_COMMON_TILT_DEG
    if excess > 1:
        turned = {name: pose_distance(case.start[name], registration.T_world_cam[name])[0] for name in moving}
        worst = max(turned, key=lambda name: turned[name])
        reason = words.common_floor_tilts(before, after)
        yield Objection(camera=worst, kind="floor", excess=excess, reason=reason)


def _tilt_deg(normal: Array, up: Array) -> float:
    """Angle of a normal of any length with up."""
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(normal, up))), float(normal @ up)))
