"""Lenses: from a direction to a pixel and back, with derivatives.

Owns      the three distortion models of ROS and OpenCV, their inverse, projection of points.
Leaves    checking of coefficients to model.Camera.

All three models map normalised pinhole coordinates ``x = X / Z`` to distorted ones; the pixel is
``K @ (x_distorted, 1)``. Formulas: OpenCV's calib3d documentation (radial, tangential and rational terms after
Brown 1966 and Claus and Fitzgibbon 2005; fisheye after Kannala and Brandt, "A generic camera model", 2006).
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import polynomial

from aruco.model import Camera
from aruco.pose_math import Array

# Newton's method squares its error each step: from a pixel to 1e-12 in a handful of steps.
_INVERSE_STEPS = 20
_INVERSE_TOLERANCE = 1e-13
# A pixel is 1e-3 in these units: what is farther off than this has not converged.
_INVERSE_ACCEPTED = 1e-9
# Where the distorted radius stops growing the derivative is singular: stay this much inside.
_INSIDE_FOLD = 1.0 - 1e-6
_TINY = 1e-12


def _brown(x: Array, k: Array) -> tuple[Array, Array]:
    """Distorted coordinates (n, 2) and their Jacobian (n, 2, 2), for (k1 k2 p1 p2 k3 [k4 k5 k6])."""
    k1, k2, p1, p2, k3 = k[:5]
    k4, k5, k6 = k[5:8] if len(k) >= 8 else (0.0, 0.0, 0.0)
    u, v = x[:, 0], x[:, 1]
    r2 = u * u + v * v
    top = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bottom = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = top / bottom
    d_top = k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
    d_bottom = k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2)
    d_radial = (d_top - radial * d_bottom) / bottom  # with respect to r2
    out = np.stack(
        [
            u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
            v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v,
        ],
        axis=1,
    )
    J = np.empty((len(x), 2, 2))
    J[:, 0, 0] = radial + 2.0 * u * u * d_radial + 2.0 * p1 * v + 6.0 * p2 * u
    J[:, 0, 1] = 2.0 * u * v * d_radial + 2.0 * p1 * u + 2.0 * p2 * v
    J[:, 1, 0] = J[:, 0, 1]
    J[:, 1, 1] = radial + 2.0 * v * v * d_radial + 6.0 * p1 * v + 2.0 * p2 * u
    return out, J


def _kannala(x: Array, k: Array) -> tuple[Array, Array]:
    """Distorted coordinates (n, 2) and their Jacobian (n, 2, 2), for the fisheye coefficients (k1 k2 k3 k4)."""
    r = np.linalg.norm(x, axis=1)
    near = r < 1e-8
    safe = np.where(near, 1.0, r)
    theta = np.arctan(r)
    t2 = theta * theta
    poly = 1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))
    d_poly = 1.0 + t2 * (3 * k[0] + t2 * (5 * k[1] + t2 * (7 * k[2] + t2 * 9 * k[3])))
    scale = np.where(near, 1.0, theta * poly / safe)
    d_radius = d_poly / (1.0 + r * r)  # d(theta_d) / dr
    d_scale = np.where(near, 0.0, (d_radius - scale) / safe)  # d(scale) / dr
    J = scale[:, None, None] * np.eye(2) + (d_scale / safe)[:, None, None] * (x[:, :, None] * x[:, None, :])
    return x * scale[:, None], J


def distort(camera: Camera, x: Array) -> tuple[Array, Array]:
    """Distorted normalised coordinates of undistorted ones.

    Args:
        camera: Intrinsics.
        x: (n, 2) ``(X / Z, Y / Z)``.

    Returns:
        (n, 2) distorted coordinates and their (n, 2, 2) Jacobian with respect to ``x``.
    """
    if not camera.has_distortion:
        return x, np.broadcast_to(np.eye(2), (len(x), 2, 2))
    model = _kannala if camera.distortion_model == "equidistant" else _brown
    return model(x, camera.distortion)


def undistort(camera: Camera, pixels: Array) -> Array:
    """Normalised pinhole coordinates (n, 2) of recorded pixels (n, 2); NaN where the lens has no inverse."""
    K_inv = np.linalg.inv(camera.K)
    target = pixels @ K_inv[:2, :2].T + K_inv[:2, 2]
    if not camera.has_distortion:
        return target
    inverse = _kannala_inverse if camera.distortion_model == "equidistant" else _brown_inverse
    return inverse(target, camera.distortion)


def _first_root(coefficients: Array) -> float:
    """The smallest positive real root of a polynomial given from its constant term up; infinite if none."""
    roots = polynomial.polyroots(polynomial.polytrim(coefficients))
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(real.min()) if len(real) else np.inf


def _brown_fold(k: Array) -> float:
    """The radius up to which radially distorted radii grow; beyond it pixels repeat and the inverse is another."""
    top = np.array([1.0, k[0], k[1], k[4]])
    bottom = np.array([1.0, *k[5:8]])
    # The numerator of d(r top / bottom) / dr, in r squared.
    change = polynomial.polysub(
        polynomial.polymul(polynomial.polyder(top), bottom), polynomial.polymul(top, polynomial.polyder(bottom))
    )
    slope = polynomial.polyadd(polynomial.polymul(top, bottom), polynomial.polymul([0.0, 2.0], change))
    return min(_first_root(slope), _first_root(bottom)) ** 0.5


def _brown_inverse(target: Array, k: Array) -> Array:
    fold = _brown_fold(k) * _INSIDE_FOLD
    radius = np.linalg.norm(target, axis=1, keepdims=True)
    # From inside: near the fold the slope vanishes, and Newton's step would leap across the centre.
    x = target * np.minimum(1.0, 0.5 * fold / np.maximum(radius, _TINY))
    for _ in range(_INVERSE_STEPS):
        value, J = _brown(x, k)
        error = value - target
        if not (np.abs(error) > _INVERSE_TOLERANCE).any():
            break
        determinant = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
        determinant = np.where(np.abs(determinant) < 1e-9, np.nan, determinant)
        x[:, 0] -= (J[:, 1, 1] * error[:, 0] - J[:, 0, 1] * error[:, 1]) / determinant
        x[:, 1] -= (J[:, 0, 0] * error[:, 1] - J[:, 1, 0] * error[:, 0]) / determinant
        x *= np.minimum(1.0, fold / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), _TINY))
    x[~(np.abs(_brown(x, k)[0] - target) < _INVERSE_ACCEPTED).all(axis=1)] = np.nan
    return x


def _kannala_inverse(target: Array, k: Array) -> Array:
    # In the angle, not in its tangent, which bends so much towards 90 degrees that Newton's method runs away.
    odd = np.array([1.0, *k])
    slope = odd * np.array([1.0, 3.0, 5.0, 7.0, 9.0])
    fold = min(_first_root(slope) ** 0.5, np.pi / 2) * _INSIDE_FOLD
    radius = np.linalg.norm(target, axis=1)
    theta = np.minimum(radius, 0.5 * fold)
    for _ in range(_INVERSE_STEPS):
        error = theta * polynomial.polyval(theta**2, odd) - radius
        if not (np.abs(error) > _INVERSE_TOLERANCE).any():
            break
        theta = np.clip(theta - error / polynomial.polyval(theta**2, slope), 0.0, fold)
    theta[~(np.abs(theta * polynomial.polyval(theta**2, odd) - radius) < _INVERSE_ACCEPTED)] = np.nan
    return target * np.where(radius > _TINY, np.tan(theta) / np.maximum(radius, _TINY), 1.0)[:, None]


def straighten(camera: Camera, pixels: Array) -> Array:
    """Where recorded pixels (n, 2) would lie in the image of a pinhole camera with the same K [px]."""
    if not camera.has_distortion:
        return pixels
    return undistort(camera, pixels) @ camera.K[:2, :2].T + camera.K[:2, 2]


def bend(camera: Camera, pinhole_pixels: Array) -> Array:
    """The inverse of ``straighten``: recorded pixels (n, 2) of pinhole pixels (n, 2)."""
    if not camera.has_distortion:
        return pinhole_pixels
    K_inv = np.linalg.inv(camera.K)
    x = pinhole_pixels @ K_inv[:2, :2].T + K_inv[:2, 2]
    return distort(camera, x)[0] @ camera.K[:2, :2].T + camera.K[:2, 2]


def project(camera: Camera, points_cam: Array) -> Array:
    """Recorded pixels (n, 2) of points (n, 3) in the camera's frame [m]; NaN for points not in front of it."""
    z = np.where(points_cam[:, 2] > 1e-9, points_cam[:, 2], np.nan)
    distorted, _ = distort(camera, points_cam[:, :2] / z[:, None])
    return distorted @ camera.K[:2, :2].T + camera.K[:2, 2]
