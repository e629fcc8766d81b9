"""The centre of a disc's image is not the image of its centre: what to take off.

Perspective moves the centre of the image ellipse towards the camera's side of the disc, and a
lens bends the outline. Both are computed by projecting the outline through the whole camera and
fitting an ellipse, as detection does. The disc's attitude, which this needs, follows from its
ellipses in two or more views and its true diameter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import BoolArray, FloatArray, all_finite, frozen_array
from closerange.rig.camera import Camera

_OUTLINE = 32  # points on the outline: the ellipse fit is exact for 5, distortion is smooth
_SPHERE = 400  # first guesses of the normal: 6 degrees apart, well inside Gauss-Newton's basin
_REFINEMENTS = 6
ROOT_2 = float(np.sqrt(2.0))
_CHUNK = 512  # discs at once: bounds the memory of the search


@dataclass(frozen=True, slots=True, eq=False)
class DiscViews:
    """Discs as seen by several cameras; M discs, C cameras.

    Attributes
    ----------
    xyz_mm : ndarray, shape (M, 3)
        World position of the centres.
    ellipse : ndarray, shape (M, C, 3)
        Semi-axes a >= b in px and angle in rad; NaN where not seen.
    diameter_mm : ndarray, shape (M,)
        True diameters; NaN for points that are no discs.
    """

    xyz_mm: FloatArray
    ellipse: FloatArray
    diameter_mm: FloatArray

    @property
    def seen(self) -> BoolArray:
        """Which disc has an ellipse in which view, shape (M, C)."""
        return all_finite(self.ellipse, 2)


def disc_centre_bias(cameras: Sequence[Camera], discs: DiscViews) -> FloatArray:
    """Return centre of the seen outline minus image of the centre.

    Parameters
    ----------
    cameras : sequence of Camera, length C
        Calibrated cameras.
    discs : DiscViews
        Discs with approximately known positions.

    Returns
    -------
    ndarray, shape (M, C, 2)
        Bias in px, to be subtracted from the detected centres; 0 for what is no disc and for
        discs with fewer than two ellipses, whose attitude is unknown.
    """
    bias = np.zeros((len(discs.xyz_mm), len(cameras), 2))
    normals = disc_normals(cameras, discs)
    rows = np.flatnonzero(all_finite(normals, 1))
    if not len(rows):
        return bias
    xyz, radius = discs.xyz_mm[rows], discs.diameter_mm[rows] / 2
    for index, camera in enumerate(cameras):
        shift = outline_centre(camera, xyz, normals[rows], radius) - camera.project(xyz)
        bias[rows, index] = np.where(np.isfinite(shift), shift, 0.0)
    return bias


def outline_centre(
    camera: Camera, xyz_mm: FloatArray, normal: FloatArray, radius_mm: FloatArray
) -> FloatArray:
    """Return the centre of the ellipse fitted to the image of a disc's outline.

    Parameters
    ----------
    camera : Camera
        The view.
    xyz_mm, normal : ndarray, shape (M, 3)
        Centre and unit normal of each disc in the world.
    radius_mm : ndarray, shape (M,)
        Radii.

    Returns
    -------
    ndarray, shape (M, 2)
        Centre in observed px; NaN where the outline is not in front of the camera.
    """
    u, v = _plane_axes(normal)
    angle = np.linspace(0.0, 2 * np.pi, _OUTLINE, endpoint=False)
    circle = np.cos(angle)[:, None] * u[:, None] + np.sin(angle)[:, None] * v[:, None]
    outline = xyz_mm[:, None] + radius_mm[:, None, None] * circle
    seen = camera.project(outline.reshape(-1, 3)).reshape(len(xyz_mm), _OUTLINE, 2)
    return _ellipse_centres(seen)


def disc_normals(cameras: Sequence[Camera], discs: DiscViews) -> FloatArray:
    """Find the attitude of discs from their ellipses in two or more views.

    Parameters
    ----------
    cameras : sequence of Camera, length C
        Calibrated cameras.
    discs : DiscViews
        Discs with approximately known positions.

    Returns
    -------
    ndarray, shape (M, 3)
        Unit normals, towards the cameras; NaN where fewer than two views have an ellipse.

    Notes
    -----
    With J the 2x3 Jacobian of the projection, a disc of radius r and normal n is seen as the
    ellipse matrix ``E = s r^2 J (I - n n') J'`` (local affine approximation, exact to (r/depth)^2).
    The common factor s takes up blooming and gamma, which change apparent sizes but not shapes.
    """
    normals = np.full((len(discs.xyz_mm), 3), np.nan)
    usable = (discs.seen.sum(axis=1) >= 2) & np.isfinite(discs.diameter_mm)
    usable &= all_finite(discs.xyz_mm, 1)
    rows = np.flatnonzero(usable)
    for start in range(0, len(rows), _CHUNK):
        chunk = rows[start : start + _CHUNK]
        normals[chunk] = _fit_normals(cameras, discs, chunk)
    return normals


def _fit_normals(cameras: Sequence[Camera], discs: DiscViews, rows: NDArray[np.intp]) -> FloatArray:
    xyz, seen = discs.xyz_mm[rows], discs.seen[rows]
    jacobians = np.stack([camera.project_jacobian(xyz) for camera in cameras], axis=1)
    jacobians *= discs.diameter_mm[rows, None, None, None] / 2
    wanted = _ellipse_matrices(discs.ellipse[rows])
    size = np.sqrt(np.abs(np.linalg.det(np.where(seen[..., None, None], wanted, np.eye(2)))))
    weight = np.where(seen & np.isfinite(jacobians).all(axis=(2, 3)), 1 / size, 0.0)
    wanted, jacobians = np.nan_to_num(wanted), np.nan_to_num(jacobians)

    flat = jacobians.reshape(len(rows), -1, 3)
    whole = _three_terms(jacobians @ np.swapaxes(jacobians, 2, 3))[:, None]
    seen_terms = (weight[..., None] * _three_terms(wanted)).reshape(len(rows), -1)

    def miss(normal: FloatArray) -> FloatArray:
        """Relative shape residuals (m, g, 3C) of g normals a disc, (m, g, 3), best factor s."""
        count = normal.shape[1]
        along = normal @ np.swapaxes(flat, 1, 2)  # (m, g, 2C): x and y of each view
        x, y = along[..., 0::2], along[..., 1::2]
        shape = np.empty((len(rows), count, len(cameras), 3))
        np.subtract(whole[..., 0], x * x, out=shape[..., 0])
        np.subtract(whole[..., 1], ROOT_2 * x * y, out=shape[..., 1])
        np.subtract(whole[..., 2], y * y, out=shape[..., 2])
        shape *= weight[:, None, :, None]
        terms = shape.reshape(len(rows), count, -1)
        factor = (terms @ seen_terms[..., None])[..., 0] / np.maximum(_square(terms), 1e-300)
        residual: FloatArray = seen_terms[:, None] - factor[..., None] * terms
        return residual

    sphere = np.broadcast_to(_sphere(), (len(rows), _SPHERE, 3))
    best = np.argmin(_square(miss(sphere)), axis=1)
    normal = _sphere()[best]
    for _ in range(_REFINEMENTS):
        normal = _gauss_newton(miss, normal)
    centre = np.mean([camera.centre_mm for camera in cameras], axis=0)
    facing = np.sum(normal * (centre - xyz), axis=1, keepdims=True)
    towards: FloatArray = np.where(facing < 0, -normal, normal)
    return towards


def _gauss_newton(miss: Callable[[FloatArray], FloatArray], normal: FloatArray) -> FloatArray:
    """Turn normals within their tangent planes so that the shape residuals shrink."""
    step = 1e-5
    u, v = _plane_axes(normal)
    trial = np.stack([normal, normal + step * u, normal + step * v], axis=1)
    residual = miss(trial / np.linalg.norm(trial, axis=2, keepdims=True))
    jacobian = np.swapaxes(residual[:, 1:] - residual[:, :1], 1, 2) / step
    curvature = np.swapaxes(jacobian, 1, 2) @ jacobian
    # a disc seen frontally has a flat optimum: damp so that noise cannot throw the normal away
    curvature = curvature + 1e-6 * np.eye(2)
    slope = np.swapaxes(jacobian, 1, 2) @ residual[:, 0, :, None]
    turn = np.clip(-np.linalg.solve(curvature, slope)[..., 0], -0.2, 0.2)
    turned = normal + turn[:, :1] * u + turn[:, 1:] * v
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    pair = _square(miss(np.stack([normal, turned], axis=1)))
    better: FloatArray = np.where((pair[:, 1] < pair[:, 0])[:, None], turned, normal)
    return better


def _square(residual: FloatArray) -> FloatArray:
    """Sum of squares over the last axis."""
    return np.asarray(np.einsum("mgk,mgk->mg", residual, residual))


@cache
def _sphere() -> FloatArray:
    """Return directions spread evenly over a half sphere (Fibonacci lattice)."""
    index = np.arange(_SPHERE) + 0.5
    z = 1 - index / _SPHERE
    turn = np.pi * (1 + np.sqrt(5)) * index
    flat = np.sqrt(1 - z * z)
    return frozen_array(
        np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1), (_SPHERE, 3), "sphere"
    )


def _plane_axes(normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return two unit vectors that span the plane of each normal, shape (M, 3)."""
    helper = np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u = np.cross(normal, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return u, np.cross(normal, u)


def _ellipse_matrices(ellipse: FloatArray) -> FloatArray:
    """Return ``R diag(a^2, b^2) R'``, shape (..., 2, 2)."""
    cos, sin = np.cos(ellipse[..., 2]), np.sin(ellipse[..., 2])
    turn = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    scaled: FloatArray = turn * ellipse[..., None, :2] ** 2 @ np.swapaxes(turn, -1, -2)
    return scaled


def _three_terms(matrix: FloatArray) -> FloatArray:
    """Return the terms of symmetric 2x2 matrices so that their norm is the Frobenius norm."""
    return np.stack([matrix[..., 0, 0], ROOT_2 * matrix[..., 0, 1], matrix[..., 1, 1]], axis=-1)


def _ellipse_centres(points: FloatArray) -> FloatArray:
    """Fit conics to (M, K, 2) points near an ellipse and return their centres, (M, 2)."""
    middle = points.mean(axis=1, keepdims=True)
    scale = np.sqrt(np.mean((points - middle) ** 2, axis=(1, 2), keepdims=True))
    finite = all_finite(points, (1, 2)) & (scale[:, 0, 0] > 0)
    xy = np.where(finite[:, None, None], (points - middle) / np.where(scale > 0, scale, 1), 0.0)
    x, y = xy[..., 0], xy[..., 1]
    terms = np.stack([x * x, x * y, y * y, x, y], axis=2)
    normal = np.swapaxes(terms, 1, 2) @ terms
    normal[~finite] = np.eye(5)
    a, b, c, d, e = np.linalg.solve(normal, terms.sum(axis=1)[..., None])[..., 0].T
    determinant = np.where(finite, 4 * a * c - b * b, np.nan)
    centre = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], axis=1) / determinant[:, None]
    result: FloatArray = centre * scale[:, 0] + middle[:, 0]
    return result
