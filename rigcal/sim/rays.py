"""The directions of a camera's rays.

Owns      rays through whole rows of pixels and through many points inside single pixels.
Leaves    the lens's formulas to aruco.lens; what rays meet to render.

A ray is (x, y, 1) in the camera's frame. The lens has to be inverted for each; it bends so gently that
interpolation between exact rays is right to 1e-5 px and several times faster.
"""

from __future__ import annotations

import numpy as np

from aruco import lens
from aruco.model import Camera
from aruco.pose_math import Array

# Cubic interpolation over this many pixels leaves less than 1e-5 px with the distortion of a common lens.
_NODE_STEP_PX = 8


def pinhole_rays(K: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Rays of a camera without distortion through pixels (u, v) that broadcast."""
    y = (v - K[1, 2]) / K[1, 1]
    x = (u - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return x, np.broadcast_to(y, x.shape)


def row_rays(camera: Camera, rows: slice) -> tuple[Array, Array]:
    """Rays through the centres of whole rows of recorded pixels, each (r, w); NaN where the lens sees nothing."""
    u, v = np.arange(camera.width, dtype=np.float64), np.arange(rows.start, rows.stop, dtype=np.float64)[:, None]
    if not camera.has_distortion:
        return pinhole_rays(camera.K, u, v)
    node_u, along_u = _cubic_weights(u)
    node_v, along_v = _cubic_weights(v[:, 0])
    x, y = _exact_rays(camera, node_u[None, :], node_v[:, None])
    if np.isnan(x).any():
        return _exact_rays(camera, u[None, :], v)
    return along_v @ x @ along_u.T, along_v @ y @ along_u.T


def rays_inside(camera: Camera, pixels: Array, offsets: Array) -> tuple[Array, Array]:
    """Rays through points inside of recorded pixels.

    Args:
        camera: Intrinsics.
        pixels: (n, 2) centres.
        offsets: (n, m, 2) from the centre, each in [-0.5, 0.5].

    Returns:
        x and y, each (n, m); NaN where the lens sees nothing.
    """
    if not camera.has_distortion:
        return pinhole_rays(camera.K, *(pixels[:, None, :] + offsets).transpose(2, 0, 1))
    places = pixels[:, None, None, :] + np.stack(np.meshgrid(*[[-0.5, 0.0, 0.5]] * 2, indexing="ij"), axis=-1)
    nodes = _exact_rays(camera, places[..., 0], places[..., 1])  # (n, 3, 3): offsets in u, then in v
    along_u, along_v = _quadratic_weights(offsets[..., 0]), _quadratic_weights(offsets[..., 1])
    x, y = (((along_u @ values) * along_v).sum(axis=-1) for values in nodes)
    return x, y


def _exact_rays(camera: Camera, u: Array, v: Array) -> tuple[Array, Array]:
    u, v = np.broadcast_arrays(u, v)
    x = lens.undistort(camera, np.stack([u.ravel(), v.ravel()], axis=1))
    return x[:, 0].reshape(u.shape), x[:, 1].reshape(u.shape)


def _cubic_weights(places: Array) -> tuple[Array, Array]:
    """Evenly spaced nodes (k,) around places (n,), and Lagrange's weights (n, k) of the four nearest."""
    first = places[0] - _NODE_STEP_PX
    count = int(np.ceil((places[-1] - first) / _NODE_STEP_PX)) + 3
    s = (places - first) / _NODE_STEP_PX
    cell = np.floor(s).astype(np.int64)
    s = s - cell
    weights = np.zeros((len(places), count))
    lagrange = (
        -s * (s - 1) * (s - 2) / 6,
        (s + 1) * (s - 1) * (s - 2) / 2,
        -(s + 1) * s * (s - 2) / 2,
        (s + 1) * s * (s - 1) / 6,
    )
    for k, weight in enumerate(lagrange):
        weights[np.arange(len(places)), cell - 1 + k] = weight
    return first + _NODE_STEP_PX * np.arange(count), weights


def _quadratic_weights(s: Array) -> Array:
    """Lagrange's weights (..., 3) of the nodes -0.5, 0, 0.5."""
    return np.stack([2 * s * (s - 0.5), 1 - 4 * s * s, 2 * s * (s + 0.5)], axis=-1)
