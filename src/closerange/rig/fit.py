"""What a least-squares fit in the images knows of itself, whatever was fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closerange.geometry.arrays import FloatArray

MAX_CONDITION = 1 / np.sqrt(np.finfo(float).eps)
"""Largest condition number of the Jacobian with columns of unit length, 6.7e7. A covariance matrix
carries its square: beyond this limit float64 has no digit left of it."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fit of N image points with p parameters.

    Attributes
    ----------
    residual_px : ndarray, shape (N, 2)
        Observed minus calculated.
    whitened : ndarray, shape (N, 2)
        The same, divided by the standard deviations; equal to `residual_px` at unit weights.
    orthonormal : ndarray, shape (N, 2, p)
        Orthonormal basis Q of the whitened Jacobian's columns; Q Q' is the hat matrix.
    root : ndarray, shape (p, p)
        Changes of the parameters by whitened residuals are ``root @ Q' r``.
    condition : float
        Condition number of the Jacobian with columns of unit length.
    iterations : int
        Steps of the search.
    converged : bool
        False if the search gave up.
    """

    residual_px: FloatArray
    whitened: FloatArray
    orthonormal: FloatArray
    root: FloatArray
    condition: float
    iterations: int
    converged: bool

    @property
    def rss_px2(self) -> float:
        """Sum of squared residuals in px^2."""
        return float(np.sum(self.residual_px**2))

    @property
    def cofactor(self) -> FloatArray:
        """inverse(J' W J), shape (p, p): covariance for residuals of unit variance."""
        matrix: FloatArray = self.root @ self.root.T
        return matrix

    @property
    def chi_square(self) -> float:
        """Sum of squared whitened residuals."""
        return float(np.sum(self.whitened**2))

    @property
    def dof(self) -> int:
        """Numbers minus parameters."""
        return self.residual_px.size - len(self.root)


@dataclass(frozen=True, slots=True, eq=False)
class Factors:
    """A Jacobian taken apart.

    Attributes
    ----------
    orthonormal, root : ndarrays, shapes (N, 2, p), (p, p)
        As in `Fit`.
    condition : float
        As in `Fit`.
    indistinct : ndarray, shape (k, p)
        Directions of the scaled parameters that `MAX_CONDITION` does not allow to be estimated.
    """

    orthonormal: FloatArray
    root: FloatArray
    condition: float
    indistinct: FloatArray


def take_apart(columns: FloatArray) -> Factors:
    """Take a whitened Jacobian apart into an orthonormal basis and the way back.

    Parameters
    ----------
    columns : ndarray, shape (p, 2, N)
        Derivatives of the calculated image positions, in standard deviations.

    Returns
    -------
    Factors
        To be refused by the caller if `indistinct` has rows.
    """
    count, _, points = columns.shape
    matrix = columns.reshape(count, -1).T
    scale = np.linalg.norm(matrix, axis=0)
    scale[scale == 0] = 1.0
    basis, upper = np.linalg.qr(matrix / scale)
    turn, singular, vt = np.linalg.svd(upper)
    safe = np.maximum(singular, np.finfo(float).tiny)
    return Factors(
        # rows of the Jacobian are all x, then all y
        orthonormal=np.moveaxis((basis @ turn).reshape(2, points, -1), 0, 1),
        root=(vt.T / safe) / scale[:, None],
        condition=float(singular[0] / safe[-1]),
        indistinct=vt[~(singular * MAX_CONDITION > singular[0])],
    )


def inner_variance(square: FloatArray, dof: int) -> float:
    """Return the variance of one coordinate by the better half of the points.

    Parameters
    ----------
    square : ndarray, shape (N,)
        Squared whitened residuals, both coordinates together.
    dof : int
        Of the fit.

    Returns
    -------
    float
        From the median: squares of two Gaussians are exponential.
    """
    return float(np.median(square) / (2 * np.log(2)) * 2 * len(square) / max(dof, 1))
