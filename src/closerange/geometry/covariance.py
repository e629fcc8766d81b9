"""Covariances: regions, propagation, principal axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from closerange.geometry.arrays import BoolArray, FloatArray, all_finite


def mahalanobis_squared(errors: ArrayLike, cov: ArrayLike) -> FloatArray:
    """Return e' V^-1 e of each error.

    Parameters
    ----------
    errors : array_like, shape (M, K)
        Errors.
    cov : array_like, shape (M, K, K)
        Covariances V.

    Returns
    -------
    ndarray, shape (M,)
        NaN where the error or the covariance is not finite.
    """
    errors = np.asarray(errors, dtype=np.float64)
    cov = np.array(cov, dtype=np.float64)
    bad = ~(np.isfinite(errors).all(axis=1) & np.isfinite(cov).all(axis=(1, 2)))
    cov[bad] = np.eye(cov.shape[1])
    solved = np.linalg.solve(cov, errors[..., None])[..., 0]
    squared: FloatArray = np.sum(errors * solved, axis=1)
    squared[bad] = np.nan
    return squared


def positive_definite(cov: FloatArray) -> BoolArray:
    """Return which matrices are finite and positive definite.

    Parameters
    ----------
    cov : ndarray, shape (M, K, K)
        Symmetric matrices.

    Returns
    -------
    ndarray of bool, shape (M,)
        False also where NaN says "unknown".
    """
    known = all_finite(cov, (1, 2))
    known[known] = np.linalg.eigvalsh(cov[known])[:, 0] > 0
    return known


def limited_part(part: FloatArray, whole: FloatArray) -> FloatArray:
    """Keep a part of a covariance from exceeding the whole in any direction.

    Parameters
    ----------
    part, whole : ndarray, shape (M, K, K)
        Covariances that were estimated apart, so that chance can make the part the larger.

    Returns
    -------
    ndarray, shape (M, K, K)
        The part, shortened along those axes in which it exceeds the whole; NaN where either is
        unknown or the whole is not positive definite.
    """
    known = positive_definite(whole) & all_finite(part, (1, 2))
    result = np.full_like(whole, np.nan)
    root = np.linalg.cholesky(whole[known])
    half_way = np.swapaxes(np.linalg.solve(root, part[known]), 1, 2)
    shares, axes = np.linalg.eigh(np.linalg.solve(root, half_way))
    axes = root @ axes
    result[known] = (axes * np.minimum(shares, 1)[:, None]) @ np.swapaxes(axes, 1, 2)
    return result


def region_limit(dimensions: int, dof: int | None, *, probability: float = 0.95) -> float:
    """Return the limit of e' V^-1 e that a region of given probability has.

    Parameters
    ----------
    dimensions : int
        K of the error.
    dof : int or None
        Degrees of freedom of the variance factor behind V; None if V is known.
    probability : float, optional
        Content of the region.

    Returns
    -------
    float
        ``K F(p; K, dof)``, or the chi-square quantile for known V (2.80^2 in 3-D).
    """
    from scipy.stats import chi2, f  # noqa: PLC0415  # takes half a second: only when asked

    if dof is None:
        return float(chi2.ppf(probability, dimensions))
    return float(dimensions * f.ppf(probability, dimensions, dof))


def propagate(jacobian: FloatArray, cov: FloatArray) -> FloatArray:
    """Return J V J' for stacks of matrices, exactly symmetric.

    Parameters
    ----------
    jacobian : ndarray, shape (..., K, P)
        Derivatives of results by inputs.
    cov : ndarray, shape (..., P, P)
        Covariance of the inputs.

    Returns
    -------
    ndarray, shape (..., K, K)
        Covariance of the results, to first order.
    """
    result = jacobian @ cov @ np.swapaxes(jacobian, -1, -2)
    symmetric: FloatArray = 0.5 * (result + np.swapaxes(result, -1, -2))
    return symmetric
