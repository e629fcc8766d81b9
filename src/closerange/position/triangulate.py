"""Triangulation: linear start, reprojection-optimal refinement, covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closerange.geometry.arrays import BoolArray, FloatArray, all_finite
from closerange.geometry.covariance import positive_definite, propagate
from closerange.geometry.intersection import intersect_linear
from closerange.rig.rig import Rig

_STEPS = 10  # Gauss-Newton from the linear solution settles in two or three
_SETTLED_MM = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Refined points with what their covariance is made of; M points, C cameras.

    Attributes
    ----------
    xyz_mm : ndarray, shape (M, 3)
        Positions.
    residual_px : ndarray, shape (M, C, 2)
        Observed minus calculated; NaN where not used.
    image_cov_mm2, calibration_cov_mm2 : ndarray, shape (M, 3, 3)
        Covariance from the image points and from the calibration.
    by_image : ndarray, shape (M, C, 3, 2)
        Derivatives of the position by the image points, mm / px; 0 for views not used.
    predicted_px2 : ndarray, shape (M, C, 2, 2)
        Covariance of the pixel position that the calibration alone leaves open.
    """

    xyz_mm: FloatArray
    residual_px: FloatArray
    image_cov_mm2: FloatArray
    calibration_cov_mm2: FloatArray
    by_image: FloatArray
    predicted_px2: FloatArray


def triangulate_linear(rig: Rig, xy_px: FloatArray, used: BoolArray) -> FloatArray:
    """Solve the linear equations of all views after taking off the lens distortion.

    Parameters
    ----------
    rig : Rig
        C cameras.
    xy_px : ndarray, shape (M, C, 2)
        Observed px.
    used : ndarray of bool, shape (M, C)
        Which views take part.

    Returns
    -------
    ndarray, shape (M, 3)
        World points in mm; NaN with fewer than two views.
    """
    ideal = np.stack(
        [camera.undistort(xy_px[:, i]) for i, camera in enumerate(rig.cameras)], axis=1
    )
    matrices = np.stack([camera.projection_matrix for camera in rig.cameras])
    valid = used & all_finite(ideal, 2)
    return intersect_linear(matrices, ideal, valid, rig.volume_mm.mean(axis=0))


def refine(
    rig: Rig, start_mm: FloatArray, xy_px: FloatArray, cov_px2: FloatArray, used: BoolArray
) -> FloatArray:
    """Minimise the weighted reprojection error by Gauss-Newton.

    Parameters
    ----------
    rig : Rig
        C cameras.
    start_mm : ndarray, shape (M, 3)
        Linear solution.
    xy_px, cov_px2, used : ndarrays, shapes (M, C, 2), (M, C, 2, 2), (M, C)
        Observations.

    Returns
    -------
    ndarray, shape (M, 3)
        Refined points; the start where a step would leave the cameras' range.
    """
    weight = np.linalg.inv(cov_px2)
    xyz = start_mm.copy()
    moving = all_finite(xyz, 1)
    for _ in range(_STEPS):
        rows = np.flatnonzero(moving)
        if not len(rows):
            break
        residual, jacobian = _views(rig, xyz[rows], xy_px[rows], used[rows])
        weighted = np.swapaxes(jacobian, 2, 3) @ weight[rows]
        normal = (weighted @ jacobian).sum(axis=1)
        moment = (weighted @ residual[..., None]).sum(axis=1)
        step = _solve(normal, moment)
        good = all_finite(step, 1)
        xyz[rows[good]] += step[good]
        size = np.abs(np.where(np.isfinite(step), step, 0.0)).max(axis=1)
        moving[rows] = good & (size > _SETTLED_MM)
    return xyz


def solve_points(rig: Rig, xy_px: FloatArray, cov_px2: FloatArray, used: BoolArray) -> Solution:
    """Triangulate, refine and propagate.

    Parameters
    ----------
    rig : Rig
        C cameras with the covariance of their parameters.
    xy_px, cov_px2, used : ndarrays, shapes (M, C, 2), (M, C, 2, 2), (M, C)
        Observations.

    Returns
    -------
    Solution
        Positions and covariances; NaN where two rays do not define a point. Points of which a
        view has no covariance are solved with equal weights, and their covariance is NaN.
    """
    start = triangulate_linear(rig, xy_px, used)
    stated = positive_definite(cov_px2.reshape(-1, 2, 2)).reshape(used.shape)
    known = np.asarray((stated | ~used).all(axis=1))
    cov_px2 = np.where((known[:, None] & used)[..., None, None], cov_px2, np.eye(2))
    refined = refine(rig, start, xy_px, cov_px2, used)
    residual, jacobian = _views(rig, refined, xy_px, used)
    weight = np.linalg.inv(cov_px2)
    weighted = np.swapaxes(jacobian, 2, 3) @ weight
    image_cov = _inverse((weighted @ jacobian).sum(axis=1))
    by_parameter = _parameter_jacobian(rig, refined, used)
    predicted = propagate(by_parameter, rig.parameter_cov)
    # X = argmin |W^(1/2) (x - f(X; a))|, hence dX/dx = (J'WJ)^-1 J'W, dX/da = -dX/dx df/da
    by_image = image_cov[:, None] @ weighted
    sensitivity = -image_cov @ (weighted @ by_parameter).sum(axis=1)
    seen = np.where(used[:, :, None], residual, np.nan)
    calibration_cov = propagate(sensitivity, rig.parameter_cov)
    image_cov = np.where(known[:, None, None], image_cov, np.nan)
    return Solution(refined, seen, image_cov, calibration_cov, by_image, predicted)


def _views(
    rig: Rig, xyz_mm: FloatArray, xy_px: FloatArray, used: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (M, C, 2) and Jacobians (M, C, 2, 3); zero for unused views."""
    residual = np.zeros((*used.shape, 2))
    jacobian = np.zeros((*used.shape, 2, 3))
    for index, camera in enumerate(rig.cameras):
        rows = np.flatnonzero(used[:, index])
        residual[rows, index] = xy_px[rows, index] - camera.project(xyz_mm[rows])
        jacobian[rows, index] = camera.project_jacobian(xyz_mm[rows])
    return residual, jacobian


def _parameter_jacobian(rig: Rig, xyz_mm: FloatArray, used: BoolArray) -> FloatArray:
    """Return d px / d all parameters of the rig, shape (M, C, 2, P)."""
    jacobian = np.zeros((*used.shape, 2, len(rig.parameters)))
    for index, camera in enumerate(rig.cameras):
        names, places = rig.parameters_of(camera.name)
        rows = np.flatnonzero(used[:, index])
        if names and len(rows):
            block = camera.parameter_jacobian(xyz_mm[rows], names)
            jacobian[rows[:, None], index, :, np.array(places)[None, :]] = np.moveaxis(block, 2, 1)
    return jacobian


def _solve(normal: FloatArray, moment: FloatArray) -> FloatArray:
    return (_inverse(normal) @ moment)[..., 0]


def _inverse(normal: FloatArray) -> FloatArray:
    """Invert stacks of 3x3 matrices; NaN where singular or not finite."""
    finite = all_finite(normal, (1, 2))
    safe = np.where(finite[:, None, None], normal, np.eye(3))
    values = np.linalg.eigvalsh(safe)
    regular = finite & (values[:, 0] > 1e-14 * values[:, 2]) & (values[:, 2] > 0)
    safe = np.where(regular[:, None, None], safe, np.eye(3))
    inverse: FloatArray = np.linalg.inv(safe)
    inverse[~regular] = np.nan
    return inverse
