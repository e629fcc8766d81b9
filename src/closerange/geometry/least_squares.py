"""Non-linear least squares for small dense problems (Levenberg-Marquardt)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dposv

from closerange.geometry.arrays import FloatArray

Residuals: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""x (p,) -> residuals (n,) and their Jacobian (n, p)."""

# Damping beyond which a step no longer changes float64 parameters: there is no way down.
LARGEST_DAMPING = 1e12
# Predicted gains, as shares of the cost: x moves by sqrt(share x n) of its standard deviations.
# The first ends the search; where residuals are large and parameters hang together, each step
# gains only a little less than the one before, and the second is good enough when steps run out.
GAIN_LIMIT, GAIN_ENOUGH = 1e-12, 1e-7
# A step that gains less than a quarter of what the linear model promised was too long (the usual
# limit, doi:10.1007/BFb0067700).
KEPT_PROMISE = 0.25
# A residual is the difference of two numbers that a few operations have rounded: exact data leave
# a cost of this share of the numbers' squares, in which no step finds a way down.
ROUNDING = (4 * np.finfo(np.float64).eps) ** 2


@dataclass(frozen=True, slots=True, eq=False)
class LeastSquaresFit:
    """Where the search ended.

    Attributes
    ----------
    x : ndarray, shape (p,)
        Best parameters found.
    residuals : ndarray, shape (n,)
        At `x`.
    jacobian : ndarray, shape (n, p)
        Derivatives of the residuals at `x`.
    cost : float
        Sum of squared residuals at `x`; infinite if they are not finite at the start.
    iterations : int
        Steps tried, rejected ones included.
    converged : bool
        False if the iterations ran out or no way down was found.
    """

    x: FloatArray
    residuals: FloatArray
    jacobian: FloatArray
    cost: float
    iterations: int
    converged: bool

    def covariance(self, variance: float = 1.0) -> FloatArray:
        """Propagate the residuals' variance into the parameters.

        Parameters
        ----------
        variance : float, optional
            Variance of each residual; 1 for residuals divided by their standard deviation,
            cost / (n - p) to let the residuals speak.

        Returns
        -------
        ndarray, shape (p, p)
            ``variance * inverse(J'J)``, infinite if J'J is singular.
        """
        scale = _column_scale(self.jacobian)
        scaled = self.jacobian / scale
        try:
            inverse = np.linalg.inv(scaled.T @ scaled)
        except np.linalg.LinAlgError:
            return np.full((self.x.size, self.x.size), np.inf)
        return np.asarray(variance * inverse / np.outer(scale, scale))


def levenberg_marquardt(
    function: Residuals,
    start: ArrayLike,
    *,
    max_iterations: int = 100,
    step_limit: float = 1e-10,
    damping: float = 1e-3,
    gain_limit: float = GAIN_LIMIT,
    terms: float = 0.0,
) -> LeastSquaresFit:
    """Minimise a sum of squares.

    Parameters
    ----------
    function : callable
        ``function(x) -> (residuals (n,), jacobian (n, p))``. Residuals that are not finite
        reject the step, so a model may answer NaN outside its domain.
    start : array_like, shape (p,)
        First guess.
    max_iterations : int, optional
        Largest number of steps tried.
    step_limit : float, optional
        The search has converged when a step is below this share of x, each parameter weighed
        by the length of its Jacobian column.
    damping : float, optional
        First damping, relative to the diagonal of J'J.
    gain_limit : float, optional
        It has also converged when the best step would lower the cost by less than this share.
    terms : float, optional
        Sum of squares of the numbers whose differences the residuals are, as of all observed
        coordinates: it has also converged when the best step would gain no more than their
        rounding. Without it, exact data may never converge.

    Returns
    -------
    LeastSquaresFit
        The best point found; never worse than the start.

    Notes
    -----
    Marquardt's scaling makes the search independent of the parameters' units
    (doi:10.1137/0111030). Columns of zeros are allowed: their parameters stay where they are.
    """
    x = np.array(start, dtype=np.float64)
    residuals, jacobian, cost = _evaluated(function, x)
    iterations, converged, gain = 0, cost == 0, np.inf
    while np.isfinite(cost) and not converged and iterations < max_iterations:
        scale = _column_scale(jacobian)
        scaled = jacobian / scale
        gradient, normal = scaled.T @ residuals, scaled.T @ scaled
        step = _solve(scaled, normal, residuals, gradient, damping)
        gain = float(step @ (damping * step - gradient))
        small = np.linalg.norm(step) <= step_limit * (np.linalg.norm(x * scale) + step_limit)
        # Strong damping makes any step small; only a lightly damped one proves a minimum.
        if damping <= 1 and gain <= max(gain_limit * cost, ROUNDING * terms):
            converged = True
            break
        iterations += 1
        trial = x + step / scale
        trial_residuals, trial_jacobian, trial_cost = _evaluated(function, trial)
        if trial_cost <= cost and np.isfinite(trial_jacobian).all():
            damping = _next_damping(damping, cost - trial_cost, gain)
            x, residuals, jacobian, cost = trial, trial_residuals, trial_jacobian, trial_cost
        else:
            damping *= 10
        converged = bool(small and damping <= 1) or cost == 0
        if damping > LARGEST_DAMPING:
            break
    converged = converged or bool(iterations >= max_iterations and gain <= GAIN_ENOUGH * cost)
    return LeastSquaresFit(x, residuals, jacobian, cost, iterations, bool(converged))


def _next_damping(damping: float, gained: float, promised: float) -> float:
    """Damping after a step downhill: less where it kept its promise, more where it overshot.

    Along a curved valley undamped steps leap from one side to the other and gain next to nothing.
    """
    return max(damping / 10, 1e-12) if gained >= KEPT_PROMISE * promised else 10 * damping


def _evaluated(function: Residuals, x: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Residuals, Jacobian and cost; a trial step may overflow without a warning: it is rejected."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        residuals, jacobian = function(x)
        cost = float(residuals @ residuals)
    return residuals, jacobian, cost if np.isfinite(cost) else np.inf


def _column_scale(jacobian: FloatArray) -> FloatArray:
    """Length of each column, 1 for a column of zeros."""
    length = np.sqrt(np.einsum("np,np->p", jacobian, jacobian))
    return np.where(length > 0, length, 1.0)


def _solve(
    scaled: FloatArray,
    normal: FloatArray,
    residuals: FloatArray,
    gradient: FloatArray,
    damping: float,
) -> FloatArray:
    """Solve the damped normal equations, or the equations themselves where those are singular."""
    size = gradient.size
    damped = normal.copy()
    damped.flat[:: size + 1] += damping
    _, solution, failed = dposv(damped, gradient)  # by Cholesky; NumPy's ways take thrice as long
    if not failed:
        return np.asarray(-solution)
    rows = np.vstack([scaled, np.sqrt(damping) * np.eye(size)])
    right = np.concatenate([-residuals, np.zeros(size)])
    return np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0])
