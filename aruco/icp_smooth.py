"""Where a cloud's surfaces are, apart from the noise of single samples.

Owns      depth of the surface along each sample's ray; clouds whose slopes and weights are taken there; clouds and
          surfaces with a depth error taken out.
Leaves    samples and normals to icp_cloud.

Whatever multiplies noise must not have the same noise itself. By a camera's scale a floor's gap changes by n . ray
times the depth measured: as much as the camera's height, and the noise of the gap itself. So shrinking a cloud and
raising its camera seems to explain all noise, and thousands of samples seem to know the scale that well. Taken at the
surface, derivatives and weights have no such noise. Nor has depth the bias of 1 / (w + noise) if it is linear in the
inverse depth w about the surface.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from aruco.icp_cloud import Cloud
from aruco.icp_rows import Index
from aruco.pose_math import Array

# A surface that several planes are fitted to, or one across an edge: no smoothing beyond what noise can be.
_MOST_SIGMAS = 5.0
# Of inverse depth, however large an error is tried on the way.
_LEAST_LEFT = 0.2


def smoothed(cloud: Cloud) -> tuple[Cloud, Array]:
    """A cloud with slopes, noise and depth taken about its surfaces, and the depth (n,) of these [m].

    Large planes are surfaces as a whole, everything else is one plane a cell.
    """
    surface = _surface_depth(cloud)
    ratio = surface / cloud.depth_m
    about = replace(
        cloud,
        depth_m=2.0 * surface - surface * ratio,
        slopes=np.stack([slope * ratio**power for slope, power in zip(cloud.slopes, _powers(cloud))]),
        sigma_m=cloud.sigma_m * ratio**2,
    )
    return about, surface


def corrected(cloud: Cloud, surface: Array, error: Array) -> tuple[Cloud, Array]:
    """A cloud and the depth (n,) of its surfaces with a depth error taken out.

    Normals follow: 3 % of depth or a lean turn a floor by half a degree in the camera's frame. Clouds that then lie
    level with normals that do not would seem to know yaw, by half a degree of the distance to the middle of the rig.

    Args:
        cloud: About its surfaces.
        surface: (n,) depth of these [m].
        error: (4,) see icp_cloud.Cloud.slopes.
    """
    if not error.any():
        return cloud, surface
    # Linear in inverse depth, where planes stay planes.
    ratio = 1.0 / np.maximum(1.0 - error @ cloud.slopes / surface, _LEAST_LEFT)
    taken_out = replace(
        cloud,
        depth_m=surface * ratio + (cloud.depth_m - surface) * ratio**2,
        sigma_m=cloud.sigma_m * ratio**2,
        slopes=cloud.slopes * ratio**2,
        normals=_turned(cloud, surface, error),
    )
    return taken_out, surface * ratio


def slopes_at(cloud: Cloud, surface: Array, index: Index, points: Array) -> Array:
    """(k, 4) slopes at points (k, 3) of the camera's frame beside samples (k,), whose surface is (n,) deep."""
    z = points[:, 2]
    nearby = cloud.slopes.T[index] * (z / surface[index])[:, None] ** _powers(cloud)
    nearby[:, 2:] = z[:, None] * points[:, :2]
    return nearby


def _turned(cloud: Cloud, surface: Array, error: Array) -> Array:
    """(n, 3) normals of planes 1 / z = a . r whose depth changes by error . slopes, at each sample.

    To first order 1 / z changes by -error . slopes / z^2: by the scale in proportion to itself, by an inverse depth
    everywhere alike, by a lean along x and y; and by an offset in proportion to its square, of which the tangent plane
    counts.
    """
    inverse = 1.0 / surface
    scale, second = error[0] * cloud.slopes[0] * inverse, error[1] * cloud.slopes[1]
    a = cloud.normals / (cloud.normals * cloud.rays).sum(axis=1)[:, None] * inverse[:, None]
    change = -scale[:, None] * a
    if _by_offset(cloud):
        change -= 2.0 * (second * inverse)[:, None] * a
        change[:, 2] += second * inverse**2
    else:
        change[:, 2] -= second * inverse**2
    change[:, :2] -= error[2:]
    turned = -(a + change)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _by_offset(cloud: Cloud) -> bool:
    """Whether the second number of a depth error is an offset rather than an inverse depth."""
    return cloud.given_bias is not None and cloud.given_bias.model == "offset"


def _powers(cloud: Cloud) -> Array:
    """(4,) of depth that slopes grow with."""
    return np.array([1, 0, 2, 2] if _by_offset(cloud) else [1, 2, 2, 2])


def _surface_depth(cloud: Cloud) -> Array:
    patch = _patches(cloud)
    n = int(patch.max(initial=-1)) + 1
    count = np.maximum(np.bincount(patch, minlength=n), 1)
    normal = np.stack([np.bincount(patch, column, n) for column in cloud.normals.T], axis=1)
    along = (cloud.rays * normal[patch]).sum(axis=1)
    # Along a plane 1 / z = along / offset, and there noise has no bias.
    inverse_offset = np.bincount(patch, 1.0 / (cloud.depth_m * along), n) / count
    depth = 1.0 / (along * inverse_offset[patch])
    near = np.abs(depth - cloud.depth_m) <= _MOST_SIGMAS * cloud.sigma_m
    return np.where(near, depth, cloud.depth_m)


def _patches(cloud: Cloud) -> Index:
    """The number (n,) of the plane or piece of a surface that each sample lies on."""
    facing = np.argmax(np.abs(cloud.normals), axis=1)
    facing = 2 * facing + (cloud.normals[np.arange(len(facing)), facing] > 0)
    # Samples of one plane have the very same normal.
    _, plane, size = np.unique(cloud.normals[:, 0], return_inverse=True, return_counts=True)
    alone = size[plane] < 2
    patch = np.where(alone, 6 * cloud.cell.astype(np.int64) + facing, -1 - plane.astype(np.int64))
    return np.unique(patch, return_inverse=True)[1].ravel()
