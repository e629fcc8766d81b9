"""How the points of a calibration are weighed, and what their uncertainty makes of the cameras'.

A point's covariance in the image is ``C_i + tau^2 I + std_i^2 J_i J_i'``: what detection states,
a common part that it does not know (lens, print, sensor), and the control position's own error
seen through the camera (J_i = d px / d mm). tau is one number for the whole rig: a camera of nine
points has four degrees of freedom, too few for a variance of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.rig.camera import Camera
from closerange.rig.camera_fit import CameraFit
from closerange.rig.fit import Fit
from closerange.rig.view import View, whiten

ROUNDING_PX = 1e-6
"""Errors below this are rounding of exact data."""

_STEPS = 200
_LAST_DIGIT = 4 * float(np.finfo(float).eps)


@dataclass(frozen=True, slots=True, eq=False)
class Stated:
    """What is known of one camera's points before the fit; N points.

    Attributes
    ----------
    cov_px2 : ndarray, shape (N, 2, 2)
        Covariances in the image; 0 where nothing is known.
    std_mm : ndarray, shape (N,)
        Standard deviations of the control positions.
    control_row : ndarray of int, shape (N,)
        Which points share a control position, also among cameras.
    """

    cov_px2: FloatArray
    std_mm: FloatArray
    control_row: IntArray

    @property
    def any(self) -> bool:
        """Whether anything is stated that makes weights unequal."""
        return bool(self.cov_px2.any() or self.std_mm.any())

    def select(self, rows: BoolArray) -> Stated:
        """Keep some points."""
        return Stated(self.cov_px2[rows], self.std_mm[rows], self.control_row[rows])

    def in_image(self, camera: Camera, xyz_mm: FloatArray) -> FloatArray:
        """Return the stated part of the covariances, shape (N, 2, 2), px^2."""
        if not self.std_mm.any():
            return self.cov_px2
        by_world = camera.project_jacobian(xyz_mm)
        spread = by_world * self.std_mm[:, None, None]
        cov: FloatArray = self.cov_px2 + spread @ np.swapaxes(spread, 1, 2)
        return cov


def common_variance(residual_px: FloatArray, cov_px2: FloatArray, dof: int) -> float:
    """Return tau^2 >= 0 that makes chi^2 equal to its degrees of freedom.

    Parameters
    ----------
    residual_px : ndarray, shape (N, 2)
        Of a fit.
    cov_px2 : ndarray, shape (N, 2, 2)
        Stated covariances; may be zero.
    dof : int
        Numbers minus parameters.

    Returns
    -------
    float
        px^2. Zero where the stated covariances explain the residuals alone, or overstate them:
        they are then believed, which errs on the safe side. Without any, RSS / (n - p).

    Notes
    -----
    The moment estimator of Mandel and Paule (doi:10.1021/ac60293a019).
    """
    values, vectors = np.linalg.eigh(cov_px2)
    square = np.einsum("nij,ni->nj", vectors, residual_px) ** 2
    values = np.maximum(values, 0.0)
    floor = max(1e-12 * float(values.max(initial=0.0)), np.finfo(float).tiny)

    highest = float(np.sum(square)) / dof
    if not values.any():
        return highest
    tau2 = 0.0
    for _ in range(_STEPS):
        # a value of zero is rounding or an exact point: it must not overflow
        total = np.maximum(values + tau2, floor)
        terms = square / total
        excess = float(terms.sum()) - dof
        # The excess falls and is convex, so Newton's steps from below never pass the root.
        step = excess / float((terms / total).sum()) if excess > 0 else 0.0
        tau2 += step
        if step <= _LAST_DIGIT * tau2:
            break
    return min(tau2, highest)


def whitener_of(cov_px2: FloatArray) -> FloatArray:
    """Return the lower triangles (l11, l21, l22) of W with W C W' = I, shape (N, 3)."""
    a = np.sqrt(cov_px2[:, 0, 0])
    b = cov_px2[:, 1, 0] / a
    c = np.sqrt(np.maximum(cov_px2[:, 1, 1] - b * b, np.finfo(float).tiny))
    return np.stack([1 / a, -b / (a * c), 1 / c], axis=1)


def parameter_covariance(
    fits: Sequence[CameraFit],
    views: Sequence[View],
    stated: Sequence[Stated],
    *,
    variance: float,
    tau_px: float,
) -> FloatArray:
    """Return the covariance of all cameras' parameters.

    Parameters
    ----------
    fits : sequence of CameraFit
        One a camera.
    views : sequence of View
        The points that were fitted, with their whiteners.
    stated : sequence of Stated
        What was known of them.
    variance : float
        Of whitened residuals: 1 where they are true standard deviations, else s^2.
    tau_px : float
        The common part.

    Returns
    -------
    ndarray, shape (P, P)
        Blocks of the cameras on the diagonal. An error of a control position displaces its
        images in all cameras and readings together; that correlation fills the other blocks
        (the sandwich ``A cov(observations) A'`` with A the estimator's linear map).
    """
    offsets = np.cumsum([0, *(len(fit.free) for fit in fits)])
    total = np.zeros((offsets[-1], offsets[-1]))
    shared = any(part.std_mm.any() for part in stated)
    count = sum(len(view) for view in views) if shared else 0
    pull, done = np.zeros((count, offsets[-1], 3)), 0
    for fit, view, part, start in zip(fits, views, stated, offsets, strict=False):
        block = slice(start, start + len(fit.free))
        if not shared:
            total[block, block] = variance * fit.cofactor
            continue
        total[block, block] = image_errors(fit, view.whitener, part.cov_px2, tau_px)
        by_point = fit.camera.project_jacobian(view.xyz_mm) * part.std_mm[:, None, None]
        pull[done : done + len(view), block] = pull_of(fit, view.whitener, by_point)
        done += len(view)
    if shared:
        total += shared_errors(pull, np.concatenate([part.control_row for part in stated]))
    return total


def image_errors(
    fit: Fit, whitener: FloatArray | None, cov_px2: FloatArray, tau_px: float
) -> FloatArray:
    """Return the covariance of parameters by the points' own errors in the image, (p, p).

    Parameters
    ----------
    fit, whitener
        Of N points.
    cov_px2 : ndarray, shape (N, 2, 2)
        Their covariances, without those of the control positions.
    tau_px : float
        Common part of their standard deviation.
    """
    lower = np.linalg.cholesky(cov_px2 + max(tau_px, ROUNDING_PX) ** 2 * np.eye(2))
    columns = np.moveaxis(pull_of(fit, whitener, lower), 1, 0).reshape(len(fit.root), -1)
    matrix: FloatArray = columns @ columns.T
    return matrix


def shared_errors(pull: FloatArray, control_row: IntArray) -> FloatArray:
    """Return the covariance of parameters by errors of control positions, shape (P, P).

    Parameters
    ----------
    pull : ndarray, shape (N, P, 3)
        Change of the parameters by one standard deviation of each point's control position,
        through that point alone.
    control_row : ndarray of int, shape (N,)
        Which points share a position.
    """
    _, group = np.unique(control_row, return_inverse=True)
    together = np.zeros((group.max() + 1, *pull.shape[1:]))
    np.add.at(together, group, pull)
    shared: FloatArray = np.tensordot(together, together, axes=([0, 2], [0, 2]))
    return shared


def pull_of(fit: Fit, whitener: FloatArray | None, by_point: FloatArray) -> FloatArray:
    """Return what a displaced point does to the parameters.

    Parameters
    ----------
    fit : Fit
        Of N points.
    whitener : ndarray, shape (N, 3), or None
        Its weights.
    by_point : ndarray, shape (N, 2, k)
        Displacements in px by k causes.

    Returns
    -------
    ndarray, shape (N, P, k)
        Changes of the parameters.
    """
    columns = np.moveaxis(by_point, 0, 2).swapaxes(0, 1)  # (k, 2, N)
    _, white = whiten(whitener, np.zeros((2, len(by_point))), columns)
    moment = np.einsum("nip,kin->npk", fit.orthonormal, white)
    pull: FloatArray = np.einsum("qp,npk->nqk", fit.root, moment)
    return pull
