"""Normal equations of the refinement of windows, and the uncertainty that follows from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import FloatArray
from closerange.matching.window_images import FINER_NOISE

LEAST_SLOPE = 0.3
"""Least mean slope of the influence of a residual, per weight: 0.7 for Gaussian residuals."""

MOST_NOISE = 0.8
"""Largest share of the squares of derivatives that is taken for noise."""

GREY_VARIANCE = 1 / 12
"""Least variance of a difference of grey values: they are whole numbers."""


Pixels = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Windows as the second image shows them; `steps` are those of the middle, as columns."""

    values: Pixels
    along: Pixels
    across: Pixels
    weight: Pixels
    steps: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """Normal equations of windows and what they are made of.

    Unknown are the shift along the curve, its change per px in x and y, gain, offset, and the shift
    across the curve. `along`, `grey` and `across` are the derivatives of the error by the first, by
    minus the fourth and by the last of them.
    """

    normal: FloatArray
    right: FloatArray
    along: Pixels
    grey: Pixels
    across: Pixels
    place: Pixels
    trust: Pixels
    error: Pixels
    prior: FloatArray
    weight: Pixels
    spread: FloatArray
    gross: Pixels


def squares(
    weight: Pixels, along: Pixels, grey: Pixels, across: Pixels, place: Pixels
) -> FloatArray:
    """Return the weighted sums of the products of all derivatives, shape (N, 6, 6).

    Parameters
    ----------
    weight : ndarray of float32, shape (N, P)
        Of the pixels.
    along, grey, across : ndarray of float32, shape (N, P)
        As `System` has them.
    place : ndarray of float32, shape (P, 6)
        1, x, y, x x, x y, y y of the pixels.
    """
    result = np.empty((len(weight), 6, 6))
    by_along, by_across, by_grey = weight * along, weight * across, weight * grey
    second = (by_along * along) @ place
    result[:, 0, :3] = second[:, :3]
    result[:, 1, 1:3], result[:, 2, 2] = second[:, 3:5], second[:, 5]
    result[:, :3, 3] = -((by_along * grey) @ place[:, :3])
    result[:, :3, 4] = -(by_along @ place[:, :3])
    result[:, :3, 5] = (by_along * across) @ place[:, :3]
    result[:, 3, 3] = np.einsum("np,np->n", by_grey, grey)
    result[:, 3, 4], result[:, 4, 4] = by_grey.sum(axis=1), weight.sum(axis=1)
    result[:, 3, 5] = -np.einsum("np,np->n", by_grey, across)
    result[:, 4, 5] = -by_across.sum(axis=1)
    result[:, 5, 5] = np.einsum("np,np->n", by_across, across)
    row, column = np.tril_indices(6, -1)
    result[:, row, column] = result[:, column, row]
    return result


def right_side(system: System) -> FloatArray:
    """Return the right side of the normal equations but for the priors, shape (N, 6)."""
    result = np.empty((len(system.error), 6))
    drawn = system.trust * system.error
    result[:, :3] = -((drawn * system.along) @ system.place[:, :3])
    result[:, 3] = np.einsum("np,np->n", drawn, system.grey)
    result[:, 4] = drawn.sum(axis=1)
    result[:, 5] = -np.einsum("np,np->n", drawn, system.across)
    return result


def gain_and_offset(grey: Pixels, values: Pixels, weight: Pixels) -> tuple[FloatArray, FloatArray]:
    """Return gain and offset of a straight-line fit of values over grey, shape (N,) each."""
    total = np.maximum(weight.sum(axis=1), 1e-12)
    mean_1 = np.einsum("np,np->n", weight, grey) / total
    mean_2 = np.einsum("np,np->n", weight, values) / total
    apart_1, apart_2 = grey - mean_1[:, None], values - mean_2[:, None]
    shared = np.einsum("np,np,np->n", weight, apart_1, apart_2)
    own = np.einsum("np,np->n", weight, apart_1**2)
    other = np.einsum("np,np->n", weight, apart_2**2)
    # a start a pixel off has little correlation: the ratio of contrasts is the better gain
    ratio = np.sqrt(other / np.maximum(own, 1e-12))
    gain = np.clip(np.maximum(shared / np.maximum(own, 1e-12), 0.5 * ratio), 0.05, 20.0)
    return gain.astype(np.float64), (mean_2 - gain * mean_1).astype(np.float64)


def spread(error: Pixels, weight: Pixels) -> FloatArray:
    """Return the standard deviation of the residuals, blind to the worse half, shape (N,)."""
    counted = weight > 0.1
    ordered = np.sort(np.where(counted, np.abs(error), np.float32(np.inf)), axis=1)
    count = counted.sum(axis=1)
    rows = np.arange(len(error))
    lower, upper = (ordered[rows, np.maximum(n, 0) // 2] for n in (count - 1, count))
    upper = np.where(np.isfinite(upper), upper, lower)
    middle = np.where(count > 0, 1.4826 * 0.5 * (lower.astype(np.float64) + upper), 1.0)
    return np.asarray(np.maximum(middle, np.sqrt(GREY_VARIANCE)))


def inverse_covariance(matrix: FloatArray) -> FloatArray:
    """Invert 2 x 2 covariances; those of cameras that see no tilt are held fast."""
    size = np.trace(matrix, axis1=1, axis2=2)[:, None, None]
    return np.asarray(np.linalg.inv(matrix + np.eye(2) * np.maximum(1e-6 * size, 1e-10)))


def noise_part(
    normal: FloatArray,
    trust: Pixels,
    variance: FloatArray,
    steps: FloatArray,
    place: Pixels,
) -> FloatArray:
    """Return what the noise in the derivatives of the first image adds to the squares.

    It tells nothing about the shift: with it left in, weak texture seems to be strong.

    Parameters
    ----------
    normal : ndarray, shape (N, 6, 6)
        From which it is to be taken; a part of each square is left.
    trust : ndarray, shape (N, P)
        Weights of the pixels.
    variance : ndarray, shape (N,)
        Of the noise of the first image's pixels, in grey values of the second.
    steps : ndarray, shape (N, 2, 2)
        Columns: the steps in the first image that shifts along and across the curve make.
    place : ndarray, shape (P, 6)
        1, x, y, x x, x y, y y of the pixels from the middle of the window, px of the images.
    """
    sums = trust @ place
    moments = sums[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
    products = FINER_NOISE * variance[:, None, None] * steps.transpose(0, 2, 1) @ steps
    part = np.zeros_like(normal)
    part[:, :3, :3] = products[:, :1, :1] * moments
    part[:, 5, 5] = products[:, 1, 1] * moments[:, 0, 0]
    part[:, 5, :3] = products[:, 0, 1, None] * moments[:, 0]
    part[:, :3, 5] = part[:, 5, :3]
    own = [0, 1, 2, 5]
    share = (part[:, own, own] / np.maximum(normal[:, own, own], 1e-12)).max(axis=1)
    return np.asarray(part * (MOST_NOISE / np.maximum(share, MOST_NOISE))[:, None, None])


def shift_std(system: System) -> FloatArray:
    """Return the standard deviation of the shift, px: noise, misfit and unknown tilt."""
    # the variance of an M-estimate: squares of the influence over its slope, and more where
    # neighbouring residuals are alike, be it that noise was interpolated or the plane does
    # not fit
    weight, trust, error = system.weight, system.trust, system.error
    far = (error / system.gross) ** 2
    slope = np.einsum("np,np->n", weight, (1 - 3 * far) / (1 + far) ** 3)
    slope = np.maximum(slope / np.maximum(trust.sum(axis=1), 1e-12), LEAST_SLOPE)
    doubled = np.maximum((trust**2).sum(axis=1), 1e-12)
    count = np.maximum(trust.sum(axis=1), 1e-12) ** 2 / doubled
    variance = np.einsum("np,np->n", trust**2, error**2) / doubled / slope**2
    variance = np.maximum(variance, GREY_VARIANCE) * count / np.maximum(count - 6, 1.0)
    inverse = np.linalg.inv(system.normal)
    middle = squares(trust**2, system.along, system.grey, system.across, system.place)
    middle *= (_alike(system) * variance)[:, None, None]
    middle += system.prior * system.spread[:, None, None] ** 2
    cov = inverse @ middle @ inverse
    return np.asarray(np.sqrt(np.maximum(cov[:, 0, 0], 0.0)))


def _alike(system: System) -> FloatArray:
    """Return by how much correlation enlarges the variance of a mean of the residuals."""
    side = int(np.sqrt(system.error.shape[1]))
    error = (system.error * np.sqrt(system.trust)).reshape(-1, side, side)
    own = np.maximum((error**2).sum(axis=(1, 2)), 1e-12)
    alike: FloatArray = np.ones(len(own))
    for turned in (error, error.transpose(0, 2, 1)):
        lags = [(turned[:, lag:] * turned[:, :-lag]).sum(axis=(1, 2)) / own for lag in (1, 2)]
        alike = alike * np.maximum(1 + 2 * (lags[0] + lags[1]), 1.0)
    return alike
