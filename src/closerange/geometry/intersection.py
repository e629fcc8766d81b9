"""Where rays of several cameras meet."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import FloatArray


def intersect_linear(
    matrices: FloatArray, ideal_px: FloatArray, seen: NDArray[np.bool_], centre_mm: FloatArray
) -> FloatArray:
    """Solve the two linear equations of each view for world points, by least squares.

    Parameters
    ----------
    matrices : ndarray, shape (C, 3, 4)
        Projection matrices: world (mm) to homogeneous ideal px.
    ideal_px : ndarray, shape (M, C, 2)
        Ideal (undistorted) px; ignored where not seen.
    seen : ndarray of bool, shape (M, C)
        Which camera sees which point.
    centre_mm : ndarray, shape (3,)
        A point amid the scene; the equations are written about it, so that a world frame far
        away costs no digits, and each view's are divided by its depth, so that views weigh alike.

    Returns
    -------
    ndarray, shape (M, 3)
        World points in mm; NaN where fewer than two views see the point or where the
        rays are parallel.

    Notes
    -----
    Equations (2.9) to (2.11) and (5.6) of the thesis, for any number of views.
    """
    shifted = matrices.copy()
    shifted[:, :, 3] += matrices[:, :, :3] @ centre_mm
    shifted /= shifted[:, 2:, 3:]  # the thesis' gauge a12 = 1, safe about a visible point
    px = np.where(seen[:, :, None], ideal_px, 0.0)
    left = shifted[None, :, :2, :3] - px[..., None] * shifted[None, :, 2:, :3]
    right = px - shifted[None, :, :2, 3]
    left = np.where(seen[:, :, None, None], left, 0.0).reshape(len(px), 2 * len(matrices), 3)
    right = np.where(seen[:, :, None], right, 0.0).reshape(len(px), 2 * len(matrices))
    normal = np.einsum("mri,mrj->mij", left, left)
    solvable = (seen.sum(axis=1) >= 2) & (_reciprocal_condition(normal) > 1e-14)
    normal[~solvable] = np.eye(3)
    moment = np.einsum("mri,mr->mi", left, right)
    xyz: FloatArray = np.linalg.solve(normal, moment[..., None])[..., 0] + centre_mm
    xyz[~solvable] = np.nan
    return xyz


def widest_angle(directions: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
    """Return the largest angle between any two rays of each point.

    Parameters
    ----------
    directions : ndarray, shape (M, C, 3)
        Unit vectors from each camera to the point.
    seen : ndarray of bool, shape (M, C)
        Which rays count.

    Returns
    -------
    ndarray, shape (M,)
        Angle in rad; 0 with fewer than two rays.
    """
    widest = np.zeros(len(directions))
    count = directions.shape[1]
    for first in range(count):
        for second in range(first + 1, count):
            cross = np.cross(directions[:, first], directions[:, second])
            cosine = np.sum(directions[:, first] * directions[:, second], axis=1)
            angle = np.arctan2(np.linalg.norm(cross, axis=1), cosine)
            both = seen[:, first] & seen[:, second] & np.isfinite(angle)
            widest = np.where(both, np.maximum(widest, angle), widest)
    return widest


def _reciprocal_condition(normal: FloatArray) -> FloatArray:
    values = np.linalg.eigvalsh(normal)
    smallest, largest = values[:, 0], values[:, 2]
    ratio: FloatArray = np.divide(smallest, largest, out=np.zeros_like(smallest), where=largest > 0)
    return ratio
