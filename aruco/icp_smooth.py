"""Where a cloud's surfaces are, apart from the noise of single samples.

Owns      depth of the surface along each sample's ray; clouds whose slopes and weights are taken there.
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


def smoothed(cloud: Cloud) -> tuple[Cloud, Array]:
    """A cloud with slopes, noise and depth taken about its surfaces, and the depth (n,) of these [m].

    Large planes are surfaces as a whole, everything else is one plane a cell.
    """
    surface = _surface_depth(cloud)
    ratio = surface / cloud.depth_m
    powers = (1, 0, 2, 2) if cloud.given_bias is not None and cloud.given_bias.model == "offset" else (1, 2, 2, 2)
    about = replace(
        cloud,
        depth_m=2.0 * surface - surface * ratio,
        slopes=np.stack([slope * ratio**power for slope, power in zip(cloud.slopes, powers)]),
        sigma_m=cloud.sigma_m * ratio**2,
    )
    return about, surface


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
