"""Statistics of repeated measurements against a known truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import integrate, special

from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.geometry.covariance import mahalanobis_squared, region_limit

AXES = ("X", "Y", "Z", "3-D")
"""Order of arrays of length 4; those of length 3 leave out the last."""


@dataclass(frozen=True, slots=True, eq=False)
class PooledStd:
    """Standard deviation pooled over groups of readings.

    Attributes
    ----------
    std_mm : ndarray, shape (3,)
        ``sqrt(mean s_i^2)``, weighted by degrees of freedom; NaN without repeated readings.
    dof : int
        Sum of (readings - 1).
    relative_uncertainty : float
        Its own relative standard uncertainty, ``1 / sqrt(2 dof)``.
    """

    std_mm: FloatArray
    dof: int
    relative_uncertainty: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "std_mm", frozen_array(self.std_mm, (3,), "std_mm"))


@dataclass(frozen=True, slots=True, eq=False)
class ErrorSummary:
    """What a set of N errors amounts to, in the order X, Y, Z (, 3-D); mm.

    Attributes
    ----------
    count : int
        N.
    bias_mm, lowest_mm, highest_mm, half_range_mm : ndarray, shape (3,)
        Mean, envelope and half of its width, with sign.
    mean_abs_mm, rms_mm, p95_mm, max_mm : ndarray, shape (4,)
        Of absolute errors; the fourth of distances in space.
    """

    count: int
    bias_mm: FloatArray
    lowest_mm: FloatArray
    highest_mm: FloatArray
    half_range_mm: FloatArray
    mean_abs_mm: FloatArray
    rms_mm: FloatArray
    p95_mm: FloatArray
    max_mm: FloatArray

    def __post_init__(self) -> None:
        for name in ("bias_mm", "lowest_mm", "highest_mm", "half_range_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (3,), name))
        for name in ("mean_abs_mm", "rms_mm", "p95_mm", "max_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (4,), name))


@dataclass(frozen=True, slots=True)
class Luck:
    """What chance alone does to an extreme value, in units of sigma.

    Attributes
    ----------
    mean : float
        Expected value.
    low, high : float
        95 % interval.
    """

    mean: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class LuckOfTest:
    """What chance alone would show in a test of this size, in units of sigma.

    Attributes
    ----------
    worst_std : Luck
        Largest standard deviation of a position.
    worst_error : Luck
        Largest abs(mean error) of a position.
    half_range : float
        Expected half width of the error envelope.
    """

    worst_std: Luck
    worst_error: Luck
    half_range: float


@dataclass(frozen=True, slots=True, eq=False)
class AxisSlopes:
    """Linear dependence of each axis' error on the three coordinates together.

    Attributes
    ----------
    slope : ndarray, shape (3, 3)
        ``slope[i, j]`` = d error_i / d coordinate_j, mm per mm; NaN where the coordinates do
        not vary, or not independently.
    std : ndarray, shape (3, 3)
        Standard errors.
    p_value : ndarray, shape (3, 3)
        Two-sided probability of such a slope if there were none.
    explained : ndarray, shape (3,)
        Share of the variance about the mean that the fit explains.
    dof : int
        Residual degrees of freedom.
    """

    slope: FloatArray
    std: FloatArray
    p_value: FloatArray
    explained: FloatArray
    dof: int

    def __post_init__(self) -> None:
        for name in ("slope", "std", "p_value"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (3, 3), name))
        object.__setattr__(self, "explained", frozen_array(self.explained, (3,), "explained"))


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often errors lie inside their stated regions.

    Attributes
    ----------
    level : float
        Stated probability.
    count, inside : int
        Errors with a usable covariance, and those inside.
    share : float
        inside / count; NaN without any.
    low, high : float
        95 % interval of the true share if the errors are independent (Clopper-Pearson). Errors
        that share one calibration are not: the interval is then too narrow.
    mean_ratio : float
        Mean of ``e' V^-1 e / 3``; 1 if the covariances hold.
    """

    level: float
    count: int
    inside: int
    share: float
    low: float
    high: float
    mean_ratio: float


def pooled_std(std_mm: ArrayLike, count: ArrayLike) -> PooledStd:
    """Pool standard deviations of groups of readings.

    Parameters
    ----------
    std_mm : array_like, shape (P, 3)
        Standard deviation about each group's mean (n - 1 in the denominator).
    count : array_like of int, shape (P,)
        Readings in each group; groups of fewer than two are left out.

    Returns
    -------
    PooledStd
        For groups of equal size the root of the mean variance.
    """
    std = np.reshape(np.asarray(std_mm, np.float64), (-1, 3))
    count = np.asarray(count)
    weight = np.maximum(count - 1, 0)
    dof = int(weight.sum())
    if not dof:
        return PooledStd(np.full(3, np.nan), 0, np.nan)
    kept = weight > 0
    variance = (weight[kept, None] * std[kept] ** 2).sum(axis=0) / dof
    return PooledStd(np.sqrt(variance), dof, 1 / np.sqrt(2 * dof))


def summarise_errors(error_mm: ArrayLike) -> ErrorSummary:
    """Summarise errors.

    Parameters
    ----------
    error_mm : array_like, shape (N, 3)
        Errors with sign; rows with NaN are left out.

    Returns
    -------
    ErrorSummary
        All NaN if no row is left.
    """
    error = np.reshape(np.asarray(error_mm, np.float64), (-1, 3))
    error = error[np.isfinite(error).all(axis=1)]
    if not len(error):
        return ErrorSummary(0, *(np.full(3, np.nan),) * 4, *(np.full(4, np.nan),) * 4)
    size = np.column_stack([np.abs(error), np.linalg.norm(error, axis=1)])
    lowest, highest = error.min(axis=0), error.max(axis=0)
    return ErrorSummary(
        count=len(error),
        bias_mm=error.mean(axis=0),
        lowest_mm=lowest,
        highest_mm=highest,
        half_range_mm=(highest - lowest) / 2,
        mean_abs_mm=size.mean(axis=0),
        rms_mm=np.sqrt((size**2).mean(axis=0)),
        p95_mm=np.quantile(size, 0.95, axis=0),
        max_mm=size.max(axis=0),
    )


def worst_std_by_luck(groups: int, readings: int) -> Luck:
    """Return how large the worst of many standard deviations is by chance.

    Parameters
    ----------
    groups : int
        Positions, each with the same true standard deviation sigma.
    readings : int
        Normal readings at each.

    Returns
    -------
    Luck
        In units of sigma: the maximum of `groups` values of sqrt(chi^2 / dof). NaN if there is
        nothing to compare.
    """
    if groups < 1 or readings < 2:
        return Luck(np.nan, np.nan, np.nan)
    dof = readings - 1
    return _luck_of_maximum(
        groups,
        cdf=lambda s: float(special.chdtr(dof, dof * s * s)),
        inverse=lambda upper: float(np.sqrt(special.chdtri(dof, upper) / dof)),
    )


def worst_error_by_luck(count: int) -> Luck:
    """Return how large the worst of many normal errors is by chance.

    Parameters
    ----------
    count : int
        Errors, each normal with mean 0 and standard deviation sigma.

    Returns
    -------
    Luck
        Of max abs(error), in units of sigma.
    """
    if count < 1:
        return Luck(np.nan, np.nan, np.nan)
    return _luck_of_maximum(
        count,
        cdf=lambda z: float(special.erf(z / np.sqrt(2))),
        inverse=lambda upper: float(-special.ndtri(upper / 2)),
    )


def half_range_by_luck(count: int) -> float:
    """Return the expected half range of normal values, in units of sigma.

    Parameters
    ----------
    count : int
        How many values.

    Returns
    -------
    float
        E(max - min) / 2 by order statistics; NaN for fewer than two.
    """
    if count < 2:
        return float("nan")
    # max and min of normal values are mirror images, so half the range is the mean maximum
    value, _ = integrate.quad(
        lambda x: 1 - special.ndtr(x) ** count - special.ndtr(-x) ** count, 0, 12, limit=200
    )
    return float(value)


def axis_slopes(error_mm: ArrayLike, xyz_mm: ArrayLike) -> AxisSlopes:
    """Fit each axis' error linearly by all coordinates (section 3.5: 'X error follows Z').

    Parameters
    ----------
    error_mm : array_like, shape (N, 3)
        Errors with sign; rows with NaN are left out.
    xyz_mm : array_like, shape (N, 3)
        Where they were found.

    Returns
    -------
    AxisSlopes
        Ordinary least squares with an intercept; a coordinate that does not vary is left out of
        the fit.
    """
    error = np.reshape(np.asarray(error_mm, np.float64), (-1, 3))
    xyz = np.reshape(np.asarray(xyz_mm, np.float64), (-1, 3))
    kept = np.isfinite(error).all(axis=1) & np.isfinite(xyz).all(axis=1)
    error, xyz = error[kept], xyz[kept]
    slope, std, p_value = (np.full((3, 3), np.nan) for _ in range(3))
    span = np.ptp(xyz, axis=0) if len(xyz) else np.zeros(3)
    # a coordinate that stands still differs only by rounding of its own size
    varies = span > 1e-9 * (1 + np.abs(xyz).max(axis=0, initial=0.0))
    dof = len(error) - 1 - int(varies.sum())
    nothing = AxisSlopes(slope, std, p_value, np.full(3, np.nan), max(dof, 0))
    if dof < 1 or not varies.any():
        return nothing
    centred = (xyz - xyz.mean(axis=0))[:, varies] / span[varies]
    # 1e-6: coordinates that follow each other to a millionth of their span tell nothing apart
    if np.linalg.matrix_rank(centred, tol=1e-6 * np.sqrt(len(xyz))) < varies.sum():
        return nothing
    inverse = np.linalg.inv(centred.T @ centred)
    deviation = error - error.mean(axis=0)
    fitted = inverse @ centred.T @ deviation  # (coordinates, axes)
    rest = ((deviation - centred @ fitted) ** 2).sum(axis=0)
    sigma = np.sqrt(rest[:, None] / dof * np.diag(inverse))
    slope[:, varies] = fitted.T / span[varies]
    std[:, varies] = sigma / span[varies]
    with np.errstate(divide="ignore", invalid="ignore"):
        p_value[:, varies] = 2 * special.stdtr(dof, -np.abs(fitted.T / sigma))
        explained = 1 - rest / (deviation**2).sum(axis=0)
    return AxisSlopes(slope, std, p_value, explained, dof)


def region_coverage(
    error_mm: ArrayLike, cov_mm2: ArrayLike, *, dof: int | None = None, level: float = 0.95
) -> Coverage:
    """Count the errors inside their stated 3-D regions.

    Parameters
    ----------
    error_mm : array_like, shape (N, 3)
        Errors; rows with NaN are left out.
    cov_mm2 : array_like, shape (N, 3, 3)
        Their stated covariances; rows that are not positive definite are left out.
    dof : int, optional
        Degrees of freedom of the variance behind them: the limit is ``3 F(level; 3, dof)``,
        without it ``chi^2(level; 3)``.
    level : float, optional
        Stated probability.

    Returns
    -------
    Coverage
        Over the rows that are left.
    """
    error = np.reshape(np.asarray(error_mm, np.float64), (-1, 3))
    cov = np.reshape(np.asarray(cov_mm2, np.float64), (-1, 3, 3))
    kept = np.isfinite(error).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
    error, cov = error[kept], cov[kept]
    definite = np.linalg.eigvalsh(cov)[:, 0] > 0
    error, cov = error[definite], cov[definite]
    square = mahalanobis_squared(error, cov)
    limit = region_limit(3, dof, probability=level)
    count, inside = len(square), int((square <= limit).sum())
    if not count:
        return Coverage(level, 0, 0, np.nan, np.nan, np.nan, np.nan)
    low = float(special.betaincinv(inside, count - inside + 1, 0.025)) if inside else 0.0
    high = float(special.betaincinv(inside + 1, count - inside, 0.975)) if inside < count else 1.0
    return Coverage(level, count, inside, inside / count, low, high, float(square.mean()) / 3)


def _luck_of_maximum(
    count: int, *, cdf: Callable[[float], float], inverse: Callable[[float], float]
) -> Luck:
    """Return mean and 95 % interval of the maximum of `count` positive values.

    `inverse` takes the upper tail's probability.
    """

    def quantile(probability: float) -> float:
        return inverse(float(-np.expm1(np.log(probability) / count)))

    # the mean of a positive value is the integral of its survival function
    mean, _ = integrate.quad(lambda x: 1 - cdf(x) ** count, 0, quantile(1 - 1e-12), limit=200)
    return Luck(float(mean), quantile(0.025), quantile(0.975))
